"""The official software's calibration, read without executing it.

The official software keeps a dot grid as a pickle of two arrays: centres (n, 2) as (x, y), radii (n, 1). A pickle is a
small program, and loading a strange one is running it. Here

- only opcodes that build plain values are let through, and none that asks for more memory than the file has bytes;
- every name it asks for is looked up in a table of this module: stand-ins that take notes in place of numpy's
  functions. Nothing of numpy, of builtins or of any other module can be called, whatever the file says;
- arrays are made from the notes afterwards, with dtype, shape and number of bytes checked.

Why stand-ins: numpy's own `_reconstruct`, the one function that the official file needs, makes an array of whatever
shape the file says, before anybody has seen that it lacks the bytes.
"""

import io
import math
import pickle
import pickletools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError

MOST_BYTES = 1 << 20  # the official file has 1,735
MOST_MEMO = 10_000
NUMBERS = ("f4", "f8", "i4", "i8", "u4", "u8")

# Plain values, containers, the memo, and the three opcodes by which numpy's arrays come: a name, a call, its state.
_OPCODES = """
PROTO FRAME STOP MARK POP POP_MARK DUP NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 FLOAT BINFLOAT
STRING BINSTRING SHORT_BINSTRING UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8
BYTEARRAY8 EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST LIST APPEND APPENDS EMPTY_DICT DICT SETITEM SETITEMS
GET BINGET LONG_BINGET PUT BINPUT LONG_BINPUT MEMOIZE GLOBAL STACK_GLOBAL REDUCE BUILD
"""


@dataclass
class _Type:
    """What a pickle says of a dtype."""

    code: str
    order: str = "<"

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) > 1 and state[1] in ("<", ">", "=", "|"):
            self.order = state[1]
        else:
            raise pickle.UnpicklingError("a dtype without a byte order")

    def numpy(self) -> np.dtype[Any]:
        if self.code not in NUMBERS:
            raise pickle.UnpicklingError(f"numbers of type {str(self.code)[:20]!r}, not {', '.join(NUMBERS)}")
        return np.dtype(self.order.replace("|", "<") + self.code)


@dataclass
class _Array:
    """What a pickle says of an array."""

    shape: Any = None
    type: Any = None
    columns_first: Any = False
    content: Any = b""

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("an array without a state")
        _, self.shape, self.type, self.columns_first, self.content = state

    def numpy(self) -> NDArray[Any]:
        shape, content = self.shape, self.content
        if not isinstance(self.type, _Type) or not isinstance(content, (bytes, bytearray)):
            raise pickle.UnpicklingError("an array of something other than numbers")
        if not isinstance(shape, tuple) or len(shape) > 4 or not all(type(n) is int and n >= 0 for n in shape):
            raise pickle.UnpicklingError("an array without a shape")
        dtype = self.type.numpy()
        if math.prod(shape) * dtype.itemsize != len(content):
            raise pickle.UnpicklingError(f"an array of shape {shape} in {len(content)} bytes")
        return np.frombuffer(content, dtype).reshape(shape, order="F" if self.columns_first else "C")


# A pickle can write to what it can name, so it can name functions and texts, and no class.
def _reconstruct(*_: Any) -> _Array:
    return _Array()


def _from_buffer(content: Any, type_: Any, shape: Any, order: Any = "C") -> _Array:
    return _Array(shape, type_, order == "F", content)


def _scalar(type_: Any, content: Any) -> _Array:
    return _Array((), type_, False, content)


def _type(code: Any, *_: Any) -> _Type:
    return _Type(code)


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError("text in another encoding than latin1")
    return text.encode("latin1")


_NAMES: dict[tuple[str, str], Any] = {("numpy", "ndarray"): "ndarray", ("numpy", "dtype"): _type}
_NAMES[("_codecs", "encode")] = _encode  # how protocol 2 and older write bytes
for _core in ("numpy.core", "numpy._core"):
    _NAMES[(f"{_core}.multiarray", "_reconstruct")] = _reconstruct
    _NAMES[(f"{_core}.multiarray", "scalar")] = _scalar
    _NAMES[(f"{_core}.numeric", "_frombuffer")] = _from_buffer


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Look a name up in the table of stand-ins; nothing is ever imported."""
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"it asks for {module[:40]}.{name[:40]}, which a calibration does not need")
        return _NAMES[(module, name)]


def read_pickle(path: Path) -> tuple[NDArray[np.float64], float]:
    """Centres (n, 2) as (x, y) in px, in the file's order, and the mean radius in px; InputError for anything else."""
    expected = "a pickle of centres (n, 2) and radii (n, 1), as the official software writes it"
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise pickle.UnpicklingError(f"more than {MOST_BYTES} bytes")
        _check_opcodes(content)
        value = _Reader(io.BytesIO(content)).load()
        if not isinstance(value, (tuple, list)) or len(value) != 2:
            raise pickle.UnpicklingError("not two arrays")
        centres, radii = (_numbers(part) for part in value)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from None
    # A damaged or hostile pickle can make the unpickler raise any of these, and each means: refused.
    except (
        pickle.UnpicklingError, ValueError, TypeError, KeyError, IndexError, AttributeError, EOFError, OverflowError,
        RecursionError, MemoryError,
    ) as error:  # fmt: skip
        raise InputError(f"not a calibration: {str(error)[:200]}", where=str(path), expected=expected) from None
    count = len(centres) if centres.ndim else 0
    if centres.shape != (count, 2) or count == 0 or radii.size != count or not np.isfinite(centres).all():
        raise InputError(
            "not a calibration", where=str(path), expected=expected, found=f"shapes {centres.shape} and {radii.shape}"
        )
    if not (np.isfinite(radii).all() and (radii > 0).all()):
        raise InputError("a radius is not a number above 0", where=str(path), expected=expected)
    return centres, float(radii.mean())


def _check_opcodes(content: bytes) -> None:
    """Refuse opcodes that no calibration needs; genops reads arguments only as far as the file goes."""
    allowed = _OPCODES.split()
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name not in allowed:
            raise pickle.UnpicklingError(f"opcode {opcode.name}, which a calibration does not need")
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > MOST_MEMO:
            raise pickle.UnpicklingError(f"a memo of {argument} entries")


def _numbers(value: Any) -> NDArray[np.float64]:
    """An array that was noted down, or nested lists of numbers."""
    array = np.array(_plain(value))
    if not isinstance(value, (_Array, list)) or array.dtype.kind not in "iuf":
        raise pickle.UnpicklingError("something other than arrays of numbers")
    return array.astype(np.float64)


def _plain(value: Any) -> Any:
    """Lists with arrays in place of what was noted down of them."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value.numpy() if isinstance(value, _Array) else value
