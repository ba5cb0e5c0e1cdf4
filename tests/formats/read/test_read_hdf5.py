"""HDF5 in the layouts of other data sets: the same events from each, written by the published layout with h5py."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from tests.importing import FRAME, assert_equal, drawn, refusal

EVENTS = drawn(3000)
SMALL = drawn(3000, (346, 260))


def signed(events: Events) -> Any:
    return events.p.astype(np.int8) * 2 - 1


def table(events: Events, order: str, dtype: Any, t: Any = None, p: Any = None) -> Any:
    columns = {**events._asdict(), **({} if t is None else {"t": t}), **({} if p is None else {"p": p})}
    return np.stack([columns[name].astype(dtype) for name in order], axis=1)


def rpg(file: h5py.File) -> None:
    """event_utils, which e2vid's successors read: times in seconds as float64, logical polarities."""
    file["events/ts"] = EVENTS.t / 1e6
    file["events/xs"] = EVENTS.x.astype(np.int16)
    file["events/ys"] = EVENTS.y.astype(np.int16)
    file["events/ps"] = EVENTS.p.astype(bool)
    file.attrs["sensor_resolution"] = (480, 640)


def rpg_in_us(file: h5py.File) -> None:
    for name in "txyp":
        file[f"events/{name}s"] = getattr(EVENTS, name)


def v2e(file: h5py.File) -> None:
    file.create_dataset(
        "events", data=table(EVENTS, "txyp", np.uint32), maxshape=(None, 4), chunks=(1000, 4), compression="gzip"
    )


def prophesee(file: h5py.File) -> None:
    """Metavision's layout, without its codec."""
    rows = np.zeros(EVENTS.size, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "txyp":
        rows[name] = getattr(EVENTS, name)
    file.create_dataset("CD/events", data=rows, chunks=(1024,), compression="gzip")
    file["CD/indexes"] = np.zeros(5, [("id", "<u8"), ("ts", "<i8")])
    file["EXT_TRIGGER/events"] = np.zeros(3, [("p", "<i2"), ("t", "<i8"), ("id", "<i2")])
    file["EXT_TRIGGER/indexes"] = np.zeros(2, [("id", "<u8"), ("ts", "<i8")])
    file.attrs["geometry"] = "640x480"


def m3ed(file: h5py.File) -> None:
    for name in "txyp":
        file[f"prophesee/left/{name}"] = getattr(EVENTS, name)
    file["prophesee/left/ms_map_idx"] = np.arange(9)


LAYOUTS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "rpg": (rpg, "the layout of rpg: time in seconds, polarity"),
    "rpg in us": (rpg_in_us, "the layout of rpg: time in microseconds, polarity"),
    "v2e": (v2e, "the layout of v2e: columns t x y p, time in microseconds"),
    "Prophesee": (prophesee, "the layout of Prophesee: time in microseconds"),
    "M3ED": (m3ed, "the layout of M3ED: time in microseconds"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_read_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Assert that every layout gives the events that were written, whole and in batches, and says what was assumed."""
    write, assumed = LAYOUTS[name]
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        write(file)
    imported = read_events(path, frame_px=FRAME)
    assert_equal(imported, EVENTS)
    assert imported.notes[-1].startswith(f"assumed: {assumed}")
    monkeypatch.setattr("evetac_cli.formats.read.read_hdf5.BATCH_ROWS", 700)
    assert_equal(read_events(path), EVENTS)


def mvsec(file: h5py.File, side: str, start_s: float = 1_506_117_893.0) -> None:
    """The left or right camera of MVSEC: x, y, t in s since 1970, p -1 or 1, as float64; frames and IMU beside them."""
    t = start_s + (SMALL.t - SMALL.t[0]) / 1e6
    file[f"davis/{side}/events"] = table(SMALL, "xytp", np.float64, t=t, p=signed(SMALL))
    file[f"davis/{side}/image_raw"] = np.zeros((4, 260, 346), np.uint8)
    file[f"davis/{side}/image_raw_ts"] = np.zeros(4)
    file[f"davis/{side}/image_raw_event_inds"] = np.zeros(4, np.int64)
    file[f"davis/{side}/imu"] = np.zeros((50, 6))


def test_mvsec(tmp_path: Path) -> None:
    """Assert that both cameras of MVSEC are read, on a clock since 1970, and that frames and IMU are counted."""
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        mvsec(file, "left")
    imported = read_events(path)
    assert imported.frame_px == (346, 260)
    assert imported.t_offset_us == 1_506_117_893_000_000
    assert np.array_equal(imported.events.t, SMALL.t - SMALL.t[0])
    assert all(np.array_equal(a, b) for a, b in zip(imported.events[1:], SMALL[1:], strict=True))
    counts = {"image_raw": 4, "image_raw_ts": 4, "imu": 50}
    assert imported.left_out == {f"rows of davis/left/{name}": count for name, count in counts.items()}
    with h5py.File(path, "a") as file:
        mvsec(file, "right", 1_506_117_894.0)
    notes = read_events(path).notes
    assert "read the camera left; the file also has: right (choose with --stream)" in notes
    assert read_events(path, stream="right").t_offset_us == 1_506_117_894_000_000
    assert "left or right" in refusal(path, stream="middle")


def test_prophesee_says_its_frame_and_triggers(tmp_path: Path) -> None:
    """Assert that the frame is the one of the attribute, and that triggers are counted, indices not."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        prophesee(file)
    imported = read_events(path)
    assert imported.frame_px == FRAME
    assert imported.left_out == {"rows of EXT_TRIGGER/events": 3}
    assert "leave out --frame-size" in refusal(path, frame_px=(1280, 720))


def test_prophesee_s_codec_is_named(tmp_path: Path) -> None:
    """Assert that a file packed with ECF, which no plugin from a package index unpacks, is refused in words."""
    if h5py.h5z.filter_avail(0x8ECF):
        pytest.skip("the codec is installed here")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        rows = np.zeros(3, [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
        recipe = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        recipe.set_chunk((3,))
        recipe.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        group = file.create_group("CD")
        space = h5py.h5s.create_simple((3,))
        h5py.h5d.create(group.id, b"events", h5py.h5t.py_create(rows.dtype), space, dcpl=recipe)
        group["events"].id.write_direct_chunk((0,), b"squeezed", 0)
    words = refusal(path, frame_px=FRAME)
    assert "CD/events is compressed" in words and "convert it with Prophesee's tools" in words


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("events", np.zeros((3, 5)), "`events`: float64 of shape (3, 5)"),
        ("events", np.array([b"a", b"b"]), "no event columns"),
        ("CD/events", np.zeros((3, 4)), "`CD/events`: float64"),
        ("CD/events", np.zeros(3, [("t", "i8"), ("x", "S4"), ("y", "i2"), ("p", "i2")]), "no event columns"),
        ("davis/left/events", np.array([[1, 2, 1e300, 1.0]]), "time out of range"),
        ("davis/left/events", np.array([[1, 2.5, 1, 1.0]]), "y is not a whole pixel"),
        ("davis/left/depth", np.zeros((3, 4)), "found:    davis"),
    ],
)
def test_what_does_not_fit_a_layout_is_refused(tmp_path: Path, name: str, data: Any, words: str) -> None:
    """Assert that a dataset under the name of a layout that is not what the layout says is refused by what it is."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file[name] = data
    assert words in refusal(path, frame_px=FRAME)
