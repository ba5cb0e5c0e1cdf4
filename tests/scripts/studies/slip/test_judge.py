"""What slips are warned of, at which price: alarms, oracles, and the tables made of judged trials."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.slip.load_path import LoadPath
from scripts.studies.motions import MOTIONS, Trial
from scripts.studies.slip import oracles, seen
from scripts.studies.slip import tables as slip_tables
from scripts.studies.slip import trials as slip_trials
from scripts.studies.slip.seen import SeenTrial, View

MS = 3000
ONSET = 2000


def trial() -> Trial:
    """A contact of which ever more slips in the 100 ms before ONSET, while the fingers open and the load stays."""
    at = np.arange(MS, dtype=np.float32)
    share = np.clip((at - (ONSET - 100)) / 100, 0, 1).astype(np.float32)
    normal = np.clip(3 - at / 1500, 0.5, None).astype(np.float32)
    dots = np.zeros((MS, 4, 2), np.float32)
    shear = np.stack([np.ones(MS), np.zeros(MS)], axis=1).astype(np.float32)
    return Trial(dots, np.zeros((4, 2)), 0.03, share, at >= ONSET, normal, shear, 5 - at / 500, (640, 480))


def test_oracles_know_when_it_slips() -> None:
    """Assert that each oracle's score rises towards slip, and that nothing of later slices is known."""
    whole = trial()
    cut = Trial(*(part[:ONSET] if np.shape(part)[:1] == (MS,) else part for part in whole))
    for oracle in oracles.ORACLES:
        for horizon_ms in oracles.HORIZONS_MS:
            score = oracles.score(whole, oracle, horizon_ms)
            assert score.shape == (MS,) and score.min() >= 0 and score.max() <= 1
            assert score[ONSET] > 0.9 > 0.2 > score[1000]
            assert np.array_equal(score[:ONSET], oracles.score(cut, oracle, horizon_ms))


def seen_trial(motion: str, row: dict[str, Any]) -> SeenTrial:
    """A contact that the sticking network sees slip 30 ms late in true dots, and 80 ms late in tracked ones."""
    made = trial()
    path = LoadPath(np.zeros((MS // 5, 20), np.float32), np.ones(MS // 5, np.bool_), MS)
    late = {dots: np.pad(made.slip_share, (ms, 0))[:MS] for dots, ms in (("tracked", 80), ("true", 30))}
    return SeenTrial(motion, row, made, {dots: View(path, 1 - share, share) for dots, share in late.items()}, {})


def test_trials_are_kept_and_tables_made_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a trial is not simulated again, one refused is left out, and tables follow from the rest."""
    monkeypatch.setattr(slip_tables, "THRESHOLD_FILE", tmp_path / "thresholds.json")
    simulated = []

    def simulate(motion: str, row: dict[str, Any], *_: Any) -> SeenTrial:
        simulated.append(row["seed"])
        if row["seed"] == 101 and motion == "pushes":
            return SeenTrial(motion, row | {"refused": "too heavy"}, None, {}, {})
        return seen_trial(motion, row)

    monkeypatch.setattr(seen, "seen", simulate)
    for motion in ("slip-speeds", "pushes"):
        plans = [slip_trials.planned_at(motion, (4, 7), 100, place, 100) for place in range(4)]
        assert [number for number, _ in plans] == [4, 4, 7, 7]
        for _ in range(2):
            assert slip_trials.see(tmp_path, motion, iter(plans), 100, {}, 99.0, 2) == 2
    assert simulated == [100, 101, 100, 101, 102]
    with pytest.raises(SystemExit, match=r"00000\.npz: expected .*'seed': 900.* found .*'seed': 100"):
        slip_trials.see(tmp_path, "pushes", iter(plans), 900, {}, 99.0, 2)
    rows = {
        motion: [
            one.row | slip_trials.judged(motion, one.trial, slip_trials.scores_of(one, {}))
            for one in seen.trials_in(tmp_path, motion)
            if one.trial is not None
        ]
        for motion in ("slip-speeds", "pushes")
    }
    assert [row["seed"] for row in rows["pushes"]] == [100, 102]
    slip_tables.choose_thresholds(rows)
    timing = slip_tables.timing_table("a", rows, slip_tables.thresholds(), "command")
    ahead = next(row for row in timing["rows"] if row["score"] == "ahead 10 ms")
    assert (ahead["slips"], ahead["correct"], ahead["late"]) == (2, 1.0, 0.0)
    warned = {row["score"]: row for row in slip_tables.warning_table("b", rows, {}, "command")["rows"]}
    tracked, true = (warned[f"slip has begun, {dots} dots"] for dots in ("tracked", "true"))
    assert (true["warned_10_ms_at_1"], true["warned_20_ms_at_1"]) == (1.0, 1.0)
    assert (tracked["warned_10_ms_at_1"], tracked["warned_20_ms_at_1"], tracked["slips"]) == (1.0, 0.0, 2)
    parts = {row["part"]: row for row in slip_tables.motions_table("c", rows, {}, "command")["rows"]}
    assert parts["slip-speeds"]["slip has begun, tracked dots warned"] == 1.0
    assert parts["pushes"]["slips"] == 0 and parts["random sensors"]["slips"] == 1


def test_motions_for_training_leave_some_for_the_judge() -> None:
    """Assert that training leaves some known motions for the judge alone, and that the page counts the others so."""
    from scripts.studies.slip import recordings

    for counts in recordings.COUNTS.values():
        assert set(counts) < set(MOTIONS) and not {"fast jerks", "weights", "data-rate"} & set(counts)
    page = (Path(slip_tables.__file__).parents[3] / "docs" / "slip-detector.md").read_text()
    learn, choose = recordings.COUNTS.values()
    for motion, trials in learn.items():
        assert f"| {motion} | {trials} | {choose.get(motion, 0)} |" in page
