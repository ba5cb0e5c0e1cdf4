"""Detect the end of a touch: the dots are then at rest, wherever a tracker reports them.

`start`, then `step` with each slice's dots. `step` reports the end once per touch; the caller then resets the tracker
to the dots at rest (`tracker.place`). A touch has ended if most dots are back near their rest and have not moved for
STILL_SLICES.

A touch that starts from rest and stays light is never mistaken for rest: dots may only be reset after a displacement by
TOUCHED_PX, which takes 0.5 to 2 N. After such a displacement, a remaining touch below NEAR_PX, some 0.4 N (0.2 to 0.9;
contacts of seeds 7000-7011), is mistaken for rest. NEAR_PX is needed because after a minute of pushes a fifth of the
dots are off by 0.3 to 0.4 px (seeds 7010-7012).
"""

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.checks import check_range

STILL_SLICES = 400
STILL_PX = 0.1  # dots that move less than this in STILL_SLICES are still
NEAR_PX = 0.5  # from rest, after the displacement common to all dots is removed
COMMON_PX = 1.0  # largest common displacement at rest
TOUCHED_PX = 1.0  # displacement of a touch
MOST = 0.8  # share of dots that must be still and near; in a touch, fewer dots than this are within TOUCHED_PX
LEAST_DOTS = 4  # tracked dots: with fewer, nothing is decided


class UntouchedState:
    """State after the slices so far; `step` changes it. rest_xy_px: (dots, 2); touched: a touch has been seen."""

    def __init__(self, rest_xy_px: Floats, still_slices: int) -> None:
        self.rest_xy_px = rest_xy_px
        self.still_slices = still_slices
        self.since_xy_px = rest_xy_px.copy()
        self.still_for = 0
        self.touched = False


def start(rest_xy_px: Floats, still_slices: int = STILL_SLICES) -> UntouchedState:
    """Start with dots at rest (n, 2) in px, NaN for a missing one;"""
    rest: Floats = np.array(rest_xy_px, np.float64)
    assert rest.ndim == 2 and rest.shape[1] == 2
    there = int(np.isfinite(rest).all(axis=1).sum())
    assert there >= LEAST_DOTS
    check_range("still_slices", still_slices, 1, 1e6)
    return UntouchedState(rest, still_slices)


def step(state: UntouchedState, dot_xy_px: Floats, lost: Flags | None = None) -> bool:
    """Return True, once per touch, when this slice shows that the touch has ended.

    dot_xy_px: (n, 2) as tracked; lost: (n,). Dots that are lost or not finite are ignored.
    """
    assert dot_xy_px.shape == state.rest_xy_px.shape
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
    """Return the number of seen dots near rest without their common displacement; 0 if that exceeds COMMON_PX."""
    moved = (dot_xy_px - state.rest_xy_px)[seen]
    common = np.median(moved, axis=0)
    if np.hypot(*common) > COMMON_PX:
        return 0
    return int(np.count_nonzero(np.hypot(*(moved - common).T) <= within_px))
