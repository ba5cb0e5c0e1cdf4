"""Find hot pixels, whose events are ignored.

A hot pixel in the ring of a dot would pull it for ever; a DVXplorer has hundreds, some above 1000 events/s. So the
events of every pixel are counted, and a pixel with far more than all of its neighbours is ignored. The counts decay:
row after row is halved, so that each count halves every 1.9 s, in a frame of any height. Edges are not mistaken for hot
pixels, even if they vibrate: along an edge, neighbouring pixels have about as many events.

Reason for a separate loop: counting in the loop that assigns events to dots costs more, because its accesses to pixels
all over the frame would wait for each other. While no pixel is hot, the counts are not read again.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit

HOT_RATIO = 4  # a hot pixel has at least this many times the events of each neighbour
FADE_SLICES = 1920  # slices in which every row is halved once
HOT = np.uint16(0x8000)  # flag of a hot pixel in its entry pixel_events[y + 1, x + 1]
_COUNT = np.uint16(0x7FFF)  # ... and the bits of its recent events
_ONE = np.uint64(1)
_ROW_BITS = np.uint32(16)  # bit position of the row in an entry of `at_limit`, above the column


@njit(cache=True)
def counts(state: np.void) -> NDArray[np.uint16]:
    """Return a state's pixel_events as (height + 2, width + 2), with a border of zeros; state: tracker.STATE."""
    width, height = state["frame_px"][0] + 2, state["frame_px"][1] + 2
    pixels: NDArray[np.uint16] = state["pixel_events"]
    return pixels[: width * height].reshape((height, width))


@njit(cache=True)
def _fade(pixel_events: NDArray[np.uint16], halved_row: int, limit: int) -> None:
    """Halve the counts of one row of pixel_events, and find its hot pixels again."""
    busiest = np.uint16(0)
    row = pixel_events[halved_row]
    for column in range(row.shape[0]):
        row[column] = (row[column] & _COUNT) >> np.uint16(1)
        busiest = max(busiest, row[column])
    if busiest > limit:
        for column in range(1, row.shape[0] - 1):
            if _is_hot(pixel_events, np.uint64(halved_row), np.uint64(column), limit):
                row[column] |= HOT


@njit(cache=True)
def count(
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    pixel_events: NDArray[np.uint16],
    slices: int,
    limit: int,
) -> bool:
    """Count the events of every pixel into pixel_events; return whether any of them comes from a hot pixel.

    A pixel is checked when its count exceeds the limit, and when its row fades, so nearly every event costs one access.
    The order of events within the slice does not matter: all are counted before any pixel is checked.

    pixel_events: (height + 2, width + 2), the frame with a border of zeros. slices: number of slices before, from 0.
    """
    height, width = pixel_events.shape[0] - 2, pixel_events.shape[1] - 2
    turn = slices % FADE_SLICES
    # Rows r with turn <= r * FADE_SLICES / height < turn + 1.
    for row_y in range(-(-turn * height // FADE_SLICES), -(-(turn + 1) * height // FADE_SLICES)):
        _fade(pixel_events, 1 + row_y, limit)
    seen = np.uint16(0)
    judged = np.uint64(0)
    at_limit = np.empty(x.shape[0], np.uint32)
    for k in range(x.shape[0]):
        if x[k] < width and y[k] < height:
            row = np.uint64(y[k]) + _ONE
            column = np.uint64(x[k]) + _ONE
            before = pixel_events[row, column]
            seen |= before
            events = before & _COUNT
            if events == limit:
                at_limit[judged] = row << np.uint64(_ROW_BITS) | column
                judged += _ONE
            pixel_events[row, column] = before + np.uint16(events != _COUNT)
    for k in range(judged):
        row = np.uint64(at_limit[k] >> _ROW_BITS)
        column = np.uint64(at_limit[k]) & np.uint64(0xFFFF)
        if _is_hot(pixel_events, row, column, limit):
            pixel_events[row, column] |= HOT
            seen |= HOT
    return bool(seen & HOT)


@njit(cache=True)
def _is_hot(pixel_events: NDArray[np.uint16], row: int, column: int, limit: int) -> bool:
    """Whether a pixel has more events than the limit and far more than its eight neighbours."""
    events = pixel_events[row, column] & _COUNT
    if events <= limit:
        return False
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            if (r != row or c != column) and HOT_RATIO * (pixel_events[r, c] & _COUNT) > events:
                return False
    return True
