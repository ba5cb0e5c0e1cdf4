"""The settings of a scene: the tables of its TOML file, each as a frozen type.

A scene names the parts that exist and the ranges from which each trial's values are drawn. Once scene_file.py has read
the file, the code uses attributes only: a table that the file leaves out is None or a table of defaults.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

from msgspec import Meta

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
from evetac_cli.sim.setup.tables import UNIQUE, Positive, Range, Seconds, Share, Table, UpTo100, UpTo1000, kinds

Kind = Literal["ramp", "lift", "hold", "press", "rub", "tone"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, kw_only=True)
class SceneTimes(Table):
    """Times of the phases of a scene, in s."""

    #: initial time at rest: nothing moves, and something other than the gripper carries the object
    rest_s: Annotated[Seconds, kinds(needed=("ramp", "hold", "press", "rub", "tone"))] = 0.0
    #: time over which the object's weight is handed over to the gripper
    load_s: Annotated[Seconds, kinds(needed=("ramp", "hold"))] = 0.0
    #: time the object is held before the current ramps down
    hold_s: Annotated[Seconds, kinds(needed=("ramp",))] = 0.0
    #: time recorded after the object is lost
    after_lost_s: Seconds = 0.15
    #: longest duration of the recording
    longest_s: Annotated[Seconds, kinds(needed=("ramp", "hold"))] = 0.0
    #: time from the start to the lifting phase
    touch_s: Annotated[Seconds, kinds(needed=("lift",))] = 0.0
    #: time from the start of the lifting phase until the hand moves
    before_rise_s: Seconds = 0.0
    #: start of the tone
    tone_at_s: Annotated[Seconds, kinds(needed=("tone",))] = 0.0
    #: duration of the tone
    tone_s: Annotated[Seconds, kinds(needed=("tone",))] = 0.0
    #: time recorded after the motion or the tone ends; rest_s if left out
    after_s: Annotated[Seconds | None, kinds(needed=("tone",))] = None

    @property
    def after_motion_s(self) -> float:
        """Return the time that is recorded after the motion or the tone, in s."""
        return self.rest_s if self.after_s is None else self.after_s


@dataclass(frozen=True, kw_only=True)
class GelSettings(Table):
    """The gel in this scene."""

    #: true: the gel is cut; the last column of dots is removed to make a window
    cut: bool
    #: true: the object is grasped from the side, with gravity along +y of the image
    sideways: bool = False
    #: factor on the shear modulus and the normal modulus of the sensor's gel
    stiffness_factor: Annotated[float, Meta(ge=0.01, le=100)] = 1.0


@dataclass(frozen=True, kw_only=True)
class Randomised(Table):
    """Ranges from which each trial's values are drawn."""

    #: range of the factor on the object's static friction
    static_friction: Range[Positive] = (1.0, 1.0)
    #: range of kinetic friction divided by static friction
    kinetic_share: Range[Positive] = (1.0, 1.0)
    #: range of the Stribeck velocity: the slip speed at which friction falls from static to kinetic, in mm/s
    stribeck_mm_s: Range[Positive] = (10.0, 10.0)
    #: range of the factor on the object's mass
    mass: Range[Positive] = (1.0, 1.0)
    #: each object has its own ratio of kinetic to static friction; a trial's ratio differs from it by at most this
    kinetic_share_spread: Share | None = None
    #: largest distance of the touched point from the middle of the pad, along gravity and across it
    touch_mm: Annotated[float, Meta(ge=0, le=10)] = 0.0
    #: standard deviation of the distance, across gravity, from the touched point to the centre of mass; flat objects
    #: only, because round ones are touched on their axis
    lever_mm: UpTo100 = 0.0
    #: range of the misalignment of the fingers, in degrees
    tilt_deg: Range[Annotated[float, Meta(ge=-5, le=5)]] = (
        0.0,
        0.0,
    )
    #: slip distance over which friction adapts to the slip speed, or its range; unknown for this gel (evetac's scenes
    #: use 50); 0: at once
    memory_um: Range[UpTo1000] = (20.0, 20.0)
    #: friction grows as p^(1 - this) with the pressure p; a number or its range. 0: in proportion to p; 1: independent
    #: of p. The friction limit of the whole contact is mu N for every value
    pressure_exponent: Range[Share] = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Texture(Table):
    """The object's texture, as seen through the window of a cut gel."""

    #: range of the standard deviation of the logarithm of brightness
    log_sd: Range[Positive] = (0.06, 0.06)
    #: range of the distance at which the correlation of brightness is one half
    half_correlation_px: Range[Positive] = (12.0, 12.0)
    #: defocus: the contrast falls as exp(-gap / focus_mm) when the object is off the gel
    focus_mm: Annotated[float, Meta(gt=0, le=100)] = 1.0
    #: true: the window shows the texture; grasps set false, because no controller uses the window
    show: bool = True


@dataclass(frozen=True, kw_only=True)
class FrictionChange(Table):
    """A sudden change of static and kinetic friction in the whole contact, for example from a wet patch."""

    #: time of the change, from the start of the recording
    at_s: Seconds
    #: friction after the change divided by friction before it
    factor: UpTo100


@dataclass(frozen=True, kw_only=True)
class Flicker(Table):
    """Flickering light: brightness = mean * (1 + depth * sin(2 pi frequency t))."""

    #: flicker frequency, twice the mains frequency: 100 or 120 Hz
    frequency_hz: Annotated[float, Meta(ge=0.1, le=400)]
    #: amplitude of the flicker as a share of the mean brightness
    depth: Annotated[float, Meta(gt=0, le=0.95)]


@dataclass(frozen=True, kw_only=True)
class LightStep(Table):
    """A sudden change of brightness."""

    #: time of the change, from the start of the recording
    at_s: Seconds
    #: brightness after the change divided by brightness before it
    factor: Annotated[float, Meta(ge=0.001, le=1000)]


@dataclass(frozen=True, kw_only=True)
class LightSettings(Table):
    """Light that varies."""

    flicker: Flicker | None = None
    step: LightStep | None = None

    NOT_EMPTY: ClassVar = True


@dataclass(frozen=True, kw_only=True)
class VanishingDots(Table):
    """Dots whose ink comes off: the camera sees bare gel where they were."""

    #: [row, column] of each dot that vanishes
    dots: Annotated[
        tuple[tuple[Annotated[int, Meta(ge=0, le=100)], Annotated[int, Meta(ge=0, le=100)]], ...],
        Meta(min_length=1, max_length=256),
        UNIQUE,
    ]
    #: time at which the dots vanish, from the start of the recording
    at_s: Seconds


@dataclass(frozen=True, kw_only=True)
class CalibrationOffset(Table):
    """A wrong calibration: the recording's dots at rest are rotated and shifted from their true positions."""

    #: shift of the dots at rest, along x and y
    offset_px: tuple[Annotated[float, Meta(ge=-20, le=20)], Annotated[float, Meta(ge=-20, le=20)]] = (0.0, 0.0)
    #: rotation of the dots at rest about the middle of the frame
    turned_deg: Annotated[float, Meta(ge=-5, le=5)] = 0.0

    NOT_EMPTY: ClassVar = True


@dataclass(frozen=True, kw_only=True)
class Scene(Table):
    """A scene to simulate; only the parts that it names exist."""

    #: name of the scene in recordings
    name: Annotated[str, Meta(max_length=100, pattern="^[a-z][a-z0-9-]*$")]
    #: In a ramp, a gripper in current mode already holds the object at the start. In a lift, a gripper in position mode
    #: starts open, grasps an object on a table and lifts it. In a hold, the gripper starts open and closes; the object
    #: is pushed, then slips as the grip loosens. In a press, a flat face is driven over the gel. In a rub, a hand rubs
    #: an object with visible edges over the gel. In a tone, a speaker vibrates the gel (linear response)
    kind: Kind
    #: one-line description of the scene
    summary: Annotated[str, Meta(max_length=1000)]
    time: SceneTimes
    hand: Annotated[HandSettings, kinds(*GRIPPED, needed=("lift",))] = HandSettings()
    gel: GelSettings
    gripper: Annotated[GripperSettings, kinds(needed=("hold",))] = GripperSettings()
    randomise: Randomised = Randomised()
    texture: Texture | None = None
    drop: Annotated[FallingWeight | None, kinds("lift")] = None
    floor: Annotated[Floor, kinds("hold")] = Floor()
    push: Annotated[Pushes | None, kinds("ramp", "hold")] = None
    object: Annotated[ObjectChanges | None, kinds(*GRIPPED)] = None
    friction_change: Annotated[FrictionChange | None, kinds(*GRIPPED, "press", "rub")] = None
    light: LightSettings | None = None
    vanishing_dots: VanishingDots | None = None
    calibration: CalibrationOffset | None = None
    rub: Annotated[Rub | None, kinds("rub", needed=("rub",))] = None
    tone: Annotated[Speaker | None, kinds("tone", needed=("tone",))] = None
    face: Annotated[Face | None, kinds("press", needed=("press",))] = None
    motion: Annotated[FaceMotion | None, kinds("press", needed=("press",))] = None
    solver: Solver = Solver()

    @property
    def is_gripped(self) -> bool:
        """Whether a gripper holds an object."""
        return self.kind in GRIPPED

    @property
    def shows_texture(self) -> bool:
        """Whether the window shows the object's texture."""
        return self.gel.cut and self.texture is not None and self.texture.show
