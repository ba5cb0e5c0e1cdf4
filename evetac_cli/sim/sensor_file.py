"""Reads one's own sensor, a TOML file with the keys of a row of sensors.toml: `--sensor mine.sensor.toml`.

`like = "evetac"` takes every key that the file leaves out from a named sensor. What comes out is a whole row, the same
for two files of the same content: names of files and `like` do not enter a recipe.
"""

import functools
import json
import re
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.calibration import grid
from evetac_cli.resources import schemas
from evetac_cli.resources import table as packaged
from evetac_cli.text_files import read_toml

SUFFIX = ".toml"
UNNAMED = "own-sensor"  # what recordings call a sensor whose file has no `name`
TYPES = {
    "number": "a number",
    "integer": "a whole number",
    "string": "a text",
    "array": "a list",
    "object": "a table",
    "boolean": "true or false",
}
GRID = ("dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg")  # what dot_xy_px takes the place of
RISING = ("dot_columns_px", "dot_rows_px", "hot_pixel_hz")
TOGETHER = (("gripper", "servo_n_tick", "two_ticks_n"), ("friction", "patch_spread", "patch_mm"))
LEAST_DOTS = 4  # fewer say nothing of how a gel turns and stretches


def read(path: Path, named_row: Callable[[str], dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """The name and the whole row of a sensor's file; InputError for anything that is no sensor.

    named_row: the row of a sensor by its name, for `like`.
    """
    table = read_toml(path)
    where = str(path)
    if "dot_xy_px" in table:
        table = {**table, "dot_xy_px": _rows_of_dots(table["dot_xy_px"])}
    _check(table, where, whole=False)
    name, like = table.get("name", UNNAMED), table.get("like")
    if like == "randomized":
        expected = "one sensor, as in evetac or randomized:7"
        raise InputError("like: not one sensor but many", where=where, expected=expected, found=like)
    check_name(name, where)
    named = [key for key in GRID if key in table]
    if "dot_xy_px" in table and named:
        expected = f"dot_xy_px, or {', '.join(GRID)}"
        raise InputError("dots are named twice", where=where, expected=expected, found=f"dot_xy_px and {named[0]}")
    base = {} if like is None else _row_of(like, named_row, where)
    replaced = GRID if "dot_xy_px" in table else ("dot_xy_px",) if named else ()
    kept = {key: value for key, value in base.items() if key not in replaced}
    row = {**kept, **{key: value for key, value in table.items() if key not in ("name", "like")}}
    for group in ("gripper", "friction"):
        if group in base and group in table:
            row[group] = {**base[group], **table[group]}
    row.setdefault("summary", f"read from a file, like {like}" if like else "read from a file")
    check_row(row, where)
    result: dict[str, Any] = with_floats(row, _rules())
    return str(name), result


def check_name(name: str, where: str) -> None:
    """InputError unless a sensor may be called so: in small letters, and not as one that comes with evetac."""
    if not re.fullmatch(_rules()["properties"]["name"]["pattern"], name):
        expected = "small letters, digits and -, as in lab-3"
        raise InputError("name: not the name of a sensor", where=where, expected=expected, found=name)
    if name in packaged("sensors"):
        raise InputError("name: that of a sensor which comes with evetac", where=where, expected="another", found=name)


def check_row(row: Mapping[str, Any], where: str) -> None:
    """InputError unless this is a whole row of a sensor whose values fit together."""
    _check(row, where, whole=True)
    for key in RISING:
        values = row.get(key, [])
        if any(after < before for before, after in zip(values, values[1:], strict=False)):
            raise InputError(f"{key}: expected rising values", where=where, found=str(values))
    x0, y0, x1, y1 = row["window_px"]
    if not (x0 < x1 and y0 < y1 <= row["frame_px"][1]):
        expected = "x0 < x1 and y0 < y1 within the frame"
        raise InputError("window_px: not a window", where=where, expected=expected, found=str(row["window_px"]))
    for group, one, other in TOGETHER:
        if (one in row.get(group, {})) != (other in row.get(group, {})):
            raise InputError(f"{group}: {one} and {other} need each other", where=where)
    unused = [key for key in ("gain_ma_tick", "friction_n") if key in row.get("gripper", {})]
    if unused and "servo_n_tick" in row["gripper"]:
        expected = "servo_n_tick and two_ticks_n, or gain_ma_tick and friction_n"
        both = f"servo_n_tick and {unused[0]}"
        raise InputError("gripper: the same is named twice", where=where, expected=expected, found=both)
    arms = [len(values) for values in row.get("creep", {}).values()]
    if len(set(arms)) > 1:
        expected = "a share and a time of each arm"
        lengths = f"{len(row['creep']['share'])} in share, {len(row['creep']['time_s'])} in time_s"
        raise InputError("creep: lists of different lengths", where=where, expected=expected, found=lengths)
    _check_dots(row, where)
    if "hot_pixel_table" in row:
        _check_hot_pixels(row["hot_pixel_table"], where)


def _check_hot_pixels(table: Mapping[str, Any], where: str) -> None:
    """The lists are of one length, no pixel comes twice, and no value contradicts another of its pixel."""
    lengths = {key: len(values) for key, values in table.items() if isinstance(values, list)}
    if len(set(lengths.values())) != 1:
        lengths_text = ", ".join(f"{length} in {key}" for key, length in lengths.items())
        raise InputError("hot_pixel_table: lists of different lengths", where=where, found=lengths_text)
    columns = (table[key] for key in ("x_px", "y_px", "rate_hz", "on_share", "polarity_change_share"))
    seen = set()
    for place, (x, y, rate_hz, on, change) in enumerate(zip(*columns, strict=True)):
        what = f"hot_pixel_table: pixel {place} at ({x}, {y})"
        if (x, y) in seen:
            raise InputError(f"{what} comes twice", where=where)
        seen.add((x, y))
        if change > 2 * min(on, 1 - on) + 1e-9:
            expected = (
                f"polarity_change_share of at most {2 * min(on, 1 - on):g}, twice the share of the rarer polarity"
            )
            raise InputError(
                f"{what} changes its polarity too often", where=where, expected=expected, found=f"{change}"
            )
        quick_us = table["short_interval_share"][place] * table["short_interval_us"][place]
        if (table["dead_time_us"] + quick_us) * rate_hz * 1e-6 >= 1.0:
            raise InputError(
                f"{what} has no time for so many events",
                where=where,
                expected="dead_time_us + short_interval_share * short_interval_us below the mean time between events",
                found=f"{table['dead_time_us'] + quick_us:g} us of {1e6 / rate_hz:g} us",
            )


@functools.cache
def _rules() -> dict[str, Any]:
    rules: dict[str, Any] = json.loads((schemas() / "sensor.v1.json").read_text())
    return rules


def _row_of(like: str, named_row: Callable[[str], dict[str, Any]], where: str) -> dict[str, Any]:
    try:
        return named_row(like)
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


def _check_dots(row: Mapping[str, Any], where: str) -> None:
    """InputError unless the dots are a grid or one row of them, as many as can be tracked, in the frame and apart."""
    from evetac_cli.sim.camera.gel_camera import dot_grid  # brings numba
    from evetac_cli.sim.camera.lens import Lens

    missing = ", ".join(key for key in GRID if key not in row)
    if "dot_xy_px" in row and len({len(dots) for dots in row["dot_xy_px"]}) != 1:
        expected = "rows of equally many dots; dots in no grid as a list without rows"
        raise InputError("dot_xy_px: rows of different lengths", where=where, expected=expected)
    if "dot_xy_px" not in row and missing:
        raise InputError("the places of the dots are missing", where=where, expected=f"{missing}, or dot_xy_px")
    lens = Lens.of_sensor(row)
    dots = dot_grid(row, cut=False).reshape(-1, 2)
    seen = dots if lens is None else lens.seen(dots)
    if not LEAST_DOTS <= len(dots) <= grid.MOST_DOTS:
        expected = f"{LEAST_DOTS} to {grid.MOST_DOTS}, which the tracker has room for"
        raise InputError(
            "a number of dots that cannot be tracked", where=where, expected=expected, found=str(len(dots))
        )
    width, height = row["frame_px"]
    outside = ((seen < 0) | (seen > (width - 1, height - 1))).any(axis=1)
    if outside.any():
        x, y = seen[outside][0]
        expected = f"centres inside {width} x {height} px"
        raise InputError("a dot lies outside the frame", where=where, expected=expected, found=f"({x:.4g}, {y:.4g})")
    apart_px = np.linalg.norm(dots[:, None] - dots[None], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    one, other = np.unravel_index(apart_px.argmin(), apart_px.shape)
    if apart_px[one, other] < 2.0 * row["dot_radius_px"]:
        places = " and ".join(f"({x:.4g}, {y:.4g})" for x, y in dots[[one, other]])
        expected = f"centres at least a diameter apart, {2.0 * row['dot_radius_px']:g} px"
        raise InputError("two dots overlap", where=where, expected=expected, found=places)
    beside = dot_grid(row, cut=True).size // 2
    if beside < LEAST_DOTS:
        expected = f"at least {LEAST_DOTS} left of window_px, for a cut gel"
        raise InputError("too few dots beside the window", where=where, expected=expected, found=str(beside))


def _check(table: Mapping[str, Any], where: str, *, whole: bool) -> None:
    """Refuse what the schema does not allow, in words; `whole` asks for every key that a sensor needs."""
    rules = _rules() if whole else {**_rules(), "required": []}
    check_table(table, where, rules, '`like = "evetac"` takes what is left out from that sensor')


def check_table(table: Mapping[str, Any], where: str, rules: Mapping[str, Any], if_missing: str = "") -> None:
    """InputError in words for what a schema does not allow; if_missing: what to try where a key is missing."""
    errors = list(jsonschema.Draft202012Validator(rules).iter_errors(table))
    misspelt = [error for error in errors if error.validator == "additionalProperties"]  # also why another is missing
    error = (misspelt or sorted(errors, key=lambda error: list(map(str, error.absolute_path))) or [None])[0]
    if error is None:
        return
    place = ".".join(str(step) for step in error.absolute_path)
    given = str(error.instance)
    if error.validator == "additionalProperties":
        known = list(error.schema["properties"])
        unknown = next(key for key in error.instance if key not in known)
        near = get_close_matches(unknown, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known keys: {', '.join(known)}"
        raise InputError(f"unknown key {f'{place}.' if place else ''}{unknown}", where=where, hint=hint)
    if error.validator == "required":
        missing = [key for key in error.validator_value if key not in error.instance]
        raise InputError(
            f"keys are missing{f' in {place}' if place else ''}",
            where=where,
            expected=", ".join(missing),
            found="none of them",
            hint=if_missing if not place else "",
        )
    if error.validator == "type":
        kind = TYPES[error.validator_value]
        raise InputError(f"{place}: expected {kind}", where=where, expected=_meaning(error.schema), found=given)
    if error.validator in ("minItems", "maxItems"):
        low, high = error.schema["minItems"], error.schema["maxItems"]
        count = f"{low}" if low == high else f"{low} to {high:,}"
        raise InputError(
            f"{place}: a list of another length",
            where=where,
            expected=f"{count} entries{_of_what(error.schema)}",
            found=f"{len(error.instance):,} entries",
        )
    if error.validator in ("minimum", "maximum", "exclusiveMinimum"):
        above = "exclusiveMinimum" in error.schema
        low = error.schema["exclusiveMinimum" if above else "minimum"]
        expected = f"{'more than ' if above else ''}{low:g} to {error.schema['maximum']:g}{_of_what(error.schema)}"
        raise InputError(f"{place}: out of range", where=where, expected=expected, found=given)
    if error.validator == "enum":
        names = error.validator_value
        near = get_close_matches(given, names, n=1)
        hint = f"did you mean {near[0]}?" if near else ""
        raise InputError(f"{place}: unknown value", where=where, expected=", ".join(names), found=given, hint=hint)
    expected = str(error.schema.get("const", error.schema.get("pattern", "")))
    raise InputError(
        f"{place}: not a possible value", where=where, expected=expected + _of_what(error.schema), found=given
    )


def _meaning(rules: Mapping[str, Any]) -> str:
    return str(rules.get("description", ""))


def _of_what(rules: Mapping[str, Any]) -> str:
    return f" ({rules['description']})" if "description" in rules else ""


def with_floats(value: Any, rules: Mapping[str, Any]) -> Any:
    """The same values, with a float wherever the schema says number: 15 and 15.0 are one recipe."""
    if isinstance(value, dict):
        return {key: with_floats(item, rules["properties"][key]) for key, item in value.items()}
    if isinstance(value, list):
        return [with_floats(item, rules.get("items", {})) for item in value]
    return float(value) if rules.get("type") == "number" else value
