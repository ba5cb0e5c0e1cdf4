"""The choice of checkpoint and threshold on validation trajectories."""

import numpy as np
import pytest

from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.kernels.slip.threshold import THRESHOLDS, choose_threshold
from tests.kernels.slip.test_metrics import prediction


def test_grid_is_the_papers_and_finer_near_one() -> None:
    """Assert that thresholds run from 0 to 1 by 0.025, both included, and by less from 0.975 on."""
    assert (THRESHOLDS[0], THRESHOLDS[20], THRESHOLDS[-1]) == (0.0, 0.5, 1.0)
    coarse = THRESHOLDS[:40]
    assert coarse[-1] == 0.975
    np.testing.assert_allclose(np.diff(coarse), 0.025, rtol=1e-12)
    assert (np.diff(THRESHOLDS[39:]) > 0).all()
    assert np.diff(THRESHOLDS[39:]).max() < 0.01


def staircase(noise: float, slip_says: float) -> list[Prediction]:
    """Give one trajectory that says `noise` before its onset and `slip_says` after it."""
    says = np.where(np.arange(200) < 100, noise, slip_says)
    return [Prediction(says, (np.arange(200) >= 100).astype(np.int8), 100)]


def test_tie_goes_to_the_lower_threshold() -> None:
    """Assert that of all thresholds between noise and slip, which score 1 alike, the lowest is chosen."""
    choice = choose_threshold([staircase(0.31, 0.8)])
    assert (choice.checkpoint, choice.threshold, choice.score) == (0, 0.325, 1.0)


def test_tie_goes_to_the_later_checkpoint() -> None:
    """Assert that of two checkpoints with the same score the later is chosen, though its threshold is higher."""
    choice = choose_threshold([staircase(0.31, 0.8), staircase(0.51, 0.8), staircase(0.9, 0.1)])
    assert (choice.checkpoint, choice.threshold, choice.score) == (1, 0.525, 1.0)


def test_only_the_last_three_checkpoints_are_chosen_from() -> None:
    """Assert that a perfect fourth-last checkpoint is reported and passed over."""
    poor = [prediction(200, 100, 110)]
    choice = choose_threshold([staircase(0.31, 0.8), poor, [prediction(200, 100, 105)], poor])
    assert choice.scores[0] == 1.0
    assert choice.thresholds[0] == 0.325
    assert choice.checkpoint == 2
    assert choice.score == choice.scores[2] == pytest.approx((1 + 30 / 35) / 2)
    assert len(choice.scores) == len(choice.thresholds) == 4


def test_choice_weighs_timing_and_f1() -> None:
    """Assert that a threshold that is too early but catches all loses to one in time that misses some."""
    says = np.zeros(200)
    says[30:110] = 0.4  # above 0.4: in time, 10 of 20 slices; up to 0.4: 70 ms early, all slices and 70 false
    says[110:] = 0.9
    choice = choose_threshold([[Prediction(says, (np.arange(200) >= 100).astype(np.int8), 100)]])
    assert choice.threshold == pytest.approx(0.425)
    assert choice.score == pytest.approx((1 + 2 * 10 / 30) / 2)


def test_choice_needs_slip_and_checkpoints() -> None:
    """Assert that validation without a slip, or without a checkpoint, is refused."""
    with pytest.raises(ValueError, match="onset"):
        choose_threshold([[prediction(50, -1, 20)]])
    with pytest.raises(ValueError, match="checkpoint"):
        choose_threshold([])


def of_labels(says: float, label: list[int], onset: int) -> Prediction:
    """A detector that says the same of every slice."""
    return Prediction(np.full(len(label), says, np.float32), np.array(label, np.int8), onset)


@pytest.mark.parametrize(
    ("predictions", "threshold", "detected", "slips"),
    [
        (staircase(0.31, 0.8), 0.325, 0.5, 0.5),
        ([of_labels(0.4, [0] * 100 + [1] * 20, 100)], 0.0, 1.0, 20 / 120),  # the same of every slice
        ([of_labels(0.4, [1] * 20, 0)], 0.0, 1.0, 1.0),  # no slice without slip
        ([of_labels(0.4, [-1] * 80 + [0] * 20 + [1] * 20 + [-1] * 9, 100)], 0.0, 1.0, 0.5),  # not examined: not counted
        (
            [*staircase(0.31, 0.8), of_labels(0.1, [0] * 200, -1)],
            0.325,
            0.25,
            0.25,
        ),
    ],
)
def test_how_much_is_detected_is_said(
    predictions: list[Prediction], threshold: float, detected: float, slips: float
) -> None:
    """Assert the shares of the examined slices that are detected at the chosen threshold, and that slip."""
    choice = choose_threshold([predictions])
    assert choice.threshold == threshold
    assert (choice.detected_share, choice.slip_share) == pytest.approx((detected, slips))


def test_slices_before_the_history_is_full_do_not_count() -> None:
    """Assert that a slice without a probability is in neither share."""
    (whole,) = staircase(0.31, 0.8)
    says = whole.probability.copy()
    says[:50] = np.nan
    choice = choose_threshold([[Prediction(says, whole.label, whole.onset)]])
    assert (choice.detected_share, choice.slip_share) == pytest.approx((100 / 150, 100 / 150))
