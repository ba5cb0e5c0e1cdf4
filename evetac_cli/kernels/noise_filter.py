"""Background activity filter: remove events without a recent event at a neighbouring pixel.

It is the background activity filter of dv-processing, which the authors' readout uses. An event is kept if one of the 8
pixels around its own had an event less than a given time before, whether that event was kept or not. Events at its own
pixel do not count, so isolated hot pixels are removed as well as noise.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit

Columns = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]
LONG_AGO_US = -(2**62)  # time of the last event of a pixel without events
OWN = 4  # index of an event's own pixel among the 9 at and around it, row by row


class NoiseFilter:
    """The filter of one camera, from slice to slice; `removed` counts the events that were removed."""

    def __init__(self, support_ms: float, frame_px: tuple[int, int]) -> None:
        """Keep events with a neighbouring event within this many ms before."""
        width, height = frame_px
        self._support_us = 1e3 * support_ms
        # the border replaces checks at the frame's edges
        self._last_us = np.full((height + 2, width + 2), LONG_AGO_US, np.int64)
        self.removed = 0

    def keep(self, columns: Columns) -> Columns:
        """Return the kept events of a slice, which must be sorted by time and follow those of previous slices.

        `columns` is overwritten.
        """
        kept = _move_supported(*columns, self._support_us, self._last_us)
        self.removed += len(columns[0]) - kept
        return columns[0][:kept], columns[1][:kept], columns[2][:kept], columns[3][:kept]


@njit(cache=True, _nrt=False)
def _move_supported(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    support_us: float,
    last_us: NDArray[np.int64],
) -> int:
    """Move the kept events to the front and return their number.

    `last_us` (height + 2, width + 2): time of the last event of each pixel, shifted by one to the right and down.
    """
    kept = 0
    for event in range(len(t_us)):
        now_us, column, row = t_us[event], int(x[event]), int(y[event])
        supported = False
        for place in range(9):
            if place != OWN and now_us - last_us[row + place // 3, column + place % 3] < support_us:
                supported = True
                break
        last_us[row + 1, column + 1] = now_us
        if supported:
            t_us[kept], x[kept], y[kept], p[kept] = now_us, x[event], y[event], p[event]
            kept += 1
    return kept
