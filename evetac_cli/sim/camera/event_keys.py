"""An event of a slice as a single integer, and the integers of a slice as sorted columns.

Within a slice, events are created pixel by pixel; a single integer is quick to write and to sort by time.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit

# Bit fields, from the highest: time in the slice, column, row, polarity.
TIME_SHIFT = 33
COLUMN_SHIFT = 17
ROW_SHIFT = 1
COORDINATE_MASK = 0xFFFF
FEW = 40  # up to this many events of a slice are sorted by insertion

# Events of a slice: times in us, columns, rows, polarities.
Columns = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]


@njit(cache=True, _nrt=False)
def event_key(time_us: int, x: int, y: int, brighter: bool) -> int:
    """Return the integer of an event, `time_us` after the start of its slice."""
    return (time_us << TIME_SHIFT) | (x << COLUMN_SHIFT) | (y << ROW_SHIFT) | int(brighter)


def sorted_columns(keys: NDArray[np.int64], t0_us: int) -> Columns:
    """Return the columns t, x, y, p of the events of a slice that starts at `t0_us`."""
    events = len(keys)
    t_us = np.empty(events, np.int64)
    x, y, p = np.empty(events, np.uint16), np.empty(events, np.uint16), np.empty(events, np.uint8)
    place = np.empty(FEW if events <= FEW else SLICE_US + 1, np.int64)
    _sort(keys, t0_us, place, t_us, x, y, p)
    return t_us, x, y, p


@njit(cache=True, _nrt=False)
def _sort(
    keys: NDArray[np.int64],
    t0_us: int,
    place: NDArray[np.int64],
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
) -> None:
    """Fill the columns, sorted by time, stable. Counting sort: 1000 times are few compared with a busy slice's events.

    Few events are sorted by insertion. `place` is scratch.
    """
    if len(keys) <= FEW:
        for event in range(len(keys)):
            key = keys[event]
            at = event
            while at > 0 and place[at - 1] >> TIME_SHIFT > key >> TIME_SHIFT:
                place[at] = place[at - 1]
                at -= 1
            place[at] = key
        for event in range(len(keys)):
            key = place[event]
            t_us[event] = t0_us + (key >> TIME_SHIFT)
            x[event] = (key >> COLUMN_SHIFT) & COORDINATE_MASK
            y[event] = (key >> ROW_SHIFT) & COORDINATE_MASK
            p[event] = key & 1
        return
    place[:] = 0
    for key in keys:
        place[(key >> TIME_SHIFT) + 1] += 1
    for time in range(SLICE_US):
        place[time + 1] += place[time]
    for key in keys:
        time = key >> TIME_SHIFT
        event = place[time]
        place[time] += 1
        t_us[event] = t0_us + time
        x[event] = (key >> COLUMN_SHIFT) & COORDINATE_MASK
        y[event] = (key >> ROW_SHIFT) & COORDINATE_MASK
        p[event] = key & 1
