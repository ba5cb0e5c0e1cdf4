"""Settings of the gripper and the hand of a scene, and of the disturbances that act on the held object."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from evetac_cli.sim.setup.tables import (
    STRICTLY_RISING,
    Large,
    Positive,
    Range,
    Seconds,
    Table,
    UpTo100,
    UpTo1000,
    kinds,
)

GRIPPED = ("ramp", "lift", "hold")  # kinds of scene in which a gripper holds an object
OF_GRIPPER = kinds(*GRIPPED)
LIFT = kinds("lift", needed=("lift",))
Ticks = Annotated[float, Meta(ge=0, le=50)]


@dataclass(frozen=True, kw_only=True)
class HandJerk(Table):
    """A jerk of the hand: a half-sine pulse of speed, added to its motion."""

    #: start of the pulse, from the start of the recording
    at_s: Seconds
    #: peak speed of the pulse, positive upwards
    speed_mm_s: Annotated[float, Meta(ge=-1000, le=1000)]
    #: duration of the pulse
    lasts_s: Annotated[float, Meta(ge=0.002, le=10)]

    def at(self, now_s: float) -> float:
        """Return the speed that the jerk adds to the hand's upward speed at a time, in m/s."""
        since_s = now_s - self.at_s
        if not 0.0 < since_s < self.lasts_s:
            return 0.0
        return self.speed_mm_s * 1e-3 * math.sin(math.pi * since_s / self.lasts_s)


@dataclass(frozen=True, kw_only=True)
class HandVibration(Table):
    """Vibration, along gravity, of the robot that carries the gripper: a sum of sine waves with random phases."""

    #: frequency of each sine wave
    frequency_hz: Annotated[tuple[Annotated[float, Meta(ge=1, le=200)], ...], Meta(min_length=1, max_length=16)]
    #: amplitude of each sine wave's acceleration
    acceleration_m_s2: Annotated[tuple[UpTo100, ...], Meta(min_length=1, max_length=16)]
    #: true: vibrates only during the planned rise; false: from the start of the recording
    only_moving: Annotated[bool, kinds("lift")] = False

    COLUMNS: ClassVar = ("frequency_hz", "acceleration_m_s2")


@dataclass(frozen=True, kw_only=True)
class HandSettings(Table):
    """The hand that carries the gripper."""

    #: distance that the hand rises
    height_mm: Annotated[Positive, LIFT] = 0.0
    #: largest speed of the hand
    speed_mm_s: Annotated[Positive, LIFT] = 1.0
    #: largest acceleration of the hand as it starts and stops
    acceleration_mm_s2: Annotated[float, Meta(gt=0, le=100_000), LIFT] = 1.0
    jerk: Annotated[HandJerk | None, kinds("lift")] = None
    #: speed profile of the hand. trapezoid: constant acceleration; s-curve: half a cosine that peaks at
    #: acceleration_mm_s2; steps: a trapezoid in the steps of a robot controller that updates its speed at 125 Hz
    profile: Annotated[Literal["trapezoid", "s-curve", "steps"], kinds("lift")] = "trapezoid"
    vibration: HandVibration | None = None

    NOT_EMPTY: ClassVar = True

    @property
    def is_still(self) -> bool:
        """Whether the hand never moves."""
        return self.height_mm == 0.0 and self.jerk is None and self.vibration is None


@dataclass(frozen=True, kw_only=True)
class SquareWave(Table):
    """A square wave that is added to the current for a while; its steps show how late commands take effect."""

    #: start of the square wave
    from_s: Seconds
    #: end of the square wave
    to_s: Seconds
    #: time from one step to the next
    every_ms: Annotated[int, Meta(ge=1, le=10_000)]
    #: height of each step: the current falls and rises by this
    by_ma: UpTo1000


@dataclass(frozen=True, kw_only=True)
class GripperCurrent(Table):
    """Motor current that the gripper follows instead of closing, holding and ramping down."""

    #: times of the current's points, rising; the current is linear between points
    at_s: Annotated[tuple[Seconds, ...], Meta(min_length=1, max_length=1000), STRICTLY_RISING]
    #: current at each time; positive closes the gripper
    ma: Annotated[tuple[Annotated[float, Meta(ge=-1000, le=1000)], ...], Meta(min_length=1, max_length=1000)]
    square: SquareWave | None = None

    COLUMNS: ClassVar = ("at_s", "ma")

    @property
    def ends_s(self) -> float:
        """Return the time of the last point, in s."""
        return self.at_s[-1]

    def __post_init__(self) -> None:
        """Check the square wave; ValueError if it is not within the times of the current."""
        super().__post_init__()
        square = self.square
        if square is not None and not square.from_s < square.to_s <= self.ends_s:
            raise ValueError(f"square: expected from_s < to_s <= {self.ends_s:g}, the last of at_s")

    def at(self, time_s: float) -> float:
        """Return the current at a time, in mA; it is constant before the first point and after the last."""
        current_ma = float(np.interp(time_s, self.at_s, self.ma))
        square = self.square
        if square is not None and square.from_s <= time_s < square.to_s:
            current_ma -= square.by_ma * (int((time_s - square.from_s) * 1e3 + 1e-6) // square.every_ms % 2)
        return current_ma


@dataclass(frozen=True, kw_only=True)
class SecondFingerSettings(Table):
    """The second finger's gel, if it differs from the first's; a camera views it if two sensors are named."""

    #: friction of the second finger's gel relative to the first's
    friction_factor: UpTo100 = 1.0
    #: shear and normal modulus of the second finger's gel relative to the first's
    stiffness_factor: Annotated[float, Meta(ge=0.01, le=100)] = 1.0

    NOT_EMPTY: ClassVar = True


@dataclass(frozen=True, kw_only=True)
class GripperSettings(Table):
    """The gripper in this scene; values that are left out come from the sensor's own gripper."""

    #: normal force at the start, as a factor on the force at the slip limit, or its range
    start_factor: Range[Positive] = (2.0, 2.0)
    #: normal force that is added to start_factor times the force at the slip limit
    start_more_n: UpTo1000 = 0.0
    #: normal force at the start, the same for every object; replaces start_factor and start_more_n
    start_n: Annotated[Positive | None, kinds("ramp", "hold")] = None
    #: factor on the gear friction of the gripper, or its range
    friction_factor: Range[Positive] = (1.0, 1.0)
    #: factor on the rate at which the ramp lowers the current, or its range; each trial draws from the range,
    #: uniformly in the logarithm
    fall_factor: Annotated[Range[Positive], kinds("ramp", "hold")] = (1.0, 1.0)
    #: backlash between motor and finger, in gripper ticks: after a reversal the finger stays until the motor has moved
    #: this far
    backlash_ticks: Annotated[Ticks | None, OF_GRIPPER] = None
    #: standard deviation of the encoder's position noise, drawn every ms; both the servo and the controller read the
    #: noisy position
    encoder_noise_ticks: Annotated[Ticks | None, OF_GRIPPER] = None
    #: delay until a command takes effect (USB, bus, servo), rounded up to whole ms
    command_delay_ms: Annotated[UpTo1000 | None, OF_GRIPPER] = None
    #: random extra delay, uniform from 0 to this and drawn for each command; no command overtakes another
    command_jitter_ms: Annotated[UpTo1000 | None, OF_GRIPPER] = None
    #: opening of the gripper at the start, in ticks
    open_ticks: Annotated[float, Meta(gt=0, le=400), kinds(needed=("hold",))] = 0.0
    #: time at which the gripper starts to close
    close_s: Seconds = 0.0
    #: time at which the gripper changes from closing to its holding current
    grip_s: Seconds = 0.0
    #: time at which the current starts to fall
    ramp_s: Seconds = 0.0
    #: time at which the servo opens the gripper to its initial opening, as fast as it can; replaces ramp_s
    open_s: Annotated[Seconds | None, kinds("hold")] = None
    current: Annotated[GripperCurrent | None, kinds("hold")] = None
    second_finger: Annotated[SecondFingerSettings | None, OF_GRIPPER] = None

    def __post_init__(self) -> None:
        """Check the times; ValueError if the gripper opens before it has gripped."""
        super().__post_init__()
        if self.open_s is not None and self.open_s <= self.grip_s:
            raise ValueError(f"open_s: expected a time after grip_s, {self.grip_s:g} s, found {self.open_s:g} s")


@dataclass(frozen=True, kw_only=True)
class FallingWeight(Table):
    """A weight that lands on the object during the balancing phase and stays there."""

    #: mass of the weight
    mass_g: Large
    #: time of the impact, from the start of the balancing phase
    after_s: Seconds
    #: speed of the weight at the impact
    speed_m_s: Annotated[float, Meta(ge=0, le=20)]


@dataclass(frozen=True, kw_only=True)
class Floor(Table):
    """The floor on which a dropped object comes to rest."""

    #: range of the distance from the object, as held, down to the floor
    below_mm: Range[Positive] = (250.0, 250.0)

    NOT_EMPTY: ClassVar = True


@dataclass(frozen=True, kw_only=True)
class Pushes(Table):
    """Half-sine pushes on the object, along gravity."""

    #: start of each push
    at_s: Annotated[tuple[Seconds, ...], Meta(max_length=1000)]
    #: duration of each push
    lasts_s: Large
    #: peak force of each push, positive along gravity
    force_n: Annotated[tuple[Annotated[float, Meta(ge=-100, le=100)], ...], Meta(max_length=1000)]

    COLUMNS: ClassVar = ("at_s", "force_n")

    def at(self, now_s: float) -> float:
        """Return the force along gravity at a time, in N."""
        forces = [
            force_n * float(np.sin(np.pi * (now_s - at) / self.lasts_s))
            for at, force_n in zip(self.at_s, self.force_n, strict=True)
            if at <= now_s < at + self.lasts_s
        ]
        return float(sum(forces))


@dataclass(frozen=True, kw_only=True)
class ObjectChanges(Table):
    """Values that replace those of the grasped object."""

    #: mass of the object; the factor randomise.mass also applies to it
    mass_g: Annotated[float, Meta(ge=0.1, le=100_000)]
