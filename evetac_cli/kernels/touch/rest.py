"""Whether the dots are at rest: for REST_MS no dot has moved by more than the error of its tracker.

`start`, then `step` with each slice's dots. Means over BLOCK_MS are compared with an anchor: the mean of the previous
rest, or the first block after motion. The limit on the motion common to all dots is wider than that on motion relative
to each other, because the common error of a tracker drifts.

An object that slides at constant speed moves no dot, so this counts as rest, too.
"""

import math

import numpy as np

from evetac_cli.arrays import Flags, Floats, Ints
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.touch.dot_motion import DotNoise

BLOCK_MS = 5  # ms per mean
REST_MS = 200
REST_BLOCKS = REST_MS // BLOCK_MS
# Changes within this many deviations of the tracker's error count as none: of each dot, and of all together. In 200 ms
# the errors in scripts/studies/sticking/trials.py change by 0.6 deviations. The limits leave room for the largest of
# 40 blocks in most rests; chosen by judgement.
OWN, COMMON = 1.6, 2.0
LEAST_DOTS = 4  # tracked dots: with fewer, the state is never rest


class RestState:
    """State after the slices so far; `step` changes it.

    seen_mm: (dots, 2), last tracked position of each dot. block_mm: mean of the last whole block. rest_mm: mean of the
    last rest. rested: slice at its end, -1 before the first. rests: whether it continues.
    """

    def __init__(self, at_mm: Floats, noise: DotNoise) -> None:
        """For dots expected at (dots, 2)."""
        self.noise = noise
        self.slices = 0
        self.seen_mm = np.where(np.isfinite(at_mm), at_mm, 0.0)
        self.block_mm = self.seen_mm.copy()
        self.rest_mm = self.seen_mm.copy()
        self.rested = -1
        self.rests = False
        self.tracked: Flags = np.zeros(len(at_mm), np.bool_)  # in all slices of the last whole block
        self._sum_mm = np.zeros_like(self.seen_mm)
        self._counted = np.zeros(len(at_mm), np.int64)
        self._anchor_mm = self.seen_mm.copy()
        self._since_anchor_mm = np.zeros_like(self.seen_mm)
        self._blocks = 0  # number within the tolerance of the anchor


def start(at_mm: Floats, noise: DotNoise = DotNoise()) -> RestState:  # noqa: B008 - it is constant
    """Start with dots expected at (dots, 2) in mm, a row of NaN for a missing dot."""
    assert at_mm.ndim == 2 and at_mm.shape[1] == 2 and not np.isinf(at_mm).any()
    return RestState(np.array(at_mm, np.float64), noise)


def step(state: RestState, dot_mm: Floats, lost: Flags) -> bool:
    """Add the dots (dots, 2) of the next slice; return whether a block has ended with it.

    Dots that are lost (dots,) or not finite keep their last position.
    """
    assert dot_mm.shape == state.seen_mm.shape and lost.shape == state.tracked.shape
    _add(dot_mm, lost, state.seen_mm, state._sum_mm, state._counted)
    state.slices += 1
    if state.slices % BLOCK_MS:
        return False
    tracked = _end_block(state._sum_mm, state._counted, state.block_mm, state.tracked)
    own, common = _change(state.block_mm, state._anchor_mm, state.tracked)
    noise = state.noise
    near = tracked >= LEAST_DOTS and own <= OWN * noise.own_mm and common <= COMMON * noise.common_mm
    if not near:
        state._anchor_mm[:] = state.block_mm
        state._since_anchor_mm[:] = 0.0
        state._blocks = 0
        state.rests = False
    state._since_anchor_mm += state.block_mm
    state._blocks += 1
    if state._blocks == REST_BLOCKS:
        np.divide(state._since_anchor_mm, REST_BLOCKS, out=state.rest_mm)
        state._anchor_mm[:] = state.rest_mm
        state._since_anchor_mm[:] = 0.0
        state._blocks = 0
        state.rests = tracked >= LEAST_DOTS
        state.rested = state.slices - 1 if state.rests else state.rested
    return True


@njit(cache=True, _nrt=False)
def _add(dot_mm: Floats, lost: Flags, seen_mm: Floats, sum_mm: Floats, counted: Ints) -> None:
    for dot in range(len(dot_mm)):
        x, y = dot_mm[dot, 0], dot_mm[dot, 1]
        if not lost[dot] and math.isfinite(x) and math.isfinite(y):
            seen_mm[dot, 0] = x
            seen_mm[dot, 1] = y
            counted[dot] += 1
        sum_mm[dot, 0] += seen_mm[dot, 0]
        sum_mm[dot, 1] += seen_mm[dot, 1]


@njit(cache=True, _nrt=False)
def _end_block(sum_mm: Floats, counted: Ints, block_mm: Floats, tracked: Flags) -> int:
    """Compute the mean of a block and which dots were tracked throughout, and start the next. Return their number."""
    count = 0
    for dot in range(len(sum_mm)):
        for axis in range(2):
            block_mm[dot, axis] = sum_mm[dot, axis] / BLOCK_MS
            sum_mm[dot, axis] = 0.0
        tracked[dot] = counted[dot] == BLOCK_MS
        count += tracked[dot]
        counted[dot] = 0
    return count


@njit(cache=True, _nrt=False)
def _change(now_mm: Floats, before_mm: Floats, tracked: Flags) -> tuple[float, float]:
    """Return the motion of dots relative to each other, rms per axis, and the larger component of their mean motion."""
    count = 0
    x = y = square = 0.0
    for dot in range(len(now_mm)):
        if tracked[dot]:
            away_x = now_mm[dot, 0] - before_mm[dot, 0]
            away_y = now_mm[dot, 1] - before_mm[dot, 1]
            count += 1
            x += away_x
            y += away_y
            square += away_x * away_x + away_y * away_y
    if count == 0:
        return 0.0, 0.0
    x /= count
    y /= count
    return math.sqrt(max(0.5 * (square / count - x * x - y * y), 0.0)), max(abs(x), abs(y))
