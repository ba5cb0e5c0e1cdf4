"""Sort the events of an import on disk, so that memory use does not grow with the file.

The events are stored in an unnamed temporary file, which disappears with the process however it ends. They are returned
in time order; events with the same time keep their order.
"""

import mmap
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate

BLOCK_EVENTS = 1 << 18  # some 3 MB
SAMPLED = 256  # one time per this many events of a block is kept in memory, to partition all events by time
TYPES = (np.int64, np.uint16, np.uint16, np.uint8)
EVENT_BYTES = sum(np.dtype(type_).itemsize for type_ in TYPES)


class _Block(NamedTuple):
    """The position of a block of events in the file, and the time that the events span."""

    at: int
    size: int
    first_us: int
    last_us: int


class EventsOnDisk:
    """Events that are appended in pieces of any size and returned in blocks, in time order."""

    def __init__(self, folder: Path | None = None) -> None:
        """folder: where the file is created; the folder for temporary files if that is not writable."""
        self._file = _unnamed(folder)
        self._blocks: list[_Block] = []
        self._samples: list[NDArray[np.int64]] = []
        self._waiting: list[Events] = []
        self._waiting_events = 0

    def __del__(self) -> None:
        """Close the file, which removes it."""
        if hasattr(self, "_file"):
            self._file.close()

    @property
    def first_us(self) -> int:
        """The earliest time."""
        self._write()
        return min(block.first_us for block in self._blocks)

    @property
    def last_us(self) -> int:
        """The latest time."""
        self._write()
        return max(block.last_us for block in self._blocks)

    def append(self, events: Events) -> None:
        """Add events; raise InputError if the disk is full."""
        for first in range(0, events.size, BLOCK_EVENTS):
            part = events.part(first, first + BLOCK_EVENTS)
            self._waiting.append(part)
            self._waiting_events += part.size
            if self._waiting_events >= BLOCK_EVENTS:
                self._write()

    def blocks(self) -> Iterator[Events]:
        """Yield all events, one interval of time after another, collected from the blocks that have events in it.

        A microsecond with very many events is an interval by itself, yielded block by block, which is already in order.
        """
        self._write()
        if not self._blocks:
            return
        self._mapped = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        samples = np.sort(np.concatenate(self._samples))
        times, counts = np.unique(samples[:: BLOCK_EVENTS // SAMPLED], return_counts=True)
        crowded = times[counts > 1]
        edges = np.union1d(times, crowded + 1)
        for from_us, to_us in zip(edges, [*edges[1:], self.last_us + 1], strict=True):
            parts = self._between(from_us, to_us)
            if from_us in crowded:
                yield from parts
            elif (events := concatenate(list(parts))).size:
                yield events.at(np.argsort(events.t, kind="stable"))

    def _between(self, from_us: int, to_us: int) -> Iterator[Events]:
        """Yield the events of an interval of time, from each block that has some."""
        for block in self._blocks:
            if block.first_us < to_us and block.last_us >= from_us:
                events = self._read(block)
                rows = (events.t >= from_us) & (events.t < to_us)
                if rows.any():
                    yield events.at(rows)

    def _read(self, block: _Block) -> Events:
        columns: list[Any] = []
        at = block.at
        for type_ in TYPES:
            columns.append(np.frombuffer(self._mapped, type_, block.size, at))
            at += columns[-1].nbytes
        return Events(*columns)

    def _write(self) -> None:
        """Write the waiting events as a block."""
        if not self._waiting_events:
            return
        events = concatenate(self._waiting)
        self._waiting, self._waiting_events = [], 0
        try:
            end = self._file.seek(0, 2)
            at = end + self._file.write(bytes(-end % 8))  # aligned, because unaligned numbers are slow to read
            for column in events:
                self._file.write(np.ascontiguousarray(column).data)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"the events cannot be stored on disk while they are imported: {error.strerror or error}",
                hint=f"during an import, {EVENT_BYTES} bytes per event are needed in addition to its output",
            ) from error
        # Most files are in order, and checking this takes a twentieth of the time of sorting.
        times = events.t if (events.t[1:] >= events.t[:-1]).all() else np.sort(events.t)
        self._blocks.append(_Block(at, events.size, int(times[0]), int(times[-1])))
        self._samples.append(times[::SAMPLED].copy())


def _unnamed(folder: Path | None) -> IO[bytes]:
    try:
        return tempfile.TemporaryFile(dir=folder)
    except OSError:
        return tempfile.TemporaryFile()
