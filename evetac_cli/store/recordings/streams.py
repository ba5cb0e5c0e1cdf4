"""Other streams of a trial: measurements in addition to the events, such as an arm's pose, a camera's images, or marks.

A stream is the group `streams/NAME` of a recording. Its times are in the recording's clock, so they can be compared
directly with events, gripper or truth.

Marks are texts that a robot's program sent during the recording, with their times (group `marks`). They are stored as
rows of bytes: rows of plain numbers can be appended to segments one by one, and all checks of files support them, so a
mark survives a kill of the recorder like events do.
"""

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US

GROUP = "streams"
NAME = re.compile("[A-Za-z_][A-Za-z0-9_.-]{0,63}")  # valid names of streams and columns
# Names in a stream's group that no column may have: its other datasets, and the dimensions.
TAKEN = ("t_us", "about", "frames", "samples", "frame_rows", "frame_columns", "channels")
LARGEST_FRAME_PX = 16384  # width or height
MOST_OFFSET_S = 1e11  # 3,000 years
BLOCK_VALUES = 1 << 20  # numbers written at a time


@dataclass(frozen=True)
class Stream:
    """One stream: times in us, never decreasing, in the recording's clock; columns of numbers, or images, or both.

    - columns: name -> float64, one value per sample.
    - frames: uint8 (samples, rows, columns, 1 or 3: red, green, blue), which may be mapped from disk.
    - units: units of the columns, by name.
    - what: short description.
    - source: file, or file and topic.
    - clock: description of the origin of the times.
    - offset_s: offset that was added to the times.
    - left_out: number of samples outside the recording.
    """

    name: str
    t_us: NDArray[np.int64]
    columns: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    frames: NDArray[np.uint8] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    what: str = ""
    source: str = ""
    clock: str = ""
    offset_s: float = 0.0
    left_out: int = 0

    def datasets(self) -> dict[str, Any]:
        """Return its datasets in a recording, path -> array or text."""
        about = {name: getattr(self, name) for name in ("what", "source", "clock", "offset_s", "left_out")}
        about["units"] = {name: unit for name, unit in self.units.items() if unit and name in self.columns}
        whole = {"about": json.dumps(about, sort_keys=True, allow_nan=False), "t_us": self.t_us, **self.columns}
        if self.frames is not None:
            whole["frames"] = self.frames
        return {f"{GROUP}/{self.name}/{name}": values for name, values in whole.items()}

    def lengths(self) -> dict[str, int]:
        """Return the number of rows of each dataset, by its path."""
        return {path: len(values) for path, values in self.datasets().items() if not isinstance(values, str)}

    def blocks(self) -> Iterator[dict[str, Any]]:
        """Yield its rows, one dataset after the other, in blocks that fit in memory."""
        for path, values in self.datasets().items():
            if not isinstance(values, str):
                at_once = max(1, BLOCK_VALUES // max(1, math.prod(values.shape[1:])))
                for first in range(0, len(values), at_once):
                    yield {path: values[first : first + at_once]}

    def texts(self) -> dict[str, str]:
        """Return its datasets without rows."""
        return {path: values for path, values in self.datasets().items() if isinstance(values, str)}

    def within(self, slices: int) -> "Stream":
        """Return the stream with only the samples within `slices` slices; the others are counted in `left_out`."""
        first, stop = np.searchsorted(self.t_us, (0, slices * SLICE_US)).tolist()
        return replace(
            self,
            t_us=self.t_us[first:stop],
            columns={name: values[first:stop] for name, values in self.columns.items()},
            frames=None if self.frames is None else self.frames[first:stop],
            left_out=self.left_out + len(self.t_us) - (stop - first),
        )


def names(paths: Collection[str]) -> list[str]:
    """Return the names of the streams in a recording with these paths of datasets."""
    return sorted({path.split("/")[1] for path in paths if path.startswith(f"{GROUP}/")})


def free_name(wanted: str, taken: Collection[str]) -> str:
    """Return a valid, unused name for a column that is as close as possible to the name by another program."""
    name = re.sub("[^A-Za-z0-9_.-]+", "_", wanted.strip()).strip("._-")[:56] or "column"
    name = name if NAME.match(name) else f"_{name}"
    numbered = [name, *(f"{name}_{number}" for number in range(2, len(taken) + len(TAKEN) + 3))]
    return next(name for name in numbered if name not in taken and name not in TAKEN)


MARK_TIME, MARK_TEXT = "marks/t_us", "marks/text"
SHOWN_MARKS = 20  # marks in a description
MOST_MARK_BYTES = 120  # of a text, in UTF-8


class Mark(NamedTuple):
    """One mark: its slice, its time in us in the clock of the recording, and its text."""

    slice: int
    t_us: int
    text: str


def mark_row(t_us: int, text: str) -> Mapping[str, Any]:
    """Return the row of a mark in datasets `marks/...`; ValueError for a text of more than MOST_MARK_BYTES in UTF-8."""
    content = text.encode()
    if len(content) > MOST_MARK_BYTES:
        raise ValueError(f"the text has {len(content)} bytes, more than {MOST_MARK_BYTES}")
    return {MARK_TIME: t_us, MARK_TEXT: np.frombuffer(content.ljust(MOST_MARK_BYTES, b"\0"), np.uint8)}


def marks_in_words(marks: Sequence[Mark]) -> str:
    """Return a description of the first SHOWN_MARKS marks with their times; empty without marks."""
    texts = [f"{mark.text} at {mark.t_us * 1e-6:.3f} s" for mark in marks[:SHOWN_MARKS]]
    return "; ".join([*texts, *([f"{len(marks) - SHOWN_MARKS} more"] if len(marks) > SHOWN_MARKS else [])])


def marks_of(recording: Any) -> list[Mark]:
    """Return the marks of a recording in order of time; none if it has no such group."""
    if not recording.has(MARK_TIME):
        return []
    texts = (bytes(row).rstrip(b"\0").decode(errors="replace") for row in recording.read(MARK_TEXT))
    times = recording.read(MARK_TIME).tolist()
    return [Mark(t_us // SLICE_US, t_us, text) for t_us, text in zip(times, texts, strict=True)]
