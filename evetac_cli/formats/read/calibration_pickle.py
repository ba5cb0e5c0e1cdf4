"""Read the dot grid that the official software stores as a pickle: centres (n, 2) as (x, y), and sizes (n, 1).

The official software calls the sizes radii, but they are the sizes of OpenCV's blob detector (cv::KeyPoint): diameters.
With a radius of 20.6 px, evetac's tracker would search for the rims of dots outside of them, and would not move.

A pickle is a small program, and loading one means running it. Here every name in the pickle is looked up in one table
of substitutes defined in this module: nothing of numpy, builtins or any other module can be called.

Why even harmless names have substitutes: numpy's own `_reconstruct` allocates an array of any shape that the file
states, before the missing bytes are noticed, and numpy's dtypes may contain objects. Only the opcodes that numpy writes
are accepted: a key of tuples nested sixty deep would take 2^60 steps to look up.
"""

import io
import math
import pickle
import pickletools
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration.grid import MOST_DOTS
from evetac_cli.text_files import read_bytes

MOST_BYTES = 1 << 20  # the official file has 1,735
MOST_MEMO = 10_000
# The opcodes of numpy's pickles of every protocol, and of texts that Python 2 wrote.
OPCODES = """
    PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG1 FLOAT BINFLOAT
    STRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINBYTES SHORT_BINBYTES BYTEARRAY8
    EMPTY_LIST LIST APPEND APPENDS EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 GLOBAL STACK_GLOBAL REDUCE BUILD
    MEMOIZE PUT BINPUT LONG_BINPUT GET BINGET LONG_BINGET
"""
NUMBERS = ("f4", "f8", "i4", "i8", "u4", "u8")
BYTE_ORDERS = ("<", ">", "=", "|")


class _Type:
    """Substitute for a dtype: one of NUMBERS."""

    def __init__(self, code: Any) -> None:
        if code not in NUMBERS:
            raise pickle.UnpicklingError(f"numbers of type {str(code)[:20]!r}, not {', '.join(NUMBERS)}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in BYTE_ORDERS:
            raise pickle.UnpicklingError("a number type has no byte order")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Substitute for an array: empty until its state has been checked to have the bytes that its shape needs."""

    values: NDArray[Any] = np.empty(0)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("an array has no contents")
        _, shape, type_, columns_first, content = state
        if not isinstance(type_, _Type) or not isinstance(content, (bytes, bytearray)):
            raise pickle.UnpicklingError("an array has contents other than numbers")
        if not isinstance(shape, tuple) or len(shape) > 4 or not all(type(n) is int and n >= 0 for n in shape):
            raise pickle.UnpicklingError("an array has no valid shape")
        if math.prod(shape) * type_.dtype.itemsize != len(content):
            raise pickle.UnpicklingError(f"an array of shape {shape} has {len(content)} bytes")
        self.values = np.frombuffer(content, type_.dtype).reshape(shape, order="F" if columns_first else "C")


def _array(content: Any, type_: Any, shape: Any, order: Any = "C") -> _Array:
    array = _Array()
    array.__setstate__((1, shape, type_, order == "F", content))
    return array


class _Substitute:
    """A function that a pickle can call but not change, although pickles may set the state of objects they can name."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("the pickle sets the state of a function")


@lru_cache(maxsize=64)  # a pickle may name one text again and again
def _latin1(text: Any, encoding: Any) -> bytes:
    """Convert text to bytes; protocol 2 and older store bytes this way."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError("text is not encoded as latin1")
    return text.encode("latin1")


_DTYPE = _Substitute(lambda code, *_: _Type(code))
_RECONSTRUCT = _Substitute(lambda *_: _Array())
_SCALAR = _Substitute(lambda type_, content: _array(content, type_, ()))
_FROM_BUFFER = _Substitute(_array)
_NAMES: dict[str, Any] = {
    "_codecs.encode": _Substitute(_latin1),
    "numpy.ndarray": "ndarray",  # the class that _reconstruct is called with
    "numpy.dtype": _DTYPE,
    "numpy.core.multiarray._reconstruct": _RECONSTRUCT,
    "numpy._core.multiarray._reconstruct": _RECONSTRUCT,
    "numpy.core.multiarray.scalar": _SCALAR,
    "numpy._core.multiarray.scalar": _SCALAR,
    "numpy.core.numeric._frombuffer": _FROM_BUFFER,
    "numpy._core.numeric._frombuffer": _FROM_BUFFER,
}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Look a name up in the table of substitutes; nothing is ever imported."""
        if f"{module}.{name}" not in _NAMES:
            raise pickle.UnpicklingError(f"it uses {module[:40]}.{name[:40]}, which a calibration does not need")
        return _NAMES[f"{module}.{name}"]


def read_pickle(path: Path) -> tuple[NDArray[np.float64], float]:
    """Return centres (n, 2) as (x, y), in the file's order, and half the mean size, in px.

    Raises InputError for any other pickle.
    """
    expected = "a pickle of centres (n, 2) and radii (n, 1), as the official software writes it"
    try:
        content = read_bytes(path, MOST_BYTES)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about escapes in damaged strings, which do not help the user
            _check_opcodes(content)
            value = _Reader(io.BytesIO(content)).load()
        if not isinstance(value, (tuple, list)) or len(value) != 2:
            raise pickle.UnpicklingError("the pickle does not contain two arrays")
        centres, radii = (_numbers(part) for part in value)
    # A damaged or malicious pickle can make the unpickler raise any of these.
    except (
        pickle.UnpicklingError, ValueError, TypeError, KeyError, IndexError, AttributeError, EOFError, OverflowError,
        RecursionError, MemoryError,
    ) as error:  # fmt: skip
        raise InputError(f"not a calibration: {str(error)[:200]}", where=str(path), expected=expected) from None
    count = len(centres) if centres.ndim else 0
    if count > MOST_DOTS:
        raise InputError("not a calibration", where=str(path), expected=f"at most {MOST_DOTS} dots", found=str(count))
    if centres.shape != (count, 2) or count == 0 or radii.size != count or not np.isfinite(centres).all():
        raise InputError(
            "not a calibration", where=str(path), expected=expected, found=f"shapes {centres.shape} and {radii.shape}"
        )
    if not (np.isfinite(radii).all() and (radii > 0).all()):
        raise InputError("a radius is not a number above 0", where=str(path), expected=expected)
    return centres, 0.5 * float(radii.mean())


def _check_opcodes(content: bytes) -> None:
    """Refuse opcodes that numpy does not write, or that require more memory than the file has bytes.

    genops does not read beyond the end of the file.
    """
    allowed = OPCODES.split()
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name not in allowed:
            raise pickle.UnpicklingError(f"it uses {opcode.name}, which a calibration does not need")
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > MOST_MEMO:
            raise pickle.UnpicklingError(f"the memo has {argument} entries")


def _numbers(value: Any) -> NDArray[np.float64]:
    """Return an array, a list of numbers, or a list of such lists, as float64.

    A list is not longer than a grid and its rows than a dot, because lists may contain one other list many times.
    """
    if isinstance(value, list) and len(value) <= MOST_DOTS + 1:
        value = [[_plain(item) for item in row[:3]] if isinstance(row, list) else _plain(row) for row in value]
        array = np.array(value)
    else:
        array = np.asarray(_plain(value))
    if array.dtype.kind not in "iuf":
        raise pickle.UnpicklingError("contents other than arrays of numbers")
    return array.astype(np.float64)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        raise pickle.UnpicklingError(f"lists of more than {MOST_DOTS} numbers, or of other lists")
    return value.values if isinstance(value, _Array) else value
