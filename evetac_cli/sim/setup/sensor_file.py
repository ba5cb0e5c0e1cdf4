"""Sensors: the rows of sensors.toml, and your own TOML file with the same keys: `--sensor mine.sensor.toml`.

`like = "evetac"` takes every key that the file leaves out from that named sensor. The result is a complete sensor. Two
files with the same content give the same sensor: neither the file's name nor `like` enters a recipe.

The rows of sensors.toml are written likewise: a row lists only its own values and takes all others from one other row,
its `like`, which may do the same. A complete row names no other sensor, so a recipe contains all its values.
"""

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import grid
from evetac_cli.resources import table as packaged
from evetac_cli.sim.setup.sensor import SENSOR_NAME, HotPixelTable, Sensor
from evetac_cli.sim.setup.tables import as_table, read_table
from evetac_cli.text_files import read_toml

SUFFIX = ".toml"
UNNAMED = "own-sensor"  # name in recordings of a sensor whose file has no `name`
OF_FILE = ("name", "like")
GRID = ("dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg")  # keys that dot_xy_px replaces
KEY_BY_KEY = ("gripper", "friction")  # tables that a row may give in part
FOR_EACH_TRIAL = ("randomized", "randomized-narrow")  # rows of ranges, from which each trial's sensor is sampled
LEAST_DOTS = 4  # fewer dots do not show how a gel rotates and stretches


@functools.cache
def rows() -> dict[str, dict[str, Any]]:
    """Return the complete row of each named sensor, by name and without `like`; the file is read once."""
    row_by_name = packaged("sensors")
    return {name: whole(name, row_by_name) for name in row_by_name}


def whole(name: str, row_by_name: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row of a table of sensors, completed from the rows that it is like."""
    row = dict(row_by_name[name])
    like = row.pop("like", None)
    return row if like is None else over(whole(like, row_by_name), row)


def over(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return another sensor's row, overridden by the named keys.

    The tables KEY_BY_KEY are merged key by key; all others are replaced. Positions of dots replace a grid, and a grid
    replaces positions.
    """
    replaced = GRID if "dot_xy_px" in changes else ("dot_xy_px",) if changes.keys() & set(GRID) else ()
    row = {key: value for key, value in base.items() if key not in replaced} | dict(changes)
    for group in KEY_BY_KEY:
        if group in base and isinstance(changes.get(group), Mapping):
            row[group] = {**base[group], **changes[group]}
    return row


def read(path: Path, named_sensor: Callable[[str], Sensor]) -> tuple[str, Sensor]:
    """Read a sensor's file; return the sensor's name and the sensor. InputError if the file is invalid.

    named_sensor: returns a sensor by its name, for `like`.
    """
    table = read_toml(path)
    where = str(path)
    if "dot_xy_px" in table:
        table = {**table, "dot_xy_px": _rows_of_dots(table["dot_xy_px"])}
    name, like = table.get("name", UNNAMED), table.get("like")
    if like in FOR_EACH_TRIAL:
        expected = "one sensor, for example evetac or randomized:7"
        raise InputError("like: not one sensor but many", where=where, expected=expected, found=like)
    check_name(name, where)
    grid_keys = [key for key in GRID if key in table]
    if "dot_xy_px" in table and grid_keys:
        expected = f"dot_xy_px, or {', '.join(GRID)}"
        both = f"dot_xy_px and {grid_keys[0]}"
        raise InputError("the dots are given twice", where=where, expected=expected, found=both)
    base = {} if like is None else as_table(_sensor_of(str(like), named_sensor, where))
    row = over(base, {key: value for key, value in table.items() if key not in OF_FILE})
    row.setdefault("summary", f"read from a file, like {like}" if like else "read from a file")
    return str(name), of_row(row, where)


def check_name(name: str, where: str) -> None:
    """Raise InputError unless the name is valid: lower case, and not that of one of evetac's sensors."""
    if not re.fullmatch(SENSOR_NAME, str(name)):
        expected = "lower-case letters, digits and -, for example lab-3"
        raise InputError("name: not a valid sensor name", where=where, expected=expected, found=name)
    if name in rows():
        message = "name: evetac already has a sensor of this name"
        raise InputError(message, where=where, expected="another name", found=name)


def of_row(row: Mapping[str, Any], where: str) -> Sensor:
    """Build a sensor from a complete row; InputError if a key is missing or values contradict each other."""
    sensor = read_table(Sensor, row, where, if_missing='`like = "evetac"` takes missing keys from that sensor')
    if "dot_xy_px" not in row and not {"dot_columns_px", "dot_rows_px"} <= row.keys():
        missing = ", ".join(key for key in ("dot_columns_px", "dot_rows_px") if key not in row)
        raise InputError("the positions of the dots are missing", where=where, expected=f"{missing}, or dot_xy_px")
    if len({len(dots) for dots in row.get("dot_xy_px", [[]])}) != 1:
        expected = "rows with the same number of dots, or a list without rows for dots in no grid"
        raise InputError("dot_xy_px: rows of different lengths", where=where, expected=expected)
    x0, y0, x1, y1 = sensor.window_px
    if not (x0 < x1 and y0 < y1 <= sensor.frame_px[1]):
        expected = "x0 < x1 and y0 < y1 within the frame"
        raise InputError("window_px: not a window", where=where, expected=expected, found=str(row["window_px"]))
    _check_gripper_and_friction(sensor, where)
    _check_dots(sensor, where)
    if sensor.hot_pixels and not sensor.hot_pixel_hz:
        expected = "hot_pixel_hz, quantiles of their event rates"
        raise InputError("hot_pixels: the event rates are missing", where=where, expected=expected)
    if sensor.hot_pixel_table is not None:
        _check_hot_pixels(sensor.hot_pixel_table, where)
    return sensor


def _check_gripper_and_friction(sensor: Sensor, where: str) -> None:
    """Raise InputError if only one of two keys that belong together is set, or a property is given twice."""
    gripper, friction = sensor.gripper, sensor.friction
    if (gripper.servo_n_tick is None) != (gripper.two_ticks_n is None):
        raise InputError("gripper: servo_n_tick and two_ticks_n must be set together", where=where)
    if (friction.patch_spread is None) != (friction.patch_mm is None):
        raise InputError("friction: patch_spread and patch_mm must be set together", where=where)
    unused = [key for key in ("gain_ma_tick", "friction_n") if getattr(gripper, key) is not None]
    if unused and gripper.servo_n_tick is not None:
        expected = "servo_n_tick and two_ticks_n, or gain_ma_tick and friction_n"
        both = f"servo_n_tick and {unused[0]}"
        raise InputError("gripper: the servo is described twice", where=where, expected=expected, found=both)


def _check_hot_pixels(table: HotPixelTable, where: str) -> None:
    """Raise InputError if a pixel has more events than its dead time and short intervals allow."""
    columns = (table.rate_hz, table.short_interval_share, table.short_interval_us)
    for place, (rate_hz, share, short_us) in enumerate(zip(*columns, strict=True)):
        quick_us = table.dead_time_us + share * short_us
        if quick_us * rate_hz * 1e-6 >= 1.0:
            raise InputError(
                f"hot_pixel_table: pixel {place} has too many events for its dead time and short intervals",
                where=where,
                expected="dead_time_us + short_interval_share * short_interval_us below the mean time between events",
                found=f"{quick_us:g} us of {1e6 / rate_hz:g} us",
            )


def _sensor_of(like: str, named_sensor: Callable[[str], Sensor], where: str) -> Sensor:
    try:
        return named_sensor(like)
    except InputError as error:
        raise InputError(
            f"like: {error.message}", where=where, expected=error.expected, found=error.found, hint=error.hint
        ) from None


def _rows_of_dots(dot_xy_px: Any) -> Any:
    """Return dots in rows; a list of dots without rows is arranged in its grid's rows, or in one row if it has no grid.

    Anything that is not a list of dots is returned unchanged, so that the schema check reports the error.
    """
    dots = dot_xy_px if isinstance(dot_xy_px, list) else []
    if not dots or any(isinstance(value, list) for dot in dots if isinstance(dot, list) for value in dot):
        return dot_xy_px
    fits = LEAST_DOTS <= len(dots) <= grid.MOST_DOTS
    if not fits or any(type(dot) is not list or len(dot) != 2 or {type(v) for v in dot} - {int, float} for dot in dots):
        return [dots]
    try:
        rows: list[list[list[float]]] = grid.arrange(np.array(dots, float)).tolist()
    except ValueError:
        return [dots]
    return rows


def _check_dots(sensor: Sensor, where: str) -> None:
    """Raise InputError unless the dots can be tracked: neither too few nor too many, in the frame, not overlapping."""
    from evetac_cli.sim.camera.gel_camera import (
        Lens,
        dot_grid,  # imports numba
    )

    lens = Lens.of_sensor(sensor)
    dots = dot_grid(sensor, cut=False).reshape(-1, 2)
    seen = dots if lens is None else lens.seen(dots)
    if not LEAST_DOTS <= len(dots) <= grid.MOST_DOTS:
        expected = f"{LEAST_DOTS} to {grid.MOST_DOTS} dots, which the tracker can follow"
        raise InputError("this number of dots cannot be tracked", where=where, expected=expected, found=str(len(dots)))
    width, height = sensor.frame_px
    outside = ((seen < 0) | (seen > (width - 1, height - 1))).any(axis=1)
    if outside.any():
        x, y = seen[outside][0]
        expected = f"centres inside {width} x {height} px"
        raise InputError("a dot is outside the frame", where=where, expected=expected, found=f"({x:.4g}, {y:.4g})")
    apart_px = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    one, other = np.unravel_index(apart_px.argmin(), apart_px.shape)
    if apart_px[one, other] < 2.0 * sensor.dot_radius_px:
        places = " and ".join(f"({x:.4g}, {y:.4g})" for x, y in dots[[one, other]])
        expected = f"centres at least a diameter apart, {2.0 * sensor.dot_radius_px:g} px"
        raise InputError("two dots overlap", where=where, expected=expected, found=places)
    beside = dot_grid(sensor, cut=True).size // 2
    if beside < LEAST_DOTS:
        expected = f"at least {LEAST_DOTS} dots to the left of window_px, for a cut gel"
        raise InputError("too few dots next to the window", where=where, expected=expected, found=str(beside))
