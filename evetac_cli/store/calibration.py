"""Dot grids as JSON: the keys of the official base calibration (frame_px, radius_px, dot_xy_px), and optionally
rows, columns, mask, window_px, hot_pixels, contrast_over_threshold and shear_modulus_pa. The dots may come in any
order; rows and columns follow from their centres. Dots without a grid are one row, [[[x, y], [x, y], ...]].

A dot is missing if its centre is null or its value in the mask, one list per row, is false. So a damaged dot can be
disabled by hand with one word. In stage files a missing dot is NaN. Neighbours follow from the centres (kernels.grid);
files written by `evetac calibrate` list them for other programs, and nothing here reads them.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip.architectures import UNKNOWN_SENSITIVITY, Sensitivity
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.provenance import Recipe, content_digest, first_difference, other_recipe
from evetac_cli.store.recordings.read import HOT_PIXELS
from evetac_cli.text_files import MOST_JSON_BYTES, parse_json, read_text

if TYPE_CHECKING:
    from evetac_cli.store.files import StageFile

MAKE_GRID = "evetac calibrate makes one from a press recording or a file; pass it with --calibration GRID.json"
LEAST_RADIUS_PX = 0.01  # files are written to 0.001 px
Side = Annotated[int, Meta(ge=1, le=grid.MOST_FRAME_PX)]  # limit of the tracker


@dataclass(frozen=True)
class Calibration:
    """The dots of a gel at rest, and the sensor's known sensitivity to contact."""

    frame_px: tuple[int, int]
    dot_xy_px: NDArray[np.float64]  # (rows, columns, 2)
    dot_radius_px: float
    window_px: tuple[int, int, int, int] | None
    sensitivity: Sensitivity = UNKNOWN_SENSITIVITY
    hot_xy_px: NDArray[np.uint16] = field(default_factory=lambda: np.empty((0, 2), np.uint16))  # hot pixels

    def arrays(self) -> dict[str, Any]:
        """Return the datasets of a stage file's sensor group."""
        arrays: dict[str, Any] = {
            "sensor/dot_xy_px": self.dot_xy_px,
            "sensor/dot_radius_px": np.float64(self.dot_radius_px),
        }
        if self.window_px is not None:
            arrays["sensor/window_px"] = np.array(self.window_px, np.int32)
        sensor_values = self.sensitivity.known()
        return arrays | {f"sensor/{name}": np.float64(value) for name, value in sensor_values.items()}

    def recorded(self) -> dict[str, Any]:
        """Return the datasets of a recording's sensor group, which also has the hot pixels."""
        return self.arrays() | ({HOT_PIXELS: self.hot_xy_px} if len(self.hot_xy_px) else {})

    def require_frame(self, frame_px: Sequence[int], where: str) -> None:
        """Raise InputError unless it is for this frame (width, height), which is that of `where`, a camera or file."""
        width, height = map(int, frame_px)
        if (width, height) != self.frame_px:
            expected, found = f"{width} x {height} px", "{} x {} px".format(*self.frame_px)
            raise InputError("the calibration is for another frame", where=where, expected=expected, found=found)

    def digest(self) -> str:
        """Return the hash that represents this calibration in a recipe."""
        return content_digest(self.recorded())


def stored_calibration(recording: "StageFile") -> Calibration:
    """Return the dot grid stored in a recording, without its sensitivity, which tracks do not need."""
    width, height = recording.read("sensor/frame_px")
    window = None
    if recording.has("sensor/window_px"):
        x0, y0, x1, y1 = recording.read("sensor/window_px").tolist()
        window = (x0, y0, x1, y1)
    radius = float(recording.read("sensor/dot_radius_px"))
    hot = {"hot_xy_px": recording.read(HOT_PIXELS)} if recording.has(HOT_PIXELS) else {}
    return Calibration((int(width), int(height)), recording.read("sensor/dot_xy_px"), radius, window, **hot)


def read_calibration(path: Path, frame_px: tuple[int, int] | None = None) -> Calibration:
    """Read a calibration; InputError names a missing or invalid key, or the frame if it differs from `frame_px`."""
    return _parsed(read_text(path, MOST_JSON_BYTES), str(path), frame_px)


def read_calibrations(path: Path | None, frames_px: Sequence[tuple[int, int]]) -> tuple[Calibration, ...]:
    """Return the calibration of each camera, by their frames: from one file for all, or one each with commas between.

    Empty without a path. InputError as for `read_calibration`, and for a wrong number of files.
    """
    if path is None:
        return ()
    paths = [path] if len(frames_px) == 1 or path.exists() else [Path(each) for each in str(path).split(",")]
    if len(paths) not in (1, len(frames_px)):
        message = "the number of calibrations differs from the number of cameras"
        raise InputError(message, where="--calibration", expected=f"1 or {len(frames_px)}", found=str(path))
    if len(paths) == 1:
        paths *= len(frames_px)
    return tuple(read_calibration(each, frame_px) for each, frame_px in zip(paths, frames_px, strict=True))


class _StoredGrid(msgspec.Struct):
    """The keys that are read; limits of the sensitivity as in stage files."""

    frame_px: tuple[Side, Side]
    radius_px: Annotated[float, Meta(ge=LEAST_RADIUS_PX)]
    dot_xy_px: list[Any]
    window_px: tuple[int, int, int, int] | None = None
    mask: list[list[bool]] | None = None
    hot_pixels: list[tuple[int, int]] = []
    rows: int | None = None
    columns: int | None = None
    contrast_over_threshold: Annotated[float, Meta(ge=0.001, le=1e3)] | None = None
    shear_modulus_pa: Annotated[float, Meta(ge=1.0, le=1e9)] | None = None


def _parsed(text: str, where: str, frame_px: tuple[int, int] | None = None) -> Calibration:
    """Parse a calibration; `where` is its source, for error messages."""
    try:
        calibration = _checked(
            msgspec.convert(parse_json(text), _StoredGrid, strict=False)
        )  # 640.0 is a whole number too
    except (ValueError, TypeError) as error:
        expected = "JSON with frame_px, radius_px, dot_xy_px; dots without a grid are one row, [[[x, y], [x, y], ...]]"
        raise InputError(f"not a calibration: {error}", where=where, expected=expected) from None
    if frame_px is not None:
        calibration.require_frame(frame_px, where)
    return calibration


def _checked(table: _StoredGrid) -> Calibration:
    """Return the calibration of a table; ValueError if its values do not belong together."""
    width, height = table.frame_px
    x0, y0, x1, y1 = table.window_px or (0, 0, width, height)
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(f"window_px: expected x0, y0, x1, y1 inside the frame, found {table.window_px}")
    if table.radius_px > max(width, height):
        raise ValueError(f"radius_px: expected no more than the frame, found {table.radius_px}")
    hot = table.hot_pixels
    if len(set(hot)) < len(hot) or not all(0 <= x < width and 0 <= y < height for x, y in hot):
        raise ValueError(f"hot_pixels: expected different pixels [x, y] within {width} x {height} px")
    dots = np.asarray(table.dot_xy_px, np.float64) + 0.0  # a 0 without a sign
    if dots.size > 2 * grid.MOST_DOTS:
        raise ValueError(f"{dots.size // 2} dots, more than {grid.MOST_DOTS}, the limit of the tracker")
    dots = _masked(grid.arrange(dots), table.mask)
    rows, columns = dots.shape[:2]
    if (table.rows or rows, table.columns or columns) != (rows, columns):
        raise ValueError(f"expected rows {rows} and columns {columns}, found {table.rows} and {table.columns}")
    if (dots < 0).any() or (dots >= (width, height)).any():
        raise ValueError(f"a dot is outside the frame of {width} x {height} px")
    if fault := grid.impossible(dots, table.radius_px):
        raise ValueError(f"these dots are impossible: expected {fault[0]}, found {fault[1]}")
    sensitivity = Sensitivity(table.contrast_over_threshold, table.shear_modulus_pa)
    hot_xy_px = np.array(hot, np.uint16).reshape(-1, 2)
    return Calibration((width, height), dots, table.radius_px, table.window_px, sensitivity, hot_xy_px)


def up_to_date(path: Path, recipe: Recipe, *, force: bool = False) -> bool:
    """Return whether `path` already has the result of this recipe; InputError if it has another, unless `force`.

    This is the counterpart of store.files.up_to_date for JSON.
    """
    if path.is_dir():
        raise InputError("the output is a folder", where=str(path))
    if not path.exists():
        return False
    try:
        provenance = parse_json(read_text(path, MOST_JSON_BYTES))["provenance"]
        difference = "" if provenance["id"] == recipe.id else first_difference(recipe, provenance)
    except (InputError, ValueError, TypeError, KeyError, AttributeError):
        difference = "not a calibration made by evetac"
    if not difference or force:
        return not difference
    raise other_recipe(str(path), difference)


def write_calibration(
    path: Path,
    calibration: Calibration,
    neighbours: list[list[int]],
    quality: dict[str, Any],
    provenance: dict[str, Any],
    source: str,
    check: Callable[[], bool] | None = None,
) -> None:
    """Write a calibration as JSON, atomically; InputError, with `source`, if the result would not be readable.

    - neighbours: indices of dots, counted row by row, a list for each dot.
    - quality: figures on the detection of the dots, with units in their names.
    - provenance: the recipe's identity, its id, and when and where it was made.
    - check: of a file that it would replace, as for `taking_the_place_of`.
    """
    dots = calibration.dot_xy_px
    present = np.isfinite(dots).all(axis=2)
    table = {
        "frame_px": list(calibration.frame_px),
        "radius_px": round(calibration.dot_radius_px, 3),
        "rows": dots.shape[0],
        "columns": dots.shape[1],
        "window_px": None if calibration.window_px is None else list(calibration.window_px),
        **{name: float(f"{value:.5g}") for name, value in calibration.sensitivity.known().items()},
        "dot_xy_px": [[_rounded(dot) for dot in row] for row in dots],
        "mask": present.tolist(),
        "hot_pixels": calibration.hot_xy_px.tolist(),
        "neighbours": neighbours,
        "quality": quality,
        "provenance": provenance,
    }
    lines = ",\n".join(f'  "{key}": {_in_lines(value)}' for key, value in table.items())
    text = f"{{\n{lines}\n}}\n"
    _parsed(text, source)
    with taking_the_place_of(path, check=check) as temporary:
        temporary.write_text(text)


def read_quality(path: Path) -> dict[str, Any]:
    """Return the figures on the detection of the dots from a calibration written by `write_calibration`."""
    table = parse_json(read_text(path, MOST_JSON_BYTES))  # already read as a calibration
    quality = table.get("quality")
    if not isinstance(quality, dict):
        raise InputError("quality is not valid", where=str(path), expected="numbers with their names")
    return quality


def _rounded(dot: NDArray[np.float64]) -> list[float | None]:
    """Return a centre rounded to 0.001 px, or nulls: detection is not more accurate, and people read these files."""
    return [round(float(value), 3) if np.isfinite(value) else None for value in dot]


def _in_lines(value: Any) -> str:
    """Return JSON with one line for every row."""
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n" + ",\n".join(f"    {json.dumps(row)}" for row in value) + "\n  ]"
    return json.dumps(value)


def _masked(dots: NDArray[np.float64], mask: list[list[bool]] | None) -> NDArray[np.float64]:
    """Return the grid with NaN where the mask is false; ValueError if the mask does not fit or all dots are missing."""
    masked = dots.copy()
    masked[np.isnan(dots).any(axis=2)] = np.nan
    if mask is not None:
        rows, columns = dots.shape[:2]
        if [len(row) for row in mask] != [columns] * rows:
            raise ValueError(f"expected a mask of {rows} rows with {columns} values, true or false, found another")
        masked[~np.array(mask)] = np.nan
    if np.isnan(masked).all():
        raise ValueError("expected at least one dot, found all missing")
    return masked
