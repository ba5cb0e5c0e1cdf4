"""Slip timing, outcomes and F1, against hand counts and scikit-learn; the choice of checkpoint and threshold."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import f1_score, precision_score, recall_score

from evetac_cli.kernels.slip import metrics
from evetac_cli.kernels.slip.metrics import THRESHOLDS, Prediction, choose_threshold, shift_labels


def prediction(slices: int, onset: int, first: int, object: str = "", probability: float = 1.0) -> Prediction:
    """Slip from `onset` on, and detections of one probability from `first` on (-1: none)."""
    label = np.zeros(slices, np.int8)
    says = np.zeros(slices, np.float32)
    if onset >= 0:
        label[onset:] = 1
    if first >= 0:
        says[first:] = probability
    return Prediction(says, label, onset, object)


def test_shifted_labels_are_scored_against_the_unshifted_onset() -> None:
    """Assert that a detection 10 ms ahead is right for labels shifted by 10 ms, and is timed from the onset itself."""
    label = (np.arange(200) >= 100).astype(np.int8)
    says = (np.arange(200) >= 90).astype(np.float32)
    row = metrics.score([Prediction(says, shift_labels(label, 10), 100)], 0.5)
    assert (row["f1"], row["slip_correct"], row["true_positives"]) == (1, 1, 30)
    late = metrics.score([Prediction(says, label, 100)], 0.5)
    assert late["f1"] == pytest.approx(2 * 20 / (2 * 20 + 10))


def test_onset_is_the_first_detection() -> None:
    """Assert that onset is the first True, -1 where there is none, also in an empty recording."""
    assert metrics.onset(np.array([False, False, True, False, True])) == 2
    assert metrics.onset(np.array([True])) == 0
    assert metrics.onset(np.zeros(9, bool)) == -1
    assert metrics.onset(np.zeros(0, bool)) == -1


@pytest.mark.parametrize(
    ("shift", "verdict"),
    [(-1000, "early"), (-51, "early"), (-50, "correct"), (0, "correct"), (20, "correct"), (21, "late"), (900, "late")],
)
def test_timing_window_includes_both_ends(shift: int, verdict: str) -> None:
    """Assert that -50 and +20 ms are correct and one slice beyond either is not."""
    assert metrics.timing(2000 + shift, 2000) == verdict


def test_counts_end_twenty_slices_after_the_onset() -> None:
    """Assert that the cut keeps the slices [0, onset + 20)."""
    label = np.r_[np.zeros(100, np.int8), np.ones(50, np.int8)]
    detected = np.zeros(150, bool)
    detected[119] = True
    assert metrics.counts(label, detected, 100) == (1, 0, 19)
    detected[120:] = True
    assert metrics.counts(label, detected, 100) == (1, 0, 19)
    assert metrics.counts(label, detected, -1) == (31, 0, 19)


@given(st.data())
def test_f1_is_scikit_learns(data: st.DataObject) -> None:
    """Assert that F1, precision and recall agree with scikit-learn over the examined slices before the cut."""
    size = data.draw(st.integers(1, 80))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    label = rng.choice(np.array([-1, 0, 1], np.int8), size)
    detected = rng.random(size) < data.draw(st.floats(0, 1))
    onset = data.draw(st.integers(-1, size - 1))
    counts = metrics.counts(label, detected, onset)
    selected = (label >= 0) & (np.arange(size) < (size if onset < 0 else onset + 20))
    if not selected.any():
        assert counts == (0, 0, 0)
        assert counts.f1 == 0
        return
    truth, says = label[selected], detected[selected].astype(np.int8)
    for ours, theirs in ((counts.f1, f1_score), (counts.precision, precision_score), (counts.recall, recall_score)):
        assert ours == pytest.approx(theirs(truth, says, zero_division=0), abs=1e-12)


def test_slices_before_the_history_is_full_are_no_samples() -> None:
    """Assert that NaN probabilities are no detection and no miss, though the slice is labelled."""
    label = np.ones(6, np.int8)
    says = np.array([np.nan, np.nan, 1, 0, 1, 1], np.float32)
    assert Prediction(says, label, 0).counts(0.5) == (3, 0, 1)
    assert metrics.onset(Prediction(says, label, 0).detected(0.0)) == 2


@pytest.mark.parametrize("says", [[0.1, 1.1, np.nan], [0.1, -0.1, 0.2], [0.1, 0.2, np.inf]])
def test_impossible_probabilities_are_refused(says: list[float]) -> None:
    """Assert that a prediction holds probabilities, or NaN anywhere."""
    Prediction(np.array([np.nan, 0.0, np.nan]), np.zeros(3, np.int8), -1)
    with pytest.raises(ValueError, match="probabilities"):
        Prediction(np.array(says), np.zeros(3, np.int8), -1)


def test_score_of_hand_made_trajectories() -> None:
    """Assert that shares, F1 by object and pooled F1 are those counted by hand."""
    row = metrics.score(
        [
            prediction(200, 100, 100, "a"),  # correct, 20 of 20 slices
            prediction(200, 100, 110, "a"),  # correct, 10 of 20
            prediction(200, 100, -1, "b"),  # late, 0 of 20
            prediction(200, 100, 40, "b"),  # early, 20 of 20 and 60 false
            prediction(200, -1, 199, "b"),  # no slip: one false alarm
        ],
        0.5,
    )
    a = 2 * 30 / (2 * 30 + 10)
    b = 2 * 20 / (2 * 20 + 61 + 20)
    assert (row["slips"], row["trajectories"], row["objects"], row["alarms_without_slip"]) == (4, 5, 2, 1)
    assert (row["slip_early"], row["slip_correct"], row["slip_late"]) == (0.25, 0.5, 0.25)
    assert (row["true_positives"], row["false_positives"], row["false_negatives"]) == (50, 61, 30)
    assert row["f1"] == pytest.approx((a + b) / 2)
    assert row["f1_pooled"] == pytest.approx(2 * 50 / (2 * 50 + 61 + 30))
    assert row["precision"] == pytest.approx(50 / 111)
    assert row["recall"] == pytest.approx(50 / 80)


def test_an_onset_that_labels_cannot_tell_is_not_timed() -> None:
    """Assert that timing is that of the other trajectories, and that a detection is then no alarm without slip."""
    sure, unsure = prediction(200, 100, 95), prediction(200, 100, 20)
    assert metrics.score([sure, unsure], 0.5)["slip_early"] == 0.5
    row = metrics.score([sure, dataclasses.replace(unsure, timed=False)], 0.5)
    assert (row["slips"], row["slip_correct"], row["alarms_without_slip"], row["trajectories"]) == (1, 1.0, 0, 2)


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


def test_choice_needs_slip() -> None:
    """Assert that validation without a slip is refused."""
    with pytest.raises(ValueError, match="onset"):
        choose_threshold([[prediction(50, -1, 20)]])


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
