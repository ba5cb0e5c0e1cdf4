"""The bandwidth of the camera's pixels: a first-order low pass, applied to what moves instead of to every pixel.

A photoreceptor follows the log brightness L of its pixel with a time constant tau = 1 / (2 pi bandwidth). To filter
the levels themselves every pixel would have to be visited. Instead the positions of dots and object are filtered, and
the camera sees a picture that lags behind. The two are the same to first order: exactly where L is linear in the
position over the distance moved within tau, and that is where an edge moves by less than its own width meanwhile.
Beyond that a true low pass blurs the passing edge as well, so that events come more spread in time, while here it is
only late. tests/sim/camera/test_low_pass.py measures it against a low pass of every pixel. Changes of contrast (the
object that comes into focus) and noise are not filtered.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US

# Still and this near to where it belongs a point has arrived; a ten-thousandth of an edge changes no pixel's event, and
# without an end what once moved would be visited in every slice.
SETTLED_PX = 1e-4
# A piece of a path is at most as long as tau, down to this many in a slice, and scans fall on its vertices.
MOST_PIECES = 50
SCANS = 5

Floats = NDArray[np.float64]


class LowPass:
    """Follows points with the lag of a first-order low pass; `now` (points, 2) is where it sees them."""

    def __init__(self, bandwidth_hz: float, at: Floats) -> None:
        """Start settled at `at` (points, 2), gain 1/sqrt 2 at the bandwidth; ValueError unless positive and finite."""
        if not 0.0 < bandwidth_hz < math.inf:
            raise ValueError(f"bandwidth_hz: expected a positive finite number, found {bandwidth_hz}")
        self._tau_us = 1e6 / (2 * math.pi * bandwidth_hz)
        self.now = at.copy()

    def follow(self, path: Floats) -> Floats:
        """Where the points are seen, (m + 1, points, 2) from `now` on, while they move along `path` (k + 1, points, 2).

        Both are positions at equally spaced times over one slice, with straight lines between; m is a multiple of k.
        The answer is exact at its vertices. Where `path` starts elsewhere than the last one ended, the points jumped.
        """
        pieces = len(path) - 1
        parts = math.ceil(min(SLICE_US / self._tau_us, MOST_PIECES) / pieces)
        if pieces % SCANS:
            parts = SCANS * math.ceil(parts / SCANS)
        seen = np.empty((pieces * parts + 1, *path.shape[1:]))
        _follow(path, parts, self._tau_us, self.now, seen)
        self.now = seen[-1].copy()
        return seen


@njit(cache=True)
def _follow(path: Floats, parts: int, tau_us: float, now: Floats, seen: Floats) -> None:
    """The exact answer to straight pieces: a lag of velocity * tau, and what is left of the start dies away."""
    pieces = len(path) - 1
    part_us = SLICE_US / (pieces * parts)
    left = math.exp(-part_us / tau_us)
    for point in range(path.shape[1]):
        for axis in range(2):
            at = now[point, axis]
            seen[0, point, axis] = at
            for piece in range(pieces):
                begin = path[piece, point, axis]
                step = (path[piece + 1, point, axis] - begin) / parts
                lag = step / part_us * tau_us
                for part in range(parts):
                    target = begin + part * step
                    at = target + step - lag + (at - target + lag) * left
                    if step == 0.0 and abs(at - target) < SETTLED_PX:
                        at = target
                    seen[piece * parts + part + 1, point, axis] = at
