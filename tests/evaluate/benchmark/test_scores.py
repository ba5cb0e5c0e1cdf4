"""The five scores, in cases whose value is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.evaluate.benchmark import EvaluateBenchmark, command, scores
from evetac_cli.evaluate.benchmark.data_set import Benchmark, BenchmarkTrial, Truth
from evetac_cli.evaluate.benchmark.predictions import Predictions
from evetac_cli.jobs import Rows

MS, ONSET = 60_000, 30_000
LOW, HIGH = np.float32(0.1), np.float32(0.9)


def contact(onset: int | None, name: str) -> Truth:
    """A minute of contact, with slip for 300 ms from the onset on."""
    slips = np.zeros(MS, np.bool_)
    if onset is not None:
        slips[onset : onset + 300] = True
    dots_ms = np.array([100, 200])
    return Truth(
        f"sensor {name}", f"object {name}", slips, np.zeros(MS, np.float32), np.ones(MS, np.bool_), onset,
        dots_ms, np.zeros((2, 5, 2)), dots_ms, np.array([[1.0, -1.0], [2.0, 0.0]]),
    )  # fmt: skip


@pytest.fixture
def known() -> tuple[Benchmark, dict[str, Truth]]:
    """Two recordings of slip, one without, and a press."""
    kinds = {"a": "slip", "b": "slip", "quiet": "handling", "press": "press"}
    split = {"a": "all-new", "b": "known-sensor", "quiet": "all-new", "press": "all-new"}
    entries = {name: BenchmarkTrial(name, kind, split[name], "s", Path(name)) for name, kind in kinds.items()}
    true = {name: contact(ONSET if kind == "slip" else None, name) for name, kind in kinds.items()}
    return Benchmark(Path(), "test", "", entries, {"s": 0.04}, {"dots": [], "force": []}), true


def value(rows: Rows, task: str, split: str = scores.ALL) -> float:
    (row,) = (row for row in rows if (row["task"], row["split"]) == (task, split))
    return float(row["value"])


@pytest.mark.parametrize(("late_ms", "correct"), [(-51, 0), (-50, 1), (0, 1), (20, 1), (21, 0)])
def test_an_onset_is_correct_by_the_papers_rule(
    late_ms: int, correct: float, known: tuple[Benchmark, dict[str, Truth]]
) -> None:
    """Assert that a first detection counts from 50 ms before to 20 ms after slip, and none at all does not."""
    rows = scores.all_rows(*known, Predictions(onset_ms={"a": ONSET + late_ms, "b": None}), None)
    assert value(rows, "onset", "all-new") == correct
    assert value(rows, "onset", "known-sensor") == 0
    assert value(rows, "onset") == correct / 2


def scored(ahead_ms: int, alarms_without_slip: int) -> dict[str, np.ndarray]:
    """Scores that rise ahead of each slip, and at some times without slip, once a second."""
    found = {name: np.full(MS, LOW, np.float32) for name in ("a", "b", "quiet")}
    for name in "ab":
        found[name][ONSET - ahead_ms - 2 : ONSET + 50] = HIGH
    for number in range(alarms_without_slip):
        found["quiet"][1000 * number : 1000 * number + 3] = HIGH
    return found


@pytest.mark.parametrize(
    ("ahead_ms", "false", "warned"), [(10, 0, 1.0), (9, 0, 0.0), (10, 1, 1.0), (10, 2, 0.0), (200, 1, 1.0), (201, 1, 0)]
)
def test_a_warning_counts_at_one_false_alarm_per_minute(
    ahead_ms: int, false: int, warned: float, known: tuple[Benchmark, dict[str, Truth]]
) -> None:
    """Assert that it counts from 10 to 200 ms ahead, if the threshold that it needs has one false alarm at most."""
    rows = scores.all_rows(*known, Predictions(warning=scored(ahead_ms, false)), None)
    assert value(rows, "warning") == warned
    (row,) = (row for row in rows if row["split"] == scores.ALL)
    assert row["false_per_min"] <= 1.0
    assert row["quiet_minutes"] == 1.0


def test_any_increasing_scale_of_the_score_is_the_same(known: tuple[Benchmark, dict[str, Truth]]) -> None:
    """Assert that the warnings of a score do not depend on its scale, so that it need not be a probability."""
    benchmark, true = known
    plain = scored(15, 1)
    other = {name: (1e4 * score - 3).astype(np.float32) for name, score in plain.items()}
    first, second = (value(scores.all_rows(benchmark, true, Predictions(warning=one), None), "warning")
                     for one in (plain, other))  # fmt: skip
    assert first == second == 1.0


def test_forces_and_dots_in_closed_form(known: tuple[Benchmark, dict[str, Truth]]) -> None:
    """Assert the mean absolute error of forces, and the root mean square of dots, with intervals around them."""
    made = Predictions(
        force_n={"press": np.zeros((2, 2))},
        dot_xy_px={"a": np.full((2, 5, 2), 3.0), "b": np.full((2, 5, 2), 4.0)},
    )
    rows = scores.all_rows(*known, made, None)
    assert value(rows, "force") == pytest.approx((1 + 1 + 2 + 0) / 4)
    assert value(rows, "dots") == pytest.approx(np.sqrt((18 + 32) / 2))
    (whole,) = (row for row in rows if row["task"] == "dots" and row["split"] == scores.ALL)
    assert whole["low"] == pytest.approx(np.sqrt(18)) and whole["high"] == pytest.approx(np.sqrt(32))
    assert (whole["n"], whole["sensors"], whole["objects"]) == (2, 2, 2)


@pytest.mark.parametrize(("ratio", "held", "good"), [(3.0, True, 1), (3.01, True, 0), (None, False, 0)])
def test_a_grip_counts_if_it_holds_lightly(
    ratio: float | None, held: bool, good: float, known: tuple[Benchmark, dict[str, Truth]]
) -> None:
    """Assert that a lift counts if it is held with at most three times the force that just holds."""
    lift = {"split": "all-new", "sensor": "s", "object": "o", "balanced": held, "over_holding_mean": ratio}
    rows = scores.all_rows(*known, Predictions(), [lift])
    assert value(rows, "grip") == good
    assert rows[0]["kept"] == held


def test_a_task_without_predictions_has_no_figure(known: tuple[Benchmark, dict[str, Truth]]) -> None:
    """Assert that there are rows only for the tasks with predictions, and none of slips that did not come."""
    benchmark, true = known
    assert scores.all_rows(benchmark, true, Predictions(), None) == []
    still = {**true, "a": true["a"]._replace(onset_ms=None)}
    rows = scores.all_rows(replace(benchmark), still, Predictions(onset_ms={"a": 5, "b": ONSET}), None)
    assert [row["n"] for row in rows if row["split"] == scores.ALL] == [1]


def test_recordings_without_slip_are_left_out(known: tuple[Benchmark, dict[str, Truth]]) -> None:
    """Assert that they are counted by split and named beside the score, and that a partly known figure has its n."""
    rows = scores.all_rows(*known, Predictions(warning=scored(10, 0)), None)
    left_out = {row["split"]: (row["n"], row["left_out"], row["left_out_because"]) for row in rows}
    assert left_out == {"all-new": (1, 1, "no slip"), "known-sensor": (1, 0, None), "all": (2, 1, "no slip")}
    _, (line, *_) = command.for_people(rows, EvaluateBenchmark())
    assert "of 2 slips, " in line and line.endswith("; 1 recordings are left out: no slip.")
    benchmark, true = known
    still = {**true, "a": true["a"]._replace(onset_ms=None)}
    rows = scores.all_rows(benchmark, still, Predictions(onset_ms={"a": None}), None)
    assert command.for_people(rows, EvaluateBenchmark())[1][0].startswith("onset: unknown, n = 0; 1 recordings are")
    lift = {"split": "all-new", "sensor": "s", "object": "o", "balanced": True, "over_holding_mean": 2.0}
    (_, whole) = scores.all_rows(*known, Predictions(), [lift, lift | {"balanced": False, "over_holding_mean": None}])
    assert (whole["n"], whole["force_over_holding"], whole["force_over_holding_n"]) == (2, 2.0, 1)
