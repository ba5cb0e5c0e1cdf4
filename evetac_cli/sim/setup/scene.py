"""What a scene is: the tables of its TOML file, which name the parts that exist and the ranges a trial is drawn from.

Behind the door (scene_file.py) nothing asks a scene by string: a table that is not named is None, or one of defaults.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from evetac_cli.sim.setup.solver import Solver
from evetac_cli.sim.setup.tables import (
    REQUIRED,
    between,
    flag,
    lists,
    number,
    numbers,
    one_of,
    table,
    whole,
    wholes,
    words,
)

KINDS = {
    "ramp": "gripper in current mode, starts held",
    "lift": "position mode, starts open over a table",
    "hold": "starts open, closes, the object is pushed and let slip",
    "press": "a face driven over the gel, no gripper",
    "rub": "an object with visible edges that a hand rubs over the gel",
    "tone": "a speaker on the gel, linear response, no gripper",
}
GRIPPED = ("ramp", "lift", "hold")
MOTIONS = {
    "waypoints": "pressed on once, moved to random places",
    "strokes": "drawn over the whole gel in lines",
}
LONGEST_S = 3600.0

Rules = Mapping[str, Any]  # of JSON schema, beside what the fields say


def duration(meaning: str, **more: Any) -> Any:
    """A time in s, of an hour at most."""
    return number(meaning, 0, LONGEST_S, **more)


@dataclass(frozen=True, kw_only=True)
class SceneTimes:
    """When what happens, in s."""

    rest_s: float = duration(
        "until then nothing moves, and something else carries the object",
        default=0.0,
        needed_in=("ramp", "hold", "press", "rub", "tone"),
    )
    load_s: float = duration(
        "for so long the weight is handed over to the gripper", default=0.0, needed_in=("ramp", "hold")
    )
    hold_s: float = duration("held before the current ramps down", default=0.0, needed_in=("ramp",))
    after_lost_s: float = duration("recording goes on for so long after the object is lost", default=0.15)
    longest_s: float = duration(
        "the recording ends at the latest after so long", default=0.0, needed_in=("ramp", "hold")
    )
    touch_s: float = duration("from the start until the lifting phase", default=0.0, needed_in=("lift",))
    before_rise_s: float = duration("from the start of the lifting phase until the hand moves", default=0.0)
    tone_at_s: float = duration("when the tone starts", default=0.0, needed_in=("tone",))
    tone_s: float = duration("how long the tone lasts", default=0.0, needed_in=("tone",))
    after_s: float | None = duration(
        "recording goes on for so long after the motion or the tone; as long as rest_s where it is left out",
        default=None,
        needed_in=("tone",),
    )

    @property
    def after_motion_s(self) -> float:
        """How long a recording goes on after the motion or the tone."""
        return self.rest_s if self.after_s is None else self.after_s


@dataclass(frozen=True, kw_only=True)
class HandJerk:
    """A pulse of the hand's speed, half a sine wave, that comes on top of its motion."""

    at_s: float = duration("when it starts, from the start of the recording")
    speed_mm_s: float = number("at its most, positive upwards", -1000, 1000)
    lasts_s: float = number("how long it lasts", 0.002, 10)


@dataclass(frozen=True, kw_only=True)
class HandVibration:
    """Vibration of the robot that holds the gripper, along gravity: a sum of sine waves with random phases."""

    frequency_hz: tuple[float, ...] = numbers("of each sine wave", 1, 200, (1, 16))
    acceleration_m_s2: tuple[float, ...] = numbers("amplitude of each", 0, 100, (1, 16))
    only_moving: bool = flag(
        "true: while the hand rises as planned; false: from the start of the recording on",
        default=False,
        only_in=("lift",),
    )

    COLUMNS: ClassVar = ("frequency_hz", "acceleration_m_s2")


@dataclass(frozen=True, kw_only=True)
class HandSettings:
    """The hand that holds the gripper."""

    height_mm: float = number(
        "how far the hand rises", None, 1000, above=0, default=0.0, needed_in=("lift",), only_in=("lift",)
    )
    speed_mm_s: float = number(
        "of the hand, at its most", None, 1000, above=0, default=1.0, needed_in=("lift",), only_in=("lift",)
    )
    acceleration_mm_s2: float = number(
        "of the hand while it starts and stops",
        None,
        100_000,
        above=0,
        default=1.0,
        needed_in=("lift",),
        only_in=("lift",),
    )
    jerk: HandJerk | None = table(HandJerk, only_in=("lift",))
    profile: str = one_of(
        "of the hand's speed while it starts and stops: trapezoid; s-curve, half a cosine whose largest acceleration is"
        " acceleration_mm_s2; steps, the trapezoid as a robot controller makes it that updates its speed at 125 Hz",
        ("trapezoid", "s-curve", "steps"),
        default="trapezoid",
        only_in=("lift",),
    )
    vibration: HandVibration | None = table(HandVibration)

    RULES: ClassVar[Rules] = {"minProperties": 1}

    @property
    def is_still(self) -> bool:
        """Whether the hand never moves."""
        return self.height_mm == 0.0 and self.jerk is None and self.vibration is None


@dataclass(frozen=True, kw_only=True)
class GelSettings:
    """The gel in this scene."""

    cut: bool = flag("true: the last dot column is cut out and makes room for the window")
    sideways: bool = flag("grasped from the side: gravity along +y of the image", default=False)
    stiffness_factor: float = number(
        "factor on the shear and normal modulus of the sensor's gel", 0.01, 100, default=1.0
    )


@dataclass(frozen=True, kw_only=True)
class SquareWave:
    """A square wave on top of the current, for a while: its steps show how late commands take effect."""

    from_s: float = duration("when it starts")
    to_s: float = duration("when it ends")
    every_ms: int = whole("from one step to the next", 1, 10_000)
    by_ma: float = number("by how much the current falls and rises", 0, 1000)


@dataclass(frozen=True, kw_only=True)
class GripperCurrent:
    """The motor current that the gripper follows, instead of closing, holding and ramping."""

    at_s: tuple[float, ...] = numbers(
        "times of its points, rising; the current is linear between them", 0, LONGEST_S, (1, 1000),
        order="strictly rising",
    )  # fmt: skip
    ma: tuple[float, ...] = numbers("current at each of them, closing is positive", -1000, 1000, (1, 1000))
    square: SquareWave | None = table(SquareWave)

    COLUMNS: ClassVar = ("at_s", "ma")

    @property
    def ends_s(self) -> float:
        """When the last point is reached."""
        return self.at_s[-1]

    def at(self, time_s: float) -> float:
        """The current in mA at a time; that of the first and the last point before and after them."""
        current_ma = float(np.interp(time_s, self.at_s, self.ma))
        square = self.square
        if square is not None and square.from_s <= time_s < square.to_s:
            current_ma -= square.by_ma * (int((time_s - square.from_s) * 1e3 + 1e-6) // square.every_ms % 2)
        return current_ma


@dataclass(frozen=True, kw_only=True)
class SecondFingerSettings:
    """The second finger's gel, at which no camera looks, where it is no mirror image of the first."""

    friction_factor: float = number("its static and kinetic friction over those of the first", 0, 100, default=1.0)
    stiffness_factor: float = number("its shear and normal modulus over those of the first", 0.01, 100, default=1.0)

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """The gripper in this scene; what is not named is as on the sensor's own gripper."""

    start_factor: tuple[float, float] = between(
        "range of the normal force at the start over that at the slip limit", None, 1000, above=0, default=(2.0, 2.0)
    )
    start_more_n: float = number("normal force beyond start_factor times that at the slip limit", 0, 1000, default=0.0)
    friction_factor: tuple[float, float] = between(
        "factor on the gear's friction, or its range", None, 1000, above=0, or_one=True, default=(1.0, 1.0)
    )
    backlash_ticks: float | None = number(
        "lost motion between motor and finger, in ticks of the gripper: after a reversal the finger stays until the"
        " motor has gone so far",
        0,
        50,
        default=None,
        only_in=GRIPPED,
    )
    encoder_noise_ticks: float | None = number(
        "standard deviation of what the encoder reads about the motor's place, anew in each ms; the servo and the"
        " controller read it",
        0,
        50,
        default=None,
        only_in=GRIPPED,
    )
    command_delay_ms: float | None = number(
        "a command takes effect so much later (USB, bus, servo), in whole ms, rounded up",
        0,
        1000,
        default=None,
        only_in=GRIPPED,
    )
    command_jitter_ms: float | None = number(
        "and later by a random time up to this, uniform, anew for each command; none overtakes another",
        0,
        1000,
        default=None,
        only_in=GRIPPED,
    )
    open_ticks: float = number(
        "how far the gripper is open at the start", None, 400, above=0, default=0.0, needed_in=("hold",)
    )
    close_s: float = duration("when the gripper starts to close", default=0.0)
    grip_s: float = duration("when the gripper changes from closing to its holding current", default=0.0)
    ramp_s: float = duration("when the current starts to fall", default=0.0)
    current: GripperCurrent | None = table(GripperCurrent, only_in=("hold",))
    second_finger: SecondFingerSettings | None = table(SecondFingerSettings, only_in=GRIPPED)


@dataclass(frozen=True, kw_only=True)
class Randomised:
    """What is drawn anew for each trial, and from which ranges."""

    static_friction: tuple[float, float] = between(
        "range of the factor on the object's static friction", None, 1000, above=0, default=(1.0, 1.0)
    )
    kinetic_share: tuple[float, float] = between(
        "range of kinetic over static friction", None, 1000, above=0, default=(1.0, 1.0)
    )
    stribeck_mm_s: tuple[float, float] = between(
        "range of the slip speed at which friction falls from static to kinetic",
        None,
        1000,
        above=0,
        default=(10.0, 10.0),
    )
    mass: tuple[float, float] = between(
        "range of the factor on the object's mass", None, 1000, above=0, default=(1.0, 1.0)
    )
    kinetic_share_spread: float | None = number(
        "an object keeps a kinetic share of its own in all trials; that of a trial lies this far from it at most",
        0,
        1,
        default=None,
    )
    touch_mm: float = number(
        "the object is touched this far from the middle of the pad at most, along gravity and across",
        0,
        10,
        default=0.0,
    )
    lever_mm: float = number(
        "standard deviation of the centre of mass's place across gravity, from where a flat object is touched; round"
        " ones are touched on their axis",
        0,
        100,
        default=0.0,
    )
    tilt_deg: tuple[float, float] = between("range of the misalignment of the fingers", -5, 5, default=(0.0, 0.0))
    memory_um: float = number(
        "distance over which friction follows the slip speed; 20 is a guess, none is known for this gel; 0: at once",
        0,
        1000,
        default=20.0,
    )


@dataclass(frozen=True, kw_only=True)
class Texture:
    """The texture of the object, seen through the window."""

    log_sd: tuple[float, float] = between(
        "range of the standard deviation of the log brightness", None, 1000, above=0, default=(0.06, 0.06)
    )
    half_correlation_px: tuple[float, float] = between(
        "range of the distance at which the brightness is half correlated", None, 1000, above=0, default=(12.0, 12.0)
    )
    focus_mm: float = number(
        "the contrast fades with exp(-gap / focus) once the object is away from the gel",
        None,
        100,
        above=0,
        default=1.0,
    )
    show: bool = flag(
        "whether the window shows it; grasps leave it out, because no controller looks at the window", default=True
    )


@dataclass(frozen=True, kw_only=True)
class FallingWeight:
    """A weight that lands on the object in the balancing phase and stays."""

    mass_g: float = number("of the weight", None, 10_000, above=0)
    after_s: float = duration("from the start of the balancing phase")
    speed_m_s: float = number("of the weight when it lands", 0, 20)


@dataclass(frozen=True, kw_only=True)
class Floor:
    """Where an object that was let go comes to rest."""

    below_mm: tuple[float, float] = between(
        "range of the distance under the place where the object was held", None, 1000, above=0, default=(250.0, 250.0)
    )

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class Pushes:
    """Half sine pushes on the object along gravity."""

    at_s: tuple[float, ...] = numbers("when each push starts", 0, LONGEST_S, (0, 1000))
    lasts_s: float = number("how long each push lasts", None, 10_000, above=0)
    force_n: tuple[float, ...] = numbers("of each push at its most, positive along gravity", -100, 100, (0, 1000))

    COLUMNS: ClassVar = ("at_s", "force_n")


@dataclass(frozen=True, kw_only=True)
class ObjectChanges:
    """What is otherwise than in the row of the object that is grasped."""

    mass_g: float = number("of the object; the factor randomise.mass applies to it, too", 0.1, 100_000)


@dataclass(frozen=True, kw_only=True)
class FrictionChange:
    """Static and kinetic friction change in the whole contact at once, as on a wet patch."""

    at_s: float = duration("when, from the start of the recording")
    factor: float = number("friction after over friction before", 0, 100)


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """Light that flickers: brightness = mean * (1 + depth * sin(2 pi frequency t))."""

    frequency_hz: float = number("twice that of the mains: 100 or 120 Hz", 0.1, 400)
    depth: float = number("share of the mean brightness", None, 0.95, above=0)


@dataclass(frozen=True, kw_only=True)
class LightStep:
    """Light that changes at once."""

    at_s: float = duration("when, from the start of the recording")
    factor: float = number("brightness after over brightness before", 0.001, 1000)


@dataclass(frozen=True, kw_only=True)
class LightSettings:
    """Light that is not steady: the brightness of all pixels changes together; readout dvxplorer only."""

    flicker: Flicker | None = table(Flicker)
    step: LightStep | None = table(LightStep)

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class VanishingDots:
    """Dots whose ink comes off: the camera sees bare gel in their place."""

    dots: tuple[tuple[int, int], ...] = lists(
        "row and column of each",
        {"type": "array", "items": {"type": "integer", "minimum": 0, "maximum": 100}, "minItems": 2, "maxItems": 2},
        (1, 256),
        unique=True,
    )
    at_s: float = duration("when, from the start of the recording")


@dataclass(frozen=True, kw_only=True)
class CalibrationError:
    """A calibration that is off: the dots at rest in the recording are turned and moved against the true ones."""

    offset_px: tuple[float, float] = numbers(
        "by how much they are moved, along x and y", -20, 20, 2, default=(0.0, 0.0)
    )
    turned_deg: float = number("by how much they are turned about the middle of the frame", -5, 5, default=0.0)

    RULES: ClassVar[Rules] = {"minProperties": 1}


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


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What is simulated; only the parts that it names exist."""

    name: str = words("what recordings call the scene", 100, pattern="^[a-z][a-z0-9-]*$")
    kind: str = one_of("; ".join(f"{name}: {what}" for name, what in KINDS.items()), tuple(KINDS))
    summary: str = words("one line about the scene", 1000)
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
    calibration: CalibrationError | None = table(CalibrationError)
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
        """Whether the window shows a texture."""
        return self.gel.cut and self.texture is not None and self.texture.show
