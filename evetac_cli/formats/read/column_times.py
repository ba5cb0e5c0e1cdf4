"""Convert the times of text, numpy and HDF5 files to microseconds: find their unit, check it, and unwrap their clock.

The user (`--time-unit`) or the file (`t_us`) determines the unit. Without either, whole times are assumed to be
microseconds and others seconds. This guess is checked: the number type must be precise enough for it, and the rate of
events per second and pixel must be one that a camera can have. If another unit is equally plausible, the file is
refused.
"""

from collections.abc import Callable
from typing import Any

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
