"""What a recording that broke off left: whole segments are told from damaged ones, and a gap stays a gap in time."""

import tracemalloc
from copy import copy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings import recovery, segments
from evetac_cli.store.recordings.segments import RecordingWriter

STATIC: dict[str, Any] = {
    "sensor/frame_px": np.array([640, 480], np.int32),
    "sensor/name": "dvxplorer:DXM00042",
    "t_offset": np.int64(0),
}
PARENT = Recipe("recording", 1, {"object": 8}, seed=3, simulated_source=True).header()
RECIPE = Recipe("recording", 1, {"setup": {"camera": "replay"}}, parents=(PARENT,))


def events_of(k: int, count: int = 3) -> Events:
    """Events of slice k that are told from those of any other."""
    t = 1000 * k + np.arange(count, dtype=np.int64)
    return Events(t, np.full(count, k % 640, np.uint16), np.arange(count, dtype=np.uint16), np.ones(count, np.uint8))


def broken_off(folder: Path, slices_per_segment: list[int], rows: Any = None, recipe: Recipe | None = RECIPE) -> Path:
    """Segments of so many slices each, left behind; returns NAME.part."""
    writer = RecordingWriter(folder / "a.recording.h5", STATIC, recipe=recipe)
    k = 0
    for count in slices_per_segment:
        for _ in range(count):
            writer.append(events_of(k), rows(k) if rows else {})
            k += 1
        writer.close_segment()
    writer.leave()
    return writer.folder


@pytest.fixture(autouse=True)
def no_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segments are closed by the tests, not by the time that passes."""
    monkeypatch.setattr(segments, "SEGMENT_S", 1e9)


def test_whole_leftover(tmp_path: Path) -> None:
    """Assert that everything is found, with the recipe that the recording began with, parents included."""
    folder = broken_off(tmp_path, [2, 3, 1], lambda k: {"gripper/t_us": 1000 * k})
    leftover = recovery.read_leftover(folder)
    assert leftover.recipe == RECIPE
    assert (leftover.slices, leftover.events, leftover.gripper_rows) == (6, 18, 6)
    assert [part.name for part in leftover.parts if isinstance(part, Path)] == ["000000.h5", "000001.h5", "000002.h5"]
    assert not leftover.lost
    assert not leftover.unreadable


@pytest.mark.parametrize("carries", ["as now", "as before"])
def test_a_grasp_with_a_model_of_many_ancestors(carries: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that it is found, and its segments do not carry what the model learned from, as those before did."""
    if carries == "as before":
        monkeypatch.setattr(Recipe, "carried", copy)
    learned = tuple(Recipe("recording", 1, {"many": list(range(1000))}, seed=seed).header() for seed in range(60))
    model = Recipe("model", 1, {}, seed=3, parents=learned).header()
    recipe = Recipe("recording", 1, {"setup": {}}, parents=(model, PARENT))
    folder = broken_off(tmp_path, [2], recipe=recipe)
    found = recovery.read_leftover(folder).recipe
    assert (found.id, found.parents[1]) == (recipe.id, PARENT)
    assert found.header()["history"] == recipe.header()["history"]
    assert (b"trained on" in (folder / "static.h5").read_bytes()) == (carries == "as before")


def flip_a_byte(path: Path) -> None:
    """Damage the events of a segment, not HDF5's own bytes."""
    with h5py.File(path) as h5:
        where = h5["events/t"].id.get_offset()
    data = bytearray(path.read_bytes())
    data[where] ^= 1
    path.write_bytes(bytes(data))


DAMAGE = {
    "removed": Path.unlink,
    "emptied": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-400]),
    "a flipped bit": flip_a_byte,
    "foreign": lambda path: path.write_text("not HDF5 at all"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_segment_is_a_gap(damage: str, tmp_path: Path) -> None:
    """Assert that a middle segment that was harmed in any way is named, and what follows keeps its moment."""
    folder = broken_off(tmp_path, [2, 3, 4])
    DAMAGE[damage](folder / "000001.h5")
    leftover = recovery.read_leftover(folder)
    assert leftover.parts == [folder / "000000.h5", 3, folder / "000002.h5"]
    assert leftover.lost == [(2, 5)]
    assert (leftover.slices, leftover.events) == (9, 18)
    assert len(leftover.unreadable) == 1
    assert leftover.unreadable[0].startswith("000001: ")


def test_segment_that_was_not_renamed_is_used(tmp_path: Path) -> None:
    """Assert that a segment that was closed, but killed before it got its name, is kept if it is whole."""
    folder = broken_off(tmp_path, [2, 3])
    (folder / "000001.h5").rename(folder / "000001.tmp")
    assert recovery.read_leftover(folder).slices == 5
    (folder / "000001.tmp").write_bytes((folder / "000001.tmp").read_bytes()[:-300])
    leftover = recovery.read_leftover(folder)
    assert (leftover.slices, len(leftover.unreadable)) == (2, 1)


def test_truth_ends_before_the_first_gap(tmp_path: Path) -> None:
    """Assert that a recording with a truth of every slice is not continued behind a gap, which has none."""
    folder = broken_off(tmp_path, [2, 3, 4], lambda k: {"truth/slid_px": 0.5 * k})
    (folder / "000001.h5").unlink()
    leftover = recovery.read_leftover(folder)
    assert leftover.parts == [folder / "000000.h5"]
    assert (leftover.slices, leftover.left_out) == (2, 1)


def test_probability_goes_on_behind_a_gap(tmp_path: Path) -> None:
    """Assert that what a live detector said of every slice is NaN in the gap, and in its place behind it."""
    folder = broken_off(tmp_path, [2, 3, 4], lambda k: {"control/probability": k / 10})
    (folder / "000001.h5").unlink()
    leftover = recovery.read_leftover(folder)
    assert leftover.lost == [(2, 5)]
    filled = segments._float_of_every_slice(leftover.parts)
    assert filled == {"control/probability": (np.dtype(np.float32), ())}


def test_start_that_cannot_be_read(tmp_path: Path) -> None:
    """Assert that without what was known at the start nothing is made, and that it is said where the events are."""
    folder = broken_off(tmp_path, [2])
    (folder / "static.h5").write_bytes(b"")
    with pytest.raises(InputError, match="start of the recording cannot be read") as refused:
        recovery.read_leftover(folder)
    assert "events_per_slice" in str(refused.value)


def test_recording_without_a_recipe(tmp_path: Path) -> None:
    """Assert that segments of which nobody knows what was recorded are refused, with how to read them."""
    folder = broken_off(tmp_path, [2], recipe=None)
    with pytest.raises(InputError, match="no recipe of the recording(.|\n)*plain HDF5 files"):
        recovery.read_leftover(folder)


def test_recording_in_progress_is_left_alone(tmp_path: Path) -> None:
    """Assert that a folder that a recorder holds is not touched, nor one that does not exist made."""
    writer = RecordingWriter(tmp_path / "a.recording.h5", STATIC, recipe=RECIPE)
    with pytest.raises(InputError, match="recording here"), recovery.lock_folder(writer.folder):
        pass
    writer._lock.close()  # as if it had been killed
    with recovery.lock_folder(writer.folder):
        pass
    with pytest.raises(InputError, match="no such file"), recovery.lock_folder(tmp_path / "b.recording.part"):
        pass
    assert not (tmp_path / "b.recording.part").exists()


@pytest.mark.parametrize(("events", "lost_slices"), [(3_000_000, 0), (10, 5_000_000)])
def test_m11_repair_takes_no_memory_for_the_length(tmp_path: Path, events: int, lost_slices: int) -> None:
    """Assert that neither a segment of many events nor a long gap is ever in memory as a whole."""
    folder = broken_off(tmp_path, [1])
    t = np.sort(np.random.default_rng(0).integers(1000, 2000, events))
    x, y, p = (np.ones(events, kind) for kind in (np.uint16, np.uint16, np.uint8))
    with h5py.File(folder / "000001.h5", "w") as h5:
        h5.attrs[segments.FIRST_SLICE] = 1 + lost_slices
        columns = zip(Events._fields, (t + 1000 * lost_slices, x, y, p), strict=True)
        named = {segments.COUNTS: np.array([events]), **{f"events/{name}": column for name, column in columns}}
        for name, column in named.items():
            h5[name] = column
            h5[name].attrs[segments.CRC] = segments.checksum(column)
    del t, x, y, p, column, columns, named
    tracemalloc.start()
    try:
        leftover = recovery.read_leftover(folder)
        output = tmp_path / "a.recording.h5"
        segments.join(folder, output, leftover.recipe, {"capture/ended": "x"}, parts=leftover.parts)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (leftover.slices, leftover.events) == (2 + lost_slices, 3 + events)
    assert most < 30e6
