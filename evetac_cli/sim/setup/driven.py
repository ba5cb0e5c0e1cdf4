"""Settings of objects that move on the gel without a gripper: a flat face, an object with edges, a speaker."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from evetac_cli.sim.setup.tables import (
    Rules,
    between,
    duration,
    lists,
    number,
    numbers,
    one_of,
    whole,
    wholes,
)

MOTIONS = {
    "waypoints": "pressed on once, then moved between random positions",
    "strokes": "drawn over the whole gel in parallel lines",
}


@dataclass(frozen=True, kw_only=True)
class Rub:
    """An object with visible edges: it touches, shears the gel, rubs in random directions and lifts off."""

    objects: tuple[str, ...] = lists(
        "objects to choose from; each trial draws one at random",
        {"enum": ["finger", "handle"]},
        (1, 2),
        unique=True,
    )
    static_friction: float = number("static friction of the object on the gel", 0, 1000)
    normal_n: tuple[float, float] = between(
        "range of the normal force while touching and shearing", None, 1000, above=0
    )
    rub_n: tuple[float, float] = between("range of the normal force while rubbing", None, 1000, above=0)
    touch_s: float = number("duration of the touch, in which the normal force builds up", None, 10_000, above=0)
    shear_px: float = number("distance that the object shears the gel to each side", 0, 1000)
    shear_s: float = number("duration of the shear", None, 10_000, above=0)
    count: tuple[int, int] = wholes("smallest and largest number of rubs", 0, 1000, 2, order="pair")
    length_mm: tuple[float, float] = between("range of the length of a rub", None, 1000, above=0)
    speed_mm_s: tuple[float, float] = between("range of the peak speed of a rub", None, 1000, above=0)
    pause_s: float = duration("pause before each rub and after the last")
    lift_s: float = number("duration of the lift-off", None, 10_000, above=0)
    edge_log_contrast: tuple[float, float] = between(
        "range of the step in log brightness across the object's edge", None, 1000, above=0
    )
    edge_blur_px: tuple[float, float] = between(
        "range of the standard deviation of the edge's Gaussian blur; the edge is drawn once, in an image several times"
        " this wide (50 px take 1.5 s for a view of 640 x 480)",
        None,
        50,
        above=0,
    )


def _by_frequency(meaning: str) -> Any:
    return numbers(meaning, 0, 100, (1, 1000))


@dataclass(frozen=True, kw_only=True)
class Speaker:
    """A speaker pressed on the gel: its tones, one per recording, and a table of its motion by frequency.

    The table is linear between its frequencies and constant beyond them.
    """

    frequency_hz: tuple[float, ...] = numbers("frequencies of the tones", 1, 2500, (1, 1000), unique=True)
    normal_n: float = number("normal force of the speaker", None, 10_000, above=0)
    press_s: float = number("time that the speaker takes to press on the gel", None, 10_000, above=0)
    radius_mm: float = number("radius of the contact patch", None, 10_000, above=0)
    offset_mm: float = number("largest offset of the contact patch from the centre of the view, along each axis", 0, 20)
    tangential_share: tuple[float, float] = between(
        "range of the tangential motion relative to the normal motion", 0, 10
    )
    amplitude_factor: tuple[float, float] = between("range of the factor on the amplitude", None, 1000, above=0)
    drift_s: tuple[float, float] = between(
        "range of the time between two values of the second harmonic or of the modulation; both drift", 0.01, 3600
    )
    at_hz: tuple[float, ...] = numbers(
        "frequencies of the table's rows", None, 2500, (1, 1000), above=0, order="strictly rising"
    )
    dot_motion_px: tuple[float, ...] = _by_frequency("amplitude of the dots' motion, as the root mean square over dots")
    second_harmonic_least: tuple[float, ...] = _by_frequency("lower end of the range of the second harmonic's share")
    second_harmonic_most: tuple[float, ...] = _by_frequency("upper end of the range of the second harmonic's share")
    modulation_most: tuple[float, ...] = _by_frequency("upper end of the range of the subharmonic modulation")

    COLUMNS: ClassVar = ("at_hz", "dot_motion_px", "second_harmonic_least", "second_harmonic_most", "modulation_most")

    def at(self, column: tuple[float, ...], frequency_hz: float) -> float:
        """Return the value of a column of the table at a frequency."""
        return float(np.interp(frequency_hz, self.at_hz, column))


@dataclass(frozen=True, kw_only=True)
class Face:
    """The face that presses on the gel: a rectangle (size_mm) or a disc (radius_mm)."""

    size_mm: tuple[float, float] | None = numbers(
        "sides of the rectangle, along x and y", None, 10_000, 2, above=0, default=None
    )
    radius_mm: float | None = number("radius of the disc", None, 10_000, above=0, default=None)
    static_friction: float = number("static friction of the face on the gel", 0, 1000)

    RULES: ClassVar[Rules] = {"oneOf": [{"required": ["size_mm"]}, {"required": ["radius_mm"]}]}


@dataclass(frozen=True, kw_only=True)
class FaceMotion:
    """The motion of the face."""

    kind: str = one_of("; ".join(f"{name}: {what}" for name, what in MOTIONS.items()), tuple(MOTIONS))
    normal_n: float = number("normal force of the face", None, 10_000, above=0)
    press_s: float = number("time that the face takes to press on the gel or to lift off", None, 10_000, above=0)
    shear_n: float = number(
        "shear force on the gel at the farthest waypoint",
        None, 10_000, above=0, default=0.0, needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    offset_mm: float = number(
        "largest offset of the face from the centre of the view, along each axis",
        0, 20, default=0.0, needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    count: int = whole(
        "number of waypoints", 1, 100_000, default=0, needed_in=("waypoints",), only_in=("waypoints",)
    )  # fmt: skip
    move_s: tuple[float, float] = between(
        "range of the time from one waypoint to the next",
        None, 1000, above=0, default=(0.0, 0.0), needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    pause_s: float = duration(
        "pause at each waypoint", default=0.0, needed_in=("waypoints",), only_in=("waypoints",)
    )  # fmt: skip
    lines: int = whole(
        "number of strokes in each direction", 2, 100, default=0, needed_in=("strokes",), only_in=("strokes",)
    )  # fmt: skip
    speed_mm_s: float = number(
        "speed of a stroke", None, 10_000, above=0, default=0.0, needed_in=("strokes",), only_in=("strokes",)
    )  # fmt: skip
    approach_s: float = number(
        "time from the end of one stroke to the start of the next",
        None, 10_000, above=0, default=0.0, needed_in=("strokes",), only_in=("strokes",),
    )  # fmt: skip
