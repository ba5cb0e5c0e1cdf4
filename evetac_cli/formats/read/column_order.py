"""Decide which column of a table is t, x, y or p, if text, numpy or HDF5 do not define it.

If the columns have names, the names decide: those that data sets use (NAMES), possibly with a unit after the name of
the time (`t_us`). Four unnamed columns are in the order that the user gives (`--columns`), or in the first of ORDERS
that fits: polarities have valid values, pixels are whole numbers, and time does not go backwards. The assumption is
reported.
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
ORDERS = ("t x y p", "x y t p", "x y p t")  # rpg and v2e; MVSEC and most arrays; Prophesee's CSV
POLARITY = "polarity 1 brighter, 0 or -1 darker"


class Order(NamedTuple):
    """Indices of the columns t, x, y, p, and the unit of t in us; None if the unit is not stated."""

    places: tuple[int, int, int, int]
    us_per_unit: float | None


def by_name(names: Sequence[str]) -> Order | None:
    """Return the order that the names define; None unless each of t, x, y, p is named exactly once."""
    places: dict[str, int] = {}
    us_per_unit: float | None = None
    for place, name in enumerate(names):
        column, unit = _column(name)
        if column is None:
            continue
        if column in places:
            return None
        places[column] = place
        us_per_unit = unit or us_per_unit
    if len(places) < len(NAMES):
        return None
    return Order((places["t"], places["x"], places["y"], places["p"]), us_per_unit)


def _column(column_name: str) -> tuple[str | None, float | None]:
    """Return which of t, x, y, p a name means, and the unit of time at its end, in us; each None if absent."""
    # faery writes x@640: the frame width after the name
    name = column_name.strip().strip("\"'").lower().partition("@")[0]
    base, _, unit = name.rpartition("_")
    if base in NAMES["t"] and unit in UNITS:
        return "t", UNITS[unit]
    return next((column for column, synonyms in NAMES.items() if name in synonyms), None), None


def lacking_columns(names: Sequence[str]) -> list[str]:
    """Return those of t, x, y, p that no name means."""
    columns = {_column(name)[0] for name in names}
    return [column for column in NAMES if column not in columns]


def declared_order(text: str, where: str) -> str:
    """Parse the user's order, for example "t y x p"; raise InputError unless it has each of t, x, y, p once."""
    names = text.replace(",", " ").split()
    if sorted(names) != sorted(NAMES):
        message, expected = "--columns must name t, x, y and p once each", 'for example "x y t p"'
        raise InputError(message, where=where, expected=expected, found=text[:80])
    return " ".join(names)


def refuse_columns(columns: str | None, where: str) -> None:
    """Raise InputError if a user names columns that already have names."""
    if columns is not None:
        message = "--columns is only for files whose columns have no names"
        raise InputError(message, where=where, found=columns[:80], hint="leave out --columns")


def declared_unit(time_unit: str | None, own: float | None, where: str) -> float | None:
    """Return the unit of time, in us, that the user or the file states; None if neither does.

    Raises InputError if they differ.
    """
    if time_unit is None:
        return own
    if time_unit not in UNITS:
        raise InputError(f"{FLAG}: unknown unit", where=where, expected=" or ".join(UNITS), found=time_unit[:20])
    if own is not None and own != UNITS[time_unit]:
        message = f"the file's unit of time differs from {FLAG}"
        raise InputError(message, where=where, expected=SPOKEN[own], found=time_unit, hint=f"leave out {FLAG}")
    return UNITS[time_unit]


def places_of(order: str) -> tuple[int, int, int, int]:
    """Return the indices of t, x, y, p in an order given by their names."""
    names = order.split()
    return names.index("t"), names.index("x"), names.index("y"), names.index("p")


def guess_order(rows: NDArray[Any]) -> str:
    """Return the first of ORDERS that some rows of four columns fit; `t x y p` if none fits."""
    values = rows.astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    return next((order for order in ORDERS if len(values) and _fits(values, places_of(order))), ORDERS[0])


def _fits(values: NDArray[np.float64], places: tuple[int, ...]) -> bool:
    t, x, y, p = (values[:, place] for place in places)
    if not np.isin(p, (-1, 0, 1)).all() or (x != np.rint(x)).any() or (y != np.rint(y)).any() or (t[1:] < t[:-1]).any():
        return False
    # With few events, any column may increase by chance: whole times must be larger than all pixel coordinates.
    return places[0] == 0 or bool((t != np.rint(t)).any()) or float(t[-1]) > float(max(x.max(), y.max()))


def assumption(order: str, us_per_unit: float | None) -> str:
    """Return a text on the order and unit that were assumed; empty if the file states both."""
    if not order and us_per_unit is None:
        return ""
    parts = [f"columns {order}"] if order else []
    if us_per_unit is not None:
        parts.append(f"time in {SPOKEN[us_per_unit]}")
    return ", ".join([*parts, POLARITY])
