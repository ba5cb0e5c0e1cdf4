"""The compiled loops of read_prophesee: decode the words of a block into columns. Each returns the number of events.

- highs: the unwrapped high bits of time of the block, in the order of their words
- state: one encodings.STATE, the values at the beginning of the block, updated to its end
- columns: space for the events
- edges: space for the triggers
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.formats.read.prophesee.encodings import TIME_HIGH, TRIGGER
from evetac_cli.kernels.compiled import njit

TYPES = 16
EventColumns = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]  # t, x, y, p
TriggerColumns = tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8]]  # t, id, edge


@njit(cache=True)
def count_types(words: NDArray[Any], shift: int) -> NDArray[np.int64]:
    """Return the number of words of each type; the type is the four bits above `shift`."""
    counts = np.zeros(TYPES, np.int64)
    for word in words:
        counts[np.int64(word >> type(word)(shift)) & 15] += 1
    return counts


@njit(cache=True)
def evt2(
    words: NDArray[Any], highs: NDArray[np.int64], state: Any, columns: EventColumns, edges: TriggerColumns
) -> int:
    """Decode words of EVT2 (uint32), or of EVT2.1 (uint64): an event for each set bit of the lower half."""
    t, x, y, p = columns
    trigger_t, trigger_id, trigger_edge = edges
    events = triggers = times = 0
    base = state[0].high << 6
    for each in words:
        word = np.int64(each >> np.uint64(32)) if words.itemsize == 8 else np.int64(each)
        kind = word >> 28
        if kind <= 1:
            at, column, row = base + (word >> 22 & 0x3F), word >> 11 & 0x7FF, word & 0x7FF
            bits = np.int64(each & np.uint64(0xFFFFFFFF)) if words.itemsize == 8 else 1
            while bits:
                if bits & 1:
                    t[events] = at
                    x[events] = column
                    y[events] = row
                    p[events] = kind
                    events += 1
                bits >>= 1
                column += 1
        elif kind == TIME_HIGH:
            base = highs[times] << 6
            times += 1
        elif kind == TRIGGER:
            trigger_t[triggers] = base + (word >> 22 & 0x3F)
            trigger_id[triggers] = word >> 8 & 0x1F
            trigger_edge[triggers] = word & 1
            triggers += 1
    state[0].high = base >> 6
    return events


@njit(cache=True)
def evt3(
    words: NDArray[np.uint16], highs: NDArray[np.int64], state: Any, columns: EventColumns, edges: TriggerColumns
) -> int:
    """Decode words of EVT3."""
    t, x, y, p = columns
    trigger_t, trigger_id, trigger_edge = edges
    events = triggers = times = 0
    begin = state[0]
    high, low, row, column, polarity = begin.high, begin.low, begin.y, begin.x, begin.p
    now = high << 12 | low
    for each in words:
        word = np.int64(each)
        kind, value = word >> 12, word & 0xFFF
        if kind == 2:
            t[events] = now
            x[events] = value & 0x7FF
            y[events] = row
            p[events] = value >> 11
            events += 1
        elif kind == 6:
            low = value
            now = high << 12 | low
        elif kind == 0:
            row = value & 0x7FF
        elif kind == 4 or kind == 5:
            bits = 12 if kind == 4 else 8
            for bit in range(bits):
                if value >> bit & 1:
                    t[events] = now
                    x[events] = column + bit
                    y[events] = row
                    p[events] = polarity
                    events += 1
            column += bits
        elif kind == 3:
            column, polarity = value & 0x7FF, value >> 11
        elif kind == TIME_HIGH:
            if highs[times] != high:
                high, low = highs[times], 0
                now = high << 12
            times += 1
        elif kind == TRIGGER:
            trigger_t[triggers] = now
            trigger_id[triggers] = value >> 8
            trigger_edge[triggers] = value & 1
            triggers += 1
    begin.high, begin.low, begin.y, begin.x, begin.p = high, low, row, column, polarity
    return events
