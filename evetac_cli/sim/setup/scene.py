"""The settings of a scene: the tables of its TOML file, each as a frozen type.

A scene names the parts that exist and the ranges from which each trial's values are drawn. Once scene_file.py has read
the file, the code uses attributes only: a table that the file leaves out is None or a table of defaults.
"""

from dataclasses import dataclass
from typing import ClassVar

from evetac_cli.sim.setup.driven import Face, FaceMotion, Rub, Speaker
from evetac_cli.sim.setup.held import (
    GRIPPED,
    FallingWeight,
    Floor,
    GripperSettings,
    HandSettings,
    ObjectChanges,
    Pushes,
)
from evetac_cli.sim.setup.solver import Solver
from evetac_cli.sim.setup.tables import (
    REQUIRED,
    Rules,
    between,
    duration,
    flag,
    lists,
    number,
    numbers,
    one_of,
    table,
    words,
)

KINDS = {
    "ramp": "a gripper in current mode; the object is already held at the start",
    "lift": "a gripper in position mode grasps an object on a table and lifts it; starts open",
    "hold": "the gripper starts open and closes; the object is pushed, then slips as the grip loosens",
    "press": "a flat face is driven over the gel; no gripper",
    "rub": "a hand rubs an object with visible edges over the gel; no gripper",
    "tone": "a speaker vibrates the gel, linear response; no gripper",
}


@dataclass(frozen=True, kw_only=True)
class SceneTimes:
    """Times of the phases of a scene, in s."""

    rest_s: float = duration(
        "initial time at rest: nothing moves, and something other than the gripper carries the object",
        default=0.0,
        needed_in=("ramp", "hold", "press", "rub", "tone"),
    )
    load_s: float = duration(
        "time over which the object's weight is handed over to the gripper", default=0.0, needed_in=("ramp", "hold")
    )
    hold_s: float = duration("time the object is held before the current ramps down", default=0.0, needed_in=("ramp",))
    after_lost_s: float = duration("time recorded after the object is lost", default=0.15)
    longest_s: float = duration("longest duration of the recording", default=0.0, needed_in=("ramp", "hold"))
    touch_s: float = duration("time from the start to the lifting phase", default=0.0, needed_in=("lift",))
    before_rise_s: float = duration("time from the start of the lifting phase until the hand moves", default=0.0)
    tone_at_s: float = duration("start of the tone", default=0.0, needed_in=("tone",))
    tone_s: float = duration("duration of the tone", default=0.0, needed_in=("tone",))
    after_s: float | None = duration(
        "time recorded after the motion or the tone ends; rest_s if left out",
        default=None,
        needed_in=("tone",),
    )

    @property
    def after_motion_s(self) -> float:
        """Return the time that is recorded after the motion or the tone, in s."""
        return self.rest_s if self.after_s is None else self.after_s


@dataclass(frozen=True, kw_only=True)
class GelSettings:
    """The gel in this scene."""

    cut: bool = flag("true: the gel is cut; the last column of dots is removed to make a window")
    sideways: bool = flag(
        "true: the object is grasped from the side, with gravity along +y of the image", default=False
    )
    stiffness_factor: float = number(
        "factor on the shear modulus and the normal modulus of the sensor's gel", 0.01, 100, default=1.0
    )


@dataclass(frozen=True, kw_only=True)
class Randomised:
    """Ranges from which each trial's values are drawn."""

    static_friction: tuple[float, float] = between(
        "range of the factor on the object's static friction", None, 1000, above=0, default=(1.0, 1.0)
    )
    kinetic_share: tuple[float, float] = between(
        "range of kinetic friction divided by static friction", None, 1000, above=0, default=(1.0, 1.0)
    )
    stribeck_mm_s: tuple[float, float] = between(
        "range of the Stribeck velocity: the slip speed at which friction falls from static to kinetic, in mm/s",
        None,
        1000,
        above=0,
        default=(10.0, 10.0),
    )
    mass: tuple[float, float] = between(
        "range of the factor on the object's mass", None, 1000, above=0, default=(1.0, 1.0)
    )
    kinetic_share_spread: float | None = number(
        "each object has its own ratio of kinetic to static friction; a trial's ratio differs from it by at most this",
        0,
        1,
        default=None,
    )
    touch_mm: float = number(
        "largest distance of the touched point from the middle of the pad, along gravity and across it",
        0,
        10,
        default=0.0,
    )
    lever_mm: float = number(
        "standard deviation of the distance, across gravity, from the touched point to the centre of mass; flat objects"
        " only, because round ones are touched on their axis",
        0,
        100,
        default=0.0,
    )
    tilt_deg: tuple[float, float] = between(
        "range of the misalignment of the fingers, in degrees", -5, 5, default=(0.0, 0.0)
    )
    memory_um: tuple[float, float] = between(
        "slip distance over which friction adapts to the slip speed, or its range; unknown for this gel (evetac's"
        " scenes use 50); 0: at once",
        0,
        1000,
        or_one=True,
        default=(20.0, 20.0),
    )
    pressure_exponent: tuple[float, float] = between(
        "friction grows as p^(1 - this) with the pressure p; a number or its range. 0: in proportion to p; 1:"
        " independent of p. The friction limit of the whole contact is mu N for every value",
        0,
        1,
        or_one=True,
        default=(0.0, 0.0),
    )


@dataclass(frozen=True, kw_only=True)
class Texture:
    """The object's texture, as seen through the window of a cut gel."""

    log_sd: tuple[float, float] = between(
        "range of the standard deviation of the logarithm of brightness", None, 1000, above=0, default=(0.06, 0.06)
    )
    half_correlation_px: tuple[float, float] = between(
        "range of the distance at which the correlation of brightness is one half",
        None,
        1000,
        above=0,
        default=(12.0, 12.0),
    )
    focus_mm: float = number(
        "defocus: the contrast falls as exp(-gap / focus_mm) when the object is off the gel",
        None,
        100,
        above=0,
        default=1.0,
    )
    show: bool = flag(
        "true: the window shows the texture; grasps set false, because no controller uses the window", default=True
    )


@dataclass(frozen=True, kw_only=True)
class FrictionChange:
    """A sudden change of static and kinetic friction in the whole contact, for example from a wet patch."""

    at_s: float = duration("time of the change, from the start of the recording")
    factor: float = number("friction after the change divided by friction before it", 0, 100)


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """Flickering light: brightness = mean * (1 + depth * sin(2 pi frequency t))."""

    frequency_hz: float = number("flicker frequency, twice the mains frequency: 100 or 120 Hz", 0.1, 400)
    depth: float = number("amplitude of the flicker as a share of the mean brightness", None, 0.95, above=0)


@dataclass(frozen=True, kw_only=True)
class LightStep:
    """A sudden change of brightness."""

    at_s: float = duration("time of the change, from the start of the recording")
    factor: float = number("brightness after the change divided by brightness before it", 0.001, 1000)


@dataclass(frozen=True, kw_only=True)
class Flash:
    """Flashes of light that do not pass through the print: dots get brighter, bare gel hardly does."""

    every_s: float = number("time from one flash to the next, and from the start to the first", 0.05, 3600)
    brightness: tuple[float, ...] = numbers(
        "brightness of each pulse of a flash, relative to bare gel; each pulse lasts one slice (1 ms), with one slice"
        " between pulses",
        0.001,
        1000,
        (1, 8),
    )


@dataclass(frozen=True, kw_only=True)
class LightSettings:
    """Light that varies, or that does not pass through the print."""

    flicker: Flicker | None = table(Flicker)
    step: LightStep | None = table(LightStep)
    floor: float = number(
        "light that does not pass through the print (scattered, or from inside the sensor), relative to the lamp's"
        " light on bare gel; it neither flickers nor steps",
        0,
        1000,
        default=0.0,
    )
    flash: Flash | None = table(Flash)

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class VanishingDots:
    """Dots whose ink comes off: the camera sees bare gel where they were."""

    dots: tuple[tuple[int, int], ...] = lists(
        "[row, column] of each dot that vanishes",
        {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 100}, "minItems": 2, "maxItems": 2},
        (1, 256),
        unique=True,
    )
    at_s: float = duration("time at which the dots vanish, from the start of the recording")


@dataclass(frozen=True, kw_only=True)
class CalibrationOffset:
    """A wrong calibration: the recording's dots at rest are rotated and shifted from their true positions."""

    offset_px: tuple[float, float] = numbers("shift of the dots at rest, along x and y", -20, 20, 2, default=(0.0, 0.0))
    turned_deg: float = number("rotation of the dots at rest about the middle of the frame", -5, 5, default=0.0)

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene to simulate; only the parts that it names exist."""

    name: str = words("name of the scene in recordings", 100, pattern="^[a-z][a-z0-9-]*$")
    kind: str = one_of("; ".join(f"{name}: {what}" for name, what in KINDS.items()), tuple(KINDS))
    summary: str = words("one-line description of the scene", 1000)
    time: SceneTimes = table(SceneTimes, default=REQUIRED)
    hand: HandSettings = table(HandSettings, default=HandSettings(), needed_in=("lift",), only_in=GRIPPED)
    gel: GelSettings = table(GelSettings, default=REQUIRED)
    gripper: GripperSettings = table(GripperSettings, default=GripperSettings(), needed_in=("hold",))
    randomise: Randomised = table(Randomised, default=Randomised())
    texture: Texture | None = table(Texture)
    drop: FallingWeight | None = table(FallingWeight, only_in=("lift",))
    floor: Floor = table(Floor, default=Floor(), only_in=("hold",))
    push: Pushes | None = table(Pushes, only_in=("ramp", "hold"))
    object: ObjectChanges | None = table(ObjectChanges, only_in=GRIPPED)
    friction_change: FrictionChange | None = table(
        FrictionChange, only_in=(*GRIPPED, "press", "rub")
    )  # fmt: skip
    light: LightSettings | None = table(LightSettings)
    vanishing_dots: VanishingDots | None = table(VanishingDots)
    calibration: CalibrationOffset | None = table(CalibrationOffset)
    rub: Rub | None = table(Rub, needed_in=("rub",), only_in=("rub",))
    tone: Speaker | None = table(Speaker, needed_in=("tone",), only_in=("tone",))
    face: Face | None = table(Face, needed_in=("press",), only_in=("press",))
    motion: FaceMotion | None = table(FaceMotion, needed_in=("press",), only_in=("press",))
    solver: Solver = table(Solver, default=Solver())

    @property
    def is_gripped(self) -> bool:
        """Whether a gripper holds an object."""
        return self.kind in GRIPPED

    @property
    def shows_texture(self) -> bool:
        """Whether the window shows the object's texture."""
        return self.gel.cut and self.texture is not None and self.texture.show
