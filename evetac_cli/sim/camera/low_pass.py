"""The bandwidth of the camera's pixels: a first-order low pass, applied to what moves instead of to every pixel.

A photoreceptor follows the log brightness L of its pixel with a time constant tau = 1 / (2 pi bandwidth). To filter
the levels themselves every pixel would have to be visited. Instead the positions of dots and object are filtered, and
the camera sees a picture that lags behind. The two are the same to first order: exactly where L is linear in the
position over the distance moved within tau, and that is where an edge moves by less than its own width meanwhile.
Beyond that a true low pass blurs the passing edge as well, so that events come more spread in time, while here it is
only late. tests/sim/camera/test_low_pass.py measures it against a low pass of every pixel. Changes of contrast (the
object that comes into focus) and noise are not filtered.

A photoreceptor is the slower the darker its pixel (Lichtsteiner 2008; v2e, Hu 2021): its bandwidth is proportional to
brightness. A rim that passes takes a pixel through all levels from gel to ink, each late by the time constant at that
level; a dot lags by their mean (`rim_bandwidth`). What it leaves out is the spread about it: the bright side of a rim
is earlier, the dark one later.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from evetac_cli.arrays import Floats
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit

# Still and this near to where it belongs a point has arrived; a ten-thousandth of an edge changes no pixel's event, and
# without an end what once moved would be visited in every slice.
SETTLED_PX = 1e-4
# A piece of a path is at most as long as tau, down to this many in a slice, and scans fall on its vertices.
MOST_PIECES = 50
SCANS = 5


def rim_bandwidth(log_contrast: float) -> float:
    """The bandwidth of a dot's rim, by light, over that of bare gel: 1 / mean of exp(-L), for L from ink to gel."""
    return log_contrast / math.expm1(log_contrast)


def light_at(xy_px: Floats, frame_px: ArrayLike, light_gradient: float) -> Floats:
    """Brightness at places (..., 2) over its mean in the frame, if by that share less light falls on the corners.

    It falls as the square of the distance from the frame's middle, which in the mean is a third of that at a corner.
    """
    middle = np.asarray(frame_px, np.float64) / 2
    share = ((xy_px - middle) ** 2).sum(axis=-1) / (middle**2).sum()
    light: Floats = (1.0 - light_gradient * share) / (1.0 - light_gradient / 3.0)
    return np.maximum(light, 1.0 - light_gradient)


class LowPass:
    """Follows points with the lag of a first-order low pass; `now` (points, 2) is where it sees them."""

    def __init__(self, bandwidth_hz: float | Floats, at: Floats) -> None:
        """Start settled at `at` (points, 2), gain 1/sqrt 2 at the bandwidth, one of all points or of each (points,).

        ValueError unless positive and finite.
        """
        each_hz = np.full(len(at), bandwidth_hz, np.float64)
        if not ((each_hz > 0.0) & (each_hz < np.inf)).all():
            raise ValueError(f"bandwidth_hz: expected a positive finite number, found {bandwidth_hz}")
        self._tau_us = 1e6 / (2 * math.pi * each_hz)
        self.now = at.copy()

    def follow(self, path: Floats) -> Floats:
        """Where the points are seen, (m + 1, points, 2) from `now` on, while they move along `path` (k + 1, points, 2).

        Both are positions at equally spaced times over one slice, with straight lines between; m is a multiple of k.
        The answer is exact at its vertices. Where `path` starts elsewhere than the last one ended, the points jumped.
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
    """The exact answer to straight pieces: a lag of velocity * tau, and what is left of the start dies away."""
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
