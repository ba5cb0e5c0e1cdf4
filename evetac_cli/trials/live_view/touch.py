"""What a live view shows of touch: forces and a touch map from where the dots are, a sample at a time.

The patch is renewed in parts, one per sample, each some milliseconds of the 50 that a sample has: it is 0.2 s old at
most. A first touch has its patch at once.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_modes import DotNoise
from evetac_cli.kernels.touch.dot_motion import CELL_MM, GelLayer
from evetac_cli.kernels.touch.touch_map import TouchReading
from evetac_cli.kernels.tracking.tracker import TrackerState

MM_PER_PX = 0.0329  # of the sensor `evetac`; what a calibration tells has no scale
STIFFNESS_ERROR = 0.1  # of a modulus that the calibration names, as predict-touch --sensor has it
UNKNOWN_STIFFNESS = 0.4  # relative sd over gels: log-uniform from 70 to 300 kPa, as `randomized` has them
DIGITS = 3  # of numbers in a map


class LiveTouch:
    """Touch maps of dots that a tracker follows."""

    def __init__(self, sensor: Mapping[str, Any], tracking: TrackerState) -> None:
        """For datasets `sensor/...` of a camera; ValueError where nothing can be told of its dots."""
        width, height = (int(side) for side in sensor["sensor/frame_px"])
        if (width, height) != FRAME_PX:  # how large its pixels are on the gel is not known
            raise ValueError("the frame is not {} x {} px".format(*FRAME_PX))
        self._tracking, self._middle_px = tracking, np.array(FRAME_PX) / 2
        modulus = sensor.get("sensor/shear_modulus_pa")
        layer, error = GelLayer(), UNKNOWN_STIFFNESS
        if modulus is not None:
            layer, error = layer._replace(shear_modulus_pa=float(modulus)), STIFFNESS_ERROR
        self._state = touch_map.start(self._mm(tracking.rest_xy_px), layer, DotNoise(), error, renews=False)
        self._reading: TouchReading | None = None

    def _mm(self, dot_xy_px: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.asarray((dot_xy_px - self._middle_px) * MM_PER_PX)

    def now(self) -> dict[str, float]:
        """Forces, torsion and area now, with deviations; NaN where too few dots are tracked."""
        state, dots_mm, lost = self._state, self._mm(self._tracking.dot_xy_px), self._tracking.lost
        reading = touch_map.step(state, dots_mm, lost)
        if reading.touches:
            touch_map.renew_part(state)
        elif reading.known and state.touches:  # a touch that has begun
            touch_map.renew(state)
            reading = touch_map.step(state, dots_mm, lost)
        self._reading = reading
        x_n, y_n = reading.shear_n
        return {
            "shear_x_n": float(x_n),
            "shear_y_n": float(y_n),
            "shear_sd_n": float(reading.shear_sd_n.max()),
            "normal_n": reading.normal_n,
            "normal_sd_n": reading.normal_sd_n,
            "torsion_n_mm": reading.torsion_n_mm,
            "torsion_sd_n_mm": reading.torsion_sd_n_mm,
            "area_mm2": reading.area_mm2,
        }

    def map(self) -> dict[str, Any] | None:
        """The map of the latest reading: its grid in mm, and number, pressure and shear in kPa of each touched cell."""
        reading, (x_mm, y_mm) = self._reading, self._state.cells
        if reading is None:
            return None
        cells = np.flatnonzero(reading.patch)
        kpa = np.stack([reading.pressure_pa, *reading.shear_pa]).reshape(3, -1)[:, cells] * 1e-3
        known = reading.touches and bool(np.isfinite(reading.centre_mm).all())
        return {
            "known": reading.known,
            "x_mm": float(x_mm[0]),
            "y_mm": float(y_mm[0]),
            "cell_mm": CELL_MM,
            "columns": len(x_mm),
            "rows": len(y_mm),
            "area_mm2": round(reading.area_mm2, DIGITS) if reading.touches else None,
            "centre_mm": _rounded(reading.centre_mm) if known else None,
            "centre_sd_mm": _rounded(reading.centre_sd_mm) if known else None,
            "cells": [[cell, *_rounded(values)] for cell, values in zip(cells.tolist(), kpa.T, strict=True)],
        }


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [round(value, DIGITS) for value in values.tolist()]
