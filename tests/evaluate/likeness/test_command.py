"""evaluate likeness: a real and a simulated recording by the same measures, what neither tells, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.record import Record
from evetac_cli.evaluate.likeness import EvaluateLikeness, command
from evetac_cli.evaluate.likeness.facts import facts
from evetac_cli.events import Events
from evetac_cli.jobs import Outcome, Row
from evetac_cli.trials import record
from tests.make import event_arrays, run_stage, truth_arrays, write_recording

ONSET, SLICES = 1200, 1600


def evaluated(files: list[Path], out: Path, **options: Any) -> tuple[dict[str, Row], Outcome]:
    """Rows of the facts by name, and the whole outcome."""
    _, outcome = run_stage(command, files, EvaluateLikeness(**options), out / "all.report.h5", force=True)
    return {row["name"]: row for row in outcome.rows if "fact" in row}, outcome


def slip_of(path: Path, called: int, loud: int, *, simulated: bool = True) -> Path:
    """A held object, quiet until its slip: 4 events in the columns that count and 2 in the window, then `loud` more."""
    rng = np.random.default_rng(called)
    sensing = np.full(SLICES, 4)
    sensing[ONSET - 5 : ONSET + 30] += loud
    t_us = np.repeat(np.arange(SLICES) * 1000, sensing + 2)
    x = np.concatenate([[*rng.integers(0, 540, inside), 600, 601] for inside in sensing]).astype(np.uint16)
    y = rng.integers(0, 480, len(x)).astype(np.uint16)
    arrays = event_arrays(Events(t_us, x, y, np.zeros(len(x), np.uint8)), SLICES)
    at = np.arange(SLICES)
    dots = np.full((SLICES, 1, 2), 100.0)
    dots[ONSET:, 0, 0] += np.minimum(at[ONSET:] - ONSET, 20)  # one dot goes by 20 px
    truth = truth_arrays(dots, at >= ONSET, np.where(at < ONSET + 90, 2.0, 0.0))
    truth["truth/visible_slip_share"] = np.where(at >= ONSET - 40, 0.6, 0.0).astype(np.float32)
    truth["truth/visible_slip_share"][ONSET - 12 :] = 1.0
    truth["truth/sampled_parameters"] = json.dumps({"mass_kg": 0.1})
    scene = {"scene": {"name": "slip"}, "object": called}
    return write_recording(path, arrays | (truth if simulated else {}), simulated=simulated, **scene)


def test_what_slips_tell(tmp_path: Path) -> None:
    """Assert that slips of two objects tell rates, times, path and one threshold, each in its own unit."""
    files = [slip_of(tmp_path / f"{called}.recording.h5", called, 60) for called in (3, 4)]
    rows, outcome = evaluated(files, tmp_path)
    assert list(rows) == [fact.name for fact in facts()]
    values = {name: json.loads(row["simulated_values"]) for name, row in rows.items()}
    assert values["one-threshold"] == values["one-threshold-first"] == [1.0]
    assert values["half-slipped-time"] == [40.0] and values["most-slipped-time"] == [12.0]
    assert values["contact-after-slip"] == [90.0]
    assert values["path-per-gram"] == pytest.approx([20 / 100])
    assert values["events-per-px"] == pytest.approx([35 * 60 / 20])
    assert values["quiet-before-slip"] == pytest.approx([0.0])
    assert values["busy-slices"] == [0.0]
    assert values["window-at-slip"] == pytest.approx([500 / (500 + 250 * 4 + 30 * 60)])
    assert rows["one-threshold"]["simulated_n"] == 2 and rows["one-threshold"]["compared"] == "half to twice"
    assert outcome.simulated and outcome.summary["one_threshold_correct"] == 1.0
    assert [row["onset_ms"] for row in outcome.rows if "file" in row] == [ONSET, ONSET]


def test_what_is_not_told_says_what_would_tell_it(tmp_path: Path) -> None:
    """Assert that each fact is told or says what it needs, and that a scene's fact is not told by another scene."""
    rows, outcome = evaluated([slip_of(tmp_path / "3.recording.h5", 3, 60)], tmp_path)
    for name, row in rows.items():
        assert (row["simulated"] is None) == bool(row["not_measured"]), name
    assert "slips of at least two objects" in rows["one-threshold"]["not_measured"]
    assert rows["data-rate-whole"]["not_measured"] == "no simulated recording here is of the scene data-rate"
    assert rows["grasps-kept"]["not_measured"].startswith("it needs grasps")
    assert rows["gel-stiffness"]["simulated_from"].endswith(" as it is set")
    shown, lines = command.for_people(outcome.rows, EvaluateLikeness())
    assert {row["fact"] for row in shown} >= {"half-slipped-time", "path-per-gram"}
    assert {row["fact"] for row in shown}.isdisjoint({"grasps-kept", "gel-stiffness"})
    assert lines[1].startswith("Of the 19 ")
    reasons = {row["not_measured"] for row in rows.values()} - {None}
    assert len(lines) == 2 + len(reasons)
    assert sum(f" {name}" in line for line in lines[2:] for name in ("data-rate-whole", "one-threshold")) == 2


def test_a_real_recording_is_not_mixed_with_simulated_ones(tmp_path: Path) -> None:
    """Assert that a recording without truth has a column of its own, and that truth alone is asked for no figure."""
    real = slip_of(tmp_path / "real.recording.h5", 5, 60, simulated=False)
    both, _ = evaluated([slip_of(tmp_path / "3.recording.h5", 3, 30), real], tmp_path)
    assert both["data-rate-whole"]["real_n"] == 1 and both["data-rate-whole"]["simulated"] is None
    assert both["half-slipped-time"]["real"] is None and both["half-slipped-time"]["simulated"] == "40"
    alone, outcome = evaluated([real], tmp_path)
    assert not outcome.simulated and alone["quiet-before-slip"]["real"] is None  # it has neither truth nor labels


def test_a_real_camera_at_rest(tmp_path: Path, outside_file: Callable[[str], Path]) -> None:
    """Assert that the noise of a real DVXplorer is measured as its maker's library counts it, and beside the facts."""
    source = Record(source=outside_file("dvxplorer_static_noise.aedat4"))
    output, _ = run_stage(record, [], source, tmp_path / "noise.recording.h5")
    rows, outcome = evaluated([output], tmp_path)
    real = {name: json.loads(row["real_values"]) for name, row in rows.items()}
    assert real["static-hot-pixels"] == pytest.approx([385], abs=5)
    assert real["static-noise"] == pytest.approx([0.10], abs=0.01)
    ordinary, hot = real["noise-at-rest"]
    assert rows["noise-at-rest"]["real_compared"] == "off" and hot > 23 < ordinary + hot
    assert not outcome.simulated and rows["dot-radius-measured"]["real"] is None
