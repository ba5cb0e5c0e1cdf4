"""Optional detector inputs in addition to the dots: finger position, finger command, and sticking share.

Per slice they are (extras,), in the order of EXTRAS, NaN for unknown ones. A slice has the values that were known at
its start, as a detector that runs next to a gripper knows them; offline, the last reading and command at or before its
start.

Goals in ticks and in mA are combined into one command. Otherwise a network would learn the difference between trials
that end in slip, under a falling current, and grasps, which have goals in ticks. A goal current is converted to the
ticks that press as hard.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import EXTRAS, IN_TICKS, DotArchitecture, ExtraView

# Conversion of a goal current: 0.40 N/mA of the servo over some 0.2 N per tick of further closing (both simulated; on a
# real gripper neither has been measured). An error within a factor of two hardly changes the network's input.
TICKS_PER_MA = 2.0
# Limit on changes in ticks: a change of the control mode is a step of 100 ticks, and one such step would set the
# normalisation of the input.
MOST_CHANGE = 10.0
UNKNOWN = np.full(len(EXTRAS), np.nan, np.float32)


def command_ticks(goal_ticks: float, goal_ma: float) -> float:
    """Return the command in the unit of EXTRAS from a goal position or a goal current; the other, or both, are NaN."""
    return goal_ma * TICKS_PER_MA if np.isnan(goal_ticks) else goal_ticks


def known_at_start(t_us: NDArray[np.int64], values: NDArray[np.number], slices: int) -> NDArray[np.float32]:
    """Return the last value, of rising times (rows,), at the start of each slice, (slices,); NaN before the first."""
    last = np.searchsorted(t_us, np.arange(slices, dtype=np.int64) * SLICE_US, side="right") - 1
    result = np.full(slices, np.nan, np.float32)
    result[last >= 0] = values[last[last >= 0]]
    return result


def columns(
    slices: int,
    position_ticks: NDArray[np.float32] | None = None,
    goal_ticks: NDArray[np.float32] | None = None,
    goal_ma: NDArray[np.float32] | None = None,
    sticking_share: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return extras (slices, extras) from quantities per slice, (slices,) each."""
    unknown = np.full(slices, np.nan, np.float32)
    all_columns = [unknown if each is None else each for each in (position_ticks, goal_ticks, goal_ma, sticking_share)]
    assert all(each.shape == (slices,) for each in all_columns)
    position, goal, current, sticking = all_columns
    command = np.where(np.isnan(goal), current * np.float32(TICKS_PER_MA), goal)
    return np.stack([position, command, sticking], axis=1).astype(np.float32)


def table(views: Sequence[ExtraView]) -> NDArray[np.int64]:
    """Return the views for `fill`, flat: per view its extra, newest or not, number of changes, and their lengths."""
    numbers: list[int] = []
    for view in views:
        numbers += [EXTRAS.index(view.extra), int(view.newest), len(view.changes_ms), *view.changes_ms]
    return np.array(numbers, np.int64)


def first_inputs(architecture: DotArchitecture) -> dict[str, slice]:
    """Return the inputs of a dot that belong to each extra of a network."""
    first, places = architecture.own_inputs, {}
    for view in architecture.extras:
        places[view.extra] = slice(first, first + view.width)
        first += view.width
    return places


def scaled_inputs(architecture: DotArchitecture) -> NDArray[np.bool_]:
    """Return which inputs of a dot, (inputs,), scale with the forces: all of its own, and changes in ticks."""
    scaled = np.arange(architecture.inputs_per_dot) < architecture.own_inputs
    for extra, place in first_inputs(architecture).items():
        if extra in IN_TICKS:
            scaled[place.start + 1 : place.stop] = True
    return scaled


def never_known(architecture: DotArchitecture, training_extras: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Return which inputs of a dot, (inputs,), belong to extras that are unknown in all training slices.

    The network has not learned their meaning and must not see them later, so its scale for them is 0.
    training_extras: (slices, extras), of all training slices.
    """
    unknown = np.zeros(architecture.inputs_per_dot, np.bool_)
    for extra, place in first_inputs(architecture).items():
        unknown[place] = training_extras is None or not np.isfinite(training_extras[:, EXTRAS.index(extra)]).any()
    return unknown


def learned(architecture: DotArchitecture, input_scale: NDArray[np.float32]) -> tuple[str, ...]:
    """Return the extras that a network has learned to use, from the scale of its inputs (inputs,)."""
    return tuple(extra for extra, place in first_inputs(architecture).items() if input_scale[place].any())


def leave_out(architecture: DotArchitecture, batch: NDArray[np.float32], left_out: NDArray[np.bool_]) -> None:
    """Set extras to unknown in inputs (samples, dots, inputs): of the gripper, and of the sticking share.

    left_out: (samples, 2).
    """
    for extra, place in first_inputs(architecture).items():
        batch[left_out[:, 0 if extra in IN_TICKS else 1], :, place] = 0.0


@njit(cache=True)
def fill(
    extras: NDArray[np.float32],
    ends: NDArray[np.int64],
    views: NDArray[np.int64],
    first: int,
    inputs: NDArray[np.float32],
) -> None:
    """Write the extras of a series (slices, extras), for samples that end at these slices, into inputs from `first` on.

    inputs: (samples, dots, inputs). views: from `table`. Nothing is checked.
    """
    for sample in range(ends.shape[0]):
        end, column, at = ends[sample], first, 0
        while at < views.shape[0]:
            extra, newest, changes = views[at], views[at + 1], views[at + 2]
            now = extras[end, extra]
            is_known = np.isfinite(now)
            for number in range(changes):
                is_known &= np.isfinite(extras[end - views[at + 3 + number], extra])
            for dot in range(inputs.shape[1]):
                inputs[sample, dot, column] = np.float32(is_known)
            column += 1
            for number in range(newest + changes):
                value = np.float32(0.0)
                if is_known:
                    value = now
                    if number >= newest:
                        value = now - extras[end - views[at + 3 + number - newest], extra]
                        value = min(max(value, np.float32(-MOST_CHANGE)), np.float32(MOST_CHANGE))
                for dot in range(inputs.shape[1]):
                    inputs[sample, dot, column] = value
                column += 1
            at += 3 + changes
