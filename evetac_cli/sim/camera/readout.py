"""From the events of the pixels to those that arrive: sorted by time, and late if the readout is slow under load.

Within a slice, events are created pixel by pixel; a single integer is quick to write and to sort by time.

At rest a DVXplorer scans 5000 times per second. With more events a scan takes longer ("variable" mode of libcaer), and
all pixels hold their changes until it is their turn (global hold). No document specifies the time per event. `Readout`
is the simplest model that transfers at most a given number of events per second. Events are read one after another, an
event's time stamp is that of its readout, and a pixel that still waits has no other event. Of several changes within
such a long scan only the first is reported, as in a scan of normal length.

Not simulated: the comparison itself waits for the previous scan. Events that still wait at the end of a recording are
not in it.
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


class Readout:
    """The readout of one camera, from slice to slice; `lost` counts the events of waiting pixels."""

    def __init__(self, events_per_s: float, frame_px: tuple[int, int]) -> None:
        """Start a readout of at most this many events per second."""
        width, height = frame_px
        self._event_us = 1e6 / events_per_s
        self._free_us = -np.inf
        self._read_at_us = np.full((height, width), -np.inf)
        self._waiting: Columns | None = None
        self.lost = 0

    def read(self, columns: Columns, t0_us: int) -> Columns:
        """Return the events that are read in the slice starting at `t0_us`, from its events (sorted) and earlier ones.

        The `columns` are overwritten.
        """
        kept, self._free_us = _take_turns(*columns, self._event_us, self._free_us, self._read_at_us)
        self.lost += len(columns[0]) - kept
        t, x, y, p = columns[0][:kept], columns[1][:kept], columns[2][:kept], columns[3][:kept]
        if self._waiting is not None:
            old_t, old_x, old_y, old_p = self._waiting
            t, x = np.concatenate((old_t, t)), np.concatenate((old_x, x))
            y, p = np.concatenate((old_y, y)), np.concatenate((old_p, p))
        now = int(np.searchsorted(t, t0_us + SLICE_US))
        self._waiting = (t[now:], x[now:], y[now:], p[now:]) if now < len(t) else None
        return t[:now], x[:now], y[:now], p[:now]


@njit(cache=True, _nrt=False)
def _take_turns(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    event_us: float,
    free_us: float,
    read_at_us: NDArray[np.float64],
) -> tuple[int, float]:
    """Move the events that are not lost to the front, with the times at which they are read.

    Return their number, and the time at which the readout is free again. `read_at_us` (height, width): the time at
    which a pixel was last read.
    """
    kept = 0
    for event in range(len(t_us)):
        if read_at_us[y[event], x[event]] >= t_us[event] + 1:  # time stamps are whole us
            continue
        now_us = max(float(t_us[event]), free_us)
        free_us = now_us + event_us
        read_at_us[y[event], x[event]] = now_us
        t_us[kept] = int(now_us)
        x[kept] = x[event]
        y[kept] = y[event]
        p[kept] = p[event]
        kept += 1
    return kept, free_us
