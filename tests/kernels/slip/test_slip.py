"""Architectures, slip timing, F1 and the choice of a threshold."""

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import f1_score, precision_score, recall_score

from evetac_cli.kernels.slip import slip
from evetac_cli.kernels.slip.slip import ARCHITECTURES, DotArchitecture, ImageArchitecture, Prediction, View

# the paper's table of model configurations: history, l_i, l_fc1, l_fc2
PAPER_ROWS = {
    "no-hist": (1, 2, 10, 4),
    "hist10": (10, 20, 12, 4),
    "events-only": (10, 10, 8, 4),
    "disp-only": (10, 10, 8, 4),
    "hist20": (20, 40, 20, 8),
    "down5": (50, 20, 12, 4),
    "fast-slow": (50, 30, 15, 8),
}


def prediction(slices: int, onset: int, first: int, object: str = "", probability: float = 1.0) -> Prediction:
    """Slip from `onset` on, and detections of one probability from `first` on (-1: none)."""
    label = np.zeros(slices, np.int8)
    says = np.zeros(slices, np.float32)
    if onset >= 0:
        label[onset:] = 1
    if first >= 0:
        says[first:] = probability
    return Prediction(says, label, onset, object)


def test_module_needs_no_torch() -> None:
    """Assert that grasp can learn a model's history without torch."""
    code = "import sys, evetac_cli.kernels.slip.slip; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", PAPER_ROWS)
def test_dot_models_are_the_papers(name: str) -> None:
    """Assert that each dot model of the paper is one row of the table, with the paper's history and widths."""
    row = ARCHITECTURES[name]
    assert isinstance(row, DotArchitecture)
    assert (row.history, row.inputs_per_dot, row.fc1, row.fc2) == PAPER_ROWS[name]
    assert row.every == (5 if name == "down5" else 1)


@pytest.mark.parametrize(("name", "history"), [("no-hist-img", 1), ("hist10-img", 10)])
def test_image_models_are_the_papers(name: str, history: int) -> None:
    """Assert that the baselines see 540 x 480 px with the paper's pools, and their small forms 90 x 80."""
    row, small = ARCHITECTURES[name], ARCHITECTURES[name + "-6x6"]
    assert isinstance(row, ImageArchitecture)
    assert isinstance(small, ImageArchitecture)
    assert row.input_shape == (history, 480, 540)
    assert row.pools == ((3, 3), (3, 3), (4, 4), (9, 7))
    assert small.input_shape == (history, 80, 90)


@pytest.mark.parametrize("row", ARCHITECTURES.values(), ids=ARCHITECTURES)
def test_train_cut_follows_history(row: slip.Architecture) -> None:
    """Assert that longer histories train on more of the slip, with the paper's three values."""
    assert row.train_cut_ms == {1: 15, 10: 15, 20: 20, 50: 50}[row.history]


def test_columns_of_a_channel() -> None:
    """Assert that the inputs of a dot are its views one after the other."""
    row = DotArchitecture("", (View("events", 3), View("x", 1, 5, 2), View("y", 1, 5, 2)), 1, 1)
    assert [row.columns_of(channel) for channel in ("events", "x", "y")] == [slice(0, 3), slice(3, 6), slice(6, 9)]
    assert row.columns_of("distance") == slice(0, 0)
    assert (row.history, row.inputs_per_dot) == (10, 9)


HIST10 = DotArchitecture("hist10", (View("distance", 10), View("events", 10)), 12, 4)


@pytest.mark.parametrize(
    "change",
    [
        {"views": ()},
        {"views": (View("events", 1), View("events", 2))},
        {"views": (View("colour", 1),)},
        {"views": (View("events", -1, 1, 3),)},
        {"views": (View("events", 0),)},
        {"views": (View("events", 1, 0, 1),)},
        {"views": (View("events", 0, 2, 2, change=True),)},
        {"views": (View("x", 1),)},
        {"views": (View("x", 1), View("y", 2))},
        {"fc1": 0},
        {"every": 0},
    ],
)
def test_impossible_architectures_are_refused(change: dict[str, Any]) -> None:
    """Assert that a row that cannot be built, or whose inputs cannot be rotated, is refused when it is written."""
    assert replace(HIST10) == HIST10
    with pytest.raises(ValueError, match="found"):
        replace(HIST10, **change)


def test_labels_shifted_by_hand() -> None:
    """Assert that slip is labelled earlier by the shift, and that what is not known stays as it was."""
    label = np.array([-1, -1, 0, 0, 0, 0, 1, 1, 1, -1], np.int8)
    assert slip.shift(label, 0).tolist() == label.tolist()
    assert slip.shift(label, 2).tolist() == [-1, -1, 0, 0, 1, 1, 1, 1, 1, -1]
    assert slip.shift(label, 50).tolist() == label.tolist()
    assert slip.shift(label[:0], 3).tolist() == []
    with pytest.raises(ValueError, match="at least 0, found -1"):
        slip.shift(label, -1)


@given(onset=st.integers(0, 80), horizon_ms=st.integers(0, 30), after=st.integers(1, 40), start=st.integers(0, 40))
def test_shift_moves_the_onset_alone(onset: int, horizon_ms: int, after: int, start: int) -> None:
    """Assert that of labels with one onset, it comes ahead by the shift, as far as slices are examined."""
    slices = np.arange(120)
    label = np.where(slices < start, -1, np.where(slices < onset, 0, 1)).astype(np.int8)
    label[onset + after :] = -1
    shifted = slip.shift(label, horizon_ms)
    np.testing.assert_array_equal(shifted == -1, label == -1)
    expected = (label >= 0) & (slices >= onset - horizon_ms)
    if horizon_ms <= after:  # else the labels end before slices that far ahead of slip see it
        np.testing.assert_array_equal(shifted == 1, expected | (label == 1))


def test_shifted_labels_are_scored_against_the_unshifted_onset() -> None:
    """Assert that a detection 10 ms ahead is right for labels shifted by 10 ms, and is timed from the onset itself."""
    label = (np.arange(200) >= 100).astype(np.int8)
    says = (np.arange(200) >= 90).astype(np.float32)
    row = slip.score([Prediction(says, slip.shift(label, 10), 100)], 0.5)
    assert (row["f1"], row["slip_correct"], row["true_positives"]) == (1, 1, 30)
    late = slip.score([Prediction(says, label, 100)], 0.5)
    assert late["f1"] == pytest.approx(2 * 20 / (2 * 20 + 10))


def test_onset_is_the_first_detection() -> None:
    """Assert that onset is the first True, -1 where there is none, also in an empty recording."""
    assert slip.onset(np.array([False, False, True, False, True])) == 2
    assert slip.onset(np.array([True])) == 0
    assert slip.onset(np.zeros(9, bool)) == -1
    assert slip.onset(np.zeros(0, bool)) == -1


def test_onset_wants_decisions() -> None:
    """Assert that probabilities are not taken for detections."""
    with pytest.raises(ValueError, match="bool"):
        slip.onset(np.array([0.2, 0.9]))


@pytest.mark.parametrize(
    ("shift", "verdict"),
    [(-1000, "early"), (-51, "early"), (-50, "correct"), (0, "correct"), (20, "correct"), (21, "late"), (900, "late")],
)
def test_timing_window_includes_both_ends(shift: int, verdict: str) -> None:
    """Assert that -50 and +20 ms are correct and one slice beyond either is not."""
    assert slip.timing(2000 + shift, 2000) == verdict


def test_no_detection_is_late() -> None:
    """Assert that a missed slip is late, even right after the start where -1 would lie within the window."""
    assert slip.timing(-1, 2000) == "late"
    assert slip.timing(-1, 10) == "late"


def test_timing_needs_an_onset() -> None:
    """Assert that timing against no onset is refused."""
    with pytest.raises(ValueError, match="-1, found|found -1"):
        slip.timing(5, -1)


def test_counts_end_twenty_slices_after_the_onset() -> None:
    """Assert that the cut keeps the slices [0, onset + 20)."""
    label = np.r_[np.zeros(100, np.int8), np.ones(50, np.int8)]
    detected = np.zeros(150, bool)
    detected[119] = True
    assert slip.counts(label, detected, 100) == (1, 0, 19)
    detected[120:] = True
    assert slip.counts(label, detected, 100) == (1, 0, 19)
    assert slip.counts(label, detected, -1) == (31, 0, 19)


def test_unexamined_slices_never_count() -> None:
    """Assert that a label of -1 is neither right nor wrong, whatever was detected."""
    label = np.array([-1, 0, 0, 1, 1, -1], np.int8)
    for detected in (True, False):
        verdict = np.array([detected, True, False, True, False, detected])
        assert slip.counts(label, verdict, 3) == (1, 1, 1)


@given(st.data())
def test_f1_is_scikit_learns(data: st.DataObject) -> None:
    """Assert that F1, precision and recall agree with scikit-learn over the examined slices before the cut."""
    size = data.draw(st.integers(1, 80))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    label = rng.choice(np.array([-1, 0, 1], np.int8), size)
    detected = rng.random(size) < data.draw(st.floats(0, 1))
    onset = data.draw(st.integers(-1, size - 1))
    counts = slip.counts(label, detected, onset)
    kept = (label >= 0) & (np.arange(size) < (size if onset < 0 else onset + 20))
    if not kept.any():
        assert counts == (0, 0, 0)
        assert slip.f1(label, detected, onset) == 0
        return
    truth, said = label[kept], detected[kept].astype(np.int8)
    for ours, theirs in ((counts.f1, f1_score), (counts.precision, precision_score), (counts.recall, recall_score)):
        assert ours == pytest.approx(theirs(truth, said, zero_division=0), abs=1e-12)
    assert slip.f1(label, detected, onset) == counts.f1


def test_f1_is_the_harmonic_mean() -> None:
    """Assert that precision 1 and recall 1/4 give 0.4, where their geometric mean would be 0.5."""
    label = np.array([1, 1, 1, 1, 0], np.int8)
    assert slip.f1(label, np.array([True, False, False, False, False]), 0) == pytest.approx(0.4)


def test_impossible_labels_are_refused() -> None:
    """Assert that labels beyond -1..1, onsets beyond the recording and mismatched lengths are refused."""
    label = np.zeros(5, np.int8)
    with pytest.raises(ValueError, match="labels"):
        slip.counts(np.full(5, 2, np.int8), np.zeros(5, bool), -1)
    with pytest.raises(ValueError, match="onset"):
        slip.counts(label, np.zeros(5, bool), 5)
    with pytest.raises(ValueError, match="detections"):
        slip.counts(label, np.zeros(4, bool), 0)


def test_slices_before_the_history_is_full_are_no_samples() -> None:
    """Assert that NaN probabilities are no detection and no miss, though the slice is labelled."""
    label = np.ones(6, np.int8)
    says = np.array([np.nan, np.nan, 1, 0, 1, 1], np.float32)
    assert Prediction(says, label, 0).counts(0.5) == (3, 0, 1)
    assert slip.onset(Prediction(says, label, 0).detected(0.0)) == 2


@pytest.mark.parametrize(
    "says", [[0.1, np.nan, 0.2], [0.1, 1.1, 0.2], [0.1, -0.1, 0.2], [0.1, 0.2, np.inf], [0.1, 0.2]]
)
def test_impossible_probabilities_are_refused(says: list[float]) -> None:
    """Assert that a prediction holds probabilities, NaN at its start only."""
    with pytest.raises(ValueError, match="probabilities"):
        Prediction(np.array(says), np.zeros(3, np.int8), -1)


def test_threshold_is_reached_not_passed() -> None:
    """Assert that a float32 probability equal to the threshold counts as slip, for every threshold of the grid."""
    for threshold in slip.THRESHOLDS:
        says = np.array([threshold], np.float32)
        assert Prediction(says, np.zeros(1, np.int8), -1).detected(threshold)[0]


def test_score_of_hand_made_trajectories() -> None:
    """Assert that shares, F1 by object and pooled F1 are those counted by hand."""
    row = slip.score(
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


def test_score_without_slip_has_no_shares() -> None:
    """Assert that where nothing slips the shares are absent rather than a number, and F1 is 0."""
    row = slip.score([prediction(50, -1, 20)], 0.5)
    assert row["slip_correct"] is None
    assert (row["f1"], row["alarms_without_slip"]) == (0, 1)


def test_score_refuses_nothing_and_nonsense() -> None:
    """Assert that no trajectories and thresholds beyond 0..1 are refused."""
    with pytest.raises(ValueError, match="at least one trajectory"):
        slip.score([], 0.5)
    with pytest.raises(ValueError, match="threshold"):
        slip.score([prediction(50, 20, 20)], float("nan"))


def test_grid_is_the_papers() -> None:
    """Assert that thresholds run from 0 to 1 by 0.025, both included."""
    assert len(slip.THRESHOLDS) == 41
    assert (slip.THRESHOLDS[0], slip.THRESHOLDS[20], slip.THRESHOLDS[-1]) == (0.0, 0.5, 1.0)
    np.testing.assert_allclose(np.diff(slip.THRESHOLDS), 0.025, rtol=1e-12)


def staircase(noise: float, slip_says: float) -> list[Prediction]:
    """Give one trajectory that says `noise` before its onset and `slip_says` after it."""
    says = np.where(np.arange(200) < 100, noise, slip_says)
    return [Prediction(says, (np.arange(200) >= 100).astype(np.int8), 100)]


def test_tie_goes_to_the_lower_threshold() -> None:
    """Assert that of all thresholds between noise and slip, which score 1 alike, the lowest is chosen."""
    choice = slip.choose_threshold([staircase(0.31, 0.8)])
    assert (choice.checkpoint, choice.threshold, choice.score) == (0, 0.325, 1.0)


def test_tie_goes_to_the_later_checkpoint() -> None:
    """Assert that of two checkpoints with the same score the later is chosen, though its threshold is higher."""
    choice = slip.choose_threshold([staircase(0.31, 0.8), staircase(0.51, 0.8), staircase(0.9, 0.1)])
    assert (choice.checkpoint, choice.threshold, choice.score) == (1, 0.525, 1.0)


def test_only_the_last_three_checkpoints_are_chosen_from() -> None:
    """Assert that a perfect fourth-last checkpoint is reported and passed over."""
    poor = [prediction(200, 100, 110)]
    choice = slip.choose_threshold([staircase(0.31, 0.8), poor, [prediction(200, 100, 105)], poor])
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
    choice = slip.choose_threshold([[Prediction(says, (np.arange(200) >= 100).astype(np.int8), 100)]])
    assert choice.threshold == pytest.approx(0.425)
    assert choice.score == pytest.approx((1 + 2 * 10 / 30) / 2)


def test_choice_needs_slip_and_checkpoints() -> None:
    """Assert that validation without a slip, or without a checkpoint, is refused."""
    with pytest.raises(ValueError, match="onset"):
        slip.choose_threshold([[prediction(50, -1, 20)]])
    with pytest.raises(ValueError, match="checkpoint"):
        slip.choose_threshold([])
