"""Datasets of chunks with gzip and shuffle, compressed and decompressed here.

Every HDF5 tool reads them without a plugin. ISA-L (isal) compresses events four times as fast as the zlib in HDF5, to
the same size, and decompresses them in two thirds of the time. With zlib, this is most of the time for writing or
reading a file of events.
"""

import math
from typing import Any

import h5py
import numpy as np
from h5py import h5d, h5s, h5z
from isal import igzip_lib, isal_zlib
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


class RowReader:
    """Reads rows of a dataset; the last decompressed chunk is kept for further rows in it.

    Chunks with another compression, or none, are read by HDF5.
    """

    def __init__(self, dataset: h5d.DatasetID, dtype: np.dtype[Any]) -> None:
        self._dataset, self._shape, self._dtype = dataset, dataset.shape, dtype
        recipe = dataset.get_create_plist()
        self._chunks: Any = recipe.get_chunk() if recipe.get_layout() == h5d.CHUNKED else ()
        self._first = -1  # first row of the kept chunk
        self._kept: NDArray[Any] = np.empty(0)
        self._nothing = self._kept
        filters = [recipe.get_filter(number)[0] for number in range(recipe.get_nfilters())]
        self._ours = (
            filters == [h5z.FILTER_SHUFFLE, h5z.FILTER_DEFLATE]
            and self._chunks[1:] == self._shape[1:]
            and self._dtype.kind in "iuf"
        )

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the rows [start, stop) as stored; OSError if a chunk is damaged."""
        if not self._ours or start >= stop:
            return self._by_hdf5(start, stop)
        chunk = self._chunks[0]
        rows = np.empty((stop - start, *self._shape[1:]), self._dtype)
        for first in range(start - start % chunk, stop, chunk):
            if first != self._first:
                self._kept, self._first = self._nothing, -1  # free the old chunk first
                self._kept, self._first = self._unpacked(first), first
            begin, end = max(start, first), min(stop, first + chunk)
            rows[begin - start : end - start] = self._kept[begin - first : end - first]
        return rows

    def _unpacked(self, first: int) -> NDArray[Any]:
        """Return the decompressed chunk that starts at this row."""
        left_out, packed = self._dataset.read_direct_chunk((first,) + (0,) * (len(self._shape) - 1))
        if left_out:  # the writer skipped some filters
            return self._by_hdf5(first, min(first + self._chunks[0], self._shape[0]))
        size = math.prod(self._chunks) * self._dtype.itemsize
        unpacker = isal_zlib.decompressobj()
        try:
            shuffled = unpacker.decompress(packed, size + 1)  # limited, against decompression bombs
        except igzip_lib.IsalError as error:  # type: ignore[misc]  # its stub says no class
            raise OSError(f"a chunk cannot be unpacked: {error}") from None
        if len(shuffled) != size or not unpacker.eof:
            raise OSError(f"a chunk does not unpack to its {size} bytes")
        planes = np.frombuffer(shuffled, np.uint8).reshape(self._dtype.itemsize, -1)
        numbers = np.empty(planes.shape[::-1], np.uint8)
        for place, plane in enumerate(planes):  # three times as fast as a copy of planes.T
            numbers[:, place] = plane
        chunk: NDArray[Any] = numbers.view(self._dtype).reshape(self._chunks)
        return chunk

    def _by_hdf5(self, start: int, stop: int) -> NDArray[Any]:
        rows = np.empty((max(0, stop - start), *self._shape[1:]), self._dtype)
        if rows.size:
            space = self._dataset.get_space()
            space.select_hyperslab((start,) + (0,) * (len(self._shape) - 1), rows.shape)
            self._dataset.read(h5s.create_simple(rows.shape), space, rows)
        return rows


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
