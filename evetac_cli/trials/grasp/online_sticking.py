"""The share of a contact that sticks, in a grasp: the network of a touch map, over the dots that the detector tracks.

The scale is the one that is expected of any sensor (stages/touch/known_gel.py). Whether anything touches is asked once
in a block of rest.py.
"""

import math

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.touch import dot_field, rest, sticking
from evetac_cli.kernels.touch.dot_modes import DotNoise
from evetac_cli.kernels.touch.sticking import StickingState
from evetac_cli.kernels.touch.touch_map import BEGINS, ENDS
from evetac_cli.stages.touch import sticking_network
from evetac_cli.stages.touch.known_gel import DRIFT_PX, MM_PER_PX, TRACKER_PX


class OnlineSticking:
    """What sticks after the slices so far; `share` is NaN where nothing touches, or too few dots are known."""

    def __init__(self, rest_xy_px: NDArray[np.float64], frame_px: tuple[int, int]) -> None:
        """For dots at rest at (dots, 2), NaN where one is missing, in a frame of (width, height)."""
        self.share = math.nan
        self._middle_px = np.array(frame_px) / 2
        self._rest_mm = (rest_xy_px - self._middle_px) * MM_PER_PX
        noise = DotNoise(TRACKER_PX * MM_PER_PX, DRIFT_PX * MM_PER_PX)
        self._own_mm = noise.own_mm
        self._touches = False
        self._slices = 0
        self._state: StickingState | None = None
        if np.count_nonzero(np.isfinite(rest_xy_px).all(axis=1)) >= dot_field.LEAST_DOTS:
            self._state = sticking.start(self._rest_mm, sticking_network.shipped(), noise)

    def step(self, dot_xy_px: NDArray[np.float64], lost: NDArray[np.bool_]) -> float:
        """The share after one more slice, with its dots (dots, 2) and which of them are lost (dots,)."""
        if self._state is None:
            return self.share
        dot_mm = (dot_xy_px - self._middle_px) * MM_PER_PX
        self._slices += 1
        if self._slices % rest.BLOCK_MS == 0:
            self._touches = self._is_touched(dot_mm, lost)
        self.share = sticking.step(self._state, dot_mm, lost, self._touches).sticking_share
        return self.share

    def _is_touched(self, dot_mm: NDArray[np.float64], lost: NDArray[np.bool_]) -> bool:
        moved = (dot_mm - self._rest_mm)[~lost]
        moved = moved[np.isfinite(moved[:, 0])]
        if len(moved) < dot_field.LEAST_DOTS:
            return self._touches
        apart = moved - moved.mean(axis=0)
        return math.sqrt(float(np.mean(apart * apart))) > (ENDS if self._touches else BEGINS) * self._own_mm
