"""An event of one slice as one integer, and the integers of a slice as sorted columns.

Why so: while a slice is made its events come pixel after pixel; one integer is quick to write and to sort by time.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit

# From the highest bits down: time in the slice, column, row, polarity.
TIME_SHIFT = 33
COLUMN_SHIFT = 17
ROW_SHIFT = 1
COORDINATE_MASK = 0xFFFF


@njit(cache=True, _nrt=False)
def event_key(time_us: int, x: int, y: int, brighter: bool) -> int:
    """The integer of an event, `time_us` after the start of its slice."""
    return (time_us << TIME_SHIFT) | (x << COLUMN_SHIFT) | (y << ROW_SHIFT) | int(brighter)


@njit(cache=True)
def sorted_columns(
    keys: NDArray[np.int64], t0_us: int
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Columns t, x, y, p of the events of a slice that starts at `t0_us`.

    Counting sort by time, stable: 1000 times are few against the events of a busy slice.
    """
    place = np.zeros(SLICE_US + 1, np.int64)
    for key in keys:
        place[(key >> TIME_SHIFT) + 1] += 1
    for time in range(SLICE_US):
        place[time + 1] += place[time]
    t_us = np.empty(len(keys), np.int64)
    x = np.empty(len(keys), np.uint16)
    y = np.empty(len(keys), np.uint16)
    p = np.empty(len(keys), np.uint8)
    for key in keys:
        time = key >> TIME_SHIFT
        event = place[time]
        place[time] += 1
        t_us[event] = t0_us + time
        x[event] = (key >> COLUMN_SHIFT) & COORDINATE_MASK
        y[event] = (key >> ROW_SHIFT) & COORDINATE_MASK
        p[event] = key & 1
    return t_us, x, y, p
