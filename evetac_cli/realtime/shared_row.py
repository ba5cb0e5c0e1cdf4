"""A row of numbers in shared memory: written by one process, read by others, never read half written.

A checksum next to the row requires no lock and no guarantee about the order of memory writes. A reader that finds a
half-written row reads again, and uses the previous row if the writer died while writing.
"""

import mmap
import struct
import zlib

_TRIES = 1000


class SharedRow:
    """The row at `start` of a memory of zeros; form: its numbers, as in the module struct."""

    def __init__(self, memory: "mmap.mmap | memoryview[int]", start: int, form: str) -> None:
        self._memory = memory
        self._start = start
        self._form = struct.Struct("<q" + form)  # preceded by a counter
        self._count = 0
        self._last: tuple[int, tuple[float, ...]] | None = None

    @property
    def size(self) -> int:
        """Size of the row in bytes, including counter and checksum."""
        return self._form.size + 4

    def write(self, *row: float) -> None:
        """Replace the row; only one process may write it."""
        self._count += 1
        data = self._form.pack(self._count, *row)
        data += struct.pack("<I", zlib.crc32(data))
        self._memory[self._start : self._start + len(data)] = data

    def read(self) -> tuple[int, tuple[float, ...]] | None:
        """Return the number of writes and the row; None if it was never written."""
        size = self._form.size
        for _ in range(_TRIES):
            data = bytes(self._memory[self._start : self._start + size + 4])
            if data == bytes(size + 4):
                break
            if zlib.crc32(data[:size]) == struct.unpack_from("<I", data, size)[0]:
                count, *row = self._form.unpack_from(data)
                self._last = count, tuple(row)
                break
        return self._last
