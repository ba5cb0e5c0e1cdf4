"""Which events come from hot pixels, and are not worth listening to.

A hot pixel in the ring of a dot would pull it for ever; a DVXplorer has hundreds, some above 1000 events/s. So the
events of every pixel are counted (rows are halved in turn, each once in as many slices as there are rows), and a pixel
that is ahead of all its neighbours by far is left out. Edges keep their say, also when they vibrate: there neighbours
fire alike.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX

HOT_RATIO = 4
_COUNT = np.uint16(0x7FFF)  # of a pixel's entry in `fired`: its recent events
_HOT = np.uint16(0x8000)  # ... and whether it is hot


@njit(cache=True)
def keep_cool(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    fired: NDArray[np.uint16],
    halved_row: int,
    limit: int,
    cool_x: NDArray[np.uint16],
    cool_y: NDArray[np.uint16],
) -> int:
    """Count the events of every pixel, copy those of pixels that are not hot, and return how many; -1 if all may stay.

    A pixel is judged when its count passes the limit, and with its row: so nearly every event costs one look at its
    pixel. All are counted before any is judged, so that the order of events within the slice does not matter.
    """
    busiest = np.uint16(0)
    row = fired[halved_row]
    for column in range(row.shape[0]):
        row[column] = (row[column] & _COUNT) >> np.uint16(1)
        busiest = max(busiest, row[column])
    if busiest > limit:
        for column in range(1, row.shape[0] - 1):
            if _is_hot(fired, halved_row, column, limit):
                row[column] |= _HOT
    seen = np.uint16(0)
    passed = 0
    for k in range(x.shape[0]):
        if x[k] < FRAME_PX[0] and y[k] < FRAME_PX[1]:
            before = fired[y[k] + 1, x[k] + 1]
            seen |= before
            if before & _COUNT == limit:
                cool_x[passed] = x[k]
                cool_y[passed] = y[k]
                passed += 1
            if before & _COUNT != _COUNT:
                fired[y[k] + 1, x[k] + 1] = before + 1
    for k in range(passed):
        if _is_hot(fired, cool_y[k] + 1, cool_x[k] + 1, limit):
            fired[cool_y[k] + 1, cool_x[k] + 1] |= _HOT
            seen |= _HOT
    if not seen & _HOT:
        return -1
    kept = 0
    for k in range(x.shape[0]):
        if x[k] < FRAME_PX[0] and y[k] < FRAME_PX[1] and not fired[y[k] + 1, x[k] + 1] & _HOT:
            cool_x[kept] = x[k]
            cool_y[kept] = y[k]
            kept += 1
    return kept


@njit(cache=True)
def _is_hot(fired: NDArray[np.uint16], row: int, column: int, limit: int) -> bool:
    """Whether a pixel has more events than the limit and is far ahead of its eight neighbours."""
    count = fired[row, column] & _COUNT
    if count <= limit:
        return False
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if (r != row or c != column) and HOT_RATIO * (fired[r, c] & _COUNT) > count:
                return False
    return True
