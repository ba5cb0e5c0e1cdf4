"""Dot grids as JSON: the keys of the official base calibration (frame_px, radius_px, dot_xy_px), and optionally
window_px. The dots may come in any order; rows and columns are found from their centres.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels import grid
from evetac_cli.store.provenance import content_digest


@dataclass(frozen=True)
class Calibration:
    """Where the dots of one gel are at rest."""

    frame_px: tuple[int, int]
    dot_xy_px: NDArray[np.float64]  # (rows, columns, 2)
    dot_radius_px: float
    window_px: tuple[int, int, int, int] | None

    def arrays(self) -> dict[str, Any]:
        """As the datasets of a stage file's sensor group."""
        arrays: dict[str, Any] = {
            "sensor/dot_xy_px": self.dot_xy_px,
            "sensor/dot_radius_px": np.float64(self.dot_radius_px),
        }
        if self.window_px is not None:
            arrays["sensor/window_px"] = np.array(self.window_px, np.int32)
        return arrays

    def digest(self) -> str:
        """What stands for this calibration in a recipe."""
        return content_digest(self.arrays())


def read_calibration(path: Path) -> Calibration:
    """Read a calibration; InputError names the key that is missing or wrong."""
    try:
        table = json.loads(path.read_text())
        frame = tuple(int(size) for size in table["frame_px"])
        dots = np.asarray(table["dot_xy_px"], dtype=np.float64)
        radius = float(table["radius_px"])
        window = table.get("window_px")
        window = None if window is None else tuple(int(edge) for edge in window)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from None
    except KeyError as error:
        raise InputError(
            f"the key {error} is missing", where=str(path), expected="frame_px, radius_px, dot_xy_px"
        ) from None
    except (ValueError, TypeError) as error:
        raise InputError(
            f"not a calibration: {error}", where=str(path), expected="JSON with frame_px, radius_px, dot_xy_px"
        ) from None
    if len(frame) != 2 or (window is not None and len(window) != 4) or not (np.isfinite(radius) and radius > 0):
        raise InputError(
            "not a calibration", where=str(path), expected="frame_px of 2, window_px of 4 numbers, radius_px > 0"
        )
    try:
        return Calibration((frame[0], frame[1]), grid.arrange(dots), radius, window)
    except ValueError as error:
        raise InputError(f"the dots do not form a grid: {error}", where=str(path)) from None
