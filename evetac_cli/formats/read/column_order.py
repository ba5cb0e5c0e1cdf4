"""Which column of a table is t, x, y or p, where text, numpy and HDF5 leave it unsaid.

Names decide where there are any: those that data sets use (NAMES), with a unit behind the name of the time (`t_us`).
Four columns without names are in the order that the user says (`--columns`), or in the first of ORDERS that fits:
polarities are a code, pixels are whole, and time does not go backwards. What was assumed is said.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.read.column_times import FLAG, SPOKEN, UNITS

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}
ORDERS = ("t x y p", "x y t p", "x y p t")  # of rpg and v2e, of MVSEC and most arrays, of Prophesee's CSV
POLARITY = "polarity 1 brighter, 0 or -1 darker"


class Order(NamedTuple):
    """Places of the columns t, x, y, p, and how many us the unit of t has; None: what the times look like decides."""

    places: tuple[int, int, int, int]
    us_per_unit: float | None


def by_name(names: Sequence[str]) -> Order | None:
    """The order that names tell; None unless each of t, x, y, p is named just once."""
    places: dict[str, int] = {}
    us_per_unit: float | None = None
    for place, given in enumerate(names):
        column, unit = _column(given)
        if column is None:
            continue
        if column in places:
            return None
        places[column] = place
        us_per_unit = unit or us_per_unit
    if len(places) < len(NAMES):
        return None
    return Order((places["t"], places["x"], places["y"], places["p"]), us_per_unit)


def _column(given: str) -> tuple[str | None, float | None]:
    """Which of t, x, y, p a name stands for, and how many us the unit has that it ends with; None where it does not."""
    name = given.strip().strip("\"'").lower().partition("@")[0]  # faery: x@640, the frame behind the name
    base, _, unit = name.rpartition("_")
    if base in NAMES["t"] and unit in UNITS:
        return "t", UNITS[unit]
    return next((column for column, known in NAMES.items() if name in known), None), None


def lacking_columns(names: Sequence[str]) -> list[str]:
    """Which of t, x, y, p none of the names stands for."""
    known = {_column(name)[0] for name in names}
    return [column for column in NAMES if column not in known]


def said_order(text: str, where: str) -> str:
    """The order that a user says, as in "t y x p"; InputError unless it names each of t, x, y, p once."""
    names = text.replace(",", " ").split()
    if sorted(names) != sorted(NAMES):
        raise InputError(
            "--columns does not name four columns", where=where, expected='as in "x y t p"', found=text[:80]
        )
    return " ".join(names)


def refuse_columns(columns: str | None, where: str) -> None:
    """InputError where a user names columns that have names."""
    if columns is not None:
        raise InputError(
            "--columns is for files whose columns have no names", where=where, found=columns[:80], hint="leave it out"
        )


def unit_said(time_unit: str | None, own: float | None, where: str) -> float | None:
    """How many us the unit of time has that the user says or the file; None where neither does.

    InputError where they differ.
    """
    if time_unit is None:
        return own
    if time_unit not in UNITS:
        raise InputError(f"{FLAG}: no such unit", where=where, expected=" or ".join(UNITS), found=time_unit[:20])
    if own is not None and own != UNITS[time_unit]:
        raise InputError(
            "the file states another unit of time", where=where, expected=SPOKEN[own], found=f"{FLAG} {time_unit}"
        )
    return UNITS[time_unit]


def places_of(order: str) -> tuple[int, int, int, int]:
    """Places of t, x, y, p in an order of their names."""
    names = order.split()
    return names.index("t"), names.index("x"), names.index("y"), names.index("p")


def guess_order(rows: NDArray[Any]) -> str:
    """The name, in ORDERS, of the first order that some rows of four columns fit; `t x y p` where none fits."""
    values = rows.astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    return next((order for order in ORDERS if len(values) and _fits(values, places_of(order))), ORDERS[0])


def _fits(values: NDArray[np.float64], places: tuple[int, ...]) -> bool:
    t, x, y, p = (values[:, place] for place in places)
    if not np.isin(p, (-1, 0, 1)).all() or (x != np.rint(x)).any() or (y != np.rint(y)).any() or (t[1:] < t[:-1]).any():
        return False
    # Of a few events, any column may rise by chance: whole times have to be larger than any pixel's place.
    return places[0] == 0 or bool((t != np.rint(t)).any()) or float(t[-1]) > float(max(x.max(), y.max()))


def assumption(order: str, us_per_unit: float | None) -> str:
    """What was assumed of a file, in words; no order or no unit where the file says it, nothing where it says both."""
    if not order and us_per_unit is None:
        return ""
    parts = [f"columns {order}"] if order else []
    if us_per_unit is not None:
        parts.append(f"time in {SPOKEN[us_per_unit]}")
    return ", ".join([*parts, POLARITY])
