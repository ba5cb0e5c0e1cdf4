"""Reads one's own object, a TOML file with the keys of schemas/object.v1.json: `--object can.toml`.

`TouchSensor(object={...})` takes the same keys. What comes out is a row like those of objects.toml, the same for two
files of the same content: names of files do not enter a recipe.
"""

import functools
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.resources import schemas
from evetac_cli.sim import sensor_file
from evetac_cli.text_files import read_toml

SUFFIX = ".toml"
UNNAMED = "own-object"  # what recordings call an object whose file has no `name`
HELD = ("mass_g", "width_mm", "height_mm")  # what a scene in which it is held needs, beside what is always needed
SLIPPERIEST = 0.05  # static friction of what fingers hold: below, their force would be that of no gripper
WIDEST_MM = 104.8  # that fits between the fingers
WIDEST_SURFACE_MM = 1e4  # of a flat object whose width nothing depends on


def read(path: Path) -> tuple[str, dict[str, Any]]:
    """The name and the row of an object that is held; InputError for anything that is none."""
    where = str(path)
    table = read_toml(path)
    row = row_of(table, where, HELD)
    held_mm = row.get("grasped_width_mm", row["width_mm"])
    if held_mm > WIDEST_MM:
        raise InputError(
            "the object does not fit between the fingers",
            where=where,
            expected=f"width_mm, or grasped_width_mm, of at most {WIDEST_MM:g} mm",
            found=f"{held_mm:g} mm",
        )
    if row["static_friction"] < SLIPPERIEST:
        expected = f"{SLIPPERIEST:g} to 5, for fingers to hold it"
        raise InputError(
            "static_friction: out of range", where=where, expected=expected, found=f"{row['static_friction']:g}"
        )
    return str(table.get("name", UNNAMED)), row


def row_of(table: Mapping[str, Any], where: str, needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """The row of an object from its keys, checked against the schema; `needed` are required beside what always is."""
    rules = {**_rules(), "required": [*_rules()["required"], *needed]}
    sensor_file.check_table(table, where, rules)
    row: dict[str, Any] = sensor_file.with_floats(dict(table), rules)
    row.pop("name", None)
    if "tilt_deg" in row:
        row["tilt_deg"] = [row["tilt_deg"]] * 2  # as in objects.toml: a range
    return row


def seed_of(called: int | str | None) -> int:
    """A number that stands for an object where random numbers are drawn for it: that of the table, or of its name."""
    return zlib.crc32(called.encode()) if isinstance(called, str) else called or 0


@functools.cache
def _rules() -> dict[str, Any]:
    rules: dict[str, Any] = json.loads((schemas() / "object.v1.json").read_text())
    return rules
