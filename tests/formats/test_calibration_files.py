"""The official pickle, read and not run: what numpy writes comes through, all else is refused and does nothing."""

import builtins
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.errors import InputError
from evetac_cli.formats.calibration_files import read_pickle
from evetac_cli.store.calibration import read_calibration

CENTRES = np.arange(24.0).reshape(12, 2)
RADII = np.full((12, 1), 20.5)


def read(folder: Path, content: bytes) -> Any:
    path = folder / "grid.pkl"
    path.write_bytes(content)
    return read_pickle(path)


class Calls:
    """Pickles as a call of anything with anything."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Any, Any]:
        return self.call


def test_the_official_file(outside_file: Callable[[str], Path]) -> None:
    """Assert that the official file holds the centres of its JSON twin, and diameters."""
    centres, radius = read_pickle(outside_file("evetac_base_calibration.pkl"))
    assert 2 * radius == pytest.approx(20.62, abs=0.005)
    twin = read_calibration(outside_file("evetac_base_calibration.json")).dot_xy_px.reshape(-1, 2)
    order = np.lexsort(centres.round(3).T), np.lexsort(twin.T)
    np.testing.assert_allclose(centres[order[0]], twin[order[1]], atol=5.1e-4)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    "change",
    [
        lambda a: a,
        lambda a: a.astype(">f8"),
        lambda a: a.astype(np.float32),
        lambda a: a.astype(np.int64),
        np.asfortranarray,
        lambda a: a.tolist(),
        lambda a: [list(row) for row in a],
    ],
    ids=["plain", "big-endian", "single", "integers", "columns first", "lists", "lists of scalars"],
)
def test_what_numpy_writes(tmp_path: Path, protocol: int, change: Callable[[Any], Any]) -> None:
    """Assert that arrays and lists of numbers come through every protocol, in any memory order."""
    for pair in (tuple, list):
        content = pickle.dumps(pair([change(CENTRES), change(RADII)]), protocol)
        centres, radius = read(tmp_path, content)
        np.testing.assert_array_equal(centres, CENTRES)
        assert 2 * radius == pytest.approx(20.5, abs=0.5)


def hostile(owned: Path) -> dict[str, bytes]:
    """Pickles that do something, if they are run."""
    touch = f"touch {owned}"
    calls = {
        "os.system": Calls(os.system, touch),
        "eval": Calls(builtins.eval, f"open({str(owned)!r}, 'w')"),
        "numpy.load": Calls(np.load, str(owned), None, True),
        "numpy.ndarray.tofile": Calls(np.ndarray.tofile, CENTRES, str(owned)),
        "numpy.zeros": Calls(np.zeros, (10**6, 10**6)),
    }
    files = {name: pickle.dumps((call, RADII), 4) for name, call in calls.items()}
    files |= {f"{name}, protocol 0": pickle.dumps(call, 0) for name, call in calls.items()}
    return files


NAMES = list(hostile(Path("x")))


@pytest.mark.parametrize("name", NAMES)
def test_hostile_pickles_do_nothing(tmp_path: Path, name: str) -> None:
    """Assert that a pickle that calls anything is refused with the name of what it calls, and has not called it."""
    owned = tmp_path / "owned"
    with pytest.raises(InputError, match="which a calibration does not need"):
        read(tmp_path, hostile(owned)[name])
    assert [file.name for file in tmp_path.iterdir()] == ["grid.pkl"]


RECONSTRUCT = b"\x80\x04cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"


def array_of(shape: bytes, type_: bytes, content: bytes) -> bytes:
    """A pickled array whose parts are given as opcodes."""
    dtype = (
        b"cnumpy\ndtype\n"
        + type_
        + b"\x89\x88\x87R(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    )
    return RECONSTRUCT + b"K\x00\x85C\x01b\x87R(K\x01" + shape + dtype + b"\x89" + content + b"tb"


F8 = b"X\x02\x00\x00\x00f8"
HUGE = b"\x8a\x06" + (10**13).to_bytes(6, "little")
CRAFTED: dict[str, bytes] = {
    "huge shape": array_of(HUGE + b"K\x02\x86", F8, b"C\x08" + bytes(8)),
    "too few bytes": array_of(b"K\x0cK\x02\x86", F8, b"C\x08" + bytes(8)),
    "objects": array_of(b"K\x01K\x02\x86", b"X\x02\x00\x00\x00O8", b"]"),
    "bytes of 2**62": b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"abc.",
    "persistent id": b"Pfile\n.",
    "instance": b"(S'touch x'\nios\nsystem\n.",
    "state of a function": b"\x80\x04cnumpy\ndtype\n}X\x04\x00\x00\x00nameK\x01sb.",
    "attributes of a function": b"\x80\x04cnumpy\ndtype\nN}X\x08\x00\x00\x00__code__K\x01s\x86b.",
    "nothing": b"",
    "no end": b"\x80\x04K\x01",
    "one array": pickle.dumps(CENTRES),
    "ragged": pickle.dumps(([[1.0, 2.0], [3.0]], [1.0])),
    "centres of three": pickle.dumps((np.zeros((4, 3)), np.ones((4, 1)))),
    "not finite": pickle.dumps((CENTRES * np.nan, RADII)),
    "too long": pickle.dumps((np.zeros((100_000, 2)), np.ones((100_000, 1)))),
}  # fmt: skip


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_pickles_are_refused(tmp_path: Path, name: str) -> None:
    """Assert that damaged, greedy and foreign pickles are refused in words, with their file."""
    with pytest.raises(InputError) as refused:
        read(tmp_path, CRAFTED[name])
    assert str(refused.value).startswith(f"{tmp_path / 'grid.pkl'}: ")


def test_nothing_of_the_module_is_changed(tmp_path: Path) -> None:
    """Assert that a pickle that sets attributes of the stand-ins does not change what the next one is read with."""
    for name in ("state of a function", "attributes of a function"):
        with pytest.raises(InputError):
            read(tmp_path, CRAFTED[name])
    centres, _ = read(tmp_path, pickle.dumps((CENTRES, RADII)))
    np.testing.assert_array_equal(centres, CENTRES)


@given(st.data())
@settings(deadline=None, max_examples=200)
def test_damaged_files(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Assert that a valid file with bytes changed or cut off is read or refused, and nothing else happens."""
    content = bytearray(pickle.dumps((CENTRES, RADII), data.draw(st.integers(0, 5))))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.pkl"
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    try:
        centres, radius = read_pickle(path)
    except InputError:
        return
    assert np.isfinite(centres).all()
    assert radius > 0


def doubled(start: bytes, twice: bytes) -> bytes:
    """A value that holds the one before it twice, sixty times over."""
    content = b"\x80\x04" + start + b"\x94"
    for number in range(60):
        content += twice.replace(b"N", bytes([number])) + b"\x94"
    return content


BOMBS = {
    "lists of lists": doubled(b"]", b"](hNhNe") + b"h\x3bh\x3b\x86.",
    "tuples of tuples as a key": b"\x80\x04}" + doubled(b")", b"hNhN\x86")[2:] + b"K\x01s.",
    "one text as bytes, again and again": b"\x80\x04c_codecs\nencode\n\x94X\x00\x00\x08\x00"
    + b"a" * (1 << 19)
    + b"\x94X\x06\x00\x00\x00latin1\x94]("
    + b"h\x00h\x01h\x02\x86R" * 40_000
    + b"e.",
}  # fmt: skip


@pytest.mark.parametrize("name", BOMBS)
def test_small_pickles_of_a_large_value_are_refused(tmp_path: Path, name: str) -> None:
    """Assert that a pickle of some kB that stands for more numbers than a computer holds is refused at once."""
    with pytest.raises(InputError, match="not a calibration"):
        read(tmp_path, BOMBS[name])
