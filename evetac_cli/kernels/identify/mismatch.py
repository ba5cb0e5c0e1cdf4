"""How far the thresholds of pixels differ, from how many events each had while dots were moved over it.

Neighbours see nearly the same: what a pixel has more or less than the eight around it, in the logarithm, comes from its
own threshold and from chance. Chance is another in every stroke, the threshold is not: the covariance of two halves of
the strokes is that of the thresholds alone.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from evetac_cli.kernels.identify.estimates import Estimate, of_samples

Floats = NDArray[np.float64]

FEWEST_EVENTS = 20  # of a pixel in each half
FEWEST_PIXELS = 5000
FARTHEST = 0.5  # from the neighbours, in the logarithm: more is a hot pixel, or an edge
TILE_PX = 40  # pieces of the picture that are resampled
RESAMPLES = 200
# A threshold that is 1 % higher takes away 1.22 % of the events: what moves back before it has reached the threshold
# makes none. Pixels with equal thresholds differ, too, in the same way in both halves, as they are stroked alike: by
# 0.24 over contrast / threshold. Both chosen on simulated press scenes (sensors evetac, with mismatches of 0, 0.03 and
# 0.08, second, randomized:3 to 5; seeds 1 to 9; strokes of 15 to 60 mm/s), and how far single ones were off (sd).
SENSITIVITY, SENSITIVITY_SD = 1.22, 0.1
ALIKE, ALIKE_SQUARED_SD = 0.24, 0.35  # the second is a share of the first's square

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]) / 8.0


def estimate(
    first: NDArray[np.integer],
    second: NDArray[np.integer],
    contrast_over_threshold: float,
    rng: np.random.Generator,
) -> Estimate:
    """Relative standard deviation of the thresholds, from events of each pixel (height, width) in two halves.

    ValueError where too few pixels had enough events. Interval: bootstrap over pieces of the picture, and the scatter
    over simulated sensors.
    """
    busy = (first >= FEWEST_EVENTS) & (second >= FEWEST_EVENTS)
    usable = busy & (convolve(busy.astype(np.float64), _AROUND, mode="constant") > 0.99)
    if usable.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels with {FEWEST_EVENTS} events a half, found {usable.sum()}")
    own, other = (np.clip(_beyond_neighbours(half), -FARTHEST, FARTHEST)[usable] for half in (first, second))
    y, x = np.nonzero(usable)
    _, tile = np.unique(y // TILE_PX * first.shape[1] + x // TILE_PX, return_inverse=True)
    tiles = int(tile.max()) + 1
    sums = np.stack([np.bincount(tile, values, tiles) for values in (own * other, own, other, np.ones(len(own)))])
    alike = (ALIKE / contrast_over_threshold) ** 2

    def variance(weights: Floats) -> float:
        """Of the pixels' own logarithms."""
        product, one, another, pixels = sums @ weights
        covariance = product / pixels - one * another / pixels**2
        return float(covariance) / (1.0 + 1.0 / 8.0)  # the eight neighbours differ, too

    def spread(own_variance: Floats, of_alike: Floats, sensitivity: Floats) -> Floats:
        result: Floats = np.sqrt(np.maximum(own_variance - of_alike, 0.0)) / sensitivity
        return result

    value = spread(np.array([variance(np.ones(tiles))]), np.array([alike]), np.array([SENSITIVITY]))[0]
    drawn = rng.multinomial(tiles, np.full(tiles, 1.0 / tiles), RESAMPLES).astype(np.float64)
    own_variance = np.array([variance(weights) for weights in drawn])
    of_alike = alike * np.maximum(1.0 + ALIKE_SQUARED_SD * rng.standard_normal(RESAMPLES), 0.0)
    sensitivity = SENSITIVITY + SENSITIVITY_SD * rng.standard_normal(RESAMPLES)
    return of_samples(float(value), spread(own_variance, of_alike, sensitivity))


def _beyond_neighbours(events: NDArray[np.integer]) -> Floats:
    """The logarithm of each pixel's events less the mean of that of its neighbours."""
    log_events = np.log(np.maximum(events, 1).astype(np.float64))
    beyond: Floats = log_events - convolve(log_events, _AROUND)
    return beyond
