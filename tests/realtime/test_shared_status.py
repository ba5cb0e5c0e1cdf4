"""The numbers that detector and controller share."""

import math

from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.shared_status import REMEMBERED, DetectorStatus, SharedStatus
from tests.patience import PATIENCE_S

NUMBER = st.floats(-1e12, 1e12)


@given(
    slips=st.integers(0, 2**40),
    displacement=st.tuples(*[NUMBER] * (len(SlipSignal._fields) - 1)),
    times=st.tuples(NUMBER, NUMBER, NUMBER),
    slices=st.integers(0, 2**40),
    slip_us=st.lists(NUMBER, max_size=REMEMBERED + 5),
)
def test_what_is_published_is_what_is_seen(
    slips: int, displacement: tuple[float, ...], times: tuple[float, ...], slices: int, slip_us: list[float]
) -> None:
    """Assert that a status comes out as it went in, but for times of slip longer ago than are remembered."""
    shared = SharedStatus()
    assert shared.latest() is None
    slips = max(slips, len(slip_us)) if len(slip_us) >= REMEMBERED else len(slip_us)
    status = DetectorStatus(SlipSignal(slips, *displacement), slices, *times, tuple(slip_us))
    shared.publish(status)
    assert shared.latest() == status._replace(slip_us=tuple(slip_us[-REMEMBERED:]))


@given(slices=st.lists(st.booleans(), max_size=60), reads=st.lists(st.integers(0, 60), max_size=8))
def test_earliest_news_of_slip(slices: list[bool], reads: list[int]) -> None:
    """Assert that a reader learns when the first slice with slip began that it has not seen, if it is remembered.

    Slices last 1000 us.
    """
    shared = SharedStatus()
    known: list[float] = []
    seen = last = 0
    for index, slipping in enumerate(slices):
        if slipping:
            known.append(1000.0 * index)
        shared.publish(DetectorStatus(SlipSignal(len(known)), index + 1, 0.0, 0.0, 0.0, tuple(known)))
        if index in reads:
            status = shared.latest()
            assert status is not None
            news = [1000.0 * k for k in range(last, index + 1) if slices[k]][-REMEMBERED:]
            began = status.slip_began_us(seen)
            assert began == news[0] if news else math.isnan(began)
            seen, last = status.signal.slips, index + 1


def test_the_detector_is_told_of_the_gripper() -> None:
    """Assert that position and goal of the last step are those that the controller told, and there are none before."""
    shared = SharedStatus()
    assert shared.gripper is None
    for told in ((300.0, 310.0), (301.0, 305.0)):
        shared.tell_gripper(*told)
        assert shared.gripper == told
    assert shared.latest() is None and not shared.opening  # its place is its own


def test_stop() -> None:
    """Assert that the order to stop stays."""
    shared = SharedStatus()
    assert not shared.stopping
    shared.stop()
    assert shared.stopping
    assert shared.latest() is None


def test_two_fingers() -> None:
    """Assert that nothing is known before both fingers are, that each has a status of its own, and slip of both counts.

    The earliest news of slip is that of the finger that slipped.
    """
    shared = SharedStatus(2)
    statuses = [
        DetectorStatus(SlipSignal(slips, 0.5, sticking_share=0.5), 7 + slips, 1.0, 2.0, 3.0, (4.0,) * slips)
        for slips in (0, 1)
    ]
    shared.publish(statuses[0])
    assert shared.latest() is None
    shared.publish(statuses[1], finger=1)
    latest = shared.latest()
    assert latest == statuses[0]._replace(second=statuses[1])
    assert latest is not None and latest.control_signal.slips == 1
    assert [each.slices for each in latest.fingers] == [7, 8]
    assert math.isnan(latest.slip_began_us(0)) and latest.fingers[1].slip_began_us(0) == 4.0
    assert shared.slip_wake.wait(PATIENCE_S)
