"""Convert columns between numpy and Arrow through their buffers.

Reason: when pyarrow converts Python or numpy values, it first checks whether they are pandas objects and imports pandas
if it is installed. That takes longer than writing a trial. For buffers pyarrow does not check.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def to_arrow(arrow: Any, values: NDArray[Any], missing: NDArray[np.bool_] | None = None) -> Any:
    """Return a column of numbers or booleans (rows,) as an Arrow array, null where `missing` is set; NaN stays NaN.

    arrow: the module pyarrow.
    """
    column = np.ascontiguousarray(values)
    type_ = arrow.from_numpy_dtype(column.dtype)
    data = np.packbits(column, bitorder="little") if column.dtype == np.bool_ else column
    valid = None
    if missing is not None and missing.any():
        valid = arrow.py_buffer(np.packbits(~missing, bitorder="little"))
    return arrow.Array.from_buffers(type_, len(column), [valid, arrow.py_buffer(data)])


def repeated(arrow: Any, value: str | int | bool | None, type_: Any, rows: int) -> Any:
    """Return a column with the same value in every row; type_: Arrow's string, int64 or bool."""
    if value is None:
        return arrow.nulls(rows, type_)
    if type_ == arrow.string():
        text = str(value).encode()
        ends = np.array([0, len(text)], np.int32)
        one = arrow.Array.from_buffers(type_, 1, [None, arrow.py_buffer(ends), arrow.py_buffer(text)])
    else:
        one = to_arrow(arrow, np.array([value], np.bool_ if type_ == arrow.bool_() else np.int64))
    return arrow.repeat(one[0], rows)


def to_numpy(column: Any) -> NDArray[Any]:
    """Return an Arrow array of numbers or booleans as a numpy array; if it has nulls, as floats with NaN."""
    first, stop = column.offset, column.offset + len(column)
    kind = str(column.type)
    if kind == "null":
        return np.full(len(column), np.nan)
    data = column.buffers()[1]
    if kind == "bool":
        values: NDArray[Any] = _bits(data, first, stop)
    else:
        values = np.frombuffer(data, column.type.to_pandas_dtype(), stop)[first:] if stop else np.empty(0)
    if not column.null_count:
        return values
    valid = is_known(column)
    floats = values.astype(values.dtype if values.dtype.kind == "f" else np.float64)
    floats[~valid] = np.nan
    return floats


def is_known(column: Any) -> NDArray[np.bool_]:
    """Return a mask (rows,) of the rows of an Arrow array that are not null."""
    valid = column.buffers()[0]
    if valid is None:
        return np.full(len(column), not column.null_count)
    return _bits(valid, column.offset, column.offset + len(column))


def _bits(data: Any, first: int, stop: int) -> NDArray[np.bool_]:
    return np.unpackbits(np.frombuffer(data, np.uint8), count=stop, bitorder="little")[first:].view(np.bool_)
