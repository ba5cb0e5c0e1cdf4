"""One finger of the gripper: a geared servo with a wide band of dry friction, against the force of what it holds.

Law of one finger, closing x in metres (half the change of the gap), from first touch:

    M x'' + b x' + Sgn(x') (Fc + fl N) contains  kF I - N(x),      |x'| <= speed limit

with the motor current I = kp (goal - encoder) in position mode, or the command in current mode. The encoder and the
goal are whole ticks, the commanded current whole mA. Because the gear rubs, the finger keeps its grip while the
current falls by 2 (Fc + fl N) / kF, and x = goal does not mean letting go.

Fc + fl N holds a finger that rests, slower than REST_M_S; one that moves is resisted by kinetic_share of it. Below 1
the gear breaks loose: it starts late, and at once goes as far as the lower friction lets it.

Lost motion (backlash_ticks b, 0 unless a scene names it): the finger is where it was, moved no further than keeps it
within b / 2 of the motor, whose place the encoder reads. After a reversal it stays, and with it the force that the
motor feels, until the motor has gone b. The encoder may be noisy, and commands may take effect late (DelayedCommands).

Why so: each step is solved implicitly for the speed, force and friction at the end of the step included. The equation
is monotone in the speed, with lost motion too, so a bracketed Newton search always ends, for any stiffness, for no
damping and for no mass. Friction that falls at once does not spoil that: whether a finger rests is decided by its speed
before the step, and within the step there is one friction.
"""

import math
from collections import deque
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.contact import ForceCurve, closing_at, lookup
from evetac_cli.sim.setup.sensor import SensorGripper

Mode = Literal["position", "current"]

# ROBOTIS RH-P12-RN(A): two 57 mm four-bar fingers that start at 60 deg, 0.088 deg a tick (e-manual, URDF)
LINK_PAIR_M = 0.114
LINK_OFFSET_M = 0.0061
START_RAD = math.radians(60.0)
TICK_RAD = math.radians(0.088)
# A slower finger rests: it would take 8 s for a tick. A guess: nothing is known of how this gear comes to rest. After a
# step of 1 mA the usual finger is as slow in 0.26 s, longer than the paper's ramp takes from mA to mA.
REST_M_S = 1e-5


@dataclass(frozen=True)
class Drive:
    """Constants of one finger's drive.

    Fitted to the paper's grasp figures (only the product force_per_current * gain = 2.0 N/tick and the friction are
    identified by them): force_per_current_n_ma, gain_ma_tick, friction_n, friction_share, damping_n_s_m, mass_kg.
    friction_n and friction_share hold a finger that rests: two ticks are "just sufficient to make the gripper move"
    (paper, section VII-A). That they then stop at "very light contact" speaks for a kinetic_share near 1, the default.
    From the maker's manual: speed_limit_m_s (75 mm/s of gap), open_ticks, closed_ticks. The current limit is the one
    the paper's authors set. backlash_ticks, of the whole gripper, is no measured value.
    """

    force_per_current_n_ma: float = 0.40
    gain_ma_tick: float = 5.0
    friction_n: float = 3.87
    friction_share: float = 0.03
    kinetic_share: float = 1.0
    damping_n_s_m: float = 150.0
    mass_kg: float = 2.0
    speed_limit_m_s: float = 0.0375
    current_limit_ma: float = 661.0
    open_ticks: float = 0.0
    closed_ticks: float = 740.0
    backlash_ticks: float = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            above = entry.name in ("force_per_current_n_ma", "speed_limit_m_s")
            check_range(entry.name, getattr(self, entry.name), above=above)
        check_range("friction_share", self.friction_share, 0.0, 1.0, below=True)  # at 1 the finger could never open
        check_range("kinetic_share", self.kinetic_share, 0.0, 1.0)
        check_range("open_ticks", self.open_ticks, 0.0, self.closed_ticks, below=True)


def make_drive(own: SensorGripper, friction_factor: float = 1.0, backlash_ticks: float = 0.0) -> Drive:
    """The drive of a sensor's gripper: `Drive` but for what is its own and what a scene adds.

    servo_n_tick (force_per_current * gain) and two_ticks_n (what two ticks push beyond the friction) stand for
    gain_ma_tick and friction_n, because they are what a gripper shows; friction_factor then multiplies the friction.
    ValueError as from `Drive`.
    """
    drive = Drive(**{name: value for name in OF_DRIVE if (value := getattr(own, name)) is not None})
    if own.servo_n_tick is not None and own.two_ticks_n is not None:
        gain = own.servo_n_tick / drive.force_per_current_n_ma
        drive = replace(drive, gain_ma_tick=gain, friction_n=2 * own.servo_n_tick - own.two_ticks_n)
    friction_n = drive.friction_n * (friction_factor * own.friction_factor)
    return replace(drive, friction_n=friction_n, backlash_ticks=backlash_ticks)


# What a sensor may say of its gripper's drive, each in place of the usual value; its other keys are no part of it.
OF_DRIVE = (
    "force_per_current_n_ma",
    "gain_ma_tick",
    "friction_n",
    "friction_share",
    "kinetic_share",
    "damping_n_s_m",
    "mass_kg",
    "speed_limit_m_s",
    "current_limit_ma",
)


@dataclass
class DriveState:
    """Where a finger and its motor are past first touch (closing_ticks, motor_ticks), and what the last step left."""

    touch_ticks: float
    closing_ticks: float
    motor_ticks: float
    speed_m_s: float
    current_ma: float
    force_n: float
    indentation_m: float
    encoder_off_ticks: float = 0.0  # what the encoder is off by at this moment
    # Drive, curve and touch_ticks of the last step, and the law that followed from them, which took half of a step.
    _known: tuple[Drive, ForceCurve, float, "FingerLaw"] | None = field(default=None, repr=False, compare=False)

    def law(self, drive: Drive, curve: ForceCurve) -> "FingerLaw":
        """What the compiled law is handed of a drive, of the gap's geometry and of where the object is touched."""
        known = self._known
        if known is None or known[0] is not drive or known[1] is not curve or known[2] != self.touch_ticks:
            self._known = known = (drive, curve, self.touch_ticks, _law(drive, curve, self.touch_ticks))
        return known[3]

    @property
    def position_ticks(self) -> int:
        """What the encoder reads: whole ticks of the gripper, 0 open."""
        return math.floor(self.touch_ticks + self.motor_ticks + self.encoder_off_ticks)


class DelayedCommands:
    """The way of commands to the motor: each takes effect some time after it was given, and none overtakes another."""

    def __init__(
        self, first: tuple[Mode, float], delay_slices: float, jitter_slices: float, rng: np.random.Generator
    ) -> None:
        """Start with a command in effect; a later one comes after the delay and a random part of the jitter."""
        self._delay, self._jitter, self._rng = delay_slices, jitter_slices, rng
        self._in_effect = self._given = first
        self._on_the_way: deque[tuple[float, tuple[Mode, float]]] = deque()

    def at(self, slice_number: int, given: tuple[Mode, float]) -> tuple[Mode, float]:
        """The command in effect in a slice, for which one was given; a command that is given again is no new one."""
        if given != self._given:
            self._given = given
            arrives = slice_number + self._delay + self._jitter * self._rng.uniform()
            if self._on_the_way:
                arrives = max(arrives, self._on_the_way[-1][0])
            self._on_the_way.append((arrives, given))
        while self._on_the_way and self._on_the_way[0][0] <= slice_number:
            self._in_effect = self._on_the_way.popleft()[1]
        return self._in_effect


def gap_m(position_ticks: float) -> float:
    """Gap between the fingers at a position of the gripper (four-bar link; 104.9 mm at 0, 0 at about 717 ticks)."""
    return LINK_PAIR_M * math.sin(START_RAD - TICK_RAD * position_ticks) + LINK_OFFSET_M


def ticks_at_gap(width_m: float) -> float:
    """Position in ticks at which the fingers are width_m apart: where an object of that width is first touched."""
    sine = (width_m - LINK_OFFSET_M) / LINK_PAIR_M
    if not (width_m >= 0.0 and sine <= math.sin(START_RAD)):
        raise ValueError(f"width_m must be within [0, 0.1048], found {width_m}")
    return (START_RAD - math.asin(sine)) / TICK_RAD


def metres_per_tick(width_m: float) -> float:
    """How much one tick changes the gap between the fingers, in m, where they are width_m apart."""
    return LINK_PAIR_M * TICK_RAD * math.cos(START_RAD - TICK_RAD * ticks_at_gap(width_m))


def start(drive: Drive, curve: ForceCurve, touch_ticks: float, closing_ticks: float = -2.0) -> DriveState:
    """A finger at rest, closing_ticks past first touch (negative: before it), which lies at touch_ticks.

    The motor is in the middle of its lost motion.
    """
    if not drive.open_ticks <= touch_ticks + closing_ticks <= drive.closed_ticks:
        raise ValueError(
            f"the finger must start within [{drive.open_ticks:g}, {drive.closed_ticks:g}] ticks,"
            f" found {touch_ticks:g} + {closing_ticks:g}"
        )
    force_n = lookup(curve.force_n, curve.step_ticks, closing_ticks)
    indentation_m = lookup(curve.indentation_m, curve.step_ticks, closing_ticks)
    return DriveState(float(touch_ticks), float(closing_ticks), float(closing_ticks), 0.0, 0.0, force_n, indentation_m)


def closed_with(drive: Drive, curve: ForceCurve, touch_ticks: float, current_ma: float) -> DriveState:
    """A finger that closed slowly under a constant current and rests: N = (kF I - Fc) / (1 + fl), 0 at the least.

    Fc and fl are those of motion, kinetic_share of the friction at rest.
    """
    beyond_n = drive.force_per_current_n_ma * current_ma - drive.kinetic_share * drive.friction_n
    force_n = max(beyond_n, 0.0) / (1 + drive.kinetic_share * drive.friction_share)
    state = start(drive, curve, touch_ticks, closing_at(curve, force_n))
    state.current_ma = float(current_ma)
    state.motor_ticks += drive.backlash_ticks / 2  # it has pushed the finger there
    return state


def closing_push_n(drive: Drive, force_n: float) -> float:
    """Push of the motor in N with which a finger that closes slowly comes to rest at a normal force of force_n."""
    kinetic = drive.kinetic_share
    return force_n * (1 + kinetic * drive.friction_share) + kinetic * drive.friction_n


def opening_push_n(drive: Drive, force_n: float, *, rests: bool = False) -> float:
    """Push of the motor in N, mostly negative, down to which a finger that opens slowly keeps a normal force.

    rests: of a finger that has not begun to move.
    """
    kinetic = 1.0 if rests else drive.kinetic_share
    return force_n * (1 - kinetic * drive.friction_share) - kinetic * drive.friction_n


def step(state: DriveState, drive: Drive, curve: ForceCurve, mode: Mode, command: float, dt_s: float) -> float:
    """Move the finger for dt_s under a command and return its normal force in N at the end (also state.force_n).

    command: the goal in ticks of the gripper in position mode, rounded to whole ticks; the current in mA in current
    mode, rounded to whole mA. The servo reads its encoder once, at the start of the step. The finger stops where the
    curve ends, so that a curve too short shows as a force that stays at the curve's last.
    """
    if not (math.isfinite(command) and math.isfinite(dt_s) and dt_s > 0):
        raise ValueError(f"command must be finite and dt_s finite and > 0, found {command} and {dt_s}")
    if mode == "position":
        wanted_ma = drive.gain_ma_tick * (round(command) - state.position_ticks)
    elif mode == "current":
        wanted_ma = float(round(command))
    else:
        raise ValueError(f"mode must be position or current, found {mode!r}")
    state.current_ma = min(max(wanted_ma, -drive.current_limit_ma), drive.current_limit_ma)
    motor_n = drive.force_per_current_n_ma * state.current_ma
    place = (state.motor_ticks, state.closing_ticks)
    (
        state.speed_m_s,
        state.motor_ticks,
        state.closing_ticks,
        state.force_n,
        state.indentation_m,
    ) = _press(
        place,
        state.speed_m_s,
        motor_n,
        dt_s,
        curve.force_n,
        curve.indentation_m,
        curve.step_ticks,
        state.law(drive, curve),
    )
    return state.force_n


# The constants of one finger in `_move`: metres a tick, friction in N and as a share of the force, what of both resists
# one that moves, damping, mass, highest speed, the ends of its closing and half its lost motion in ticks. Why so: a
# plain tuple, as a named one takes 1 us more, of 4.
FingerLaw = tuple[float, float, float, float, float, float, float, float, float, float]


def _law(drive: Drive, curve: ForceCurve, touch_ticks: float) -> FingerLaw:
    """What `_move` is handed of a drive, of the gap's geometry and of where the object is touched."""
    return (
        curve.metres_per_tick / 2,  # each finger moves half the gap
        drive.friction_n,
        drive.friction_share,
        drive.kinetic_share,
        drive.damping_n_s_m,
        drive.mass_kg,
        drive.speed_limit_m_s,
        drive.open_ticks - touch_ticks,
        min(drive.closed_ticks - touch_ticks, curve.reach_ticks),
        drive.backlash_ticks / 2,
    )


@njit(cache=True, _nrt=False)
def _press(
    place: tuple[float, float],
    speed: float,
    motor_n: float,
    dt: float,
    force_table: NDArray[np.float64],
    indentation_table: NDArray[np.float64],
    step_ticks: float,
    law: FingerLaw,
) -> tuple[float, float, float, float, float]:
    """What `_move` returns, and the normal force in N and the indentation in m that follow."""
    speed, motor, finger = _move(place, speed, motor_n, dt, force_table, step_ticks, law)
    return (
        speed,
        motor,
        finger,
        lookup(force_table, step_ticks, finger),
        lookup(indentation_table, step_ticks, finger),
    )


@njit(cache=True, _nrt=False)
def _move(
    place: tuple[float, float],
    speed: float,
    motor_n: float,
    dt: float,
    force_table: NDArray[np.float64],
    step_ticks: float,
    law: FingerLaw,
) -> tuple[float, float, float]:
    """Speed (m/s) of one finger and closing (ticks) of motor and finger after dt, from the implicit law with friction.

    `place` is the closing of both before.
    """
    metres_per_tick, friction_n, friction_share, kinetic, damping, mass, speed_limit, lowest, highest, half_play = law
    motor, finger = place
    held_n = lookup(force_table, step_ticks, finger)
    drive_n = mass / dt * speed + motor_n
    surplus_n = drive_n - held_n
    holding_n = friction_n + friction_share * held_n
    if abs(speed) > REST_M_S:
        holding_n *= kinetic
    if abs(surplus_n) <= holding_n:
        return 0.0, motor, finger
    friction_n, friction_share = kinetic * friction_n, kinetic * friction_share
    sign = 1.0 if surplus_n > 0.0 else -1.0
    # with q = |speed|: what resists the motion rises with q, and at q = 0 it is less than the drive
    slow = 0.0
    room_ticks = highest - motor if sign > 0.0 else motor - lowest
    fast = max(min(speed_limit, room_ticks * metres_per_tick / dt), 0.0)
    ticks_per_speed = dt / metres_per_tick
    q = fast
    for _ in range(60):
        moved = motor + sign * q * ticks_per_speed
        force = lookup(force_table, step_ticks, _follow(moved, finger, half_play))
        excess = (mass / dt + damping) * q + friction_n + (sign + friction_share) * force - sign * drive_n
        if excess <= 0.0:
            slow = q
        else:
            fast = q
        force_beyond = lookup(force_table, step_ticks, _follow(moved + sign * step_ticks, finger, half_play))
        slope = mass / dt + damping + (sign + friction_share) * (force_beyond - force) / step_ticks * ticks_per_speed
        newton = q - excess / slope if slope > 0.0 else slow
        if fast <= slow or abs(newton - q) <= 1e-14 * speed_limit:
            break
        q = newton if slow < newton < fast else 0.5 * (slow + fast)
    motor += sign * q * ticks_per_speed
    return sign * q, motor, _follow(motor, finger, half_play)


def places(
    drive: Drive,
    curve: ForceCurve,
    touch_ticks: float,
    closing_ticks: float,
    current_ma: NDArray[np.float64],
    dt_s: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places of motor and finger, (steps,) each, in ticks of the gripper after each step of dt_s in current mode.

    current_ma: (steps,), of each step; they need not be whole. Both start at rest, closing_ticks past touch_ticks. The
    same law as `step`, in one call.
    """
    law = _law(drive, curve, touch_ticks)
    motor_n = drive.force_per_current_n_ma * np.clip(current_ma, -drive.current_limit_ma, drive.current_limit_ma)
    motor, finger = _move_on((closing_ticks, closing_ticks), motor_n, dt_s, curve.force_n, curve.step_ticks, law)
    return touch_ticks + motor, touch_ticks + finger


@njit(cache=True)
def _move_on(
    place: tuple[float, float],
    motor_n: NDArray[np.float64],
    dt: float,
    force_table: NDArray[np.float64],
    step_ticks: float,
    law: FingerLaw,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Closing of motor and finger in ticks, (steps,) each, after each step under a force of the motor in N."""
    motors, fingers = np.empty(len(motor_n)), np.empty(len(motor_n))
    motor, finger = place
    speed = 0.0
    for number in range(len(motor_n)):
        speed, motor, finger = _move((motor, finger), speed, motor_n[number], dt, force_table, step_ticks, law)
        motors[number], fingers[number] = motor, finger
    return motors, fingers


@njit(cache=True, _nrt=False)
def _follow(motor: float, finger: float, half_play: float) -> float:
    """Where a finger comes to be that its motor leaves where it is, if that is within half the lost motion."""
    return min(max(finger, motor - half_play), motor + half_play)
