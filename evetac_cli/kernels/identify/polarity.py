"""The thresholds of ON and OFF, one over the other, and how far they differ from pixel to pixel.

Over many strokes the brightness of a pixel rises as much as it falls, whatever its dots do: its ON events times their
threshold are its OFF events times theirs, but for less than one event of each. Their ratio is the inverse of that of
the thresholds. How it differs from pixel to pixel tells how far thresholds do, where each pixel has one of its own for
either polarity; where it has one for both, it hardly differs.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from evetac_cli.kernels.identify.estimates import Estimate, of_samples

Floats = NDArray[np.float64]

FEWEST_EVENTS = 10  # of either polarity that a pixel counts with
FEWEST_PIXELS = 1500
FARTHEST = 0.5  # from the usual ratio, in the logarithm: more is a hot pixel
EVENTS = (
    10.0,
    13.0,
    17.0,
    22.0,
    30.0,
    40.0,
    60.0,
    90.0,
    150.0,
    400.0,
)  # bounds between which pixels are looked at together
FEWEST_TOGETHER = 300
MOST_EVENTS = 90.0  # of pixels that tell the spread: those that are stroked most differ for other reasons, too
HOT_TIMES = 2.0  # as many events as the pixels around
TILE_PX = 40  # pieces of the picture that are resampled
RESAMPLES = 200
# Chosen on simulated press scenes (randomized:100 to 123): how much too high ratios were, over the squared events from
# dot to gel, and how far single ones were off (sd); the variance of the logarithm that pixels of equal thresholds show,
# with its sd; how far single spreads were off (sd).
RATIO_TOO_HIGH, RATIO_SD = 0.35, 0.007
ALIKE_VARIANCE, ALIKE_VARIANCE_SD = 0.0005, 0.0002
SPREAD_SD = 0.04
# Variance of the logarithm times squared events that is due to unfinished thresholds and, for each event of noise that
# a pixel had, to noise; how uncertain that is (share of it, sd), and how uncertain a variance is besides (sd).
UNFINISHED, OF_NOISE = 0.22, 1.2
CHANCE_SD, VARIANCE_SD = 0.12, 0.0001

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]) / 8.0


class Polarity(NamedTuple):
    """Threshold of OFF over that of ON, as events have it, and the relative sd of thresholds if both differ apart."""

    off_over_on: Estimate
    mismatch: Estimate


def without_last_thresholds(off_over_on: Estimate, contrast_over_threshold: float) -> Estimate:
    """The ratio of the thresholds, corrected for the last, unfinished one of each passing dot."""
    return Estimate(*(one * (1.0 - RATIO_TOO_HIGH / contrast_over_threshold**2) for one in off_over_on))


def estimate(on: Floats, off: Floats, noise: float, rng: np.random.Generator) -> Polarity:
    """Estimate from the ON and OFF events of each pixel (height, width); `noise` of each are a pixel's noise.

    ValueError where too few pixels had enough events. Intervals: bootstrap over pieces of the picture, and the scatter
    over simulated sensors.
    """
    busy = (on >= FEWEST_EVENTS) & (off >= FEWEST_EVENTS)
    if busy.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels with {FEWEST_EVENTS} events of each polarity")
    events = np.sqrt(on * off).astype(np.float32)
    busy &= events < HOT_TIMES * cv2.medianBlur(events, 5) + FEWEST_EVENTS
    if busy.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels as busy as their neighbours")
    log_ratio = np.log(np.maximum(on - noise, 0.5) / np.maximum(off - noise, 0.5))
    off_usual = log_ratio - np.median(log_ratio[busy])
    busy &= np.abs(off_usual) < FARTHEST
    beyond = np.clip(off_usual, -FARTHEST, FARTHEST)
    beyond = beyond - convolve(beyond, _AROUND)
    inside = busy & (convolve(busy.astype(np.float64), _AROUND, mode="constant") > 0.99)
    if inside.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} such pixels side by side")
    y, x = np.nonzero(inside)
    _, tile = np.unique(y // TILE_PX * on.shape[1] + x // TILE_PX, return_inverse=True)
    tiles = int(tile.max()) + 1
    of_pixel = events[inside].astype(np.float64)
    bins = np.clip(np.searchsorted(EVENTS, of_pixel, side="right") - 1, 0, len(EVENTS) - 2)
    cells = bins * tiles + tile

    def by_tile(values: Floats) -> Floats:
        summed: Floats = np.bincount(cells, values, (len(EVENTS) - 1) * tiles).reshape(-1, tiles).astype(np.float64)
        return summed

    of_polarity = [np.maximum(side - noise, 0.0)[inside] for side in (on, off)]
    columns = (*of_polarity, beyond[inside] ** 2, of_pixel**-2.0, np.ones(len(of_pixel)))
    sums = np.stack([by_tile(values) for values in columns])

    def of(weights: Floats) -> tuple[float, float, float]:
        """Log of the ratio, the variance without that of chance, and that of chance."""
        rising, falling, squares, inverse, pixels = sums @ weights
        enough = pixels >= FEWEST_TOGETHER
        if not enough.any():
            enough = pixels == pixels.max()
        # Of the busier half of the pixels: with few events, those of a last, unfinished threshold weigh more.
        many = enough & (np.cumsum(pixels[::-1])[::-1] <= pixels.sum() / 2)
        many[np.flatnonzero(enough)[-1]] = True
        ratio = np.log(rising[many].sum() / falling[many].sum())
        few = enough & (np.array(EVENTS[1:]) <= MOST_EVENTS)
        used = few if few.any() else enough
        variance = squares[used] / pixels[used] / (1.0 + 1.0 / 8.0)  # the eight neighbours differ, too
        chance = (UNFINISHED + OF_NOISE * 2.0 * noise) * inverse[used] / pixels[used]
        weight = 1.0 / ((CHANCE_SD * chance) ** 2 + VARIANCE_SD**2)
        least = np.average(variance - chance, weights=weight)
        return float(ratio), float(least), float(np.average(chance, weights=weight))

    value = of(np.ones(tiles))
    drawn = rng.multinomial(tiles, np.full(tiles, 1.0 / tiles), RESAMPLES).astype(np.float64)
    samples = np.array([of(weights) for weights in drawn])
    ratios = np.exp(samples[:, 0] + RATIO_SD * rng.standard_normal(RESAMPLES))
    unsure = np.hypot(ALIKE_VARIANCE_SD, CHANCE_SD * value[2])
    alike = ALIKE_VARIANCE + unsure * rng.standard_normal(RESAMPLES)
    spreads = np.sqrt(np.maximum(samples[:, 1] - alike, 0.0) / 2.0) * (1.0 + SPREAD_SD * rng.standard_normal(RESAMPLES))
    spread = float(np.sqrt(max(value[1] - ALIKE_VARIANCE, 0.0) / 2.0))
    return Polarity(of_samples(float(np.exp(value[0])), ratios), of_samples(spread, spreads))
