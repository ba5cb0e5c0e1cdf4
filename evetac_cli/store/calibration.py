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

MOST_PX = 65536  # events count columns and rows in uint16


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


def read_calibration(path: Path, frame_px: tuple[int, int] | None = None) -> Calibration:
    """Read a calibration; InputError names the key that is missing or wrong, or the frame if another is wanted."""
    try:
        table = json.loads(path.read_text())
        width, height = _whole(table, "frame_px", 2)
        dots = _dots(table["dot_xy_px"])
        radius = table["radius_px"]
        window = None if table.get("window_px") is None else _whole(table, "window_px", 4)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(path)) from None
    except KeyError as error:
        raise InputError(
            f"the key {error} is missing", where=str(path), expected="frame_px, radius_px, dot_xy_px"
        ) from None
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(
            f"not a calibration: {error}", where=str(path), expected="JSON with frame_px, radius_px, dot_xy_px"
        ) from None
    x0, y0, x1, y1 = window or (0, 0, width, height)
    for key, holds, expected in (
        ("frame_px", 0 < width <= MOST_PX and 0 < height <= MOST_PX, f"width and height from 1 to {MOST_PX}"),
        ("radius_px", _is_number(radius) and 0 < radius <= max(width, height), "a number above 0, in px"),
        ("window_px", 0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height, "x0, y0, x1, y1 inside the frame"),
    ):
        if not holds:
            raise InputError(f"{key} is not valid", where=str(path), expected=expected, found=str(table[key]))
    try:
        arranged = grid.arrange(dots)
    except ValueError as error:
        raise InputError(f"the dots do not form a grid: {error}", where=str(path)) from None
    if (arranged < 0).any() or (arranged >= (width, height)).any():
        raise InputError(
            "a dot lies outside the frame",
            where=str(path),
            expected=f"dot_xy_px as (x, y) within {width} x {height} px",
            found=f"x up to {np.nanmax(arranged[..., 0]):.4g}, y up to {np.nanmax(arranged[..., 1]):.4g}",
        )
    if frame_px is not None and frame_px != (width, height):
        raise InputError(
            "the calibration is for another frame",
            where=str(path),
            expected=f"{frame_px[0]} x {frame_px[1]} px",
            found=f"{width} x {height} px",
        )
    return Calibration((width, height), arranged, float(radius), (x0, y0, x1, y1) if window else None)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _whole(table: Any, key: str, count: int) -> tuple[int, ...]:
    """So many whole numbers; int() would also take the digits of a string, or cut 640.7."""
    values = table[key]
    if not isinstance(values, list) or len(values) != count or not all(_is_number(v) and v == int(v) for v in values):
        raise ValueError(f"{key} is {values}, not {count} whole numbers")
    return tuple(int(value) for value in values)


def _dots(values: Any) -> NDArray[np.float64]:
    """Centres as numbers, null for a missing dot; text is refused, though numpy would take it."""
    if np.asarray(values).dtype.kind not in "iufO":
        raise ValueError("dot_xy_px holds something other than numbers")
    return np.asarray(values, dtype=np.float64)
