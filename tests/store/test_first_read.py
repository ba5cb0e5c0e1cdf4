"""What is looked at when a file is opened, and what before one of its datasets is first read: never later than that."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.store.files import StageFile, up_to_date
from tests.small_files import every_kind

Change = Callable[[h5py.File], None]


def setting(name: str, value: object, *index: object) -> Change:
    """Write a value into a dataset."""

    def change(h5: h5py.File) -> None:
        h5[name][index or ...] = value

    return change


def never_written(h5: h5py.File) -> None:
    rows = h5["events/x"].shape
    del h5["events/x"]
    h5.create_dataset("events/x", rows, np.uint16)


def without_last_chunk(h5: h5py.File) -> None:
    rows = len(h5["events/x"])
    del h5["events/x"]
    h5.create_dataset("events/x", (rows,), np.uint16, chunks=(1,))[: rows - 1] = 3


def other_architecture(h5: h5py.File) -> None:
    del h5["architecture"]
    h5["architecture"] = "none of ours"


# What is changed: kind, how, what is said of it, and the datasets of which none may be read.
FAULTS: dict[str, tuple[str, Change, str, tuple[str, ...]]] = {
    "no bytes": ("recording", never_written, "events/x is incomplete", ("events/x",)),
    "no last chunk": ("recording", without_last_chunk, "events/x is incomplete", ("events/x",)),
    "a value": ("recording", setting("control/phase", 77, -1), "control/phase is impossible", ("control/phase",)),
    "a radius beyond the frame": (
        "recording",
        setting("sensor/dot_radius_px", 5000.0),
        "sensor/dot_radius_px is impossible",
        ("sensor/frame_px", "sensor/window_px", "sensor/dot_radius_px", "sensor/dot_xy_px"),
    ),
    "an onset before the slip": (
        "labels",
        setting("onset_slice", 0),
        "onset_slice is impossible",
        ("onset_slice", "label"),
    ),
    "a grid of other dots": (
        "features",
        setting("dot_shape", (1, 1)),
        "dot_shape is impossible",
        ("dot_shape", "displacement_px"),
    ),
    "other weights": ("model", other_architecture, "architecture is impossible", ("architecture", "history")),
}


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A small file of every kind."""
    return every_kind(tmp_path_factory.mktemp("originals"))


def changed(originals: dict[str, Path], folder: Path, kind: str, change: Change) -> Path:
    """A copy of a file, changed."""
    path = Path(shutil.copy(originals[kind], folder))
    with h5py.File(path, "r+") as h5:
        change(h5)
    return path


@pytest.mark.parametrize("name", FAULTS)
def test_whatever_is_wrong_is_said_by_the_first_reading(name: str, originals: dict[str, Path], tmp_path: Path) -> None:
    """Assert that no dataset that a fault concerns is handed out, whichever is asked for first, or again."""
    kind, change, said, concerned = FAULTS[name]
    path = changed(originals, tmp_path, kind, change)
    for first in concerned:
        with StageFile(path) as file:
            for _ in range(2):
                with pytest.raises(InputError, match=said) as refused:
                    file.read(first)
                assert str(refused.value).startswith(f"{path}: ")
            for other in concerned:
                with pytest.raises(InputError, match=said):
                    file.read(other)


@pytest.mark.parametrize("name", FAULTS)
def test_whatever_is_wrong_is_said_by_whoever_vouches_for_a_file(
    name: str, originals: dict[str, Path], tmp_path: Path
) -> None:
    """Assert that `check`, `validate` and whether --force keeps an output find what no reading has asked for."""
    kind, change, said, _ = FAULTS[name]
    path = changed(originals, tmp_path, kind, change)
    with StageFile(path) as file, pytest.raises(InputError, match=said):
        file.check()
    (row,) = validate.run([path]).rows
    assert said in row["faults"]
    with StageFile(path) as file:
        header = file.header
    assert not up_to_date(path, recipe_like(header["id"]), force=True)


def recipe_like(id_: str) -> object:
    """All that is asked of a recipe whose output has this id."""

    class Like:
        id = id_

    return Like()


def test_no_length_is_believed_of_rows_that_are_not_there(originals: dict[str, Path], tmp_path: Path) -> None:
    """Assert that whoever asks how long a dataset is, to make room for it, hears that it was never written."""
    path = changed(originals, tmp_path, "recording", never_written)
    with StageFile(path) as file, pytest.raises(InputError, match="events/x is incomplete"):
        file.length("events/x")
