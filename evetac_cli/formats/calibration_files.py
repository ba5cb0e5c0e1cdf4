"""Read the dot grid that the official software stores as a pickle, and write the grid of a recording.

The pickle is a tuple of two arrays: centres (n, 2) as (x, y), and sizes (n, 1). The official software calls the sizes
radii, but they are those of OpenCV's blob detector (cv::KeyPoint): diameters. With a radius of 20.6 px, evetac's
tracker would search for the rims of dots outside of them, and would not move.

A pickle is a small program, and loading one means running it. Here only the opcodes that numpy's pickles have are
known. Every name is looked up in one table of substitutes of this module, so that no other function can be called.
Without dictionaries, a pickle cannot change the substitutes either. Python's own unpickler
is used because the compiled one allocates memory for any number that a pickle states.
"""

import io
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.jobs import Progress
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.calibration.grid import MOST_DOTS
from evetac_cli.store.calibration import stored_calibration, write_calibration
from evetac_cli.store.layout.provenance import time_host_versions
from evetac_cli.store.recordings.read import Recording
from evetac_cli.text_files import read_bytes

MOST_BYTES = 1 << 20  # the official file has 1,735
EXPECTED = "a pickle of centres (n, 2) and radii (n, 1), as the official software writes it"
OPCODES = """
    PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG1 FLOAT BINFLOAT
    UNICODE BINUNICODE SHORT_BINUNICODE BINBYTES SHORT_BINBYTES BYTEARRAY8
    EMPTY_LIST LIST APPEND APPENDS EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 GLOBAL STACK_GLOBAL REDUCE BUILD
    MEMOIZE PUT BINPUT LONG_BINPUT GET BINGET LONG_BINGET
"""
NUMBERS = ("f4", "f8", "i4", "i8", "u4", "u8")
PROTOCOL = 3  # of the pickle that is written: the newest that stores module names as lines of text


class _Type:
    """Substitute for a dtype: one of NUMBERS."""

    def __init__(self, code: Any, *_: Any) -> None:
        if code not in NUMBERS:
            raise pickle.UnpicklingError(f"numbers of type {str(code)[:20]!r}, not {', '.join(NUMBERS)}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Substitute for an array: empty until the bytes that its shape needs are there."""

    values: NDArray[Any] = np.empty(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, type_, columns_first, content = state
        self.values = np.frombuffer(content, type_.dtype).reshape(shape, order="F" if columns_first else "C")


def _array(content: Any, type_: Any, shape: Any = (), order: Any = "C") -> _Array:
    array = _Array()
    array.__setstate__((1, shape, type_, order == "F", content))
    return array


@lru_cache(maxsize=64)  # a pickle may name one text again and again
def _latin1(text: str, _: Any) -> bytes:
    """Convert text to bytes; protocol 2 and older store bytes this way."""
    return text.encode("latin1")


_NAMES: dict[str, Any] = {
    "_codecs.encode": _latin1,
    "numpy.ndarray": "ndarray",  # the class that _reconstruct is called with
    "numpy.dtype": _Type,
    "numpy.core.multiarray._reconstruct": lambda *_: _Array(),
    "numpy.core.multiarray.scalar": lambda type_, content: _array(content, type_),
    "numpy.core.numeric._frombuffer": _array,
}


class _Reader(pickle._Unpickler):
    dispatch = {
        code: pickle._Unpickler.dispatch[code] for code in (getattr(pickle, name)[0] for name in OPCODES.split())
    }

    def find_class(self, module: str, name: str) -> Any:
        """Look a name up in the table of substitutes; nothing is ever imported."""
        full_name = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        if full_name not in _NAMES:
            raise pickle.UnpicklingError(f"it uses {full_name[:80]}, which a calibration does not need")
        return _NAMES[full_name]


def read_pickle(path: Path) -> tuple[NDArray[np.float64], float]:
    """Return centres (n, 2) as (x, y), in the file's order, and half the mean size, in px.

    Raises InputError for any other pickle.
    """
    content = read_bytes(path, MOST_BYTES)
    try:
        centres, radii = (_numbers(part) for part in _Reader(io.BytesIO(content)).load())
    except Exception as error:  # a damaged or malicious pickle can raise nearly any
        raise InputError(f"not a calibration: {str(error)[:200]}", where=str(path), expected=EXPECTED) from None
    count = len(centres) if centres.ndim else 0
    if centres.shape != (count, 2) or not 0 < count <= MOST_DOTS or radii.size != count:
        found = f"shapes {centres.shape} and {radii.shape}"
        raise InputError("not a calibration", where=str(path), expected=f"{EXPECTED}, n to {MOST_DOTS}", found=found)
    if not (np.isfinite(centres).all() and np.isfinite(radii).all() and (radii > 0).all()):
        raise InputError("a centre or radius is not a number, or a radius not above 0", where=str(path))
    return centres, 0.5 * float(radii.mean())


def _numbers(value: Any) -> NDArray[np.float64]:
    """Return an array, a list of numbers, or a list of such lists, as float64."""
    if isinstance(value, _Array):
        return value.values.astype(np.float64)
    rows = value[: MOST_DOTS + 1]
    return np.array([[_number(item) for item in row[:3]] if isinstance(row, list) else _number(row) for row in rows])


def _number(value: Any) -> float:
    return float(value.values.item() if isinstance(value, _Array) else value)


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write the recording's grid as JSON for `--calibration`, or as the pickle; raise InputError if it has none."""
    if recording.dot_xy_px is None:
        raise InputError("the recording has no dot grid", where=str(recording.path), hint="evetac calibrate finds one")
    calibration = stored_calibration(recording)
    dot_xy_px = calibration.dot_xy_px.reshape(-1, 2)
    if path.suffix.lower() == ".pkl":
        path.write_bytes(official(dot_xy_px, calibration.dot_radius_px))
        return
    neighbours = [[int(other) for other in row if other >= 0] for row in grid.neighbours(dot_xy_px)]
    header = recording.header
    about = {"recording": header["id"], "simulated": header["simulated"], "made": time_host_versions()}
    write_calibration(path, calibration, neighbours, {}, about, str(recording.path))


def official(dot_xy_px: NDArray[np.float64], radius_px: float) -> bytes:
    """Return the pickle of dots (n, 2); missing dots are left out, because the format cannot represent them.

    With numpy 2, it would have module names that the official software's numpy 1.24 does not have. The older names are
    written instead, which all versions accept.
    """
    present = dot_xy_px[np.isfinite(dot_xy_px).all(axis=1)].astype(np.float64)
    content = pickle.dumps((present, np.full((len(present), 1), 2.0 * radius_px)), protocol=PROTOCOL)
    return content.replace(b"cnumpy._core.", b"cnumpy.core.")
