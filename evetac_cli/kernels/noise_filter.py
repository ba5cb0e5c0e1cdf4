"""The filter against background activity: an event is left out that has no recent one beside it.

It is that of the authors' readout, dv-processing's filter of background activity: an event is kept if one of the 8
pixels around its own had an event less than a given time before, kept or not. What came at its own pixel does not
count, so a hot pixel that lies alone is left out as well as noise.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range
from evetac_cli.kernels.compiled import njit

Columns = tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]
LONG_AGO_US = -(2**62)
OWN = 4  # of the 9 pixels at and around an event, row by row, its own


class NoiseFilter:
    """The filter behind one camera, from slice to slice; `removed` counts the events that were left out."""

    def __init__(self, support_ms: float, frame_px: tuple[int, int]) -> None:
        """Keep what has an event beside it within so many ms before; ValueError if out of range."""
        check_range("noise_filter.support_ms", support_ms, 0.001, 1e4)
        width, height = frame_px
        self._support_us = 1e3 * support_ms
        self._last_us = np.full((height + 2, width + 2), LONG_AGO_US, np.int64)  # a border spares the frame's edges
        self.removed = 0

    def keep(self, made: Columns) -> Columns:
        """The events that are kept, of those of a slice, sorted by time, which follow those before.

        The columns `made` are used up.
        """
        kept = _move_supported(*made, self._support_us, self._last_us)
        self.removed += len(made[0]) - kept
        return made[0][:kept], made[1][:kept], made[2][:kept], made[3][:kept]


@njit(cache=True, _nrt=False)
def _move_supported(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    support_us: float,
    last_us: NDArray[np.int64],
) -> int:
    """Move the events that are kept to the front and return their number.

    `last_us` (height + 2, width + 2): when a pixel, one to the right and down, last had an event.
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
