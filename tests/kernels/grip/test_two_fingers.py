"""What the law is told of two fingers."""

import math

import pytest

from evetac_cli.kernels.grip.control import Control, SlipSignal, both_fingers, make_law
from evetac_cli.kernels.grip.paper import GraspPhase


def test_slip_of_either_is_slip() -> None:
    """Assert that the law sees slip in a step exactly where one of both fingers slips since the step before."""
    counts = [(0, 0), (1, 0), (1, 0), (1, 2), (1, 2), (3, 3)]
    control, seen = Control(make_law("paper")), []
    for first, second in counts:
        control.step(GraspPhase.LIFT, both_fingers(SlipSignal(first), SlipSignal(second)), 400)
        seen.append(control.slip)
    assert seen == [False, True, False, True, False, True]


@pytest.mark.parametrize("share", [0.5, 0.8, 1.0])
def test_load_is_half_of_what_both_carry(share: float) -> None:
    """Assert that load and turn are as of two fingers that carry alike, however the weight is shared.

    The second image shows what goes down, and how the object turns, the other way round.
    """
    x_px, y_px, turn_px = 2.0, 0.6, 0.3
    first, second = (
        SlipSignal(0, 0.1, *(2 * part * each for each in (x_px, y_px, turn_px))) for part in (share, 1 - share)
    )
    faced = second._replace(mean_displacement_y_px=-second.mean_displacement_y_px, turn_px=-second.turn_px)
    told = both_fingers(first, faced)
    assert told[2:5] == pytest.approx((x_px, y_px, turn_px))


def test_the_finger_nearer_to_slip_counts() -> None:
    """Assert that the smaller sticking share and the larger probability are told, and what is not known is left out."""
    nan = math.nan
    for first, second, told in (((0.2, 0.9), (0.7, 0.4), (0.7, 0.4)), ((0.2, nan), (nan, 0.4), (0.2, 0.4))):
        given = [SlipSignal(probability=each[0], sticking_share=each[1]) for each in (first, second)]
        found = both_fingers(*given)
        assert (found.probability, found.sticking_share) == told
    assert math.isnan(both_fingers(SlipSignal(), SlipSignal()).probability)
