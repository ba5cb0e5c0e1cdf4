"""The rows of sensors.toml, each whole: what a row leaves out is as in the sensor that it is `like`.

Why so: one place for a fact. A row says what is its own; what else a sensor is follows from one other row, and from
that one's. What comes out names no other sensor, so a recipe holds all of it.
"""

import functools
from collections.abc import Mapping
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.resources import table

GRID = ("dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg")  # what dot_xy_px takes the place of
KEY_BY_KEY = ("gripper", "friction")  # tables of which a row may give a part
FOR_EACH_TRIAL = ("randomized", "randomized-narrow")  # rows that name ranges, not one sensor


@functools.cache
def rows() -> dict[str, dict[str, Any]]:
    """The row of each named sensor, by its name, whole and without `like`; read once."""
    named = table("sensors")
    return {name: whole(name, named) for name in named}


def whole(name: str, named: Mapping[str, Mapping[str, Any]], above: tuple[str, ...] = ()) -> dict[str, Any]:
    """A row of a table of sensors with all that it takes from others; InputError for one that is like none, or itself.

    above: rows that are like this one.
    """
    row = dict(named[name])
    like = row.pop("like", None)
    if like is None:
        return row
    if like not in named or like in (*above, name):
        expected = "a row that is not like this one"
        raise InputError(f"{name}: like no other sensor", where="sensors.toml", expected=expected, found=str(like))
    return over(whole(like, named, (*above, name)), row)


def over(base: Mapping[str, Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """A row in which what is named stands above that of another sensor.

    Tables of KEY_BY_KEY go key by key, all others as a whole. Places of dots take the place of a grid, and a grid that
    of places.
    """
    replaced = GRID if "dot_xy_px" in named else ("dot_xy_px",) if named.keys() & set(GRID) else ()
    row = {key: value for key, value in base.items() if key not in replaced} | dict(named)
    for group in KEY_BY_KEY:
        if group in base and group in named:
            row[group] = {**base[group], **named[group]}
    return row
