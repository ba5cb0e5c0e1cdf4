"""Which column of text, numpy or HDF5 is t, x, y or p, and its times in microseconds: order, unit, check and clock.

If the columns have names, the names decide: those that data sets use (NAMES), possibly with a unit after the name of
the time (`t_us`). Four unnamed columns are in the order that the user gives (`--columns`), or in the first of ORDERS
that fits: polarities have valid values, pixels are whole numbers, and time does not go backwards.

The user (`--time-unit`) or the file (`t_us`) determines the unit. Without either, whole times are assumed to be
microseconds and others seconds. This guess is checked: the number type must be precise enough for it, and the rate of
events per second and pixel must be one that a camera can have. If another unit is equally plausible, the file is
refused. What is assumed is reported.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.formats.note import CLOCK_LIMIT_US
from evetac_cli.formats.read.clock import BITS_31, BITS_32, Clock

UNITS = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}  # length of the unit in us
SPOKEN = {1e6: "seconds", 1e3: "milliseconds", 1.0: "microseconds", 1e-3: "nanoseconds"}
FLAG = "--time-unit"
# Events per second and pixel, over a recording. The noise of a DVXplorer alone causes 0.3, a busy street 30 to 60.
MOST_HZ, USUAL_MOST_HZ = 200.0, 30.0  # mean over all pixels of the frame
LEAST_HZ, USUAL_LEAST_HZ = 1e-3, 0.03  # mean over those pixels that had an event
USUAL_S = 0.1  # shortest length of a usual recording
FEW_EVENTS = 100  # with fewer events the unit cannot be checked


class ColumnTimes:
    """Turns a column of times into us, batch by batch."""

    def __init__(self, where: str, unit: float | None, *, guess: float | None = None, documented: bool = False) -> None:
        """unit: its length in us, if it is known. guess: used otherwise; without it, the numbers decide.

        documented: the unit is known from the layout of the file, which may be wrong.
        """
        self._where, self._unit, self._guess, self._documented = where, unit, guess, documented
        self._guessed = unit is None
        self._clock: Clock | None = None
        self._thousands = True  # all times are multiples of a thousand
        self._first: Any = None

    @property
    def assumed(self) -> float | None:
        """The unit, as its length in us, if neither the user nor the file itself states it."""
        return self._unit if self._guessed or self._documented else None

    def us(self, t: NDArray[Any], place: Callable[[int], str]) -> NDArray[Any]:
        """Return the times of the next batch, int64, or float64 if some are not numbers.

        place(i): a text on where row i is in the file. Raises InputError if the unit is unclear, changes within the
        file, or is finer than the numbers can represent.
        """
        if self._unit is None:
            self._unit = self._guess or self._by_numbers(t)
        if t.dtype.kind == "f":
            return self._of_floats(t, place)
        if t.dtype.kind == "u" and t.dtype.itemsize == 8 and len(t) and t.max() >= 1 << 63:
            return t  # source.clean refuses them as too large
        ticks = t.astype(np.int64, copy=False)
        if self._clock is None:
            self._clock = _clock(t.dtype, self._unit)
        if len(ticks) and self._thousands:
            self._first = int(ticks[0]) if self._first is None else self._first
            self._thousands = not ((ticks[:1000] - self._first) % 1000).any()
        ticks = self._clock.continuous(ticks, place)
        if self._unit < 1:
            return ticks // round(1 / self._unit)
        most = CLOCK_LIMIT_US / self._unit
        if self._unit == 1 or (len(ticks) and -most < ticks.min() and ticks.max() < most):
            return ticks * round(self._unit) if self._unit != 1 else ticks
        return ticks.astype(np.float64) * self._unit

    def _of_floats(self, t: NDArray[Any], place: Callable[[int], str]) -> NDArray[Any]:
        assert self._unit is not None
        values = t.astype(np.float64)
        sound = np.isfinite(values)
        self._check_steps(t, sound)
        us = values * self._unit if self._unit >= 1 else np.floor(values / round(1 / self._unit))
        sound &= np.abs(us, where=sound, out=np.zeros(len(us))) < CLOCK_LIMIT_US
        if self._unit == 1 and self.assumed and (odd := us[sound] != np.rint(us[sound])).any():
            row = int(np.flatnonzero(sound)[np.argmax(odd)])
            found, hint = f"{values[row]:.9g} {place(row)}", f"give the unit with {FLAG}"
            raise InputError("the unit of time changes within the file", where=self._where, found=found, hint=hint)
        rows = np.flatnonzero(sound)
        if self._clock is None:
            self._clock = _clock(t.dtype, 1.0)
        ticks = self._clock.continuous(np.rint(us[rows]).astype(np.int64), lambda row: place(int(rows[row])))
        if len(rows) == len(us):
            return ticks
        us[rows] = ticks
        return us

    def _by_numbers(self, t: NDArray[Any]) -> float:
        if t.dtype.kind != "f":
            return 1.0
        finite = t[np.isfinite(t)]
        if (finite != np.rint(finite)).any():
            return 1e6
        step = float(np.spacing(np.abs(finite).max())) if len(finite) else 0.0
        if step >= 1:
            found = f"{t.dtype} times near {float(np.abs(finite).max()):.9g}, in steps of {step:.6g}"
            hint = f"save the times as float64 or as integers, or give the unit with {FLAG}"
            raise InputError("the unit of time is unclear", where=self._where, found=found, hint=hint)
        return 1.0

    def _check_steps(self, t: NDArray[Any], sound: NDArray[np.bool_]) -> None:
        """Raise InputError if the number type is too coarse to distinguish slices."""
        if t.dtype.itemsize >= 8 or not sound.any():
            return
        assert self._unit is not None
        most = np.abs(t[sound]).max()
        step_us = float(np.spacing(most)) * self._unit
        note = f"{t.dtype} times near {float(most) * self._unit / 1e6:.9g} s have steps of {_in_us(step_us)}"
        if step_us > SLICE_US:
            raise InputError("the times are too coarse", where=self._where, expected="1 ms or finer", found=note)

    def check(self, events: int, span_us: float, frame_px: tuple[int, int], lit_hz_us: float) -> None:
        """Raise InputError if the unit is a guess that is implausible, or if another unit is more plausible.

        span_us: length of the recording. lit_hz_us: events per us and pixel, of those pixels that had an event.
        """
        if self.assumed is None or events < FEW_EVENTS:
            return
        assert self._unit is not None
        readings = {
            unit: _Reading(events, span_us * us / self._unit, frame_px, lit_hz_us * self._unit / us)
            for unit, us in UNITS.items()
        }
        own = next(unit for unit, us in UNITS.items() if us == self._unit)
        coarse = self._thousands and self._first is not None  # all multiples of 1000: coarser than a camera's clock
        sound = readings[own].plausible
        if sound and (not self._guessed or (readings[own].usual and not coarse)):
            return
        others = [unit for unit, one in readings.items() if unit != own and (one.typical if sound else one.plausible)]
        if not others and (sound or not self._guessed):
            return
        message = f"the unit of time {'is not certain' if sound else 'is implausible'}"
        found = "; ".join(f"in {SPOKEN[UNITS[unit]]}: {readings[unit]}" for unit in (own, *others))
        raise InputError(
            message, where=self._where, found=found, hint=f"give the unit with {FLAG} {' or '.join(UNITS)}"
        )

    @property
    def notes(self) -> list[str]:
        """Notes on clock wraps."""
        return self._clock.notes if self._clock else []


class _Reading:
    """Length and event rate of a recording under the assumption of some unit of time."""

    def __init__(self, events: int, span_us: float, frame_px: tuple[int, int], lit_hz_us: float) -> None:
        self._span_s = span_us / 1e6
        self._hz = events / self._span_s / (frame_px[0] * frame_px[1]) if self._span_s else np.inf
        self._lit_hz = lit_hz_us * 1e6

    @property
    def plausible(self) -> bool:
        """Whether a camera can have this rate of events per second and pixel."""
        return self._hz <= MOST_HZ and self._lit_hz >= LEAST_HZ

    @property
    def usual(self) -> bool:
        """Whether length and event rate are those of a usual recording."""
        return self._span_s >= USUAL_S and self._hz <= USUAL_MOST_HZ and self._lit_hz >= USUAL_LEAST_HZ

    @property
    def typical(self) -> bool:
        """Whether it is usual, and the rate over all pixels is high enough for a camera with noise."""
        return self.usual and self._hz >= USUAL_LEAST_HZ

    def __str__(self) -> str:
        return f"{self._span_s:.3g} s with {self._hz:.2g} events per second and pixel"


def _clock(dtype: np.dtype[Any], us_per_tick: float) -> Clock:
    """Return the clock of a column: 32 bits if its type has 32, otherwise possibly 31 or 32 bits of us by values."""
    spans = {"u4": (BITS_32,), "i4": (BITS_32, BITS_31)}.get(dtype.str[1:], ())
    edges = tuple(round(bits / us_per_tick) for bits in (BITS_31, BITS_32)) if us_per_tick <= 1 else ()
    return Clock(spans, tuple(edge for edge in edges if edge not in spans), us_per_tick)


def _in_us(us: float) -> str:
    return f"{us:.3g} us" if us < 1e6 else f"{us / 1e6:.3g} s"


# Order ----------------------------------------------------------------------------------------------------------------

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
