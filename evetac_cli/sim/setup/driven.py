"""What a scene may drive over the gel without a gripper: a face, an object with edges, a speaker."""

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
    "waypoints": "pressed on once, moved to random places",
    "strokes": "drawn over the whole gel in lines",
}


@dataclass(frozen=True, kw_only=True)
class Rub:
    """An object with visible edges: touches, shears, rubs in random directions, lifts off."""

    objects: tuple[str, ...] = lists(
        "one of them is chosen at random for each trial", {"enum": ["finger", "handle"]}, (1, 2), unique=True
    )
    static_friction: float = number("of the object on the gel", 0, 1000)
    normal_n: tuple[float, float] = between("range of the normal force in touch and shear", None, 1000, above=0)
    rub_n: tuple[float, float] = between("range of the normal force in rubs", None, 1000, above=0)
    touch_s: float = number("how long the object takes to touch", None, 10_000, above=0)
    shear_px: float = number("how far the object shears the gel to each side", 0, 1000)
    shear_s: float = number("how long the shear takes", None, 10_000, above=0)
    count: tuple[int, int] = wholes("number of rubs: least and most", 0, 1000, 2, order="pair")
    length_mm: tuple[float, float] = between("range of the length of a rub", None, 1000, above=0)
    speed_mm_s: tuple[float, float] = between("range of the greatest speed of a rub", None, 1000, above=0)
    pause_s: float = duration("before each rub and after the last")
    lift_s: float = number("how long the object takes to lift off", None, 10_000, above=0)
    edge_log_contrast: tuple[float, float] = between(
        "range of the log brightness across the object's edge", None, 1000, above=0
    )
    edge_blur_px: tuple[float, float] = between(
        "range of the standard deviation of the edge's blur; its picture is drawn once, several of these wide; 50 px"
        " take 1.5 s for a view of 640 x 480",
        None,
        50,
        above=0,
    )


def _by_frequency(meaning: str) -> Any:
    return numbers(meaning, 0, 100, (1, 1000))


@dataclass(frozen=True, kw_only=True)
class Speaker:
    """A speaker pressed on the gel: its tones, one recording each, and a table by frequency, linear in between and
    constant beyond.
    """

    frequency_hz: tuple[float, ...] = numbers("of the tones", 1, 2500, (1, 1000), unique=True)
    normal_n: float = number("the speaker's normal force", None, 10_000, above=0)
    press_s: float = number("how long the speaker takes to press", None, 10_000, above=0)
    radius_mm: float = number("of the patch that touches", None, 10_000, above=0)
    offset_mm: float = number("of the patch's centre from that of the view, at most, along each axis", 0, 20)
    tangential_share: tuple[float, float] = between(
        "range of the motion along the surface over that along the normal", 0, 10
    )
    amplitude_factor: tuple[float, float] = between("range of the factor on the amplitude", None, 1000, above=0)
    drift_s: tuple[float, float] = between(
        "range of the time from one value of the second harmonic or the modulation to the next", 0.01, 3600
    )
    at_hz: tuple[float, ...] = numbers(
        "frequencies of the table's rows", None, 2500, (1, 1000), above=0, order="strictly rising"
    )
    dot_motion_px: tuple[float, ...] = _by_frequency("amplitude of the dots' motion, root mean square over them")
    second_harmonic_least: tuple[float, ...] = _by_frequency("lower end of the range of the second harmonic's share")
    second_harmonic_most: tuple[float, ...] = _by_frequency("upper end of the range of the second harmonic's share")
    modulation_most: tuple[float, ...] = _by_frequency("upper end of the range of the subharmonic modulation")

    COLUMNS: ClassVar = ("at_hz", "dot_motion_px", "second_harmonic_least", "second_harmonic_most", "modulation_most")

    def at(self, column: tuple[float, ...], frequency_hz: float) -> float:
        """A column of the table at a frequency."""
        return float(np.interp(frequency_hz, self.at_hz, column))


@dataclass(frozen=True, kw_only=True)
class Face:
    """What presses on the gel: a rectangle (size_mm) or a disc (radius_mm)."""

    size_mm: tuple[float, float] | None = numbers(
        "sides of a rectangle, along x and y", None, 10_000, 2, above=0, default=None
    )
    radius_mm: float | None = number("of a disc", None, 10_000, above=0, default=None)
    static_friction: float = number("of the face on the gel", 0, 1000)

    RULES: ClassVar[Rules] = {"oneOf": [{"required": ["size_mm"]}, {"required": ["radius_mm"]}]}


@dataclass(frozen=True, kw_only=True)
class FaceMotion:
    """How the face moves."""

    kind: str = one_of("; ".join(f"{name}: {what}" for name, what in MOTIONS.items()), tuple(MOTIONS))
    normal_n: float = number("normal force", None, 10_000, above=0)
    press_s: float = number("how long the face takes to press or to lift off", None, 10_000, above=0)
    shear_n: float = number(
        "shear force of the gel at the farthest waypoint",
        None, 10_000, above=0, default=0.0, needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    offset_mm: float = number(
        "of the face's centre from that of the view, at most, along each axis",
        0, 20, default=0.0, needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    count: int = whole(
        "of waypoints", 1, 100_000, default=0, needed_in=("waypoints",), only_in=("waypoints",)
    )  # fmt: skip
    move_s: tuple[float, float] = between(
        "range of the time from one waypoint to the next",
        None, 1000, above=0, default=(0.0, 0.0), needed_in=("waypoints",), only_in=("waypoints",),
    )  # fmt: skip
    pause_s: float = duration("at each waypoint", default=0.0, needed_in=("waypoints",), only_in=("waypoints",))
    lines: int = whole(
        "of strokes in each direction", 2, 100, default=0, needed_in=("strokes",), only_in=("strokes",)
    )  # fmt: skip
    speed_mm_s: float = number(
        "of a stroke", None, 10_000, above=0, default=0.0, needed_in=("strokes",), only_in=("strokes",)
    )  # fmt: skip
    approach_s: float = number(
        "from the end of a stroke to the start of the next",
        None, 10_000, above=0, default=0.0, needed_in=("strokes",), only_in=("strokes",),
    )  # fmt: skip
