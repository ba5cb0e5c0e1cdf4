"""Objects: a row of the paper's table (objects.toml), or one's own, a TOML file of the same keys: `--object can.toml`.

`TouchSensor(object={...})` takes the same keys. What comes out is the same for two files of the same content: names of
files do not enter a recipe.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from evetac_cli.errors import InputError
from evetac_cli.resources import table as packaged
from evetac_cli.sim.setup.tables import between, build, check, number, one_of, words
from evetac_cli.text_files import read_toml

Shape = Literal["flat", "cylinder", "sphere"]

SUFFIX = ".toml"
UNNAMED = "own-object"  # what recordings call an object whose file has no `name`
HELD = ("mass_g", "width_mm", "height_mm")  # what a scene in which it is held needs, beside what is always needed
SLIPPERIEST = 0.05  # static friction of what fingers hold: below, their force would be that of no gripper
WIDEST_MM = 104.8  # that fits between the fingers
WIDEST_SURFACE_MM = 1e4  # of a flat object whose width nothing depends on


@dataclass(frozen=True, kw_only=True)
class TouchedObject:
    """An object that the gel touches."""

    material: str | None = words("in words; shown, and without effect", 40, default=None)
    shape: Shape = one_of(
        "of the surface that the gel touches; a cylinder stands upright between the fingers",
        get_args(Shape),
    )
    static_friction: float = number("on the gel; what a scene varies at random is a factor on it", 0, 1000)
    kinetic_share: float | None = number(
        "kinetic over static friction; without it a scene draws one for each trial, and a sensor whose gel has one"
        " keeps that",
        0,
        1,
        default=None,
    )
    mass_g: float = number("of the object; needed where it is held", 0.1, 100_000, default=1.0)
    width_mm: float = number(
        "between the fingers, the diameter of a cylinder or a sphere", 1, 10_000, default=WIDEST_SURFACE_MM
    )
    grasped_width_mm: float | None = number(
        "between the fingers, where that is another side than width_mm", 1, WIDEST_MM, default=None
    )
    height_mm: float = number(
        "upright, for its moment of inertia; needed where it is held", 1, 10_000, default=WIDEST_SURFACE_MM
    )
    depth_mm: float | None = number("the other side across; shown, and without effect", 1, 10_000, default=None)
    lever_mm: float = number("centre of mass beside the fingers, where its weight turns it", -100, 100, default=0.0)
    tilt_deg: tuple[float, float] | None = between(
        "of the surface against the gel, about the horizontal axis, or its range; without it a scene draws one",
        -10,
        10,
        or_one=True,
        default=None,
    )

    @property
    def held_mm(self) -> float:
        """How far apart the fingers hold it."""
        return self.width_mm if self.grasped_width_mm is None else self.grasped_width_mm


@dataclass(frozen=True, kw_only=True)
class ObjectFile(TouchedObject):
    """A file of --object: an object, and what only its file says."""

    name: str | None = words("what recordings call this object", 40, pattern="^[a-z][a-z0-9-]{0,39}$", default=None)
    static_friction: float = number("on the gel; what a scene varies at random is a factor on it", 0, 5)


def of_number(number: int) -> TouchedObject:
    """An object of the paper's table; InputError if there is no such object."""
    row = packaged("objects").get(str(number))
    if row is None:
        raise InputError("no such object", where="--object", expected="1 to 20", found=str(number))
    return build(TouchedObject, row)


def read(path: Path) -> tuple[str, TouchedObject]:
    """The name of an object that is held, and the object, from a file; InputError for anything that is none."""
    where = str(path)
    table = read_toml(path)
    read_object = of_keys(table, where, HELD)
    if read_object.held_mm > WIDEST_MM:
        raise InputError(
            "the object does not fit between the fingers",
            where=where,
            expected=f"width_mm, or grasped_width_mm, of at most {WIDEST_MM:g} mm",
            found=f"{read_object.held_mm:g} mm",
        )
    if read_object.static_friction < SLIPPERIEST:
        expected, friction = f"{SLIPPERIEST:g} to 5, for fingers to hold it", f"{read_object.static_friction:g}"
        raise InputError("static_friction: out of range", where=where, expected=expected, found=friction)
    return str(table.get("name", UNNAMED)), read_object


def of_keys(table: Mapping[str, Any], where: str, needed: tuple[str, ...] = ()) -> TouchedObject:
    """An object from its keys, checked; `needed` are required beside what always is."""
    check(ObjectFile, table, where, needed=needed)
    return build(TouchedObject, {key: value for key, value in table.items() if key != "name"})


def seed_of(called: int | str | None) -> int:
    """A number that stands for an object where random numbers are drawn for it: that of the table, or of its name."""
    return zlib.crc32(called.encode()) if isinstance(called, str) else called or 0
