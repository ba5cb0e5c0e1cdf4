"""The rows of a data set's files."""

import shutil
from pathlib import Path

import h5py
import pytest

from evetac_cli.store import data_set
from evetac_cli.store.files import StageFile
from tests.conftest import Made


def table(folder: Path) -> dict[str, data_set.FileRow]:
    """The rows of a folder's files by path."""
    return {row.path: row for row in data_set.read_data_set(folder)}


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """A data set: two trajectories, a model in a folder of its own, and what is no part of it."""
    for path in made.recordings[:2]:
        for kind in ("recording", "labels", "tracks", "features"):
            shutil.copy(made.beside(path, kind), tmp_path)
    (tmp_path / "models").mkdir()
    shutil.copy(made.model, tmp_path / "models")
    (tmp_path / "broken-off.recording.part").mkdir()
    shutil.copy(made.recordings[0], tmp_path / "broken-off.recording.part" / "000000.h5")
    shutil.copy(made.recordings[0], tmp_path / ".a.h5")
    (tmp_path / "notes.txt").write_text("h5")
    return tmp_path


def test_a_row_says_what_a_file_is(folder: Path, made: Made) -> None:
    """Assert that files made from a recording have its object, seed and scene, and a model has its own seed."""
    rows = table(folder)
    assert len(rows) == 9
    recording = made.recordings[0].name
    kinds = {kind: rows[recording.replace(".recording.", f".{kind}.")] for kind in ("recording", "labels", "features")}
    for kind, row in kinds.items():
        assert (row.kind, row.sensor, row.scene, row.outcome, row.error) == (kind, "evetac", "short", "slips", None)
        assert (row.object, row.seed, row.simulated) == (kinds["recording"].object, kinds["recording"].seed, 1)
        assert row.slices == kinds["recording"].slices and row.slices
        assert row.size_bytes == (folder / row.path).stat().st_size
    assert kinds["recording"].object is not None and kinds["recording"].trial is not None
    model = rows[f"models/{made.model.name}"]
    assert (model.kind, model.object, model.scene, model.outcome) == ("model", None, None, None)


def test_a_grasp_has_an_outcome(made: Made, tmp_path: Path) -> None:
    """Assert that what became of a grasp stands in its row, and its object is not that of the detector's training."""
    shutil.copy(made.grasp, tmp_path)
    (row,) = table(tmp_path).values()
    assert row.kind == "recording" and row.outcome in ("dropped", "lifted", "balanced")
    with StageFile(made.grasp) as file:
        own = file.header["parameters"]
    assert (row.object, row.scene) == (own["object"], own["scene"]["name"])


def test_damaged_and_foreign_files_have_a_row(folder: Path) -> None:
    """Assert that a damaged file has the reason in its row, one of another program neither kind nor reason."""
    first, second, *_ = sorted(path.name for path in folder.glob("*.h5") if path.name[0] != ".")
    (folder / first).write_bytes((folder / first).read_bytes()[:-100])
    (folder / second).unlink()
    (folder / "gone.labels.h5").symlink_to(folder / second)
    with h5py.File(folder / "other.h5", "w") as file:
        file["x"] = 1
    rows = table(folder)
    assert rows[first].kind is None and rows[first].error == "cannot be opened: it is truncated"
    assert second not in rows and rows["gone.labels.h5"].error
    assert (rows["other.h5"].kind, rows["other.h5"].error) == (None, None)
    assert "other.h5" in data_set.foreign_note(list(rows.values()))
