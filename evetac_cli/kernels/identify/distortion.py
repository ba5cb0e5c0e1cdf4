"""A lens that shows straight rows of dots curved, from where dots are seen and the grid that they were printed on.

The model is that of the simulated camera (sim/camera/lens.py) without its second term: a point at distance r from the
middle of the frame is seen at r (1 + k1 r^2), the corners at r = 1. Print and picture may be shifted and turned against
each other, and of another size.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from evetac_cli.kernels.identify.estimates import LEVEL, Estimate

Floats = NDArray[np.float64]

FEWEST_DOTS = 12
ROUNDS = 3  # of distances that are taken in the flat picture instead of the seen one


def estimate(seen_xy_px: Floats, printed_xy: Floats, frame_px: tuple[int, int]) -> Estimate:
    """k1 from dots (dots, 2) as they are seen and as they were printed, in any unit; ValueError with too few dots.

    Least squares; the interval is Student's, from how irregularly dots lie.
    """
    dots = len(seen_xy_px)
    if dots < FEWEST_DOTS:
        raise ValueError(f"expected {FEWEST_DOTS} dots or more, found {dots}")
    middle = np.array(frame_px, np.float64) / 2
    corner2 = float(middle @ middle)
    x, y = printed_xy.T
    one, nothing = np.ones(dots), np.zeros(dots)
    similar = np.concatenate([np.column_stack([x, -y, one, nothing]), np.column_stack([y, x, nothing, one])])
    project = similar @ np.linalg.pinv(similar)
    k1, flat = 0.0, seen_xy_px - middle
    for _ in range(ROUNDS):
        outward = (flat**2).sum(axis=1, keepdims=True) / corner2 * flat
        stacked = (part.T.ravel() for part in (seen_xy_px - middle, outward))
        seen_off, outward_off = (part - project @ part for part in stacked)
        k1 = float((outward_off * seen_off).sum() / (outward_off**2).sum())
        flat = (seen_xy_px - middle) / (1.0 + k1 * (flat**2).sum(axis=1, keepdims=True) / corner2)
    left = seen_off - k1 * outward_off
    degrees = 2 * dots - 5
    sd = np.sqrt((left**2).sum() / degrees / (outward_off**2).sum())
    half = float(stats.t.ppf((1 + LEVEL) / 2, degrees) * sd)
    return Estimate(k1, k1 - half, k1 + half)


def flat(seen_xy_px: Floats, k1: float, frame_px: tuple[int, int]) -> Floats:
    """Where points (..., 2) would be seen without the lens."""
    middle = np.array(frame_px, np.float64) / 2
    off_px = np.asarray(seen_xy_px, np.float64) - middle
    corner2 = float(middle @ middle)
    nearer = off_px
    for _ in range(50):  # a contraction, as k1 is small: its error falls by 3 k1 a round
        nearer = off_px / (1.0 + k1 * (nearer**2).sum(axis=-1, keepdims=True) / corner2)
    result: Floats = nearer + middle
    return result
