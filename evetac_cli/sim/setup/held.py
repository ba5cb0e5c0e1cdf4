"""What a scene may say of its gripper, its hand, and what happens to the object that is held."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from evetac_cli.sim.setup.tables import (
    LONGEST_S,
    Rules,
    between,
    duration,
    flag,
    number,
    numbers,
    one_of,
    table,
    whole,
)

GRIPPED = ("ramp", "lift", "hold")  # kinds of scene in which a gripper holds an object


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
    """The second finger's gel, where it is no mirror image of the first; a camera looks at it where two are named."""

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
    start_n: float | None = number(
        "normal force at the start, the same for every object, in place of start_factor and start_more_n",
        None,
        1000,
        above=0,
        default=None,
        only_in=("ramp", "hold"),
    )
    friction_factor: tuple[float, float] = between(
        "factor on the gear's friction, or its range", None, 1000, above=0, or_one=True, default=(1.0, 1.0)
    )
    fall_factor: tuple[float, float] = between(
        "factor on how fast the ramp lets the current fall, or its range, from which each trial draws one, uniform in"
        " its logarithm",
        None,
        1000,
        above=0,
        or_one=True,
        default=(1.0, 1.0),
        only_in=("ramp", "hold"),
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
    open_s: float | None = duration(
        "when the servo opens the gripper to where it started, as fast as it can, in place of ramp_s",
        default=None,
        only_in=("hold",),
    )
    current: GripperCurrent | None = table(GripperCurrent, only_in=("hold",))
    second_finger: SecondFingerSettings | None = table(SecondFingerSettings, only_in=GRIPPED)


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
