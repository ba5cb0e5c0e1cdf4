"""Find dots whose motion contradicts the others, given a layer that is touched on a patch.

A tracker that has lost a dot without noticing reports it in a wrong position. The model: tractions on the patch have a
part that is common to it and a part that varies smoothly. Their size is set so that the typical dot deviates by as much
as it should. The other dots then predict each dot's position (leave one out, in closed form) with a deviation that is
small outside the patch and large within. The dot with the largest error over its deviation is removed while that ratio
exceeds LIMIT, and all others are evaluated again. This repetition is needed because several dots may be wrong, and
wrong dots make their neighbours look wrong.

The size of the tractions is not the one that makes the dots most likely, because wrong dots would raise it until all
dots look right.

LIMIT, SMOOTH_CELLS and COMMON were chosen on contacts of seeds 7000-7011, with patches found from right and wrong dots
together. The time grows with the cube of the number of dots: 2 ms for 63.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from evetac_cli.arrays import Flags, Floats
from evetac_cli.kernels.touch.dot_motion import KINDS, PRESSURE

SMOOTH_CELLS = 1.0  # standard deviation of the window that smooths the varying part, in cells
COMMON = 4.0  # standard deviation of the common part over that of the varying part, as in patch.py
PRESSURE_RATIO = 2.0  # of pressure over shear, as in patch.py
LIMIT = 4.0  # largest error of a right dot, in deviations
MOST_SHARE = 0.2  # of the dots: if more seem wrong, the patch is wrong, and no dot is rejected

# Error of the tracker per axis after some time: 0.1 px of each dot and 0.3 px of all together, at 0.0329 mm per px.
OWN_MM, COMMON_MM = 0.1 * 0.0329, 0.3 * 0.0329
LEAST_MM = 0.3 * 0.0329  # a dot with a smaller error is never wrong
MODEL_SHARE = 0.05  # deviation of gel and layer model, as a share of the dots' motion (rms), as in dot_motion.py
LEAST_DOTS = 6  # fewer dots cannot be compared
MEDIAN_OFF = 1.1774  # median distance of a two-dimensional normal distribution, in deviations
SHARE_OF_SIZE = 0.4  # of the dots, those that tractions move most: they determine the size of the tractions
SIZES, HALVINGS = (1e-3, 30.0), 5  # bisection of the size: bounds in units of the mean square motion, and rounds


class LayerMotion(NamedTuple):
    """Motion of dots per traction: smoothed over the cells (2 dots, KINDS, rows, columns), and per single cell."""

    varying: Floats
    each: Floats


def start(motion: Floats, shape: tuple[int, int]) -> LayerMotion:
    """Return the constants from the motion of dots per traction (dots, 2, KINDS, cells) of dot_motion.py, on a grid."""
    # here: scipy.ndimage takes 0.2 s to load, and commands that only open files load this module
    from scipy import ndimage

    each = motion.reshape(-1, KINDS, *shape).copy()
    each[:, PRESSURE] *= PRESSURE_RATIO
    unit = 2 * np.sqrt(np.pi) * SMOOTH_CELLS  # restores the variance of white tractions after smoothing
    return LayerMotion(unit * ndimage.gaussian_filter(each, (0, 0, SMOOTH_CELLS, SMOOTH_CELLS)), each)


def wrong(layer_motion: LayerMotion, moved_mm: Floats, trusted: Flags, patch: Flags) -> Flags:
    """Return flags (dots,) of the trusted dots whose motion contradicts the others and the patch.

    moved_mm: (dots, 2) from rest. patch: (rows, columns), touched cells, none without a touch. No dot is flagged with
    fewer than LEAST_DOTS dots, or if more than MOST_SHARE of them would be.
    """
    flags: Flags = np.zeros(len(trusted), np.bool_)
    used = np.flatnonzero(trusted)
    count = len(used)
    if count < LEAST_DOTS:
        return flags
    apart = moved_mm[used] - np.median(moved_mm[used], axis=0)
    moved = apart.ravel().copy()
    usual = np.minimum(moved**2, np.quantile(moved**2, 0.9)).mean()  # mean square, limited for the few largest
    errors = np.eye(2 * count) * (OWN_MM**2 + MODEL_SHARE**2 * usual)
    errors[::2, ::2] += COMMON_MM**2
    errors[1::2, 1::2] += COMMON_MM**2
    shown = _shown(layer_motion, used, patch)
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
        inverse[out, out] = np.eye(2)  # never considered again, and without effect on the others
        moved[out] = 0.0
    return flags


def _shown(layer_motion: LayerMotion, used: np.ndarray, patch: Flags) -> Floats | None:
    """Return the covariance of dot motion (2 dots, 2 dots) by tractions on a patch, mean 1; None without a patch."""
    if not patch.any():
        return None
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    varying = layer_motion.varying[:, :, patch][rows].reshape(len(rows), -1)
    common = layer_motion.each[:, :, patch][rows].sum(axis=2)
    shown: Floats = varying @ varying.T + COMMON**2 * (common @ common.T)
    shown /= np.trace(shown) / len(rows)
    return shown


def _inverse(shown: Floats, errors: Floats, moved: Floats, usual: float) -> Floats:
    """Return the inverse covariance of dot motion (2 dots, 2 dots), scaled so that the typical error is right.

    Only the dots that the tractions move most count: the error of the others is the tracker's, which may be smaller
    than assumed.
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
    """Return the distance of each dot from its prediction by the others, in deviations and in mm."""
    weighted = (inverse @ moved).reshape(-1, 2)
    xx, xy, yy = inverse[::2, ::2].diagonal(), inverse[::2, 1::2].diagonal(), inverse[1::2, 1::2].diagonal()
    area = xx * yy - xy * xy
    x, y = (yy * weighted[:, 0] - xy * weighted[:, 1]) / area, (xx * weighted[:, 1] - xy * weighted[:, 0]) / area
    return np.sqrt(np.maximum(x * weighted[:, 0] + y * weighted[:, 1], 0.0)), np.hypot(x, y)
