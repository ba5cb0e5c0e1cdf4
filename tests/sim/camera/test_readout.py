"""From the events of pixels to those that arrive: nothing is lost on the way to sorted columns; a slow readout."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.events import Events, concatenate
from evetac_cli.sim.camera.readout import event_key, sorted_columns
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.setup.scene import LightSettings, LightStep
from tests.sim.camera.small_frames import FRAME, QUIET, line, play, start

DOTS = [[30.0, 40.0]]
PIXELS = FRAME[0] * FRAME[1]


def limited(events_per_s: float) -> camera.CameraModel:
    return dataclasses.replace(QUIET, events_per_s=events_per_s, leak_hz=10.0, noise_rate_hz=100.0)


def flash(events_per_s: float | None, slices: int = 20) -> tuple[camera.CameraState, list[Events]]:
    """A light that becomes ten times as bright at 2 ms: an event of every pixel."""
    model = dataclasses.replace(QUIET, events_per_s=events_per_s)
    change = LightSettings(step=LightStep(at_s=0.002, factor=10.0))
    state = camera.start(model, DOTS, None, np.random.default_rng(0), light_change=change)
    return state, play(state, line(DOTS, 0.0), slices)


def test_without_load_nothing_changes() -> None:
    """Assert that a limit far above what the camera makes leaves every event as it is."""
    one, other = (play(start(DOTS, model), line(DOTS, (0.3, 0.1)), 50) for model in (limited(1e10), limited(3e8)))
    free = play(start(DOTS, dataclasses.replace(limited(1.0), events_per_s=None)), line(DOTS, (0.3, 0.1)), 50)
    for limits in (one, other):
        for mine, theirs in zip(limits, free, strict=True):
            assert all((a == b).all() for a, b in zip(mine, theirs, strict=True))


def test_a_flash_is_read_at_the_limit() -> None:
    """Assert that all pixels' events are read one after another at the limit, in slices of their own, none lost."""
    free = concatenate(flash(None)[1])
    state, slices = flash(1e6)
    assert free.size == PIXELS
    read = concatenate(slices)
    assert state.readout is not None
    assert state.readout.lost == 0
    places = [sorted(zip(events.x.tolist(), events.y.tolist(), strict=True)) for events in (read, free)]
    assert places[0] == places[1]
    assert (np.diff(read.t) == 1).all()
    assert read.t[0] == free.t[0]
    for k, part in enumerate(slices):
        assert ((part.t >= 1000 * k) & (part.t < 1000 * (k + 1))).all()
    assert max(part.size for part in slices) == 1000


def test_what_is_beyond_the_limit_is_lost() -> None:
    """Assert that under lasting load the limit is read, one event a pixel waits, and all others are counted as lost."""
    made = 400.0 * PIXELS * 0.4
    model = dataclasses.replace(QUIET, noise_rate_hz=400.0, events_per_s=made / 0.4 / 4)
    state = start(DOTS, model)
    slices = play(state, line(DOTS, 0.0), 400)
    read = concatenate(slices)
    assert read.size == pytest.approx(made / 4, rel=0.001)
    assert state.readout is not None
    assert state.readout.lost == pytest.approx(made - made / 4 - PIXELS, rel=0.05)
    assert (np.diff(read.t) >= 0).all()
    order = np.lexsort((read.t, read.y, read.x))
    same = (np.diff(read.x[order]) == 0) & (np.diff(read.y[order]) == 0)
    assert np.diff(read.t[order])[same].min() > 0


EVENT = st.tuples(st.integers(0, 999), st.integers(0, 65535), st.integers(0, 65535), st.booleans())


@given(events=st.lists(EVENT, max_size=90), t0_us=st.integers(0, 2**40))
def test_columns_are_the_events_by_time(events: list[tuple[int, int, int, bool]], t0_us: int) -> None:
    """Assert that keys become the very events, sorted by time, those of one time in the order in which they came."""
    keys = np.array([event_key(*event) for event in events], np.int64)
    t, x, y, p = sorted_columns(keys, t0_us)
    result = list(zip((t - t0_us).tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True))
    assert result == [(time, x, y, int(p)) for time, x, y, p in sorted(events, key=lambda event: event[0])]
