"""Decode words of Prophesee's encodings (encodings.py), block by block, into events and external triggers.

The high bits of a block are unwrapped (clock.py) with numpy, and a compiled loop decodes word after word. With numpy
alone, EVT3 takes ten times as long, because the meaning of a word depends on the words before it.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.clock import Clock
from evetac_cli.formats.read.prophesee.encodings import ENCODINGS, STATE, TIME_HIGH, TRIGGER


class EventBlock(NamedTuple):
    """Events of a block: t in us, x, y, p; and triggers: time in us, input, 1 for a rising and 0 for a falling edge."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    trigger_t: NDArray[np.int64]
    trigger_id: NDArray[np.uint8]
    trigger_edge: NDArray[np.uint8]


class PropheseeDecoder:
    """Decodes the words of one stream, block by block."""

    def __init__(self, kind: str) -> None:
        """kind: one of ENCODINGS."""
        from evetac_cli.formats.read.prophesee import prophesee_loops  # brings numba, which only these files need

        self._count = prophesee_loops.count_types
        self._loop = prophesee_loops.evt3 if kind == "evt3" else prophesee_loops.evt2
        self.encoding = ENCODINGS[kind]
        self.clock = Clock((1 << self.encoding.high_bits,), tick_us=self.encoding.tick_us)
        self.untimed = 0  # words before the first with high bits of time
        self.undefined = Counter[int]()  # words of types that the encoding does not define
        self.first_undefined = ""
        self.words = 0
        self._timed = False
        self._state = np.zeros(1, STATE)

    def part(self, words: NDArray[Any], place: Callable[[int], str]) -> EventBlock:
        """Decode the events and triggers of the next complete words; place(i): a text on the position of word i."""
        encoding = self.encoding
        shift = 8 * words.dtype.itemsize - 4
        first = 0
        if not self._timed:
            timed = np.flatnonzero(words >> shift == TIME_HIGH)
            first = int(timed[0]) if len(timed) else len(words)
            self.untimed += first
            self._timed = len(timed) > 0
            words = words[first:]
        counts = self._count(words, shift)
        self.words += len(words)
        for kind in np.flatnonzero(counts).tolist():
            if kind not in encoding.types:
                row = int(np.argmax(words >> shift == kind))
                self.first_undefined = self.first_undefined or f"type {kind:#x} {place(first + row)}"
                self.undefined[kind] += int(counts[kind])
        rows = np.flatnonzero(words >> shift == TIME_HIGH)
        highs = (words[rows] >> encoding.high_at).astype(np.int64) & ((1 << encoding.high_bits) - 1)
        highs = self.clock.continuous(highs, lambda row: place(first + int(rows[row])))
        most = sum(int(counts[kind]) * events for kind, events in encoding.most_events.items())
        triggers = int(counts[TRIGGER])
        columns: list[Any] = [np.empty(most, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8)]
        edges: list[Any] = [np.empty(triggers, kind) for kind in (np.int64, np.uint8, np.uint8)]
        events = self._loop(words, highs, self._state, tuple(columns), tuple(edges))
        return EventBlock(*(column[:events] for column in columns), *edges)
