"""The drive of a gripper, fitted to its rows: a simulated drive is moved by the measured currents to match positions.

All quantities are in terms of current: without a scale no force is known, and the drive's equations (sim/gripper.py),
divided by the force per current, contain only currents. Fitted are the gear's friction, damping and mass, the closing
beyond first touch as a function of current (by fingers and gel), backlash, and the position of first touch.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from evetac_cli.arrays import Floats
from evetac_cli.sim import gripper
from evetac_cli.sim.gel.contact import ForceCurve

STEP_S = 1e-3
MOVED_TICKS = 4.0  # distance that the gripper has to close before it touches, and to open again
MOST_MA = 400.0
CURVE_STEP_TICKS = 0.05
CLOSING_MA = np.concatenate([np.linspace(0.0, 1.0, 21) ** 2 * 4.0, np.geomspace(4.4, MOST_MA, 60)])
NAMES = (
    *("friction_ma", "damping_ma_s_m", "mass_ma_s2_m", "finger_ticks_ma"),
    *("gel_ticks", "backlash_ticks", "touch_ticks", "first_ticks"),
)
LOG = 4  # number of parameters, the first ones, that are fitted by their logarithm
STARTS_MA_S_M = (150.0, 400.0)  # initial values of the damping
BLOCK_MS, BLOCK_ROWS = 20.0, 10  # block over which positions are averaged
COUNTED_MS = 60.0  # rows used after a new current; while the gripper still moves, rows are used for longer
REST_MS = 30  # left out at both ends of a rest, where the motor may still move
SCALES = np.array([0.05, 0.3, 0.5, 0.1, 1.0, 1.0, 2.0, 0.5])  # of the parameters as fitted
LARGE_TICKS = 1.0  # larger residuals have less weight


@dataclass(frozen=True)
class GripperRows:
    """Time in us, commanded and measured current in mA, and position in ticks, one row per command."""

    time_us: NDArray[np.int64]
    commanded_ma: Floats
    measured_ma: Floats
    place_ticks: NDArray[np.int64]


class DriveFit(NamedTuple):
    """The fitted parameters with their standard deviations from the residuals; forces are in mA of the motor.

    residual_ticks: rms residual of the position. rests: readings during each rest of the fitted motor.
    force_ma: normal force in each ms, starting at the first row.
    """

    values: dict[str, float]
    sd: dict[str, float]
    residual_ticks: float
    rests: list[NDArray[np.int64]]
    force_ma: Floats


def fit(rows: GripperRows) -> DriveFit:
    """Fit the drive; ValueError unless the rows show a gripper that closes on an object and opens again."""
    place = rows.place_ticks.astype(np.float64)
    current_ma, at = _each_step(rows)
    start = _start(rows, place)
    block = _blocks(rows)
    counted = block >= 0
    in_block = np.bincount(block[counted])

    def residuals(parameters: Floats) -> Floats:
        motor = _simulated(_by_name(parameters), current_ma)[0]
        off: Floats = np.bincount(block[counted], (motor[at] - 0.5 - place)[counted]) / in_block
        return off

    touch, first = start["touch_ticks"], start["first_ticks"]
    low = [*np.log([0.3, 5.0, 0.05, 0.05]), 0.0, 0.0, touch - 60.0, first - 2.0]
    high = [*np.log([200.0, 1e4, 200.0, 10.0]), 20.0, 20.0, touch + 60.0, first + 2.0]
    how: dict[str, Any] = {"loss": "soft_l1", "f_scale": LARGE_TICKS, "diff_step": 1e-3, "x_scale": SCALES}
    tries = []
    for damping in STARTS_MA_S_M:
        values = {**start, "damping_ma_s_m": damping}
        guess = [np.log(values[name]) if k < LOG else values[name] for k, name in enumerate(NAMES)]
        tries.append(least_squares(residuals, np.clip(guess, low, high), bounds=(low, high), max_nfev=40, **how))
    best = min(tries, key=lambda one: one.cost)
    off = residuals(best.x)
    sd = _spread(best.jac, off)
    values = _by_name(best.x)
    spread = {name: float(sd[k]) * (values[name] if k < LOG else 1.0) for k, name in enumerate(NAMES)}
    motor, force_ma = _simulated(values, current_ma)
    return DriveFit(values, spread, float(np.sqrt(np.mean(off**2))), _rests(motor, at, rows), force_ma)


def _each_step(rows: GripperRows) -> tuple[Floats, NDArray[np.intp]]:
    """Return the current in each step, starting at the first row, and the step after which each row was read."""
    at = np.round((rows.time_us - rows.time_us[0]) / (1e6 * STEP_S)).astype(np.intp)
    steps = np.arange(at[-1] + 1)
    row = np.minimum(
        np.searchsorted(at, steps), len(at) - 1
    )  # measured at the end of a step, so also valid for the step before
    return rows.measured_ma[row], at


def _start(rows: GripperRows, place: Floats) -> dict[str, float]:
    """Return initial values, from the current at which the gripper begins to move and the distance it moves."""
    if len(place) < 1000:
        raise ValueError("fewer than 1000 rows")
    first = float(np.median(place[:20]))
    moved = np.flatnonzero(place - first >= MOVED_TICKS)
    if not len(moved):
        raise ValueError("the gripper never closes")
    friction_ma = float(rows.measured_ma[moved[0]])
    if friction_ma <= 0.5:
        raise ValueError("the current does not close the gripper")
    # The position at rest under the largest current, and the time when the current is so low that it opens.
    top = int(np.argmax(rows.measured_ma))
    tops = np.flatnonzero(rows.measured_ma >= rows.measured_ma[top] - 0.5)
    pressed = float(np.median(place[tops[len(tops) // 4 :]]))
    later = place[tops[0] :]
    if not (later <= pressed - MOVED_TICKS).any():
        raise ValueError("the gripper never opens again")
    push_ma = max(float(rows.measured_ma[top]) - friction_ma, 1.0)
    # At half of the push the fingers have closed about half as far: the closing branch of the loops.
    return {
        "first_ticks": first + 0.5,
        "friction_ma": friction_ma,
        "damping_ma_s_m": STARTS_MA_S_M[0],
        "mass_ma_s2_m": 6.0,
        "gel_ticks": 1.0,
        "finger_ticks_ma": 1.3,
        "backlash_ticks": 1.0,
        "touch_ticks": pressed - 1.3 * push_ma - push_ma ** (2 / 3),
    }


def _blocks(rows: GripperRows) -> NDArray[np.intp]:
    """Return the block number of each row, -1 for none: blocks of BLOCK_MS for some time after each new current.

    A mean over a block is less noisy than a reading, and rests of several seconds would outweigh everything else. A
    change of current is taken from the commands, because the measured current is noisy and changes in every row.
    """
    time_ms = rows.time_us * 1e-3
    new = np.diff(rows.commanded_ma, prepend=np.nan) != 0.0
    since_ms = time_ms - time_ms[np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))]
    moving = np.abs(rows.place_ticks - np.roll(rows.place_ticks, BLOCK_ROWS)) >= 3
    counted = (since_ms <= COUNTED_MS) | moving
    _, block = np.unique(np.where(counted, np.floor(time_ms / BLOCK_MS), -1.0), return_inverse=True)
    numbers: NDArray[np.intp] = block.reshape(-1) - (0 if counted.all() else 1)
    return numbers


def _simulated(values: dict[str, float], current_ma: Floats) -> tuple[Floats, Floats]:
    """Return the motor's position in ticks and the normal force in mA after each step of STEP_S.

    values: parameters by their NAMES.
    """
    closing = values["gel_ticks"] * CLOSING_MA ** (2 / 3) + values["finger_ticks_ma"] * CLOSING_MA
    ticks = np.arange(0.0, min(closing[-1], 300.0), CURVE_STEP_TICKS)
    force_ma = np.interp(ticks, closing, CLOSING_MA)
    touch = values["touch_ticks"]
    pitch_m = gripper.metres_per_tick(min(max(gripper.gap_m(touch), 0.0), 0.104))
    curve = ForceCurve(CURVE_STEP_TICKS, pitch_m, force_ma, np.zeros(len(ticks)))
    drive = gripper.Drive(
        force_per_current_n_ma=1.0,
        friction_n=values["friction_ma"],
        damping_n_s_m=values["damping_ma_s_m"],
        mass_kg=values["mass_ma_s2_m"],
        backlash_ticks=values["backlash_ticks"],
        current_limit_ma=1e6,
    )
    motor, finger = gripper.places(drive, curve, touch, values["first_ticks"] - touch, current_ma, STEP_S)
    return motor, np.interp(finger - touch, ticks, force_ma)


def _by_name(parameters: Floats) -> dict[str, float]:
    return {
        name: float(np.exp(value) if k < LOG else value)
        for k, (name, value) in enumerate(zip(NAMES, parameters, strict=True))
    }


def _spread(jacobian: Floats, off: Floats) -> Floats:
    """Return the standard deviation of each parameter, assuming independent residuals."""
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    spread: Floats = np.sqrt(np.maximum(np.diag(inverse), 0.0) * np.mean(off**2))  # rounding may make it negative
    return spread


def _rests(motor: Floats, at: NDArray[np.intp], rows: GripperRows) -> list[NDArray[np.int64]]:
    """Return the readings of each time in which the fitted motor does not move, without REST_MS at both ends."""
    moved = np.flatnonzero(np.diff(motor, prepend=np.nan, append=np.nan) != 0)
    rests = []
    for first, last in zip(moved[:-1], moved[1:], strict=True):
        inside = (at >= first + REST_MS) & (at < last - REST_MS)
        if inside.any():
            rests.append(rows.place_ticks[inside])
    return rests
