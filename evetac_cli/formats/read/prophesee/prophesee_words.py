"""Decode words of Prophesee's encodings EVT2, EVT2.1 and EVT3, block by block, into events and external triggers.

    EVT2    32 bits, the upper four the type: 0 and 1 an event (darker, brighter) with six bits of time, eleven of
            column, eleven of row; 8 the 28 high bits of time; A a trigger
    EVT2.1  64 bits, the upper four the type: as EVT2, and one bit for each of 32 columns, starting at the word's column
    EVT3    16 bits, the upper four the type: 0 row; 2 column and polarity, an event; 3 first column of a vector and its
            polarity; 4 and 5 its next twelve and eight columns, one bit each; 6 and 8 the low and the high twelve bits
            of time; A a trigger

Other types that Prophesee documents contain no events and are skipped. Words before the first high bits of time have no
time and are left out, as in Prophesee's own software. Source: Prophesee's pages on EVT 2.0, EVT 2.1 and EVT 3.0.

The high bits of a block are unwrapped (clock.py) with numpy, and a compiled loop decodes word after word. With numpy
alone, EVT3 takes ten times as long, because the meaning of a word depends on the words before it.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.clock import Clock

TIME_HIGH, TRIGGER = 0x8, 0xA  # types of words
MOST_UNDEFINED = 0.1  # share of words of undefined types above which a file has another encoding

# The state at the beginning of a block: unwrapped high bits of time; for EVT3 also the low bits, the row, and the next
# column and the polarity of a vector.
STATE = np.dtype([(name, np.int64) for name in ("high", "low", "y", "x", "p")])


class EventBlock(NamedTuple):
    """Events of a block: t in us, x, y, p; and triggers: time in us, input, 1 for a rising and 0 for a falling edge."""

    t: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    trigger_t: NDArray[np.int64]
    trigger_id: NDArray[np.uint8]
    trigger_edge: NDArray[np.uint8]


class Encoding(NamedTuple):
    """An encoding of words.

    name, dtype; number and tick (us) of the high bits of time, and their shift in a word; the defined types; and the
    largest number of events per word of a type.
    """

    name: str
    dtype: str
    high_bits: int
    tick_us: int
    high_at: int
    types: frozenset[int]
    most_events: dict[int, int]


PLAIN = frozenset((0x0, 0x1, TIME_HIGH, TRIGGER, 0xE, 0xF))
VECTORS = frozenset((0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, TIME_HIGH, TRIGGER, 0xE, 0xF))
ENCODINGS = {
    "evt2": Encoding("EVT2", "<u4", 28, 64, 0, PLAIN, {0: 1, 1: 1}),
    "evt2.1": Encoding("EVT2.1", "<u8", 28, 64, 32, PLAIN, {0: 32, 1: 32}),
    "evt3": Encoding("EVT3", "<u2", 12, 4096, 0, VECTORS, {2: 1, 4: 12, 5: 8}),
}


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
