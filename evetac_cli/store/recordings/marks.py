"""Marks of a recording: texts that a robot's program sent during the recording, with their times (group `marks`).

Texts are stored as rows of bytes. Rows of plain numbers can be appended to segments one by one, and all checks of files
support them, so a mark survives a kill of the recorder like events do.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from evetac_cli.events import SLICE_US

TIME, TEXT = "marks/t_us", "marks/text"
SHOWN = 20  # marks in a description
MOST_BYTES = 120  # of a text, in UTF-8


class Mark(NamedTuple):
    """One mark: its slice, its time in us in the clock of the recording, and its text."""

    slice: int
    t_us: int
    text: str


class _Datasets(Protocol):
    def has(self, path: str) -> bool:
        """Whether there is such a dataset."""

    def read(self, path: str) -> Any:
        """Return a dataset."""


def mark_row(t_us: int, text: str) -> Mapping[str, Any]:
    """Return the row of a mark in datasets `marks/...`; ValueError for a text of more than MOST_BYTES in UTF-8."""
    content = text.encode()
    if len(content) > MOST_BYTES:
        raise ValueError(f"the text has {len(content)} bytes, more than {MOST_BYTES}")
    return {TIME: t_us, TEXT: np.frombuffer(content.ljust(MOST_BYTES, b"\0"), np.uint8)}


def in_words(marks: Sequence[Mark]) -> str:
    """Return a description of the first SHOWN marks with their times; empty without marks."""
    texts = [f"{mark.text} at {mark.t_us * 1e-6:.3f} s" for mark in marks[:SHOWN]]
    return "; ".join([*texts, *([f"{len(marks) - SHOWN} more"] if len(marks) > SHOWN else [])])


def marks_of(recording: _Datasets) -> list[Mark]:
    """Return the marks of a recording in order of time; none if it has no such group."""
    if not recording.has(TIME):
        return []
    texts = (bytes(row).rstrip(b"\0").decode(errors="replace") for row in recording.read(TEXT))
    times = recording.read(TIME).tolist()
    return [Mark(t_us // SLICE_US, t_us, text) for t_us, text in zip(times, texts, strict=True)]
