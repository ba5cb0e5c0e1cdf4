"""What slips are warned of, at which price: alarms, oracles, and the tables made of judged trials."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import SceneError
from scripts.studies.motions import MOTIONS, Trial
from scripts.studies.slip import oracles
from scripts.studies.slip import tables as slip_tables
from scripts.studies.slip import trials as slip_trials

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


def test_rows_are_kept_and_tables_made_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a judged trial is not played again, and that thresholds and tables follow from the rows."""
    monkeypatch.setattr(slip_tables, "THRESHOLD_FILE", tmp_path / "thresholds.json")
    played = []

    def play(planned: slip_trials.Planned, seed: int) -> tuple[Trial, slip_trials.Scores]:
        played.append(seed)
        return trial(), slip_trials.oracle_scores(trial())

    rows = {}
    for motion in ("slip-speeds", "pushes"):
        plans = [slip_trials.planned_at(motion, (4, 7), 100, place, 100) for place in range(4)]
        assert [number for number, _ in plans] == [4, 4, 7, 7]
        for _ in range(2):
            given = (tmp_path / motion, motion, iter(plans), 100, 99.0, 2, play)
            rows[motion] = slip_trials.rows_of(*given)
    assert played == [100, 101, 100, 101]

    def refuse(planned: slip_trials.Planned, seed: int) -> tuple[Trial, slip_trials.Scores]:
        if seed == 100:
            raise SceneError("too heavy")
        return play(planned, seed)

    plans = [slip_trials.planned_at("grip", (4, 7), 100, place, 100) for place in range(4)]
    for _ in range(2):
        left = slip_trials.rows_of(tmp_path / "grip", "grip", iter(plans), 100, 99.0, 2, refuse)
        assert [row["seed"] for row in left] == [101, 102]
    with pytest.raises(SystemExit, match="grip, line 1: expected .*'seed': 900.* found .*'seed': 100"):
        slip_trials.rows_of(tmp_path / "grip", "grip", iter(plans), 900, 99.0, 2, refuse)
    slip_tables.choose_thresholds(rows, 100)
    timing = slip_tables.timing_table("a", rows, slip_tables.thresholds(), "command")
    ahead = next(row for row in timing["rows"] if row["score"] == "ahead 10 ms")
    assert (ahead["slips"], ahead["correct"], ahead["late"]) == (2, 1.0, 0.0)


def test_motions_for_training_leave_some_for_the_judge() -> None:
    """Assert that training leaves some known motions for the judge alone, and that the page counts the others so."""
    from scripts.studies.slip import recordings

    for counts in recordings.COUNTS.values():
        assert set(counts) < set(MOTIONS) and not {"fast jerks", "weights", "data-rate"} & set(counts)
    page = (Path(slip_tables.__file__).parents[3] / "docs" / "slip-detector.md").read_text()
    learn, choose = (
        {motion: count * len(recordings.OBJECTS[role]) for motion, count in counts.items()}
        for role, counts in recordings.COUNTS.items()
    )
    for motion, trials in learn.items():
        assert f"| {motion} | {trials} | {choose.get(motion, 0)} |" in page
