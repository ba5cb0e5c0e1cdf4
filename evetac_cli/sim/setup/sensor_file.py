"""Reads one's own sensor, a TOML file with the keys of a row of sensors.toml: `--sensor mine.sensor.toml`.

`like = "evetac"` takes every key that the file leaves out from a named sensor. What comes out is a whole sensor, the
same for two files of the same content: names of files and `like` do not enter a recipe.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import grid
from evetac_cli.sim.setup.sensor import SENSOR_NAME, HotPixelTable, Sensor, SensorFile
from evetac_cli.sim.setup.sensor_rows import FOR_EACH_TRIAL, GRID, over, rows
from evetac_cli.sim.setup.tables import as_table, build, check
from evetac_cli.text_files import read_toml

SUFFIX = ".toml"
UNNAMED = "own-sensor"  # what recordings call a sensor whose file has no `name`
OF_FILE = ("name", "like")
LEAST_DOTS = 4  # fewer say nothing of how a gel turns and stretches


def read(path: Path, named_sensor: Callable[[str], Sensor]) -> tuple[str, Sensor]:
    """The name of a sensor's file, and the sensor; InputError for anything that is no sensor.

    named_sensor: a sensor by its name, for `like`.
    """
    table = read_toml(path)
    where = str(path)
    if "dot_xy_px" in table:
        table = {**table, "dot_xy_px": _rows_of_dots(table["dot_xy_px"])}
    check(SensorFile, table, where, whole=False)
    name, like = table.get("name", UNNAMED), table.get("like")
    if like in FOR_EACH_TRIAL:
        expected = "one sensor, as in evetac or randomized:7"
        raise InputError("like: not one sensor but many", where=where, expected=expected, found=like)
    check_name(name, where)
    named = [key for key in GRID if key in table]
    if "dot_xy_px" in table and named:
        expected = f"dot_xy_px, or {', '.join(GRID)}"
        raise InputError("dots are named twice", where=where, expected=expected, found=f"dot_xy_px and {named[0]}")
    base = {} if like is None else as_table(_sensor_of(like, named_sensor, where))
    row = over(base, {key: value for key, value in table.items() if key not in OF_FILE})
    row.setdefault("summary", f"read from a file, like {like}" if like else "read from a file")
    return str(name), of_row(row, where)


def check_name(name: str, where: str) -> None:
    """InputError unless a sensor may be called so: in small letters, and not as one that comes with evetac."""
    if not re.fullmatch(SENSOR_NAME, name):
        expected = "small letters, digits and -, as in lab-3"
        raise InputError("name: not the name of a sensor", where=where, expected=expected, found=name)
    if name in rows():
        raise InputError("name: that of a sensor which comes with evetac", where=where, expected="another", found=name)


def of_row(row: Mapping[str, Any], where: str) -> Sensor:
    """A sensor from a whole row; InputError where a key is missing, or values do not fit together."""
    check(Sensor, row, where, if_missing='`like = "evetac"` takes what is left out from that sensor')
    if "dot_xy_px" not in row and not {"dot_columns_px", "dot_rows_px"} <= row.keys():
        missing = ", ".join(key for key in ("dot_columns_px", "dot_rows_px") if key not in row)
        raise InputError("the places of the dots are missing", where=where, expected=f"{missing}, or dot_xy_px")
    if len({len(dots) for dots in row.get("dot_xy_px", [[]])}) != 1:
        expected = "rows of equally many dots; dots in no grid as a list without rows"
        raise InputError("dot_xy_px: rows of different lengths", where=where, expected=expected)
    sensor = build(Sensor, row)
    x0, y0, x1, y1 = sensor.window_px
    if not (x0 < x1 and y0 < y1 <= sensor.frame_px[1]):
        expected = "x0 < x1 and y0 < y1 within the frame"
        raise InputError("window_px: not a window", where=where, expected=expected, found=str(row["window_px"]))
    _check_gripper_and_friction(sensor, where)
    _check_dots(sensor, where)
    if sensor.hot_pixels and not sensor.hot_pixel_hz:
        expected = "hot_pixel_hz, quantiles of the rates"
        raise InputError("hot_pixels: their rates are missing", where=where, expected=expected)
    if sensor.hot_pixel_table is not None:
        _check_hot_pixels(sensor.hot_pixel_table, where)
    return sensor


def _check_gripper_and_friction(sensor: Sensor, where: str) -> None:
    """Values that belong together are all there, and what is named in one way is not named in another."""
    gripper, friction = sensor.gripper, sensor.friction
    if (gripper.servo_n_tick is None) != (gripper.two_ticks_n is None):
        raise InputError("gripper: servo_n_tick and two_ticks_n need each other", where=where)
    if (friction.patch_spread is None) != (friction.patch_mm is None):
        raise InputError("friction: patch_spread and patch_mm need each other", where=where)
    unused = [key for key in ("gain_ma_tick", "friction_n") if getattr(gripper, key) is not None]
    if unused and gripper.servo_n_tick is not None:
        expected = "servo_n_tick and two_ticks_n, or gain_ma_tick and friction_n"
        both = f"servo_n_tick and {unused[0]}"
        raise InputError("gripper: the same is named twice", where=where, expected=expected, found=both)


def _check_hot_pixels(table: HotPixelTable, where: str) -> None:
    """No pixel comes twice, and no value contradicts another of its pixel."""
    columns = (table.x_px, table.y_px, table.rate_hz, table.on_share, table.polarity_change_share)
    seen = set()
    for place, (x, y, rate_hz, on, change) in enumerate(zip(*columns, strict=True)):
        what = f"hot_pixel_table: pixel {place} at ({x}, {y})"
        if (x, y) in seen:
            raise InputError(f"{what} comes twice", where=where)
        seen.add((x, y))
        if change > 2 * min(on, 1 - on) + 1e-9:
            rarer = f"{2 * min(on, 1 - on):g}, twice the share of the rarer polarity"
            expected = f"polarity_change_share of at most {rarer}"
            raise InputError(
                f"{what} changes its polarity too often", where=where, expected=expected, found=f"{change}"
            )
        quick_us = table.short_interval_share[place] * table.short_interval_us[place]
        if (table.dead_time_us + quick_us) * rate_hz * 1e-6 >= 1.0:
            raise InputError(
                f"{what} has no time for so many events",
                where=where,
                expected="dead_time_us + short_interval_share * short_interval_us below the mean time between events",
                found=f"{table.dead_time_us + quick_us:g} us of {1e6 / rate_hz:g} us",
            )


def _sensor_of(like: str, named_sensor: Callable[[str], Sensor], where: str) -> Sensor:
    try:
        return named_sensor(like)
    except InputError as error:
        raise InputError(
            f"like: {error.message}", where=where, expected=error.expected, found=error.found, hint=error.hint
        ) from None


def _rows_of_dots(dot_xy_px: Any) -> Any:
    """Rows of dots; a list of dots without rows is put into those of its grid, or into one row if it has none.

    What is no list of dots goes on to the schema, which refuses it.
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
    """InputError unless the dots are as many as can be tracked, in the frame and apart."""
    from evetac_cli.sim.camera.gel_camera import dot_grid  # brings numba
    from evetac_cli.sim.camera.lens import Lens

    lens = Lens.of_sensor(sensor)
    dots = dot_grid(sensor, cut=False).reshape(-1, 2)
    seen = dots if lens is None else lens.seen(dots)
    if not LEAST_DOTS <= len(dots) <= grid.MOST_DOTS:
        expected = f"{LEAST_DOTS} to {grid.MOST_DOTS}, which the tracker has room for"
        raise InputError(
            "a number of dots that cannot be tracked", where=where, expected=expected, found=str(len(dots))
        )
    width, height = sensor.frame_px
    outside = ((seen < 0) | (seen > (width - 1, height - 1))).any(axis=1)
    if outside.any():
        x, y = seen[outside][0]
        expected = f"centres inside {width} x {height} px"
        raise InputError("a dot lies outside the frame", where=where, expected=expected, found=f"({x:.4g}, {y:.4g})")
    apart_px = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    one, other = np.unravel_index(apart_px.argmin(), apart_px.shape)
    if apart_px[one, other] < 2.0 * sensor.dot_radius_px:
        places = " and ".join(f"({x:.4g}, {y:.4g})" for x, y in dots[[one, other]])
        expected = f"centres at least a diameter apart, {2.0 * sensor.dot_radius_px:g} px"
        raise InputError("two dots overlap", where=where, expected=expected, found=places)
    beside = dot_grid(sensor, cut=True).size // 2
    if beside < LEAST_DOTS:
        expected = f"at least {LEAST_DOTS} left of window_px, for a cut gel"
        raise InputError("too few dots beside the window", where=where, expected=expected, found=str(beside))
