"""The complete rows of sensors.toml: keys that a row leaves out come from the sensor that its `like` names.

Each value is written once: a row lists only its own values and takes all others from one other row, which may do the
same. A complete row names no other sensor, so a recipe contains all its values.
"""

import functools
from collections.abc import Mapping
from typing import Any

from evetac_cli.resources import table

GRID = ("dot_columns_px", "dot_rows_px", "dot_jitter_px", "turned_deg")  # keys that dot_xy_px replaces
KEY_BY_KEY = ("gripper", "friction")  # tables that a row may give in part
FOR_EACH_TRIAL = ("randomized", "randomized-narrow")  # rows of ranges, from which each trial's sensor is sampled


@functools.cache
def rows() -> dict[str, dict[str, Any]]:
    """Return the complete row of each named sensor, by name and without `like`; the file is read once."""
    row_by_name = table("sensors")
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
