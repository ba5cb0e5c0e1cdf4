"""Settings of objects that move on the gel without a gripper: a flat face, an object with edges, a speaker."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from evetac_cli.sim.setup.tables import (
    STRICTLY_RISING,
    UNIQUE,
    Large,
    Positive,
    Range,
    Seconds,
    Table,
    UpTo100,
    UpTo1000,
    kinds,
)

WAYPOINTS, STROKES = (kinds(kind, needed=(kind,)) for kind in ("waypoints", "strokes"))


@dataclass(frozen=True, kw_only=True)
class Rub(Table):
    """An object with visible edges: it touches, shears the gel, rubs in random directions and lifts off."""

    #: objects to choose from; each trial draws one at random
    objects: Annotated[tuple[Literal["finger", "handle"], ...], Meta(min_length=1, max_length=2), UNIQUE]
    #: static friction of the object on the gel
    static_friction: UpTo1000
    #: range of the normal force while touching and shearing
    normal_n: Range[Positive]
    #: range of the normal force while rubbing
    rub_n: Range[Positive]
    #: duration of the touch, in which the normal force builds up
    touch_s: Large
    #: distance that the object shears the gel to each side
    shear_px: UpTo1000
    #: duration of the shear
    shear_s: Large
    #: smallest and largest number of rubs
    count: Range[Annotated[int, Meta(ge=0, le=1000)]]
    #: range of the length of a rub
    length_mm: Range[Positive]
    #: range of the peak speed of a rub
    speed_mm_s: Range[Positive]
    #: pause before each rub and after the last
    pause_s: Seconds
    #: duration of the lift-off
    lift_s: Large
    #: range of the step in log brightness across the object's edge
    edge_log_contrast: Range[Positive]
    #: range of the standard deviation of the edge's Gaussian blur; the edge is drawn once, in an image several times
    #: this wide (50 px take 1.5 s for a view of 640 x 480)
    edge_blur_px: Range[Annotated[float, Meta(gt=0, le=50)]]


ByFrequency = Annotated[tuple[UpTo100, ...], Meta(min_length=1, max_length=1000)]


@dataclass(frozen=True, kw_only=True)
class Speaker(Table):
    """A speaker pressed on the gel: its tones, one per recording, and a table of its motion by frequency.

    The table is linear between its frequencies and constant beyond them.
    """

    #: frequencies of the tones
    frequency_hz: Annotated[
        tuple[Annotated[float, Meta(ge=1, le=2500)], ...], Meta(min_length=1, max_length=1000), UNIQUE
    ]
    #: normal force of the speaker
    normal_n: Large
    #: time that the speaker takes to press on the gel
    press_s: Large
    #: radius of the contact patch
    radius_mm: Large
    #: largest offset of the contact patch from the centre of the view, along each axis
    offset_mm: Annotated[float, Meta(ge=0, le=20)]
    #: range of the tangential motion relative to the normal motion
    tangential_share: Range[Annotated[float, Meta(ge=0, le=10)]]
    #: range of the factor on the amplitude
    amplitude_factor: Range[Positive]
    #: range of the time between two values of the second harmonic or of the modulation; both drift
    drift_s: Range[Annotated[float, Meta(ge=0.01, le=3600)]]
    #: frequencies of the table's rows
    at_hz: Annotated[
        tuple[Annotated[float, Meta(gt=0, le=2500)], ...],
        Meta(min_length=1, max_length=1000),
        STRICTLY_RISING,
    ]
    #: amplitude of the dots' motion, as the root mean square over dots
    dot_motion_px: ByFrequency
    #: lower end of the range of the second harmonic's share
    second_harmonic_least: ByFrequency
    #: upper end of the range of the second harmonic's share
    second_harmonic_most: ByFrequency
    #: upper end of the range of the subharmonic modulation
    modulation_most: ByFrequency

    COLUMNS: ClassVar = ("at_hz", "dot_motion_px", "second_harmonic_least", "second_harmonic_most", "modulation_most")

    def __post_init__(self) -> None:
        """Check the table; ValueError if a lower end of the second harmonic's range is above its upper end."""
        super().__post_init__()
        if any(low > high for low, high in zip(self.second_harmonic_least, self.second_harmonic_most, strict=True)):
            raise ValueError("second_harmonic_least: above second_harmonic_most")

    def at(self, column: tuple[float, ...], frequency_hz: float) -> float:
        """Return the value of a column of the table at a frequency."""
        return float(np.interp(frequency_hz, self.at_hz, column))


@dataclass(frozen=True, kw_only=True)
class Face(Table):
    """The face that presses on the gel: a rectangle (size_mm) or a disc (radius_mm)."""

    #: sides of the rectangle, along x and y
    size_mm: tuple[Large, Large] | None = None
    #: radius of the disc
    radius_mm: Large | None = None
    #: static friction of the face on the gel
    static_friction: UpTo1000

    ALONE: ClassVar = ("size_mm", "radius_mm")

    def __post_init__(self) -> None:
        """Check that the face has a size; ValueError if not."""
        if self.size_mm is None and self.radius_mm is None:
            raise ValueError("size_mm or radius_mm is missing")


@dataclass(frozen=True, kw_only=True)
class FaceMotion(Table):
    """The motion of the face."""

    #: waypoints: pressed on once, then moved between random positions; strokes: drawn over the whole gel in parallel
    #: lines
    kind: Literal["waypoints", "strokes"]
    #: normal force of the face
    normal_n: Large
    #: time that the face takes to press on the gel or to lift off
    press_s: Large
    #: shear force on the gel at the farthest waypoint
    shear_n: Annotated[Large, WAYPOINTS] = 0.0
    #: largest offset of the face from the centre of the view, along each axis
    offset_mm: Annotated[float, Meta(ge=0, le=20), WAYPOINTS] = 0.0
    #: number of waypoints
    count: Annotated[int, Meta(ge=1, le=100_000), WAYPOINTS] = 0
    #: range of the time from one waypoint to the next
    move_s: Annotated[Range[Positive], WAYPOINTS] = (0.0, 0.0)
    #: pause at each waypoint
    pause_s: Annotated[Seconds, WAYPOINTS] = 0.0
    #: number of strokes in each direction
    lines: Annotated[int, Meta(ge=2, le=100), STROKES] = 0
    #: speed of a stroke
    speed_mm_s: Annotated[Large, STROKES] = 0.0
    #: time from the end of one stroke to the start of the next
    approach_s: Annotated[Large, STROKES] = 0.0
