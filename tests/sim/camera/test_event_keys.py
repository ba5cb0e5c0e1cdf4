"""Events as integers: nothing is lost on the way to sorted columns."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.sim.camera.event_keys import event_key, sorted_columns

EVENT = st.tuples(st.integers(0, 999), st.integers(0, 65535), st.integers(0, 65535), st.booleans())


@given(events=st.lists(EVENT, max_size=90), t0_us=st.integers(0, 2**40))
def test_columns_are_the_events_by_time(events: list[tuple[int, int, int, bool]], t0_us: int) -> None:
    """Assert that keys become the very events, sorted by time, those of one time in the order in which they came."""
    keys = np.array([event_key(*event) for event in events], np.int64)
    t, x, y, p = sorted_columns(keys, t0_us)
    result = list(zip((t - t0_us).tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True))
    assert result == [(time, x, y, int(p)) for time, x, y, p in sorted(events, key=lambda event: event[0])]
