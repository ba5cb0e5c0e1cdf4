"""Touch in a live view: forces and a touch map from the dot positions, one sample at a time.

The patch is updated in parts, one per sample. Each part takes some milliseconds of the sample's 50 ms, so the patch is
at most 0.2 s old. A first touch gets its patch at once.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.force.gel_forces import CreepMemory
from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_motion import CELL_MM
from evetac_cli.kernels.touch.touch_map import TouchReading
from evetac_cli.kernels.tracking.tracker import TrackerState
from evetac_cli.stages.touch import touch_fold
from evetac_cli.stages.touch.known_gel import KnownGel, gel_of
from evetac_cli.stages.touch.touch_fold import Factor, Slices, forces_of, normal_factor, shear_factor

DIGITS = 3  # digits after the decimal point in a map


class LiveTouch:
    """Touch maps from the dots of a tracker, with the same assumptions on the gel as predict-touch."""

    def __init__(self, sensor: Mapping[str, Any], tracking: TrackerState, period_s: float) -> None:
        """sensor: datasets `sensor/...` of a camera; period_s: time between samples.

        ValueError if the dots cannot be used.
        """
        width, height = (int(side) for side in sensor["sensor/frame_px"])
        if (width, height) != FRAME_PX:  # the size of its pixels on the gel is unknown
            raise ValueError("the frame is not {} x {} px".format(*FRAME_PX))
        self._tracking, self._middle_px = tracking, np.array(FRAME_PX) / 2
        modulus = sensor.get("sensor/shear_modulus_pa")
        known_gel = KnownGel(shear_modulus_pa=None if modulus is None else float(modulus))
        gel = gel_of(known_gel, PredictTouch().stiffness_error)
        self._gel, self._mm_per_px, self._period_s = gel, gel.mm_per_px, period_s
        self._creep = CreepMemory()
        self._shear, self._normal = shear_factor(gel), normal_factor(gel)
        sd = float(np.hypot(self._shear.relative_sd.mean(), gel.mm_log_sd))  # a lever has one more power of the scale
        self._torsion = Factor(self._shear.value.mean(), np.asarray(sd), self._shear.times)
        window = sensor.get("sensor/window_px")
        window_px = None if window is None else [int(side) for side in window]
        self._state = touch_fold.start(gel, tracking.rest_xy_px, FRAME_PX, window_px, renews=False)
        self._reading: TouchReading | None = None

    def _mm(self, dot_xy_px: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.asarray((dot_xy_px - self._middle_px) * self._mm_per_px)

    def now(self) -> dict[str, float]:
        """Return the present forces, torsion and area, with standard deviations; NaN if too few dots are tracked."""
        state, dots_mm, lost = self._state, self._mm(self._tracking.dot_xy_px), self._tracking.lost
        reading = touch_map.step(state, dots_mm, lost)
        if reading.touches:
            touch_map.renew_part(state)
        elif reading.known and state.touches:  # a touch has begun
            touch_map.renew(state)
            reading = touch_map.step(state, dots_mm, lost)
        self._reading = reading
        mpa = self._gel.modulus_pa * 1e-6
        over = Slices(
            reading.shear_n[None] / mpa,
            reading.shear_sd_n[None] / mpa,
            np.array([reading.normal_n]) / mpa,
            np.array([reading.normal_sd_n]) / mpa,
            np.array([reading.touches]),
        )
        forces = forces_of(self._gel, over, self._creep, self._period_s)
        torsion, torsion_sd = self._torsion.applied(
            np.asarray(reading.torsion_n_mm), np.asarray(reading.torsion_sd_n_mm)
        )
        return {
            "shear_x_n": float(forces.shear_n[0, 0]),
            "shear_y_n": float(forces.shear_n[0, 1]),
            "shear_sd_n": float(forces.shear_sd_n.max()),
            "normal_n": float(forces.normal_n[0]),
            "normal_sd_n": float(forces.normal_sd_n[0]),
            "torsion_n_mm": float(torsion),
            "torsion_sd_n_mm": float(torsion_sd),
            "area_mm2": reading.area_mm2,
        }

    def map(self) -> dict[str, Any] | None:
        """Return the map of the latest reading; None before the first.

        It has the grid in mm, and index, pressure and shear in kPa of each touched cell.
        """
        reading, (x_mm, y_mm) = self._reading, self._state.cells
        if reading is None:
            return None
        cells = np.flatnonzero(reading.patch)
        pa = np.stack(
            [reading.pressure_pa * self._normal.value, *(reading.shear_pa * self._shear.value[:, None, None])]
        )
        kpa = pa.reshape(3, -1)[:, cells] * 1e-3
        has_centre = reading.touches and bool(np.isfinite(reading.centre_mm).all())
        return {
            "known": reading.known,
            "x_mm": float(x_mm[0]),
            "y_mm": float(y_mm[0]),
            "cell_mm": CELL_MM,
            "columns": len(x_mm),
            "rows": len(y_mm),
            "area_mm2": round(reading.area_mm2, DIGITS) if reading.touches else None,
            "centre_mm": _rounded(reading.centre_mm) if has_centre else None,
            "centre_sd_mm": _rounded(reading.centre_sd_mm) if has_centre else None,
            "cells": [[cell, *_rounded(values)] for cell, values in zip(cells.tolist(), kpa.T, strict=True)],
        }


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [round(value, DIGITS) for value in values.tolist()]
