"""Marks of a recording: what a robot's program said while it was recorded, and when (group `marks`).

Texts lie as rows of bytes: rows of plain numbers are what segments take one by one, and what every check of a file
knows, so that a mark survives a kill of the recorder as events do.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from evetac_cli.events import SLICE_US

TIME, TEXT = "marks/t_us", "marks/text"
SHOWN = 20  # in words
MOST_BYTES = 120  # of a text, in UTF-8


class Mark(NamedTuple):
    """One mark: the slice in which it was put, its time in us in the clock of the recording, and what it says."""

    slice: int
    t_us: int
    text: str


class _Datasets(Protocol):
    def has(self, path: str) -> bool:
        """Whether there is such a dataset."""

    def read(self, path: str) -> Any:
        """A dataset."""


def mark_row(t_us: int, text: str) -> Mapping[str, Any]:
    """The row of a mark in datasets `marks/...`; ValueError for a text of more than MOST_BYTES in UTF-8."""
    content = text.encode()
    if len(content) > MOST_BYTES:
        raise ValueError(f"a text of {len(content)} bytes, more than {MOST_BYTES}")
    return {TIME: t_us, TEXT: np.frombuffer(content.ljust(MOST_BYTES, b"\0"), np.uint8)}


def in_words(marks: Sequence[Mark]) -> str:
    """What was marked and when, the first SHOWN of them; empty without any."""
    said = [f"{mark.text} at {mark.t_us * 1e-6:.3f} s" for mark in marks[:SHOWN]]
    return "; ".join([*said, *([f"{len(marks) - SHOWN} more"] if len(marks) > SHOWN else [])])


def marks_of(recording: _Datasets) -> list[Mark]:
    """The marks of a recording in the order in which they were put; none where it has no such group."""
    if not recording.has(TIME):
        return []
    texts = (bytes(row).rstrip(b"\0").decode(errors="replace") for row in recording.read(TEXT))
    times = recording.read(TIME).tolist()
    return [Mark(t_us // SLICE_US, t_us, text) for t_us, text in zip(times, texts, strict=True)]
