"""Which column of a table is t, x, y or p, and in what unit its times are, where text, numpy and HDF5 leave it unsaid.

Names decide where there are any: those that data sets use (NAMES), with a unit behind the name of the time (`t_us`).
Four columns without names are in the first order of ORDERS that fits: polarities are a code, pixels are whole, and time
does not go backwards. Times that are whole are microseconds, others are seconds. What was assumed is said.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}
UNITS = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}  # us in one of them
SPOKEN = {1e6: "seconds", 1e3: "milliseconds", 1.0: "microseconds", 1e-3: "nanoseconds"}
# Places of t, x, y, p: rpg and v2e, MVSEC and most arrays, Prophesee's CSV.
ORDERS = {"t x y p": (0, 1, 2, 3), "x y t p": (2, 0, 1, 3), "x y p t": (3, 0, 1, 2)}
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
        name = given.strip().strip("\"'").lower().partition("@")[0]  # faery: x@640, the frame behind the name
        base, _, unit = name.rpartition("_")
        timed = base in NAMES["t"] and unit in UNITS
        column = "t" if timed else next((key for key, known in NAMES.items() if name in known), None)
        if column is None:
            continue
        if column in places:
            return None
        places[column] = place
        if timed:
            us_per_unit = UNITS[unit]
    if len(places) < len(NAMES):
        return None
    return Order((places["t"], places["x"], places["y"], places["p"]), us_per_unit)


def guess_order(rows: NDArray[Any]) -> str:
    """The name, in ORDERS, of the first order that some rows of four columns fit; `t x y p` where none fits."""
    values = rows.astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    return next((name for name, places in ORDERS.items() if len(values) and _fits(values, places)), "t x y p")


def _fits(values: NDArray[np.float64], places: tuple[int, ...]) -> bool:
    t, x, y, p = (values[:, place] for place in places)
    if not np.isin(p, (-1, 0, 1)).all() or (x != np.rint(x)).any() or (y != np.rint(y)).any() or (t[1:] < t[:-1]).any():
        return False
    # Of a few events, any column may rise by chance: whole times have to be larger than any pixel's place.
    return places[0] == 0 or bool((t != np.rint(t)).any()) or float(t[-1]) > float(max(x.max(), y.max()))


def unit_of(t: NDArray[Any]) -> float:
    """How many us the unit of some times has: 1 where all are whole, a million (seconds) elsewhere."""
    if t.dtype.kind != "f":
        return 1.0
    finite = t[np.isfinite(t)]
    return 1.0 if (finite == np.rint(finite)).all() else 1e6


def to_us(t: NDArray[Any], us_per_unit: float) -> NDArray[Any]:
    """Times in us: as they are, if that is their unit."""
    if us_per_unit == 1:
        return t
    if us_per_unit < 1 and t.dtype.kind in "iu":  # a clock in ns has more digits than a float
        whole: NDArray[Any] = t // 1000
        return whole
    return t.astype(np.float64) * us_per_unit


def assumption(order: str, us_per_unit: float | None) -> str:
    """What was assumed of a file, in words; no order or no unit where the file says it, nothing where it says both."""
    if not order and us_per_unit is None:
        return ""
    parts = [f"columns {order}"] if order else []
    if us_per_unit is not None:
        parts.append(f"time in {SPOKEN[us_per_unit]}")
    return ", ".join([*parts, POLARITY])
