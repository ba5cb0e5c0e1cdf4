"""The stage evaluate tracking: presets side by side, end-point consistency with and without truth."""

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli import stages
from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as tracking
from evetac_cli.jobs import Outcome
from evetac_cli.stages import track
from evetac_cli.store.files import StageFile
from tests.conftest import Made
from tests.make import run_stage


@pytest.fixture
def recording(made: Made, tmp_path: Path) -> Path:
    """A recording in a folder of its own."""
    return Path(shutil.copy(made.recordings[0], tmp_path))


def tracked(recording: Path, name: str, **chosen: Any) -> Path:
    """Tracks of it, in a folder of that name."""
    how = Track(**chosen)
    return run_stage(track, [recording], how, recording.parent / name)[0]


def evaluate(*files: Path, recordings: Path | None = None, **how: Any) -> Outcome:
    chosen = EvaluateTracking(recordings=recordings)
    return run_stage(tracking, list(files), chosen, **how)[1]


def push(path: Path, dots: int, px: float) -> None:
    """Let so many dots end so far off."""
    with h5py.File(path, "r+") as file:
        rest = file["sensor/dot_xy_px"][:].reshape(-1, 2)
        file["dot_xy_px"][-1, :dots] = rest[:dots] + (0.0, px)


def test_presets_side_by_side(recording: Path) -> None:
    """Assert that each preset has a row with its errors against truth and the paper's figures, and so each file."""
    files = [tracked(recording, preset, preset=preset) for preset in ("paper", "stable")]
    outcome = evaluate(*files, recordings=recording.parent)
    presets, trajectories = outcome.rows[:2], outcome.rows[2:]
    assert [row["preset"] for row in presets] == [row["preset"] for row in trajectories] == ["paper", "stable"]
    with StageFile(recording, "recording") as truth:
        true = truth.read("truth/dot_xy_px")
    for path, preset, row in zip(files, presets, trajectories, strict=True):
        with StageFile(path, "tracks") as tracks:
            error = np.linalg.norm(tracks.read("dot_xy_px") - true, axis=2)
        assert row["error_px_rms"] == pytest.approx(np.sqrt((error.astype(float) ** 2).mean()), rel=1e-6)
        assert preset["error_px_worst"] == row["error_px_worst"] == error.max()
        assert (preset["trajectories"], preset["consistent"], preset["dots_lost_mean"]) == (1, 1, None)
    assert (presets[0]["paper_consistent_share"], presets[0]["paper_dots_lost_mean"]) == (0.8, 1.5)
    assert presets[1]["paper_consistent_share"] is None
    assert presets[1]["error_px_rms"] < presets[0]["error_px_rms"]
    assert outcome.simulated
    assert outcome.summary["with_truth"] == 2


def test_block_by_block_as_a_whole(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that figures are those over all slices, whatever the number that are in memory together."""
    path = tracked(recording, "one")
    with StageFile(recording, "recording") as truth, StageFile(path, "tracks") as tracks:
        true, dots = truth.read("truth/dot_xy_px").astype(float), tracks.read("dot_xy_px").astype(float)
        rest, events = tracks.read("sensor/dot_xy_px").reshape(-1, 2), tracks.read("events_per_dot")
    monkeypatch.setattr(stages, "BLOCK_ROWS", 7)
    row = evaluate(path, recordings=recording.parent).rows[1]
    assert len(dots) > 7
    assert row["events_per_dot"] == pytest.approx(events.mean(), rel=1e-12)
    errors, still = np.linalg.norm(dots - true, axis=2), np.linalg.norm(rest - true, axis=2)
    assert row["error_px_rms"] == pytest.approx(np.sqrt((errors**2).mean()), rel=1e-6)
    assert row["error_px_worst"] == pytest.approx(errors.max(), rel=1e-6)
    assert row["still_px_rms"] == pytest.approx(np.sqrt((still**2).mean()), rel=1e-6)


@pytest.mark.parametrize(("px", "asked"), [(19.0, True), (30.0, False)])
def test_only_where_the_gel_ends_at_rest(recording: Path, px: float, asked: bool) -> None:
    """Assert that a trajectory whose true dots end more than 20 px off is not asked whether they end at rest."""
    tracks = tracked(recording, "one")
    with h5py.File(recording, "r+") as file:
        file["truth/dot_xy_px"][-1] = file["sensor/dot_xy_px"][:].reshape(-1, 2) + (px, 0.0)
    outcome = evaluate(tracks, recordings=recording.parent)
    preset, row = outcome.rows
    assert (row["consistent"], row["dots_lost"]) == ((True, 0) if asked else (None, None))
    assert (preset["consistent"], preset["consistent_share"]) == ((1, 1.0) if asked else (None, None))
    assert outcome.summary["decided"] == preset["decided"] == int(asked)
    _, (line, *_) = tracking.for_people(outcome.rows, EvaluateTracking())
    assert ("1 of 1 trajectories are left out, because they end with the gel" in line) != asked


@pytest.mark.parametrize(("px", "lost"), [(19.9, 0), (20.1, 3)])
def test_a_dot_off_by_20_px_is_lost(recording: Path, px: float, lost: int) -> None:
    """Assert that without truth the dots that end more than 20 px off are counted, over the trajectories with any."""
    files = [tracked(recording, name, preset="paper") for name in ("one", "two")]
    push(files[0], 3, px)
    recording.unlink()
    outcome = evaluate(*files)
    preset, first, second = outcome.rows
    assert (first["consistent"], first["dots_lost"]) == (lost == 0, lost)
    assert first["end_distance_px_worst"] == pytest.approx(px, abs=1e-3)
    assert second["dots_lost"] == 0
    assert preset["consistent_share"] == (1.0 if lost == 0 else 0.5)
    assert (preset["dots_lost_mean"], preset["dots_lost_counted"]) == (lost or None, int(lost > 0))
    assert preset["error_px_rms"] is None
    assert outcome.summary["with_truth"] == 0


@pytest.mark.parametrize(("px", "lost"), [(19.9, 0), (20.1, 1)])
@pytest.mark.parametrize("after_px", [2.9, 4.0])
def test_a_dot_that_is_put_back_is_judged_before_that(
    recording: Path, px: float, lost: int, after_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a dot put back counts by its place before, and that a flag which ends elsewhere is no such reset."""
    monkeypatch.setattr(stages, "BLOCK_ROWS", 7)
    path = tracked(recording, "one")
    with h5py.File(path, "r+") as file:
        rest = file["sensor/dot_xy_px"][:].reshape(-1, 2)
        file["lost"][3:14, 5] = 1
        file["dot_xy_px"][13, 5] = rest[5] + (px, 0.0)
        file["dot_xy_px"][14, 5] = rest[5] + (after_px, 0.0)
    preset, row = evaluate(path).rows
    was_put_back = after_px < 3
    assert (row["consistent"], row["dots_put_back"]) == (True, int(was_put_back))
    assert row["dots_lost_before_reset"] == (lost if was_put_back else 0)
    assert preset["consistent_before_reset_share"] == (0.0 if lost and was_put_back else 1.0)


def test_constants_by_hand_are_kept_apart(recording: Path) -> None:
    """Assert that two sets of constants from one preset are two rows, and the same set twice is one."""
    files = [
        tracked(recording, f"{number}", preset="paper", regulariser=weight)
        for number, weight in enumerate((1e-4, 1e-5, 1e-4))
    ]
    names = [row["preset"] for row in evaluate(*files).rows]
    assert names[:2] == ["custom from paper", "custom from paper, 2"]
    assert names[2:] == [names[0], names[1], names[0]]


def test_another_recording_is_refused(made: Made, recording: Path) -> None:
    """Assert that a recording of the same name from which the tracks were not made is no truth, and a missing none."""
    path = tracked(recording, "paper", preset="paper")
    elsewhere = recording.parent / "elsewhere"
    elsewhere.mkdir()
    with pytest.raises(InputError, match="no recording of this file"):
        evaluate(path, recordings=elsewhere)
    shutil.copy(made.recordings[1], elsewhere / recording.name)
    with pytest.raises(InputError, match="belong to another recording"):
        evaluate(path, recordings=elsewhere)


def test_truth_found_since_is_another_report(recording: Path) -> None:
    """Assert that a report made without truth is not taken for one with truth."""
    path = tracked(recording, "paper", preset="paper")
    away = recording.rename(recording.with_suffix(".away"))
    assert evaluate(path).made
    assert not evaluate(path).made
    away.rename(recording.with_name("renamed.recording.h5"))  # recognized by its id
    with pytest.raises(InputError, match="with_truth"):
        evaluate(path)
    assert evaluate(path, recordings=recording.parent, force=True).summary["with_truth"] == 1
