"""Files of numpy: however events are stored in them they read the same; nothing is run, nothing unpacked whole."""

import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from evetac_cli.formats.read import read_numpy
from evetac_cli.formats.read.time_order import OrderOptions
from tests.importing import FRAME, assert_equal, drawn, event_rows, refusal

EVENTS = drawn(3000)


def npy(values: bytes, descr: str, shape: tuple[int, ...], order: bool = False) -> bytes:
    """An npy file by its published layout, made without numpy."""
    head = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"
    head += " " * (-(len(head) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + values


def structured(events: Events, dtype: Any, names: str = "txyp") -> Any:
    rows = np.zeros(events.size, dtype)
    for name, column in zip(names, events, strict=True):
        rows[name] = column
    return rows


def test_known_values_without_numpy(tmp_path: Path) -> None:
    """Assert that the bytes of the published layout, packed by hand, are these three events."""
    rows = [(1000, 1, 2, 1), (2500, 3, 4, 0), (3000, 5, 6, 1)]
    plain = b"".join(struct.pack("<qHHB", *row) for row in rows)
    descr = "[('t', '<i8'), ('x', '<u2'), ('y', '<u2'), ('p', '|u1')]"
    path = tmp_path / "a.npy"
    path.write_bytes(npy(plain, descr, (3,)))
    imported = read_events(path, frame_px=FRAME)
    assert event_rows(imported) == [(t - 1000, x, y, p) for t, x, y, p in rows]
    assert (imported.format, imported.t_offset_us) == ("numpy", 1000)
    assert imported.notes == ["assumed: time in microseconds, polarity 1 brighter, 0 or -1 darker"]
    path.write_bytes(npy(struct.pack(">12i", *(value for row in rows for value in row)), "'>i4'", (3, 4)))
    assert event_rows(read_events(path, frame_px=FRAME))[2] == (2000, 5, 6, 1)


TONIC = [("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", bool)]
EXPELLIARMUS = [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "u1")]
FAERY = [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")]


@pytest.mark.parametrize("dtype", [TONIC, EXPELLIARMUS, FAERY], ids=["tonic", "expelliarmus", "faery"])
def test_structured_arrays_of_other_libraries(tmp_path: Path, dtype: Any) -> None:
    """Assert that fields are found by name, whatever their order and type."""
    np.save(tmp_path / "a.npy", structured(EVENTS, dtype))
    assert_equal(read_events(tmp_path / "a.npy", frame_px=FRAME), EVENTS)
    np.savez(tmp_path / "a.npz", structured(EVENTS, dtype))
    assert_equal(read_events(tmp_path / "a.npz", frame_px=FRAME), EVENTS)


@pytest.mark.parametrize("order", ["txyp", "xytp", "xypt"])
@pytest.mark.parametrize("kind", ["int64", "float64", "seconds", "columns first", "signed"])
def test_tables_in_every_order(tmp_path: Path, order: str, kind: str) -> None:
    """Assert that the order of four columns is found, and unit and order are said."""
    columns = {name: getattr(EVENTS, name).astype(np.int64) for name in "txyp"}
    if kind == "signed":
        columns["p"] = columns["p"] * 2 - 1
    if kind in ("float64", "seconds"):
        columns = {name: column.astype(np.float64) for name, column in columns.items()}
    if kind == "seconds":
        columns["t"] /= 1e6
    table = np.stack([columns[name] for name in order], axis=1)
    np.save(tmp_path / "a.npy", np.asfortranarray(table) if kind == "columns first" else table)
    imported = read_events(tmp_path / "a.npy", frame_px=FRAME)
    assert_equal(imported, EVENTS)
    unit = "seconds" if kind == "seconds" else "microseconds"
    (note,) = imported.notes
    assert note.startswith(f"assumed: columns {' '.join(order)}, time in {unit}, polarity 1 brighter")


@pytest.mark.parametrize("names", ["t x y p", "ts xs ys ps", "timestamps X Y polarity", "t_us x y pol"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_named_columns(tmp_path: Path, names: str, save: Callable[..., None]) -> None:
    """Assert that arrays are found by the names that data sets use, and that the rest is counted."""
    columns = dict(zip(names.split(), EVENTS, strict=True))
    save(tmp_path / "a.npz", frames=np.zeros((2, 30, 40), np.uint8), **columns)
    imported = read_events(tmp_path / "a.npz", frame_px=FRAME)
    assert_equal(imported, EVENTS)
    assert imported.left_out == {"values of frames": 2400}
    assert imported.notes[0] == "left out: values of frames 2,400"
    assert any("microseconds" in note for note in imported.notes) == ("t_us" not in names)


@pytest.mark.parametrize(("name", "times"), [("t_s", 1e-6), ("t_ms", 1e-3), ("t_ns", 1000)])
def test_a_unit_in_the_name_decides(tmp_path: Path, name: str, times: float) -> None:
    """Assert that s, ms and ns are read as such, those of a clock that counts from 1970 in whole ns too."""
    start = 1_600_000_000_000_000 if name == "t_ns" else 1000
    events = EVENTS._replace(t=EVENTS.t - EVENTS.t[0] + start)
    columns = {name: events.t * (np.int64(times) if times > 1 else times)}
    np.savez(tmp_path / "a.npz", x=events.x, y=events.y, p=events.p, **columns)
    assert_equal(read_events(tmp_path / "a.npz", frame_px=FRAME), events)


def test_blocks_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the same events in blocks of any size, from all layouts, and places that are counted through."""
    monkeypatch.setattr(read_numpy, "BATCH_ROWS", 7)
    events = EVENTS.part(0, 100)
    table = np.stack([column.astype(np.int64) for column in events], axis=1)
    np.savez_compressed(tmp_path / "c.npz", t=events.t, x=events.x, y=events.y, p=events.p)
    np.savez_compressed(tmp_path / "f.npz", np.asfortranarray(table))
    np.save(tmp_path / "t.npy", table)
    for name in ("c.npz", "f.npz", "t.npy"):
        assert_equal(read_events(tmp_path / name, frame_px=FRAME), events)
    table[50, 0] = 0
    np.savez(tmp_path / "late.npz", t=table[:, 0], x=events.x, y=events.y, p=events.p)
    assert "at index 50 from" in refusal(tmp_path / "late.npz", frame_px=FRAME)


def test_no_events_are_a_recording_without_any(tmp_path: Path) -> None:
    """Assert that empty arrays are read as such, once the frame is said."""
    np.save(tmp_path / "a.npy", np.empty((0, 4)))
    imported = read_events(tmp_path / "a.npy", frame_px=FRAME)
    assert (imported.events.size, imported.slices) == (0, 0)
    assert "--frame-size" in refusal(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"a": np.zeros((3, 5))}, "found:    a float64 of shape (3, 5)"),
        (
            {"t": np.zeros(3), "ts": np.zeros(3), "x": np.zeros(3), "y": np.zeros(3), "p": np.zeros(3)},
            "no event columns",
        ),
        ({"t": np.zeros(3), "x": np.zeros(2), "y": np.zeros(3), "p": np.zeros(3)}, "columns differ in length"),
        ({"a": np.zeros(3, [("t", "i8"), ("x", "i2"), ("y", "i2"), ("q", "i1")])}, "fields t, x, y, q"),
        ({"a": np.zeros(3, [("t", "i8", (2,)), ("x", "i2"), ("y", "i2"), ("p", "i1")])}, "no event columns"),
    ],
)
def test_other_arrays_are_refused(tmp_path: Path, arrays: dict[str, Any], words: str) -> None:
    """Assert that what holds no events is refused with what it holds."""
    np.savez(tmp_path / "a.npz", **arrays)
    assert words in refusal(tmp_path / "a.npz", frame_px=FRAME)


class Trap:
    """What would leave a mark if it were ever loaded."""

    def __reduce__(self) -> Any:
        return (open, (str(Path(__file__).parent / "was_run"), "w"))


def test_objects_are_never_loaded(tmp_path: Path) -> None:
    """Assert that arrays of Python objects are refused in words, alone, in an archive and as a field, or left out."""
    trap = np.array([Trap(), 1], object)
    np.save(tmp_path / "a.npy", trap)
    np.savez(tmp_path / "b.npz", t=trap, x=trap, y=trap, p=trap)
    np.save(tmp_path / "c.npy", np.zeros(2, [("t", object), ("x", "i2"), ("y", "i2"), ("p", "i1")]))
    for name in ("a.npy", "b.npz", "c.npy"):
        assert "Python objects" in refusal(tmp_path / name, frame_px=FRAME)
    np.savez(tmp_path / "d.npz", **EVENTS._asdict(), about=trap)
    imported = read_events(tmp_path / "d.npz", frame_px=FRAME)
    assert_equal(imported, EVENTS)
    assert imported.left_out["values of about"] == 2
    assert not (Path(__file__).parent / "was_run").exists()


def test_an_archive_that_unpacks_to_more_than_events_can(tmp_path: Path) -> None:
    """Assert that zeros packed a thousandfold are refused at once, before any of them is unpacked."""
    rows = 17_000_000
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        member.write(npy(b"", "'|u1'", (rows, 4)))
        for _ in range(rows * 4 >> 20):
            member.write(bytes(1 << 20))
        member.write(bytes(rows * 4 % (1 << 20)))
    assert path.stat().st_size < 1 << 18
    tracemalloc.start()
    words = refusal(path, frame_px=FRAME)
    assert "unpack to too much" in words
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


@pytest.mark.parametrize(
    "head",
    [
        b"\x93NUMPY\x01\x00",
        b"\x93NUMPY\x09\x00" + struct.pack("<H", 10) + b"{}        ",
        npy(bytes(64), "'<i8'", (2**62, 4)),
        npy(bytes(64), "'<i8'", (1000, 4)),
        npy(bytes(64), "__import__('os').system('false')", (2, 4)),
    ],
)
def test_odd_headers_are_refused(tmp_path: Path, head: bytes) -> None:
    """Assert that a header which cannot be, or announces more than there is, is refused in words."""
    (tmp_path / "a.npy").write_bytes(head)
    refusal(tmp_path / "a.npy", frame_px=FRAME)


def test_broken_archives_are_refused(tmp_path: Path) -> None:
    """Assert that an npz cut anywhere, or with a changed byte in its data, is refused and never half read."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, t=EVENTS.t, x=EVENTS.x, y=EVENTS.y, p=EVENTS.p)
    whole = path.read_bytes()
    for length in range(5, len(whole), len(whole) // 20):
        path.write_bytes(whole[:length])
        refusal(path, frame_px=FRAME)
    for at in range(200, len(whole) - 400, len(whole) // 20):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        refusal(path, frame_px=FRAME)


def test_the_words_of_a_camera(outside_file: Callable[[str], Path]) -> None:
    """Assert that the npz of a DVXplorer Mini gives its 70,789 events, sorted, and counts the words beside them."""
    path = outside_file("dvxplorer_mini_words.npz")
    imported = read_events(path, order=OrderOptions(sort=True))
    with np.load(path) as given:
        assert imported.events.size == len(given["t_us"]) == 70_789
        assert np.array_equal(np.sort(given["t_us"]) - given["t_us"].min(), imported.events.t)
        assert imported.left_out == {"values of words": given["words"].size}
