"""What a scene is: the tables of its TOML file, which name the parts that exist and the ranges a trial is drawn from.

Behind the door (scene_file.py) nothing asks a scene by string: a table that is not named is None, or one of defaults.
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
    "ramp": "gripper in current mode, starts held",
    "lift": "position mode, starts open over a table",
    "hold": "starts open, closes, the object is pushed and let slip",
    "press": "a face driven over the gel, no gripper",
    "rub": "an object with visible edges that a hand rubs over the gel",
    "tone": "a speaker on the gel, linear response, no gripper",
}


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
class GelSettings:
    """The gel in this scene."""

    cut: bool = flag("true: the last dot column is cut out and makes room for the window")
    sideways: bool = flag("grasped from the side: gravity along +y of the image", default=False)
    stiffness_factor: float = number(
        "factor on the shear and normal modulus of the sensor's gel", 0.01, 100, default=1.0
    )


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
    memory_um: tuple[float, float] = between(
        "distance over which friction follows the slip speed, or its range; none is known for this gel, the package's"
        " scenes have 50; 0: at once",
        0,
        1000,
        or_one=True,
        default=(20.0, 20.0),
    )
    pressure_exponent: tuple[float, float] = between(
        "friction under a pressure p goes with p^(1 - this), or its range: 0 in proportion, 1 not at all; all nodes"
        " together hold mu N whatever it is",
        0,
        1,
        or_one=True,
        default=(0.0, 0.0),
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
class Flash:
    """Pulses of light that does not pass the print: dots get brighter, bare gel hardly does."""

    every_s: float = number("from one to the next; the first comes so long after the start", 0.05, 3600)
    brightness: tuple[float, ...] = numbers(
        "of its pulses, over that of bare gel; each lasts for a slice, and they are a slice apart", 0.001, 1000, (1, 8)
    )


@dataclass(frozen=True, kw_only=True)
class LightSettings:
    """Light that is not steady, or does not pass the print; readout dvxplorer only."""

    flicker: Flicker | None = table(Flicker)
    step: LightStep | None = table(LightStep)
    floor: float = number(
        "light that does not pass the print (scattered, or from within), over what the lamp gives bare gel; it neither"
        " flickers nor steps",
        0,
        1000,
        default=0.0,
    )
    flash: Flash | None = table(Flash)

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
class CalibrationOffset:
    """A calibration that is off: the dots at rest in the recording are turned and moved against the true ones."""

    offset_px: tuple[float, float] = numbers(
        "by how much they are moved, along x and y", -20, 20, 2, default=(0.0, 0.0)
    )
    turned_deg: float = number("by how much they are turned about the middle of the frame", -5, 5, default=0.0)

    RULES: ClassVar[Rules] = {"minProperties": 1}


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
        """Whether the window shows a texture."""
        return self.gel.cut and self.texture is not None and self.texture.show
