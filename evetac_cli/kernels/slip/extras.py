"""What a detector may be told beside the dots: where the fingers are, what they are commanded, which share sticks.

Of each slice (extras,), in the order of EXTRAS, NaN where one is not known. A slice is told what was known when it
began, as a detector that runs beside a gripper knows it: offline the last reading and command at or before its start.

Why one command for goals in ticks and in mA: which of them a gripper is given tells trials that end in slip, under a
falling current, from grasps, and a network would learn that. A goal current is told as the ticks that press as hard.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import EXTRAS, IN_TICKS, DotArchitecture, ExtraView

# Of a goal: 0.40 N/mA of the servo over some 0.2 N for each tick that fingers close further (simulated; neither is
# known of a real gripper). Within a factor of two the network is told the same.
TICKS_PER_MA = 2.0
# Beyond, changes are told as these: a change of mode is a step of 100 ticks, and one of it would set the scale of all.
MOST_CHANGE = 10.0
UNKNOWN = np.full(len(EXTRAS), np.nan, np.float32)


def command_ticks(goal_ticks: float, goal_ma: float) -> float:
    """What is commanded, as EXTRAS has it, from a goal position or a goal current; NaN for the other, or both."""
    return goal_ma * TICKS_PER_MA if np.isnan(goal_ticks) else goal_ticks


def known_at_start(t_us: NDArray[np.int64], values: NDArray[np.number], slices: int) -> NDArray[np.float32]:
    """The last of some values, of rising times (rows,), when each slice begins, (slices,); NaN before the first."""
    last = np.searchsorted(t_us, np.arange(slices, dtype=np.int64) * SLICE_US, side="right") - 1
    known = np.full(slices, np.nan, np.float32)
    known[last >= 0] = values[last[last >= 0]]
    return known


def columns(
    slices: int,
    position_ticks: NDArray[np.float32] | None = None,
    goal_ticks: NDArray[np.float32] | None = None,
    goal_ma: NDArray[np.float32] | None = None,
    sticking_share: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Extras (slices, extras) from what is known of each slice, (slices,) each; ValueError for other shapes."""
    unknown = np.full(slices, np.nan, np.float32)
    given = [unknown if each is None else each for each in (position_ticks, goal_ticks, goal_ma, sticking_share)]
    if any(each.shape != (slices,) for each in given):
        raise ValueError(f"expected {(slices,)} each, found {[each.shape for each in given]}")
    position, goal, current, sticking = given
    command = np.where(np.isnan(goal), current * np.float32(TICKS_PER_MA), goal)
    return np.stack([position, command, sticking], axis=1).astype(np.float32)


def table(views: Sequence[ExtraView]) -> NDArray[np.int64]:
    """The views for `fill`, flat: of each its extra, whether the newest, how many changes, and over how many slices."""
    numbers: list[int] = []
    for view in views:
        numbers += [EXTRAS.index(view.extra), int(view.newest), len(view.changes_ms), *view.changes_ms]
    return np.array(numbers, np.int64)


def first_inputs(architecture: DotArchitecture) -> dict[str, slice]:
    """Which inputs of a dot are of each extra that a network is told."""
    first, places = architecture.own_inputs, {}
    for view in architecture.extras:
        places[view.extra] = slice(first, first + view.width)
        first += view.width
    return places


def scaled_inputs(architecture: DotArchitecture) -> NDArray[np.bool_]:
    """Which inputs of a dot, (inputs,), grow with the forces: all of its own, and changes in ticks."""
    scaled = np.arange(architecture.inputs_per_dot) < architecture.own_inputs
    for extra, place in first_inputs(architecture).items():
        if extra in IN_TICKS:
            scaled[place.start + 1 : place.stop] = True
    return scaled


def never_known(architecture: DotArchitecture, told: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Which inputs of a dot, (inputs,), are of extras that no slice knows, of all that are trained on (slices, extras).

    A network has not learned what they mean, and must not see them when they are known one day: its scale of them is 0.
    """
    unknown = np.zeros(architecture.inputs_per_dot, np.bool_)
    for extra, place in first_inputs(architecture).items():
        unknown[place] = told is None or not np.isfinite(told[:, EXTRAS.index(extra)]).any()
    return unknown


def learned(architecture: DotArchitecture, input_scale: NDArray[np.float32]) -> tuple[str, ...]:
    """Which extras a network has learned to see, by what its inputs (inputs,) are multiplied by."""
    return tuple(extra for extra, place in first_inputs(architecture).items() if input_scale[place].any())


def leave_out(architecture: DotArchitecture, batch: NDArray[np.float32], left_out: NDArray[np.bool_]) -> None:
    """In inputs (samples, dots, inputs), make unknown what is left out of each sample: the gripper, what sticks.

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
    """Extras of a series (slices, extras), as seen at these slices, into inputs (samples, dots, inputs) from `first`.

    views: from `table`. Nothing is checked.
    """
    for sample in range(ends.shape[0]):
        end, column, at = ends[sample], first, 0
        while at < views.shape[0]:
            extra, newest, changes = views[at], views[at + 1], views[at + 2]
            now = extras[end, extra]
            known = np.isfinite(now)
            for number in range(changes):
                known &= np.isfinite(extras[end - views[at + 3 + number], extra])
            for dot in range(inputs.shape[1]):
                inputs[sample, dot, column] = np.float32(known)
            column += 1
            for number in range(newest + changes):
                value = np.float32(0.0)
                if known:
                    value = now
                    if number >= newest:
                        value = now - extras[end - views[at + 3 + number - newest], extra]
                        value = min(max(value, np.float32(-MOST_CHANGE)), np.float32(MOST_CHANGE))
                for dot in range(inputs.shape[1]):
                    inputs[sample, dot, column] = value
                column += 1
            at += 3 + changes
