"""One finger of the gripper: a geared servo with a wide band of dry friction, against the force of the held object.

Equation of motion of one finger from first touch, with its closing x in m (half the change of the gap):

    M x'' + b x' + Sgn(x') (Fc + fl N) contains  kF I - N(x),      |x'| <= speed limit

The motor current I is kp (goal - encoder) in position mode, or the command in current mode. The encoder and the goal
are whole ticks, the commanded current is whole mA. Because of the gear's friction the finger keeps its grip while the
current falls by 2 (Fc + fl N) / kF, and x = goal does not mean that the finger lets go.

Fc + fl N holds a finger at rest (slower than REST_M_S). A moving finger is resisted by kinetic_share times that
friction. Below 1 the gear breaks loose: it starts late, and then moves at once as far as the lower friction allows.

Backlash (backlash_ticks b, 0 unless a scene names it): the finger moves only as far as is necessary to stay within
b / 2 of the motor, whose position the encoder reads. After a reversal the finger stays, and with it the force on the
motor, until the motor has moved b. The encoder may be noisy, and commands may take effect late (scenes/finger_drive).

Each step is solved implicitly for the speed, with the force and friction at the end of the step. The equation is
monotone in the speed, also with backlash, so a bracketed Newton search always ends: for any stiffness, without damping
and without mass. Friction that falls at once does not change that. The speed before the step decides whether a finger
is at rest, and within the step the friction law is fixed.
"""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.contact import ForceCurve, closing_at, lookup
from evetac_cli.sim.setup.sensor import SensorGripper

Mode = Literal["position", "current"]

# ROBOTIS RH-P12-RN(A): two 57 mm four-bar fingers that start at 60 deg, 0.088 deg per tick (e-manual, URDF)
LINK_PAIR_M = 0.114
LINK_OFFSET_M = 0.0061
START_RAD = math.radians(60.0)
TICK_RAD = math.radians(0.088)
# A slower finger is at rest: it would take 8 s for a tick. A guess: how this gear comes to rest is unknown. After a
# step of 1 mA the standard finger is this slow within 0.26 s, longer than the paper's ramp takes from mA to mA.
REST_M_S = 1e-5


@dataclass(frozen=True)
class Drive:
    """Constants of one finger's drive.

    Fitted to the paper's grasp figures: force_per_current_n_ma, gain_ma_tick, friction_n, friction_share, damping_n_s_m
    and mass_kg. The figures identify only the friction and the product force_per_current * gain = 2.0 N/tick.

    friction_n and friction_share hold a finger at rest: two ticks are "just sufficient to make the gripper move"
    (paper, section VII-A). That the fingers then stop at "very light contact" suggests a kinetic_share near 1, the
    default.

    From the maker's manual: speed_limit_m_s (75 mm/s of gap), open_ticks, closed_ticks. The current limit is that of
    the paper's authors. backlash_ticks, of the whole gripper, has not been measured.
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
        check_range("friction_share", self.friction_share, 0.0, 1.0, below=True)  # at 1 the finger never opens
        check_range("kinetic_share", self.kinetic_share, 0.0, 1.0)
        check_range("open_ticks", self.open_ticks, 0.0, self.closed_ticks, below=True)


def make_drive(own: SensorGripper, friction_factor: float = 1.0, backlash_ticks: float = 0.0) -> Drive:
    """Return the drive of a sensor's gripper: `Drive` with the gripper's own values and the scene's factors.

    servo_n_tick (force_per_current * gain) and two_ticks_n (force of two ticks minus the friction) replace gain_ma_tick
    and friction_n, because they can be measured on a gripper; friction_factor then multiplies the friction. ValueError
    as from `Drive`.
    """
    drive = Drive(**{name: value for name in OF_DRIVE if (value := getattr(own, name)) is not None})
    if own.servo_n_tick is not None and own.two_ticks_n is not None:
        gain = own.servo_n_tick / drive.force_per_current_n_ma
        drive = replace(drive, gain_ma_tick=gain, friction_n=2 * own.servo_n_tick - own.two_ticks_n)
    friction_n = drive.friction_n * (friction_factor * own.friction_factor)
    return replace(drive, friction_n=friction_n, backlash_ticks=backlash_ticks)


# Keys of a sensor's gripper that replace values of `Drive`; its other keys do not belong to the drive.
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
    """State of a finger and its motor: positions past first touch (closing_ticks, motor_ticks) and the last results."""

    touch_ticks: float
    closing_ticks: float
    motor_ticks: float
    speed_m_s: float
    current_ma: float
    force_n: float
    indentation_m: float
    encoder_off_ticks: float = 0.0  # present error of the encoder
    # Drive, curve and touch_ticks of the last step, and the law that was built from them: it took half of a step.
    _cached_law: tuple[Drive, ForceCurve, float, "FingerLaw"] | None = field(default=None, repr=False, compare=False)

    def law(self, drive: Drive, curve: ForceCurve) -> "FingerLaw":
        """Return the constants for the compiled law, from a drive, the gap's geometry and the position of touch."""
        cached = self._cached_law
        if cached is None or cached[0] is not drive or cached[1] is not curve or cached[2] != self.touch_ticks:
            self._cached_law = cached = (drive, curve, self.touch_ticks, _law(drive, curve, self.touch_ticks))
        return cached[3]

    @property
    def position_ticks(self) -> int:
        """Return the encoder's reading: whole ticks of the gripper, 0 is open."""
        return math.floor(self.touch_ticks + self.motor_ticks + self.encoder_off_ticks)


def gap_m(position_ticks: float) -> float:
    """Return the gap between the fingers at a position, in m (four-bar link; 104.9 mm at 0, 0 at about 717 ticks)."""
    return LINK_PAIR_M * math.sin(START_RAD - TICK_RAD * position_ticks) + LINK_OFFSET_M


def ticks_at_gap(width_m: float) -> float:
    """Return the position in ticks at which the gap is width_m, so that an object of that width is first touched."""
    sine = (width_m - LINK_OFFSET_M) / LINK_PAIR_M
    if not (width_m >= 0.0 and sine <= math.sin(START_RAD)):
        raise ValueError(f"width_m must be within [0, 0.1048], found {width_m}")
    return (START_RAD - math.asin(sine)) / TICK_RAD


def metres_per_tick(width_m: float) -> float:
    """Return the change of the gap per tick in m, at a gap of width_m."""
    return LINK_PAIR_M * TICK_RAD * math.cos(START_RAD - TICK_RAD * ticks_at_gap(width_m))


def start(drive: Drive, curve: ForceCurve, touch_ticks: float, closing_ticks: float = -2.0) -> DriveState:
    """Return a finger at rest, closing_ticks past first touch at touch_ticks (negative: before touch).

    The motor is in the middle of its backlash.
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
    """Return a finger that closed slowly under a constant current and is at rest: N = (kF I - Fc) / (1 + fl) >= 0.

    Fc and fl are those of motion, kinetic_share times the friction at rest.
    """
    beyond_n = drive.force_per_current_n_ma * current_ma - drive.kinetic_share * drive.friction_n
    force_n = max(beyond_n, 0.0) / (1 + drive.kinetic_share * drive.friction_share)
    state = start(drive, curve, touch_ticks, closing_at(curve, force_n))
    state.current_ma = float(current_ma)
    state.motor_ticks += drive.backlash_ticks / 2  # the motor has pushed the finger there
    return state


def closing_push_n(drive: Drive, force_n: float) -> float:
    """Return the motor force in N at which a slowly closing finger comes to rest at a normal force of force_n."""
    kinetic = drive.kinetic_share
    return force_n * (1 + kinetic * drive.friction_share) + kinetic * drive.friction_n


def opening_push_n(drive: Drive, force_n: float, *, rests: bool = False) -> float:
    """Return the least motor force in N, mostly negative, at which a slowly opening finger keeps a normal force.

    rests: the finger has not begun to move.
    """
    kinetic = 1.0 if rests else drive.kinetic_share
    return force_n * (1 - kinetic * drive.friction_share) - kinetic * drive.friction_n


def step(state: DriveState, drive: Drive, curve: ForceCurve, mode: Mode, command: float, dt_s: float) -> float:
    """Move the finger for dt_s under a command and return its normal force in N at the end (also state.force_n).

    command: in position mode the goal in gripper ticks, rounded to whole ticks; in current mode the current in mA,
    rounded to whole mA. The servo reads its encoder once, at the start of the step. The finger stops at the end of the
    curve, so a curve that is too short shows as a force that stays at the curve's last value.
    """
    if not (math.isfinite(command) and math.isfinite(dt_s) and dt_s > 0):
        raise ValueError(f"command must be finite and dt_s finite and > 0, found {command} and {dt_s}")
    if mode == "position":
        wanted_ma = drive.gain_ma_tick * (round(command) - state.position_ticks)
    else:
        wanted_ma = float(round(command))
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


# The constants of one finger in `_move` are m per tick, friction in N and as a share of the force, and the kinetic
# share of both. Then damping, mass, highest speed, limits of closing, and half the backlash in ticks. A plain tuple,
# because a named tuple takes 1 us longer, of 4 us.
FingerLaw = tuple[float, float, float, float, float, float, float, float, float, float]


def _law(drive: Drive, curve: ForceCurve, touch_ticks: float) -> FingerLaw:
    """Return the constants for `_move` from a drive, the gap's geometry and the position of touch."""
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
    """Return the results of `_move`, and the normal force in N and the indentation in m."""
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
    """Return the speed (m/s) of one finger and the closing (ticks) of motor and finger after dt.

    Solves the implicit law with friction; `place` is the closing of motor and finger before the step.
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
    # with q = |speed|: the resistance rises with q, and at q = 0 it is below the drive
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
    """Return the positions of motor and finger, (steps,) each, in gripper ticks after each step in current mode.

    current_ma: (steps,), the current of each step of dt_s; not necessarily whole mA. Motor and finger start at rest,
    closing_ticks past touch_ticks. The law is that of `step`, in one call.
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
    """Return the closing of motor and finger in ticks, (steps,) each, after each step under a motor force in N."""
    motors, fingers = np.empty(len(motor_n)), np.empty(len(motor_n))
    motor, finger = place
    speed = 0.0
    for number in range(len(motor_n)):
        speed, motor, finger = _move((motor, finger), speed, motor_n[number], dt, force_table, step_ticks, law)
        motors[number], fingers[number] = motor, finger
    return motors, fingers


@njit(cache=True, _nrt=False)
def _follow(motor: float, finger: float, half_play: float) -> float:
    """Return the position of a finger after its motor moved: unchanged if within half the backlash of the motor."""
    return min(max(finger, motor - half_play), motor + half_play)
