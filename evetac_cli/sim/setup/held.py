"""Settings of the gripper and the hand of a scene, and of the disturbances that act on the held object."""

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
    """A jerk of the hand: a half-sine pulse of speed, added to its motion."""

    at_s: float = duration("start of the pulse, from the start of the recording")
    speed_mm_s: float = number("peak speed of the pulse, positive upwards", -1000, 1000)
    lasts_s: float = number("duration of the pulse", 0.002, 10)


@dataclass(frozen=True, kw_only=True)
class HandVibration:
    """Vibration, along gravity, of the robot that carries the gripper: a sum of sine waves with random phases."""

    frequency_hz: tuple[float, ...] = numbers("frequency of each sine wave", 1, 200, (1, 16))
    acceleration_m_s2: tuple[float, ...] = numbers("amplitude of each sine wave's acceleration", 0, 100, (1, 16))
    only_moving: bool = flag(
        "true: vibrates only during the planned rise; false: from the start of the recording",
        default=False,
        only_in=("lift",),
    )

    COLUMNS: ClassVar = ("frequency_hz", "acceleration_m_s2")


@dataclass(frozen=True, kw_only=True)
class HandSettings:
    """The hand that carries the gripper."""

    height_mm: float = number(
        "distance that the hand rises", None, 1000, above=0, default=0.0, needed_in=("lift",), only_in=("lift",)
    )
    speed_mm_s: float = number(
        "largest speed of the hand", None, 1000, above=0, default=1.0, needed_in=("lift",), only_in=("lift",)
    )
    acceleration_mm_s2: float = number(
        "largest acceleration of the hand as it starts and stops",
        None,
        100_000,
        above=0,
        default=1.0,
        needed_in=("lift",),
        only_in=("lift",),
    )
    jerk: HandJerk | None = table(HandJerk, only_in=("lift",))
    profile: str = one_of(
        "speed profile of the hand. trapezoid: constant acceleration; s-curve: half a cosine that peaks at"
        " acceleration_mm_s2; steps: a trapezoid in the steps of a robot controller that updates its speed at 125 Hz",
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
    """A square wave that is added to the current for a while; its steps show how late commands take effect."""

    from_s: float = duration("start of the square wave")
    to_s: float = duration("end of the square wave")
    every_ms: int = whole("time from one step to the next", 1, 10_000)
    by_ma: float = number("height of each step: the current falls and rises by this", 0, 1000)


@dataclass(frozen=True, kw_only=True)
class GripperCurrent:
    """Motor current that the gripper follows instead of closing, holding and ramping down."""

    at_s: tuple[float, ...] = numbers(
        "times of the current's points, rising; the current is linear between points", 0, LONGEST_S, (1, 1000),
        order="strictly rising",
    )  # fmt: skip
    ma: tuple[float, ...] = numbers("current at each time; positive closes the gripper", -1000, 1000, (1, 1000))
    square: SquareWave | None = table(SquareWave)

    COLUMNS: ClassVar = ("at_s", "ma")

    @property
    def ends_s(self) -> float:
        """Return the time of the last point, in s."""
        return self.at_s[-1]

    def at(self, time_s: float) -> float:
        """Return the current at a time, in mA; it is constant before the first point and after the last."""
        current_ma = float(np.interp(time_s, self.at_s, self.ma))
        square = self.square
        if square is not None and square.from_s <= time_s < square.to_s:
            current_ma -= square.by_ma * (int((time_s - square.from_s) * 1e3 + 1e-6) // square.every_ms % 2)
        return current_ma


@dataclass(frozen=True, kw_only=True)
class SecondFingerSettings:
    """The second finger's gel, if it differs from the first's; a camera views it if two sensors are named."""

    friction_factor: float = number("friction of the second finger's gel relative to the first's", 0, 100, default=1.0)
    stiffness_factor: float = number(
        "shear and normal modulus of the second finger's gel relative to the first's", 0.01, 100, default=1.0
    )

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """The gripper in this scene; values that are left out come from the sensor's own gripper."""

    start_factor: tuple[float, float] = between(
        "normal force at the start, as a factor on the force at the slip limit, or its range",
        None,
        1000,
        above=0,
        default=(2.0, 2.0),
    )
    start_more_n: float = number(
        "normal force that is added to start_factor times the force at the slip limit", 0, 1000, default=0.0
    )
    start_n: float | None = number(
        "normal force at the start, the same for every object; replaces start_factor and start_more_n",
        None,
        1000,
        above=0,
        default=None,
        only_in=("ramp", "hold"),
    )
    friction_factor: tuple[float, float] = between(
        "factor on the gear friction of the gripper, or its range", None, 1000, above=0, or_one=True, default=(1.0, 1.0)
    )
    fall_factor: tuple[float, float] = between(
        "factor on the rate at which the ramp lowers the current, or its range; each trial draws from the range,"
        " uniformly in the logarithm",
        None,
        1000,
        above=0,
        or_one=True,
        default=(1.0, 1.0),
        only_in=("ramp", "hold"),
    )
    backlash_ticks: float | None = number(
        "backlash between motor and finger, in gripper ticks: after a reversal the finger stays until the motor has"
        " moved this far",
        0,
        50,
        default=None,
        only_in=GRIPPED,
    )
    encoder_noise_ticks: float | None = number(
        "standard deviation of the encoder's position noise, drawn every ms; both the servo and the controller read the"
        " noisy position",
        0,
        50,
        default=None,
        only_in=GRIPPED,
    )
    command_delay_ms: float | None = number(
        "delay until a command takes effect (USB, bus, servo), rounded up to whole ms",
        0,
        1000,
        default=None,
        only_in=GRIPPED,
    )
    command_jitter_ms: float | None = number(
        "random extra delay, uniform from 0 to this and drawn for each command; no command overtakes another",
        0,
        1000,
        default=None,
        only_in=GRIPPED,
    )
    open_ticks: float = number(
        "opening of the gripper at the start, in ticks", None, 400, above=0, default=0.0, needed_in=("hold",)
    )
    close_s: float = duration("time at which the gripper starts to close", default=0.0)
    grip_s: float = duration("time at which the gripper changes from closing to its holding current", default=0.0)
    ramp_s: float = duration("time at which the current starts to fall", default=0.0)
    open_s: float | None = duration(
        "time at which the servo opens the gripper to its initial opening, as fast as it can; replaces ramp_s",
        default=None,
        only_in=("hold",),
    )
    current: GripperCurrent | None = table(GripperCurrent, only_in=("hold",))
    second_finger: SecondFingerSettings | None = table(SecondFingerSettings, only_in=GRIPPED)


@dataclass(frozen=True, kw_only=True)
class FallingWeight:
    """A weight that lands on the object during the balancing phase and stays there."""

    mass_g: float = number("mass of the weight", None, 10_000, above=0)
    after_s: float = duration("time of the impact, from the start of the balancing phase")
    speed_m_s: float = number("speed of the weight at the impact", 0, 20)


@dataclass(frozen=True, kw_only=True)
class Floor:
    """The floor on which a dropped object comes to rest."""

    below_mm: tuple[float, float] = between(
        "range of the distance from the object, as held, down to the floor",
        None,
        1000,
        above=0,
        default=(250.0, 250.0),
    )

    RULES: ClassVar[Rules] = {"minProperties": 1}


@dataclass(frozen=True, kw_only=True)
class Pushes:
    """Half-sine pushes on the object, along gravity."""

    at_s: tuple[float, ...] = numbers("start of each push", 0, LONGEST_S, (0, 1000))
    lasts_s: float = number("duration of each push", None, 10_000, above=0)
    force_n: tuple[float, ...] = numbers("peak force of each push, positive along gravity", -100, 100, (0, 1000))

    COLUMNS: ClassVar = ("at_s", "force_n")


@dataclass(frozen=True, kw_only=True)
class ObjectChanges:
    """Values that replace those of the grasped object."""

    mass_g: float = number("mass of the object; the factor randomise.mass also applies to it", 0.1, 100_000)
