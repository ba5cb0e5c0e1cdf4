"""Objects: a row of the paper's table (objects.toml), or your own TOML file with the same keys: `--object can.toml`.

`TouchSensor(object={...})` takes the same keys. Two files with the same content give the same object: the names of
files do not enter a recipe.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from evetac_cli.errors import InputError
from evetac_cli.resources import table as packaged
from evetac_cli.sim.setup.tables import Range, Share, Table, UpTo1000, read_table
from evetac_cli.text_files import read_toml

Shape = Literal["flat", "cylinder", "sphere"]

SUFFIX = ".toml"
UNNAMED = "own-object"  # name in recordings of an object whose file has no `name`
HELD = ("mass_g", "width_mm", "height_mm")  # additional keys that an object needs if a gripper holds it
MOST_FRICTION = 5.0  # largest static friction of an object from a file
SLIPPERIEST = 0.05  # least static friction of a gripped object: below, no real gripper has the necessary force
WIDEST_MM = 104.8  # width of the widest object that fits between the fingers
LIGHTEST_G_CM3 = 0.005  # of the box around an object: half as dense as the lightest foam; a mass in kg is below it
WIDEST_SURFACE_MM = 1e4  # size of a flat object whose size has no effect


@dataclass(frozen=True, kw_only=True)
class TouchedObject(Table):
    """An object that touches the gel."""

    #: material of the object; shown only, no effect on the simulation
    material: Annotated[str, Meta(max_length=40)] | None = None
    #: shape of the surface that the gel touches; the axis of a cylinder is vertical between the fingers
    shape: Shape
    #: static friction on the gel; a scene may vary it by a random factor
    static_friction: UpTo1000
    #: kinetic divided by static friction; if left out, the scene draws a value for each trial. A sensor whose gel has
    #: its own value keeps it
    kinetic_share: Share | None = None
    #: mass of the object; required if a gripper holds it
    mass_g: Annotated[float, Meta(ge=0.1, le=100_000)] = 1.0
    #: width between the fingers; the diameter of a cylinder or a sphere
    width_mm: Annotated[float, Meta(ge=1, le=10_000)] = WIDEST_SURFACE_MM
    #: width between the fingers, if they hold another side than width_mm
    grasped_width_mm: Annotated[float, Meta(ge=1, le=WIDEST_MM)] | None = None
    #: height, used for the moment of inertia; required if a gripper holds the object
    height_mm: Annotated[float, Meta(ge=1, le=10_000)] = WIDEST_SURFACE_MM
    #: horizontal size of the side that is not gripped; shown only, no effect on the simulation
    depth_mm: Annotated[float, Meta(ge=1, le=10_000)] | None = None
    #: horizontal distance from the fingers to the centre of mass, over which the weight turns the object
    lever_mm: Annotated[float, Meta(ge=-100, le=100)] = 0.0
    #: tilt of the surface against the gel about the horizontal axis, or its range; if left out, the scene draws it
    tilt_deg: Range[Annotated[float, Meta(ge=-10, le=10)]] | None = None

    @property
    def held_mm(self) -> float:
        """Return the width at which the fingers hold the object, in mm."""
        return self.width_mm if self.grasped_width_mm is None else self.grasped_width_mm


@dataclass(frozen=True, kw_only=True)
class ObjectFile(TouchedObject):
    """A file of --object: an object and the key that only a file has."""

    #: name of the object in recordings
    name: Annotated[str, Meta(max_length=40, pattern="^[a-z][a-z0-9-]{0,39}$")] | None = None
    #: static friction on the gel; a scene may vary it by a random factor
    static_friction: Annotated[float, Meta(ge=0, le=MOST_FRICTION)]

    @property
    def object(self) -> TouchedObject:
        """Return the object without the keys of the file."""
        return TouchedObject(**{item.name: getattr(self, item.name) for item in fields(TouchedObject)})


def of_number(number: int) -> TouchedObject:
    """Return an object of the paper's table by its number; InputError if there is none."""
    row = packaged("objects").get(str(number))
    if row is None:
        raise InputError("no such object", where="--object", expected="1 to 20", found=str(number))
    return read_table(TouchedObject, row, "objects.toml")


def read(path: Path) -> tuple[str, TouchedObject]:
    """Read an object for a gripper from a file; return its name and the object. InputError if the file is invalid."""
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
        expected = f"{SLIPPERIEST:g} to {MOST_FRICTION:g}, for fingers to hold it"
        found = f"{read_object.static_friction:g}"
        raise InputError("static_friction: out of range", where=where, expected=expected, found=found)
    depth_mm = read_object.depth_mm or read_object.held_mm
    lightest_g = LIGHTEST_G_CM3 * 1e-3 * read_object.held_mm * read_object.height_mm * depth_mm
    if read_object.mass_g < lightest_g:
        raise InputError(
            "mass_g: lighter than foam of this size",
            where=where,
            expected=f"at least {lightest_g:.3g} g",
            found=f"{read_object.mass_g:g} g",
            hint=f"in g: {read_object.mass_g:g} kg are mass_g = {1e3 * read_object.mass_g:g}",
        )
    return str(table.get("name", UNNAMED)), read_object


def of_keys(table: Mapping[str, Any], where: str, needed: tuple[str, ...] = ()) -> TouchedObject:
    """Check the keys of an object and return the object; `needed` are required in addition to the usual keys."""
    return read_table(ObjectFile, table, where, needed=needed).object


def seed_of(object_name: int | str | None) -> int:
    """Return the seed of an object's random numbers: its number in the table, or a checksum of its name."""
    return zlib.crc32(object_name.encode()) if isinstance(object_name, str) else object_name or 0
