"""Which dots have moved otherwise than a layer that is touched on a patch can have moved them, given all the others.

A tracker that has lost a dot without notice shows it somewhere else. Here tractions on the patch are thought to have a
part that is common to it and one that varies smoothly; by their size the typical dot is as far off as it should be.
Each dot then has a place that is expected given the others (leave one out, in closed form) and a deviation, small
outside of the patch and large within. The dot that is farthest off, over its deviation, is taken out while it is off by
more than LIMIT, and all are judged anew without it: several may be wrong, and those that are make their neighbours look
so.

Why not by the size that makes the dots most likely: wrong dots would make it so large that all are right.

LIMIT, SMOOTH_CELLS and COMMON were chosen on contacts of seeds 7000-7011, patches found with the wrong dots among the
others. The time grows with the cube of the dots: 2 ms for 63.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch.dot_motion import KINDS, PRESSURE

SMOOTH_CELLS = 1.0  # sd of the window that makes the varying part smooth
COMMON = 4.0  # sd of the common part over that of the varying one, as in posterior.py
PRESSURE_RATIO = 2.0  # of pressure over shear, as in posterior.py
LIMIT = 4.0  # deviations that a dot may be off
MOST_SHARE = 0.2  # of the dots: where more seem wrong, it is the patch that is, and none is called so
# Of the tracker per axis: 0.1 px of each dot and 0.3 px of all together, at 0.0329 mm per px, as after some time.
OWN_MM, COMMON_MM = 0.1 * 0.0329, 0.3 * 0.0329
LEAST_MM = 0.3 * 0.0329  # none that is off by less is wrong
MODEL_SHARE = 0.05  # of the dots' motion (rms): what the gel is not quite like the layer, as in dot_modes.py
LEAST_DOTS = 6
MEDIAN_OFF = 1.1774  # of what is normally distributed in two dimensions, in deviations
SHARE_OF_SIZE = 0.4  # of the dots: those that tractions move most tell their size
SIZES, HALVINGS = (1e-3, 30.0), 5  # of the tractions' part in the motion's mean square: bounds, and how often halved


class LayerMotion(NamedTuple):
    """Motion of dots per traction: that varies over the cells (2 dots, KINDS, rows, columns), and per cell as it is."""

    varying: Floats
    each: Floats


def start(motion: Floats, shape: tuple[int, int]) -> LayerMotion:
    """From the motion of dots per traction (dots, 2, KINDS, cells) of dot_motion.py, on a grid of a shape."""
    from scipy import ndimage  # here, as it takes 0.2 s to load, and whoever only opens files loads this module

    each = motion.reshape(-1, KINDS, *shape).copy()
    each[:, PRESSURE] *= PRESSURE_RATIO
    unit = 2 * np.sqrt(np.pi) * SMOOTH_CELLS  # after which a smooth part of white tractions has their variance
    return LayerMotion(unit * ndimage.gaussian_filter(each, (0, 0, SMOOTH_CELLS, SMOOTH_CELLS)), each)


def wrong(
    known: LayerMotion,
    moved_mm: Floats,
    trusted: Flags,
    patch: Flags,
    own_mm: float = OWN_MM,
    common_mm: float = COMMON_MM,
) -> Flags:
    """Flags (dots,) of the trusted dots that have moved otherwise than the others and the patch allow.

    moved_mm: (dots, 2) from rest. patch: (rows, columns), what is touched, none where nothing is. own_mm, common_mm: sd
    of the tracker's error per axis, of each dot and of all together. With fewer than LEAST_DOTS dots none is wrong, nor
    where more than MOST_SHARE of them would be.
    """
    flags: Flags = np.zeros(len(trusted), np.bool_)
    used = np.flatnonzero(trusted)
    count = len(used)
    if count < LEAST_DOTS:
        return flags
    apart = moved_mm[used] - np.median(moved_mm[used], axis=0)
    moved = apart.ravel().copy()
    usual = np.minimum(moved**2, np.quantile(moved**2, 0.9)).mean()  # mean square but for some dots that are far off
    errors = np.eye(2 * count) * (own_mm**2 + MODEL_SHARE**2 * usual)
    errors[::2, ::2] += common_mm**2
    errors[1::2, 1::2] += common_mm**2
    shown = _shown(known, used, patch)
    inverse = linalg.inv(errors, check_finite=False) if shown is None else _inverse(shown, errors, moved, usual)
    left = np.ones(count, np.bool_)
    for _ in range(int(MOST_SHARE * count) + 1):
        deviations, off_mm = _off(inverse, moved)
        deviations[~left | (off_mm < LEAST_MM)] = 0.0
        worst = int(np.argmax(deviations))
        if deviations[worst] <= LIMIT:
            flags[used[~left]] = True
            break
        left[worst] = False
        out = slice(2 * worst, 2 * worst + 2)
        inverse = inverse - inverse[:, out] @ np.linalg.solve(inverse[out, out], inverse[out])
        inverse[out, out] = np.eye(2)  # never looked at again, and of no effect on the others
        moved[out] = 0.0
    return flags


def _shown(known: LayerMotion, used: np.ndarray, patch: Flags) -> Floats | None:
    """Covariance of the motion of some dots (2 dots, 2 dots) by tractions on a patch, 1 in the mean; None without."""
    if not patch.any():
        return None
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    varying = known.varying[:, :, patch][rows].reshape(len(rows), -1)
    common = known.each[:, :, patch][rows].sum(axis=2)
    shown: Floats = varying @ varying.T + COMMON**2 * (common @ common.T)
    shown /= np.trace(shown) / len(rows)
    return shown


def _inverse(shown: Floats, errors: Floats, moved: Floats, usual: float) -> Floats:
    """Inverse of the covariance of the dots' motion (2 dots, 2 dots), of a size by which a typical dot is right.

    Typical of those that the tractions move most: what the others are off by is the tracker's error, which may be less
    than told.
    """
    low, high = (np.log(size * usual + 1e-30) for size in SIZES)
    variance = shown.diagonal()[::2] + shown.diagonal()[1::2]
    by_touch = variance >= np.quantile(variance, 1.0 - SHARE_OF_SIZE)
    inverse: Floats = errors
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        inverse = linalg.inv(shown * np.exp(middle) + errors, check_finite=False)
        if np.median(_off(inverse, moved)[0][by_touch]) > MEDIAN_OFF:
            low = middle
        else:
            high = middle
    return inverse


def _off(inverse: Floats, moved: Floats) -> tuple[Floats, Floats]:
    """How far each dot is from where the others place it, in deviations and in mm, by the inverse of a covariance."""
    told = (inverse @ moved).reshape(-1, 2)
    xx, xy, yy = inverse[::2, ::2].diagonal(), inverse[::2, 1::2].diagonal(), inverse[1::2, 1::2].diagonal()
    area = xx * yy - xy * xy
    x, y = (yy * told[:, 0] - xy * told[:, 1]) / area, (xx * told[:, 1] - xy * told[:, 0]) / area
    return np.sqrt(np.maximum(x * told[:, 0] + y * told[:, 1], 0.0)), np.hypot(x, y)
