"""A row of numbers in memory that processes share: written by one, read by others, never read half written.

Why so: a checksum beside the row needs no lock and no promise about the order in which memory is written; a reader that
meets a half-written row reads again, and keeps to the row before if the writer died over it.
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
        self._form = struct.Struct("<q" + form)  # a counter comes first
        self._count = 0
        self._last: tuple[int, tuple[float, ...]] | None = None

    @property
    def size(self) -> int:
        """Bytes of memory that the row takes, counter and checksum included."""
        return self._form.size + 4

    def write(self, *row: float) -> None:
        """Replace the row; only one process may write it."""
        self._count += 1
        data = self._form.pack(self._count, *row)
        data += struct.pack("<I", zlib.crc32(data))
        self._memory[self._start : self._start + len(data)] = data

    def read(self) -> tuple[int, tuple[float, ...]] | None:
        """How often it was written, and the row; None if never."""
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
