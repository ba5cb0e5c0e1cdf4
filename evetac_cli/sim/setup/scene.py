"""The settings of a scene: the tables of its TOML file, each as a frozen type.

A scene names the parts that exist and the ranges from which each trial's values are drawn. Once scene_file.py has read
the file, the code uses attributes only: a table that the file leaves out is None or a table of defaults.

Flags of `record` and `grasp` may replace settings of the table `[solver]`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, get_args

from msgspec import Meta

from evetac_cli.errors import SceneError
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
from evetac_cli.sim.setup.tables import (
    UNIQUE,
    Positive,
    Range,
    Seconds,
    Share,
    Table,
    UpTo100,
    UpTo1000,
    kinds,
    read_table,
)

LIFT_PITCH_MM = 1.45  # distance of the gel's nodes in a lift scene that states none
HALVINGS = 3  # most halvings of a 1 ms slice at the default tolerance: steps of 1/8 ms
MOST_HALVINGS = 7  # most halvings at any tolerance


@dataclass(frozen=True, kw_only=True)
class Solver(Table):
    """Resolution of the simulation; `evaluate cost` measures the run time and accuracy of each setting.

    Steps start at 1 ms and are halved until the tolerance is reached: HALVINGS times at most at the default tolerance,
    and once more for each halving of the tolerance. Steps are also halved until nodes slip one after the other (see
    sim.gel.adaptive). MOST_HALVINGS limits both.
    """

    #: largest estimated displacement error of a mechanical step; steps of 1 ms are halved until it is reached
    tolerance_um: Annotated[float, Meta(ge=0.001, le=1000)] = 0.2
    #: fixed mechanical step, instead of tolerance_um; 1 divided by a whole number
    step_ms: Annotated[float, Meta(ge=0.0001, le=1)] | None = None
    #: implicitness of the time step: 1 is implicit Euler; 0.5 is the trapezoidal rule, which rings after stick events
    theta: Annotated[float, Meta(ge=0.5, le=1)] = 0.51
    #: distance between neighbouring nodes of the gel; chosen by `grasp` if left out
    node_pitch_mm: Annotated[float, Meta(ge=0.05, le=5)] = 0.833
    #: number of straight segments of a dot's path within a slice
    camera_substeps: Annotated[int, Meta(ge=1, le=100)] = 1
    #: scans per ms of the simulated readout; the DVXplorer has 5
    scans_per_ms: Annotated[int, Meta(ge=1, le=1000)] = 5
    #: largest residual of the force balance in a step, relative to all forces
    residual: Annotated[float, Meta(ge=1e-12, le=0.01)] = 1e-06

    WRITTEN_WHOLE: ClassVar = True
    ALONE: ClassVar = ("step_ms", "tolerance_um")

    def __post_init__(self) -> None:
        """Check the fixed step; ValueError if it does not divide a slice."""
        if self.step_ms is not None and not self._divides_slice(self.step_ms):
            raise ValueError(f"step_ms: expected 1 ms divided by a whole number, found {self.step_ms}")

    @staticmethod
    def _divides_slice(step_ms: float) -> bool:
        steps = 1.0 / step_ms if math.isfinite(step_ms) and step_ms > 0.0 else math.nan
        return 1.0 <= steps <= 1e6 and abs(steps - round(steps)) <= 1e-6 * steps

    @property
    def fixed_steps(self) -> int | None:
        """Return the number of steps per slice if it is fixed, else None."""
        return None if self.step_ms is None else round(1.0 / self.step_ms)

    @property
    def halvings(self) -> int:
        """Return the largest number of halvings of a slice."""
        finer = math.ceil(math.log2(Solver.tolerance_um / self.tolerance_um) - 1e-9)
        return min(max(HALVINGS + finer, 0), MOST_HALVINGS)

    def nodes(self, pad_m: tuple[float, float]) -> tuple[int, int]:
        """Return the numbers of columns and rows of nodes on a pad of this size."""
        columns, rows = (max(2, round(side * 1e3 / self.node_pitch_mm)) for side in pad_m)
        return columns, rows


def with_given(solver: Solver, settings: Mapping[str, Any], where: str) -> Solver:
    """Replace a scene's settings with the given ones; SceneError if they are invalid.

    A given tolerance replaces a fixed step, and a given fixed step replaces a tolerance.
    """
    typed = read_table(Solver, settings, f"{where}: [solver]", error=SceneError)
    if "step_ms" in settings:
        solver = replace(solver, tolerance_um=Solver.tolerance_um)
    if "tolerance_um" in settings:
        solver = replace(solver, step_ms=None)
    return replace(solver, **{name: getattr(typed, name) for name in settings})


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
    """Ranges from which each trial's values are drawn.

    The friction of a scene that states none is that of evetac's scenes, fitted once, to grasps and slips together
    (docs/simulator.md, "The model").
    """

    #: range of the factor on the object's static friction
    static_friction: Range[Positive] = (1.0, 1.0)
    #: range of kinetic friction divided by static friction
    kinetic_share: Range[Positive] = (0.8, 0.9)
    #: range of the Stribeck velocity: the slip speed at which friction falls from static to kinetic, in mm/s
    stribeck_mm_s: Range[Positive] = (5.0, 20.0)
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
    #: slip distance over which friction adapts to the slip speed, or its range; unknown for this gel; 0: at once
    memory_um: Range[UpTo1000] = (50.0, 50.0)
    #: friction grows as p^(1 - this) with the pressure p; a number or its range. 0: in proportion to p; 1: independent
    #: of p. The friction limit of the whole contact is mu N for every value
    pressure_exponent: Range[Share] = (0.67, 0.67)


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
class ObjectRoughness(Table):
    """Roughness of the object: friction varies over its surface, so that sliding over the gel is heard."""

    #: standard deviation of friction at a point of the surface, relative to its mean
    friction_sd: Annotated[float, Meta(gt=0, le=2)] = 0.5
    #: distance over which friction varies: the correlation of its logarithm is exp(-(distance / this)^2 / 2)
    length_mm: Annotated[float, Meta(ge=0.05, le=10)] = 1.0


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

    @property
    def depth(self) -> float:
        """Return the depth of the flicker; 0 without."""
        return 0.0 if self.flicker is None else self.flicker.depth

    def flicker_level(self, time_us: float) -> float:
        """Return what the flicker adds to log brightness at a time."""
        if self.flicker is None:
            return 0.0
        return math.log1p(self.depth * math.sin(2e-6 * math.pi * self.flicker.frequency_hz * time_us))

    def step_level(self, time_us: float) -> float:
        """Return what the step adds to log brightness at a time."""
        step = self.step
        return 0.0 if step is None or time_us < step.at_s * 1e6 else math.log(step.factor)


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
    roughness: Annotated[ObjectRoughness | None, kinds(*GRIPPED)] = None
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
