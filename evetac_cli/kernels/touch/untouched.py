"""When nothing touches the gel any more: then its dots are at rest, wherever a tracker has them.

`start`, then `step` with each slice's dots, which says so once after each touch; who follows the dots then puts them
back (`tracker.place`). Nothing touches where a touch has been, most dots have come back near their rest, and they have
been still for STILL_SLICES.

A touch that begins from rest and stays light is never taken for rest, as it has to be followed by more: only where dots
have been displaced by TOUCHED_PX, which takes 0.5 to 2 N, may they be put back. What stays at less than NEAR_PX after
that, some 0.4 N (0.2 to 0.9; contacts of seeds 7000-7011), is taken for rest. After a minute of pushes a fifth of
the dots are 0.3 to 0.4 px off (seeds 7010-7012).
"""

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.checks import check_range

STILL_SLICES = 400
STILL_PX = 0.1  # dots that move by less in that time are still
NEAR_PX = 0.5  # of rest, but for a way that all dots have in common ...
COMMON_PX = 1.0  # ... of at most so much
TOUCHED_PX = 1.0
MOST = 0.8  # of the dots have to be still and near, and fewer be within TOUCHED_PX in a touch
LEAST_DOTS = 4


class UntouchedState:
    """What is known after the slices so far; `step` changes it. rest_xy_px: (dots, 2); touched: whether a touch was."""

    def __init__(self, rest_xy_px: Floats, still_slices: int) -> None:
        self.rest_xy_px = rest_xy_px
        self.still_slices = still_slices
        self.since_xy_px = rest_xy_px.copy()
        self.still_for = 0
        self.touched = False


def start(rest_xy_px: Floats, still_slices: int = STILL_SLICES) -> UntouchedState:
    """Begin with dots at rest (n, 2) in px, NaN for a missing one; ValueError with fewer than 4, or another shape."""
    rest: Floats = np.array(rest_xy_px, np.float64)
    if rest.ndim != 2 or rest.shape[1] != 2:
        raise ValueError(f"rest_xy_px: expected shape (dots, 2), found {rest.shape}")
    there = int(np.isfinite(rest).all(axis=1).sum())
    if there < LEAST_DOTS:
        raise ValueError(f"rest_xy_px: expected at least {LEAST_DOTS} dots that are not missing, found {there}")
    check_range("still_slices", still_slices, 1, 1e6)
    return UntouchedState(rest, still_slices)


def step(state: UntouchedState, dot_xy_px: Floats, lost: Flags | None = None) -> bool:
    """Whether one more slice has shown that nothing touches any more; dot_xy_px (n, 2) as tracked, lost (n,).

    True once after each touch. Lost dots and those that are not finite are not looked at. ValueError for other numbers
    of dots.
    """
    if dot_xy_px.shape != state.rest_xy_px.shape:
        raise ValueError(f"dot_xy_px: expected shape {state.rest_xy_px.shape}, found {dot_xy_px.shape}")
    moved = dot_xy_px - state.since_xy_px
    way_px2 = moved[:, 0] * moved[:, 0] + moved[:, 1] * moved[:, 1]
    seen = np.isfinite(way_px2)
    if lost is not None:
        seen &= ~lost
    dots = np.count_nonzero(seen)
    still = np.count_nonzero(seen & (way_px2 <= STILL_PX**2))
    if dots < LEAST_DOTS or still < MOST * dots:
        state.since_xy_px = np.where(np.isfinite(dot_xy_px), dot_xy_px, state.rest_xy_px)
        state.still_for = 0
        if not state.touched and dots >= LEAST_DOTS:
            state.touched = bool(_near(state, dot_xy_px, seen, TOUCHED_PX) < MOST * dots)
        return False
    state.still_for += 1
    if state.still_for < state.still_slices or not state.touched:
        return False
    if _near(state, dot_xy_px, seen, NEAR_PX) < MOST * dots:
        return False
    state.touched, state.still_for = False, 0
    return True


def _near(state: UntouchedState, dot_xy_px: Floats, seen: Flags, within_px: float) -> int:
    """How many of the dots that are seen are near rest, but for a way that all have in common; 0 where that is long."""
    moved = (dot_xy_px - state.rest_xy_px)[seen]
    common = np.median(moved, axis=0)
    if np.hypot(*common) > COMMON_PX:
        return 0
    return int(np.count_nonzero(np.hypot(*(moved - common).T) <= within_px))
