"""Which pixels are hot, and not worth listening to.

A hot pixel in the ring of a dot would pull it for ever; a DVXplorer has hundreds, some above 1000 events/s. So the
events of every pixel are counted, and a pixel that is ahead of all its neighbours by far is left out. Rows are halved
in turn, one every FADE_SLICES: so a count halves every 1.9 s. Edges keep their say, also when they vibrate: there
neighbours fire alike.

Why so: counting in the loop that reads the events for the dots costs more than a loop of its own, whose looks at pixels
all over the frame do not wait for each other. While no pixel is hot, nobody looks at the counts again.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX

HOT_RATIO = 4
FADE_SLICES = 4
FIRED_SHAPE = (FRAME_PX[1] + 2, FRAME_PX[0] + 2)  # of the counts: the frame, with zeros around
HOT = np.uint16(0x8000)  # of a pixel's entry in `fired`, [y + 1, x + 1]: whether it is hot
_COUNT = np.uint16(0x7FFF)  # ... and its recent events
_ONE = np.uint64(1)
_ROW_BITS = np.uint32(16)  # of a pixel in `passed`: row above, column below


@njit(cache=True)
def _fade(fired: NDArray[np.uint16], halved_row: int, limit: int) -> None:
    """Halve the counts of one row of `fired`, FIRED_SHAPE, and judge its pixels anew."""
    busiest = np.uint16(0)
    row = fired[halved_row]
    for column in range(row.shape[0]):
        row[column] = (row[column] & _COUNT) >> np.uint16(1)
        busiest = max(busiest, row[column])
    if busiest > limit:
        for column in range(1, row.shape[0] - 1):
            if _is_hot(fired, halved_row, column, limit):
                row[column] |= HOT


@njit(cache=True)
def count(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    fired: NDArray[np.uint16],
    slices: int,
    limit: int,
    passed: NDArray[np.uint32],
) -> bool:
    """Count the events of every pixel into `fired` and tell whether any of them comes from a hot pixel.

    A pixel is judged when its count passes the limit, and when its row fades: so nearly every event costs one look at
    its pixel. All are counted before any is judged, so that the order of events within the slice does not matter.
    slices: how many there were before, from 0; passed: work space for as many as there are events.
    """
    if slices % FADE_SLICES == 0:
        _fade(fired, 1 + slices // FADE_SLICES % FRAME_PX[1], limit)
    seen = np.uint16(0)
    judged = np.uint64(0)
    for k in range(x.shape[0]):
        if x[k] < FRAME_PX[0] and y[k] < FRAME_PX[1]:
            row = np.uint64(y[k]) + _ONE
            column = np.uint64(x[k]) + _ONE
            before = fired[row, column]
            seen |= before
            events = before & _COUNT
            if events == limit:
                passed[judged] = row << np.uint64(_ROW_BITS) | column
                judged += _ONE
            fired[row, column] = before + np.uint16(events != _COUNT)
    for k in range(judged):
        row = np.uint64(passed[k] >> _ROW_BITS)
        column = np.uint64(passed[k]) & np.uint64(0xFFFF)
        if _is_hot(fired, row, column, limit):
            fired[row, column] |= HOT
            seen |= HOT
    return bool(seen & HOT)


@njit(cache=True)
def _is_hot(fired: NDArray[np.uint16], row: int, column: int, limit: int) -> bool:
    """Whether a pixel has more events than the limit and is far ahead of its eight neighbours."""
    events = fired[row, column] & _COUNT
    if events <= limit:
        return False
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if (r != row or c != column) and HOT_RATIO * (fired[r, c] & _COUNT) > events:
                return False
    return True
