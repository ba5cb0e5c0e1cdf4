"""Warnings of detectors in reports: leads, false alarms, calibration, and intervals by object and sensor."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.evaluate.slip.warnings import Judged
from evetac_cli.kernels import estimates
from evetac_cli.kernels.slip.metrics import Prediction


def prediction(object_: str, warned_ms: int | None, alarms: int = 0, sensor: str = "a") -> Prediction:
    """A slip at 2000 that is warned of so long ahead, or none, and so many false alarms of three slices before it."""
    probability, label = np.full(2500, 0.02), np.zeros(2500, np.int8)
    label[2000:] = 1
    if warned_ms is not None:
        probability[2000 - warned_ms - 2 :] = 0.9  # the third slice in a row alarms
    for number in range(alarms):
        probability[300 + 300 * number : 303 + 300 * number] = 0.9
    return Prediction(probability, label, 2000, object_, sensor)


def of_seeds(*seeds: list[Prediction]) -> dict[str, Any]:
    return slip_warnings.columns([[Judged.of(one, 0.8) for one in seed] for seed in seeds], seeds)


def test_columns_by_hand() -> None:
    """Assert leads, warned shares and false alarms of three trials, of which two are of one object."""
    trials = [prediction("1", 30, 1), prediction("1", 7), prediction("2", None, 2)]
    row = of_seeds(trials)
    assert [row[name] for name in slip_warnings.WARNED.values()] == [0.5, 0.5, 0.25, 0.25, 0.0]
    assert row["lead_ms_median"] == 18.5
    quiet = 3 * 1800 / 60_000
    assert row["minutes_without_slip"] == pytest.approx(quiet)
    assert row["false_alarms_per_min"] == pytest.approx(3 / quiet)
    assert row["warned_10_ms_low"] <= 0.25 <= row["warned_10_ms_high"]
    seeds = of_seeds(trials, [prediction("1", None), prediction("1", None), prediction("2", 40)])
    assert seeds["warned_10_ms"] == pytest.approx((0.25 + 0.5) / 2)
    assert seeds["false_alarms_per_min"] == pytest.approx(1.5 / quiet)


def test_a_share_of_none_or_all_keeps_an_interval() -> None:
    """Assert that four trials of two objects, all or none of which are warned of, tell as much as two trials."""
    for warned_ms, share in ((30, 1.0), (None, 0.0)):
        row = of_seeds([prediction(object_, warned_ms) for object_ in "1122"])
        low, high = estimates.share(round(2 * share), 2)[1:]
        assert (row["warned_10_ms"], row["warned_10_ms_low"], row["warned_10_ms_high"]) == (share, low, high)
        assert high - low > 0.6


def test_timing_counts_what_labels_determine() -> None:
    """Assert that the interval of timing, and timing of a group, leave out slips whose label abstains."""
    trials = [prediction(object_, 5) for object_ in "112233"]
    abstained = [replace(one, timed=False) for one in [prediction("1", None), prediction("4", None)]]
    alone, with_others = of_seeds(trials), of_seeds([*trials, *abstained])
    ends = ("slip_correct_low", "slip_correct_high")
    assert [with_others[end] for end in ends] == [alone[end] for end in ends]
    judged = [[slip_warnings.Judged.of(one, 0.5) for one in [*trials, *abstained]]]
    assert with_others["warned_10_ms"] == alone["warned_10_ms"]  # nor are they slips without a warning
    first, fourth = (slip_warnings.group(judged, "object", name) for name in "14")
    assert first["slip_correct_high"] == 1.0 and fourth["slip_correct_low"] is fourth["warned_10_ms"] is None


def test_trials_without_slip_have_false_alarms_alone() -> None:
    """Assert that nothing is warned of where nothing slips, and that an interval of no alarm reaches above 0."""
    still = Prediction(np.full(60_000, 0.02), np.zeros(60_000, np.int8), -1, "1", "a")
    row = of_seeds([still])
    assert row["warned_10_ms"] is row["slip_correct_low"] is row["lead_ms_median"] is None
    assert row["false_alarms_per_min"] == row["false_alarms_per_min_low"] == 0
    assert 3 < row["false_alarms_per_min_high"] < 4
    assert row["calibration_error"] is None


def test_what_trials_share_widens_intervals() -> None:
    """Assert that sixty trials tell no more than the three objects, or the three sensors, that they are of."""

    def width(objects: list[str], sensors: list[str], values: np.ndarray) -> float:
        weights = estimates.cluster_weights(objects, sensors)
        found = estimates.ratio_of_clusters(values, np.ones(60), weights)
        assert found is not None and found.low <= found.value <= found.high
        assert found.value == pytest.approx(values.mean())
        return found.high - found.low

    own, three = [str(n) for n in range(60)], [str(n // 20) for n in range(60)]
    one = ["a"] * 60
    values = (np.arange(60) < 20).astype(float)  # all of one cluster
    alone = width(own, one, values)
    assert width(three, one, values) == pytest.approx(width(one, three, values))
    assert width(three, one, values) > 2 * alone
    assert width(one, one, values) == pytest.approx(alone)  # trials are drawn where nothing else is shared


def test_no_trial_has_no_interval() -> None:
    """Assert that a ratio over nothing is none."""
    empty = np.empty(0)
    assert estimates.ratio_of_clusters(empty, empty, estimates.cluster_weights([])) is None


def test_groups_have_their_own_shares() -> None:
    """Assert that each sensor has its share of warnings, and its false alarms."""
    judged = [[Judged.of(one, 0.8) for one in (prediction("1", 30), prediction("1", None, 1, "b"))]]
    first, second = (slip_warnings.group(judged, "sensor", name) for name in "ab")
    assert (first["warned_10_ms"], first["false_alarms_per_min"]) == (1.0, 0.0)
    assert second["warned_10_ms"] == 0.0 and second["false_alarms_per_min"] > 0


def test_reliability_is_told_in_steps() -> None:
    """Assert that a detector that says 0.9 from 10 ms ahead on has one step, of which a third is too early."""
    (step,) = slip_warnings.reliability_rows("x", [[prediction("1", 10)]])
    assert (step["predicted"], step["slices"]) == (0.9, 32)
    assert step["observed"] == pytest.approx(20 / 32)
    assert of_seeds([prediction("1", 10)])["calibration_error"] == pytest.approx(0.9 - 20 / 32)
