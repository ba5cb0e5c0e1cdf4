"""The bandwidth of the camera's pixels: a first-order low pass, applied to positions instead of to every pixel.

A photoreceptor follows the log brightness L of its pixel with a time constant tau = 1 / (2 pi bandwidth). Filtering the
levels themselves would require a visit to every pixel. Instead the positions of dots and object are filtered, and the
camera sees an image that lags behind. Both are equal to first order. They are exactly equal if L is linear in the
position over the distance moved within tau, so that an edge moves by less than its own width in that time. For faster
motion a true low pass also blurs the passing edge, so that events are more spread in time. Here the edge is only late.
The test tests/sim/camera/test_low_pass.py compares it with a low pass of every pixel. Changes of contrast (an object
that comes into focus) and noise are not filtered.

A photoreceptor is slower in darker pixels (Lichtsteiner 2008; v2e, Hu 2021): its bandwidth is proportional to
brightness. A passing rim takes a pixel through all levels from gel to ink, each with the time constant of that level; a
dot lags by their mean (`rim_bandwidth`). The spread about the mean is left out: the bright side of a rim would be
earlier, the dark side later.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit

# A point at rest this close to its target has arrived: a ten-thousandth of an edge changes no pixel's event. Without
# this limit every point that ever moved would be visited in every slice.
SETTLED_PX = 1e-4
# A piece of a path is at most tau long, down to this many pieces in a slice, and scans coincide with its vertices.
MOST_PIECES = 50
SCANS = 5  # scans per slice of the scanning camera


def rim_bandwidth(log_contrast: float) -> float:
    """Return the bandwidth of a dot's rim relative to bare gel: 1 / mean of exp(-L), for L from ink to gel."""
    return log_contrast / math.expm1(log_contrast)


def light_at(xy_px: Floats, frame_px: ArrayLike, light_gradient: float) -> Floats:
    """Return the brightness at positions (..., 2) relative to its mean in the frame.

    light_gradient: relative loss of light at the corners. The loss grows as the square of the distance from the frame's
    middle, and its mean is a third of that at a corner.
    """
    middle = np.asarray(frame_px, np.float64) / 2
    share = ((xy_px - middle) ** 2).sum(axis=-1) / (middle**2).sum()
    light: Floats = (1.0 - light_gradient * share) / (1.0 - light_gradient / 3.0)
    return np.maximum(light, 1.0 - light_gradient)


class LowPass:
    """Follows points with the lag of a first-order low pass; `now` (points, 2) is their present position as seen."""

    def __init__(self, bandwidth_hz: float | Floats, at: Floats) -> None:
        """Start settled at `at` (points, 2); bandwidth_hz (-3 dB) is one for all points or one for each (points,)."""
        each_hz = np.full(len(at), bandwidth_hz, np.float64)
        assert ((each_hz > 0.0) & (each_hz < np.inf)).all()
        self._tau_us = 1e6 / (2 * math.pi * each_hz)
        self.now = at.copy()

    def follow(self, path: Floats) -> Floats:
        """Return the points' positions as seen, (m + 1, points, 2), while they move along `path` (k + 1, points, 2).

        Both are positions at equally spaced times over one slice, with straight lines between them; m is a multiple of
        k. The result starts at `now` and is exact at its vertices. If `path` does not start where the last one ended,
        the points have jumped.
        """
        pieces = len(path) - 1
        shortest_us = float(self._tau_us.min(initial=SLICE_US))
        parts = math.ceil(min(SLICE_US / shortest_us, MOST_PIECES) / pieces)
        if pieces % SCANS:
            parts = SCANS * math.ceil(parts / SCANS)
        seen = np.empty((pieces * parts + 1, *path.shape[1:]))
        _follow(path, parts, self._tau_us, self.now, seen)
        self.now = seen[-1].copy()
        return seen


@njit(cache=True, _nrt=False)
def _follow(path: Floats, parts: int, tau_us: Floats, now: Floats, seen: Floats) -> None:
    """Fill in the exact response to straight pieces: a lag of velocity * tau, and an exponential decay of the start."""
    pieces = len(path) - 1
    part_us = SLICE_US / (pieces * parts)
    for point in range(path.shape[1]):
        left = math.exp(-part_us / tau_us[point])
        for axis in range(2):
            at = now[point, axis]
            seen[0, point, axis] = at
            for piece in range(pieces):
                begin = path[piece, point, axis]
                step = (path[piece + 1, point, axis] - begin) / parts
                lag = step / part_us * tau_us[point]
                for part in range(parts):
                    target = begin + part * step
                    at = target + step - lag + (at - target + lag) * left
                    if step == 0.0 and abs(at - target) < SETTLED_PX:
                        at = target
                    seen[piece * parts + part + 1, point, axis] = at
