"""What a detector with memory sees of a contact: twenty numbers after every 5th slice, from dots, events and gripper.

`start`, then `step` with each slice; `over` does the same for many slices of a file. Both call one compiled function,
so that the numbers of a file and of a live camera are identical bits. LOAD_PATH (architectures.py) names the numbers.

Displacements are means over the 5 slices of a step. Reasons:
- Displacements are divided by their size, because friction has no scale: what counts is the shape of the field.
- An affine field is subtracted for `bent`. A contact that sticks everywhere stretches and turns the gel, and what is
  left over tells where it does not.
- Shear is compared with the largest since the contact began, because a gel that is unloaded and loaded again slips
  later than one that was loaded once.
- Features files have no rest positions, so a missing dot is one that has never moved.
"""

from collections.abc import Sequence
from math import exp, hypot, isnan, log, log1p, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import (
    LOAD_PATH,
    UNKNOWN_SENSITIVITY,
    MemoryArchitecture,
    Sensitivity,
    to_one_sensor,
)
from evetac_cli.kernels.slip.features import DOT_CAPACITY

EVERY = MemoryArchitecture.every  # slices of a step
# What is told of a slice, NaN for unknown: gripper, then sticking share and probability that slip has begun, both after
# the slice before.
TOLD = ("position_ticks", "goal_ticks", "goal_ma", "sticking_share", "slip_begun")
MM_PER_PX = 0.0329  # of the sensor `evetac`, whose frame is as long as any other's
SMALL_MM, USUAL_MM = 0.01, 0.1  # smallest and usual size of the displacements
USUAL_EVENTS = 50.0  # of all dots in a step
SMALL_SHEAR = 0.05  # added to the shear, relative to the usual size, before its logarithm
SMALL_MOTION = 1e-3  # the same for motion, relative to the size
MEANS_MS = (10, 30, 120)  # running means from which the motion of the dots is measured
# Share of the old value that a running mean keeps after a step.
KEPT = np.exp(-EVERY / np.array(MEANS_MS))
KEPT_20_MS, KEPT_200_MS = exp(-EVERY / 20), exp(-EVERY / 200)
LEAST_SHARE = 1 / (1 + exp(9))  # log odds are limited to +-9
ODDS_SCALE, NO_ODDS = 3.0, -5.0  # of log odds, and their value without contact
POSITION_STEPS = (2, 6, 20)  # steps back to which the position is compared
CURRENT_STEPS = 4
MOST_TICKS, MOST_AHEAD, MOST_MA = 8.0, 40.0, 50.0  # limits of changes and of the distance to the goal
AHEAD_SCALE = MA_SCALE = 10.0
FLAT = 1e-9  # determinant of the grid, relative to the product of its diagonal, below which it is a line

STATE = np.dtype(
    [
        ("dots", np.int64),
        ("columns", np.int64),  # of dots; they are stored row by row
        ("slices", np.int64),  # number so far
        ("mm_per_px", np.float64),
        ("stiffness", np.float64),  # modulus over that of the sensor `evetac`
        ("events_factor", np.float64),
        ("events", np.float64),  # of all dots since the last step
        ("most_shear_mm", np.float64),  # since the contact began
        ("bent_mm", np.float64),  # running mean over 20 ms
        ("shear_mm", np.float64, 2),  # running means over 20 and 200 ms
        ("sum_px", np.float64, (DOT_CAPACITY, 2)),  # displacements since the last step
        ("mean_mm", np.float64, (len(MEANS_MS), DOT_CAPACITY, 2)),  # running means
        ("told", np.float32, len(TOLD)),  # of the next slice
        ("position_ticks", np.float32, POSITION_STEPS[-1]),  # of the last steps, a ring
        ("current_ma", np.float32, CURRENT_STEPS),
        ("numbers", np.float32, len(LOAD_PATH)),  # of the last step
        ("touches", np.uint8),  # whether there was contact then
        ("there", np.uint8, DOT_CAPACITY),  # 1: has moved, so it is not missing
    ],
    align=True,
)


class LoadPath(NamedTuple):
    """The numbers after every 5th slice of a trajectory from its start, (steps, LOAD_PATH), and which of them touch.

    slices: length of the trajectory, 5 per step, and up to 4 more.
    """

    numbers: NDArray[np.float32]
    touches: NDArray[np.bool_]
    slices: int


class LoadPathState:
    """State after the slices so far: `record`, an array of one STATE, and views of its main fields.

    `step` changes the record in place; numbers and touches are those of the last step.
    """

    __slots__ = ("numbers", "record", "told")

    def __init__(self, record: NDArray[np.void]) -> None:
        assert record.dtype == STATE and record.shape == (1,) and record.flags.writeable
        self.record = record
        self.numbers: NDArray[np.float32] = record["numbers"][0]
        self.told: NDArray[np.float32] = record["told"][0]

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the record, so that the views of a copy belong to its own record."""
        return LoadPathState, (self.record.copy(),)

    @property
    def touches(self) -> bool:
        """Whether there was contact at the last step."""
        return bool(self.record["touches"][0])


def start(
    dot_shape: tuple[int, int],
    sensor: Sensitivity = UNKNOWN_SENSITIVITY,
    frame_px: Sequence[int] | NDArray[np.integer] = FRAME_PX,
) -> LoadPathState:
    """Start before the first slice, for rows and columns of dots in a frame (width, height)."""
    rows, columns = dot_shape
    assert 0 < rows * columns <= DOT_CAPACITY
    record = np.zeros(1, STATE)
    record["dots"], record["columns"] = rows * columns, columns
    record["mm_per_px"] = MM_PER_PX * (max(FRAME_PX) / max(frame_px))
    record["stiffness"], record["events_factor"] = to_one_sensor(sensor)
    for name in ("told", "position_ticks", "current_ma"):
        record[name] = np.nan
    # Compiles or loads the kernel now instead of in the first slice; on a copy, so that it does not count as a slice.
    none = np.zeros((rows * columns, 2), np.float32)
    take_slice(record.copy(), none, np.zeros(rows * columns, np.int32))
    return LoadPathState(record)


def step(
    state: LoadPathState, displacement_px: NDArray[np.float32], events_per_dot: NDArray[np.integer], *told: float
) -> bool:
    """Add one slice: displacements (dots, 2), 0 for a missing dot, events (dots,), and what is TOLD of it.

    Return whether a step ended, with new `numbers`.
    """
    assert displacement_px.shape == (state.record["dots"][0], 2) and events_per_dot.shape == displacement_px.shape[:1]
    state.told[:] = told
    ended: bool = take_slice(state.record, displacement_px, events_per_dot)
    return ended


def over(
    state: LoadPathState,
    displacement_px: NDArray[np.float32],
    events_per_dot: NDArray[np.integer],
    told: NDArray[np.float32],
) -> LoadPath:
    """Add slices: displacements (slices, dots, 2), events (slices, dots) and TOLD (slices, 5); return their steps."""
    slices, dots = events_per_dot.shape
    assert dots == state.record["dots"][0] and displacement_px.shape == (slices, dots, 2)
    assert told.shape == (slices, len(TOLD)) and told.dtype == np.float32
    steps = int(state.record["slices"][0] % EVERY + slices) // EVERY
    numbers, touches = np.empty((steps, len(LOAD_PATH)), np.float32), np.empty(steps, np.bool_)
    _take_slices(state.record, displacement_px, events_per_dot, told, numbers, touches)
    return LoadPath(numbers, touches, slices)


def joined(parts: Sequence[LoadPath]) -> LoadPath:
    """Return consecutive parts of a trajectory as one."""
    numbers = np.concatenate([np.empty((0, len(LOAD_PATH)), np.float32), *(part.numbers for part in parts)])
    touches = np.concatenate([np.empty(0, np.bool_), *(part.touches for part in parts)])
    return LoadPath(numbers, touches, sum(part.slices for part in parts))


@njit(cache=True)
def _take_slices(
    record: NDArray[np.void],
    displacement_px: NDArray[np.float32],
    events_per_dot: NDArray[np.integer],
    told: NDArray[np.float32],
    numbers: NDArray[np.float32],
    touches: NDArray[np.bool_],
) -> None:
    state, place = record[0], 0
    next_told = state["told"][:]
    for k in range(displacement_px.shape[0]):
        next_told[:] = told[k]
        if take_slice(record, displacement_px[k], events_per_dot[k]):
            numbers[place] = state["numbers"][:]
            touches[place] = state["touches"] != 0
            place += 1


@njit(cache=True)
def take_slice(
    record: NDArray[np.void], displacement_px: NDArray[np.float32], events_per_dot: NDArray[np.integer]
) -> bool:
    """Do the work of `step`, unchecked, for compiled code; record: of a `LoadPathState`, with what is told."""
    state = record[0]
    sum_px, there = state["sum_px"][:], state["there"][:]
    for dot in range(state["dots"]):
        x_px, y_px = displacement_px[dot, 0], displacement_px[dot, 1]
        if x_px != 0 or y_px != 0:
            there[dot] = 1
        sum_px[dot, 0] += x_px
        sum_px[dot, 1] += y_px
        state["events"] += events_per_dot[dot]
    state["slices"] += 1
    if state["slices"] % EVERY:
        return False
    _see_dots(record)
    _see_told(record)
    return True


@njit(cache=True)
def _see_dots(record: NDArray[np.void]) -> None:
    """Write the numbers of dots and events, and begin the next step."""
    state = record[0]
    dots, first = state["dots"], state["slices"] == EVERY
    sum_px, there, numbers, told = state["sum_px"][:], state["there"][:dots], state["numbers"][:], state["told"][:]
    moved_mm = np.empty((dots, 2))
    for dot in range(dots):
        for axis in range(2):
            moved_mm[dot, axis] = sum_px[dot, axis] * state["mm_per_px"] / EVERY
            sum_px[dot, axis] = 0.0
    x_mm, y_mm = _mean(moved_mm, there)
    shear, size = hypot(x_mm, y_mm), max(_rms(moved_mm, there), SMALL_MM)
    bent = _bent(moved_mm, there, state["columns"])
    state["touches"] = not isnan(told[3])
    state["most_shear_mm"] = max(state["most_shear_mm"], shear) if state["touches"] else 0.0
    shears, means = state["shear_mm"][:], state["mean_mm"][:]
    state["bent_mm"] = bent if first else _followed(state["bent_mm"], bent, KEPT_20_MS)
    shears[0] = shear if first else _followed(shears[0], shear, KEPT_20_MS)
    shears[1] = shear if first else _followed(shears[1], shear, KEPT_200_MS)
    numbers[0] = log(size / USUAL_MM)
    numbers[1] = log(state["stiffness"] * shear / USUAL_MM + SMALL_SHEAR)
    numbers[2] = shear / (state["most_shear_mm"] + SMALL_MM)
    numbers[3] = bent / size
    numbers[4] = (bent - state["bent_mm"]) / size
    numbers[5] = (shear - shears[0]) / size
    numbers[6] = (shear - shears[1]) / size
    off_mm = np.empty((dots, 2))
    for place in range(len(KEPT)):
        for dot in range(dots):
            for axis in range(2):
                now = moved_mm[dot, axis]
                mean = now if first else _followed(means[place, dot, axis], now, KEPT[place])
                means[place, dot, axis] = mean
                off_mm[dot, axis] = now - mean
        numbers[7 + place] = log(_rms(off_mm, there) / size + SMALL_MOTION)
    numbers[10] = log1p(state["events"] * state["events_factor"] / USUAL_EVENTS)
    numbers[11] = log(state["stiffness"])
    state["events"] = 0.0


@njit(cache=True)
def _see_told(record: NDArray[np.void]) -> None:
    """Write the numbers of the sticking network and the gripper; unknown ones are 0."""
    state = record[0]
    numbers, told, at = state["numbers"][:], state["told"][:], state["slices"] // EVERY
    numbers[12] = _odds(1.0 - told[3])
    numbers[13] = _odds(told[4])
    position, goal, current = np.float64(told[0]), np.float64(told[1]), np.float64(told[2])
    positions, currents = state["position_ticks"][:], state["current_ma"][:]
    numbers[14] = 0.0 if isnan(position) else 1.0
    for place in range(len(POSITION_STEPS)):
        before = positions[(at - POSITION_STEPS[place]) % len(positions)]
        numbers[15 + place] = _limited(position - before, MOST_TICKS)
    numbers[18] = _limited(goal - position, MOST_AHEAD) / AHEAD_SCALE
    numbers[19] = _limited(current - currents[at % len(currents)], MOST_MA) / MA_SCALE
    positions[at % len(positions)] = position
    currents[at % len(currents)] = current


@njit(cache=True)
def _mean(values: NDArray[np.float64], there: NDArray[np.uint8]) -> tuple[float, float]:
    x = y = count = 0.0
    for dot in range(len(values)):
        if there[dot]:
            x += values[dot, 0]
            y += values[dot, 1]
            count += 1.0
    return x / max(count, 1.0), y / max(count, 1.0)


@njit(cache=True)
def _rms(values: NDArray[np.float64], there: NDArray[np.uint8]) -> float:
    total = count = 0.0
    for dot in range(len(values)):
        if there[dot]:
            total += values[dot, 0] ** 2 + values[dot, 1] ** 2
            count += 1.0
    return sqrt(total / max(count, 1.0))


@njit(cache=True)
def _bent(moved: NDArray[np.float64], there: NDArray[np.uint8], columns: int) -> float:
    """Return the root mean square of what an affine field over the grid, fitted to the dots, leaves over."""
    row = column = count = 0.0
    for dot in range(len(moved)):
        if there[dot]:
            row += dot // columns
            column += dot % columns
            count += 1.0
    row, column = row / max(count, 1.0), column / max(count, 1.0)
    x, y = _mean(moved, there)
    rows = both = across = 0.0
    sums = np.zeros((2, 2))  # of the products of displacement, right and down, with row and column
    for dot in range(len(moved)):
        if there[dot]:
            down, right = dot // columns - row, dot % columns - column
            rows, both, across = rows + down * down, both + down * right, across + right * right
            for axis in range(2):
                off = moved[dot, axis] - (x, y)[axis]
                sums[axis, 0] += off * down
                sums[axis, 1] += off * right
    determinant = rows * across - both * both
    left = np.zeros_like(moved)
    for axis in range(2):
        by_row = by_column = 0.0
        if determinant > FLAT * rows * across:
            by_row = (across * sums[axis, 0] - both * sums[axis, 1]) / determinant
            by_column = (rows * sums[axis, 1] - both * sums[axis, 0]) / determinant
        for dot in range(len(moved)):
            affine = (x, y)[axis] + by_row * (dot // columns - row) + by_column * (dot % columns - column)
            left[dot, axis] = moved[dot, axis] - affine
    left_over: float = _rms(left, there)
    return left_over


@njit(cache=True)
def _followed(mean: float, value: float, kept: float) -> float:
    return (1.0 - kept) * value + kept * mean


@njit(cache=True)
def _odds(share: float) -> float:
    """Return scaled log odds."""
    if isnan(share):
        return NO_ODDS / ODDS_SCALE
    known = min(max(share, LEAST_SHARE), 1.0 - LEAST_SHARE)
    return log(known / (1.0 - known)) / ODDS_SCALE


@njit(cache=True)
def _limited(value: float, most: float) -> float:
    return 0.0 if isnan(value) else min(max(value, -most), most)
