"""Datasets of chunks with gzip and shuffle, compressed here.

Every HDF5 tool reads them without a plugin. ISA-L (isal) compresses events four times as fast as the zlib in HDF5, to
the same size. With zlib, this is most of the time for writing a file of events.
"""

from typing import Any

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

CHUNK_ROWS = 65536
CHUNK_BYTES = 1 << 20
FEW = 64  # fewer numbers are not worth a chunk
ISAL_LEVEL = 2  # 2.0 of 13 bytes per event, as with zlib's level 1
GZIP_LEVEL = 1  # level declared in the dataset, which HDF5 uses for rows that another program adds


class RowWriter:
    """Creates a dataset and writes its rows in blocks of any size; the dataset is complete once it is closed.

    A dataset of fewer than FEW numbers is not compressed. Rows that are larger than a chunk, such as large images, use
    several chunks each, which HDF5 compresses.
    """

    def __init__(
        self, h5: h5py.File, name: str, dtype: Any, row_shape: tuple[int, ...], length: int | None = None
    ) -> None:
        """length: number of rows; None if unknown, and the dataset may grow later."""
        size = int(np.prod(row_shape, dtype=np.int64))
        row_bytes = max(1, size * np.dtype(dtype).itemsize)
        self._packs = length is None or length * size >= FEW
        if not self._packs:
            self.dataset = h5.create_dataset(name, shape=(length, *row_shape), dtype=dtype, track_times=False)
        else:
            chunk = max(1, min(CHUNK_ROWS, CHUNK_BYTES // row_bytes, CHUNK_ROWS if length is None else length))
            within_row = row_shape
            if row_bytes > CHUNK_BYTES:
                self._packs = False
                within_row = (max(1, CHUNK_BYTES * row_shape[0] // row_bytes), *row_shape[1:])
            self.dataset = h5.create_dataset(
                name,
                shape=(length or 0, *row_shape),
                maxshape=(None, *row_shape) if length is None else None,
                dtype=dtype,
                chunks=(chunk, *within_row),
                compression="gzip",
                compression_opts=GZIP_LEVEL,
                shuffle=True,
                track_times=False,
            )
            self._open = np.zeros((chunk, *within_row), dtype)  # the chunk that is not full yet
        self._grows = length is None
        self._extent = length or 0  # of the dataset; it grows in large steps, because each step costs 60 us
        self.rows = 0

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows at the end."""
        first, self.rows = self.rows, self.rows + len(rows)
        if self._grows and self.rows > self._extent:
            self._extent = max(self.rows, 2 * self._extent)
            self.dataset.resize(self._extent, axis=0)
        if not self._packs:
            self.dataset[first : self.rows] = rows
            return
        chunk = len(self._open)
        taken = 0
        while taken < len(rows):
            at = (first + taken) % chunk
            count = min(chunk - at, len(rows) - taken)
            self._open[at : at + count] = rows[taken : taken + count]
            taken += count
            if at + count == chunk:
                self._pack(first + taken - chunk)

    def close(self) -> None:
        """Write the remaining rows."""
        if self._packs and (waiting := self.rows % len(self._open)):
            self._open[waiting:] = 0
            self._pack(self.rows - waiting)
        if self._grows and self.rows < self._extent:
            self.dataset.resize(self.rows, axis=0)

    def _pack(self, first: int) -> None:
        """Write the open chunk, which starts at row `first` of the dataset."""
        numbers = np.frombuffer(self._open, np.uint8).reshape(-1, self._open.itemsize)
        shuffled = np.ascontiguousarray(numbers.T)  # first bytes of all numbers, then second bytes, ...
        packed = isal_zlib.compress(shuffled, ISAL_LEVEL)
        self.dataset.id.write_direct_chunk((first,) + (0,) * (self._open.ndim - 1), packed)


def put(h5: h5py.File, name: str, value: Any) -> None:
    """Write one whole dataset: texts and scalars uncompressed, arrays as by a RowWriter."""
    if isinstance(value, str):
        h5.create_dataset(name, data=value, dtype=h5py.string_dtype(), track_times=False)
        return
    array = np.asarray(value)
    if array.size < FEW:
        h5.create_dataset(name, data=array, track_times=False)
        return
    writer = RowWriter(h5, name, array.dtype, array.shape[1:], len(array))
    writer.append(array)
    writer.close()
