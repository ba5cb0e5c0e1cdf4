"""Writing of simulated trials: their slices and rows are collected in memory and written once, at the end.

A trial that can be simulated again need not survive a kill, so nothing has to be on disk before it is complete. Writing
it once costs a third of writing it in segments. Only a trial that is too long for memory is written in blocks. The size
of a block depends only on its slices and events, and never on elapsed time, so the work and the file are the same on a
busy computer. Recordings of devices are kept in segments (segments.py).
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events, concatenate
from evetac_cli.interrupts import leave_if_interrupted
from evetac_cli.store.files import StageWriter, writing
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe

BLOCK_SLICES = 20_000  # each with some 2 kB in addition to its events
BLOCK_EVENTS = 2_000_000  # of 13 bytes each


@dataclass
class TrialBuffer:
    """Slices and rows of a trial, by their paths in a recording; arrays are not copied."""

    events: list[Events] = field(default_factory=list)
    rows: dict[str, list[Any]] = field(default_factory=dict)
    event_count: int = 0

    def append(self, events: Events, rows: Mapping[str, Any]) -> None:
        """Add one slice (its events may be none), and one row to each of the named datasets."""
        self.events.append(events)
        self.event_count += events.size
        self.append_rows(rows)

    def append_rows(self, rows: Mapping[str, Any]) -> None:
        """Add one row to each of the named datasets, and no events."""
        for name, row in rows.items():
            self.rows.setdefault(name, []).append(row)

    def row_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the rows as arrays, with the dtypes of the recording's schema."""
        return schema.typed_rows("recording", self.rows)

    def columns(self) -> dict[str, Any]:
        """Return events and rows as datasets, or as the next rows of datasets."""
        events = concatenate(self.events)
        return {**{f"events/{name}": getattr(events, name) for name in Events._fields}, **self.row_arrays()}

    def counts(self) -> NDArray[np.int64]:
        """Return the number of events of each slice."""
        return np.array([events.size for events in self.events], np.int64)

    def arrays(self) -> dict[str, Any]:
        """Return everything that was added as the datasets of a recording."""
        return {**self.columns(), "ms_to_idx": slice_starts_of(self.counts())}


def slice_starts_of(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of each slice's first event, then the total, from the number of events of each slice."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


class TrialWriter:
    """Appends slices and rows; `path` is written only by `finish`, and nothing is left without it."""

    def __init__(self, path: Path, initial: Mapping[str, Any], *, force: bool = False) -> None:
        """initial: the datasets that are known beforehand (sensor/..., t_offset); force: as for `write_stage`."""
        self.path, self.blocks = path, 0  # number of blocks written
        self._force = force
        self._initial = initial
        self._buffer = TrialBuffer()
        self._counts: list[NDArray[np.int64]] = []
        self._stack = ExitStack()
        self._file: StageWriter | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def append(self, events: Events, rows: Mapping[str, Any]) -> None:
        """Add one slice (its events may be none) and one row to each of the named datasets."""
        if self._file is not None:
            leave_if_interrupted()  # while a file is open, Ctrl-C is raised only here
        self._buffer.append(events, rows)
        if len(self._buffer.events) >= BLOCK_SLICES or self._buffer.event_count >= BLOCK_EVENTS:
            self._write_block()

    def finish(self, recipe: Recipe) -> bool:
        """Write the remaining data, complete the file and return whether it was made, as `write_stage` does.

        SchemaError if it is not a valid recording.
        """
        file = self._write_block(is_last=True)
        file.finish(recipe, {"ms_to_idx": slice_starts_of(np.concatenate(self._counts))})
        self._stack.close()
        return file.made

    def _write_block(self, *, is_last: bool = False) -> StageWriter:
        """Write the data in memory and return the file, which the first block opens, with all lengths if it is last."""
        columns = self._buffer.columns()
        if self._file is None:
            lengths = {name: len(rows) for name, rows in columns.items()} if is_last else {}
            self._file = self._stack.enter_context(
                writing(self.path, "recording", self._initial, lengths, force=self._force)
            )
        self._file.append(columns)
        self._counts.append(self._buffer.counts())
        self._buffer = TrialBuffer()
        self.blocks += 1
        return self._file
