"""Files of events that are not read: each hint on how to convert one is followed here, and what comes of it is read."""

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from evetac_cli.events import Events
from evetac_cli.formats.imports import read_events
from tests.importing import drawn, refusal, same

EVENTS = drawn(500, frame_px=(200, 180), start_us=0)


def hint_of(path: Path) -> str:
    """What to do about a file, as the refusal says it; a long one without its middle would be of no use."""
    words = refusal(path)
    assert "[...]" not in words
    return words.partition("  try:      ")[2]


def follow(code: str, path: Path, **known: Any) -> None:
    """Run Python of a hint, with the file's name in place of A."""
    exec(code.replace("'A.", f"'{path.with_suffix('')}."), {"numpy": np, "scipy": scipy, "h5py": h5py, **known})


def assert_read(path: Path, events: Events) -> None:
    imported = read_events(path, frame_px=None if path.suffix == ".aedat4" else (304, 240))
    assert same(imported.events, events._replace(t=events.t - events.t[0]))


def test_event_stream_by_faery(tmp_path: Path) -> None:
    """Assert that the hint for .es makes an AEDAT4 file of the same events."""
    faery = pytest.importorskip("faery")
    from faery.file_encoder import events_to_file

    array = np.zeros(EVENTS.size, faery.EVENTS_DTYPE)
    for ours, theirs in zip(EVENTS, ("t", "x", "y", "on"), strict=True):
        array[theirs] = ours
    path = tmp_path / "a.es"
    events_to_file([array], path, (304, 240), zero_t0=False)
    assert path.read_bytes().startswith(b"Event Stream")
    code = re.search('python -c "(.*)"', hint_of(path))
    assert code is not None
    follow(code[1], path)
    assert_read(path.with_suffix(".aedat4"), EVENTS)


def mat5(path: Path, columns: dict[str, Any]) -> None:
    """A file of MATLAB up to version 7, as scipy writes it."""
    scipy.io.savemat(path, {"TD": columns})


def mat7(path: Path, columns: dict[str, Any]) -> None:
    """A file of MATLAB 7.3: HDF5 behind a block of its own, columns as rows."""
    with h5py.File(path, "w", userblock_size=512) as h5:
        for name, column in columns.items():
            h5[f"TD/{name}"] = column[:, None]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Thu May  2 10:00:00 2024 HDF5 schema 1.00 .")


@pytest.mark.parametrize("write", [mat5, mat7])
def test_matlab(write: Callable[[Path, dict[str, Any]], None], tmp_path: Path) -> None:
    """Assert that what the hints for files of MATLAB name reads them, and that what they save is read."""
    path = tmp_path / "a.mat"
    write(path, {"ts": EVENTS.t, "x": EVENTS.x, "y": EVENTS.y, "p": EVENTS.p})
    hint = hint_of(path)
    if write is mat5:
        assert "scipy.io.loadmat('A.mat')" in hint
        table = scipy.io.loadmat(path)["TD"][0, 0]
        columns = {name: table[name].ravel() for name in ("ts", "x", "y", "p")}
    else:
        read = re.search(r"(h5py\.File\('A\.mat'\)\['TD/)ts(.*?ravel\(\))", hint)
        assert read is not None
        columns = {}
        for name in ("ts", "x", "y", "p"):
            follow(f"column.append({read[1]}{name}{read[2]})", path, column=(one := []))
            columns[name] = one[0]
    code = re.search(r"numpy\.savez\(.*?\)", hint)
    assert code is not None
    follow(code[0], path, t=columns["ts"], x=columns["x"], y=columns["y"], p=columns["p"])
    assert_read(path.with_suffix(".npz"), EVENTS)


def test_five_bytes_an_event(tmp_path: Path) -> None:
    """Assert that the Python of the hint for N-MNIST makes a file of the same events."""
    path = tmp_path / "a.bin"
    rows = zip(*(column.tolist() for column in EVENTS), strict=True)
    path.write_bytes(b"".join(struct.pack(">BBBH", x, y, p << 7 | t >> 16, t & 0xFFFF) for t, x, y, p in rows))
    hint = hint_of(path)
    assert "N-MNIST or N-Caltech101" in hint
    follow(hint[hint.index("b = numpy") :], path)
    assert_read(path.with_suffix(".npz"), EVENTS)
    path.write_bytes(path.read_bytes() + b"\0")
    assert "N-MNIST" not in refusal(path)


def test_packed_files(tmp_path: Path) -> None:
    """Assert that files that were packed are named."""
    import gzip

    path = tmp_path / "a.txt.gz"
    path.write_bytes(gzip.compress(b"1 2 3 1\n"))
    assert "gunzip" in hint_of(path)
    path = tmp_path / "a.db3.zstd"
    path.write_bytes(b"\x28\xb5\x2f\xfd" + bytes(40))
    assert "zstd -d" in hint_of(path) and "the bag's folder" in hint_of(path)
