"""The thresholds of pixels, from their events while dots are moved over them: OFF over ON, and how far pixels differ.

Scans merge events. An event says that brightness has changed by a threshold, and by what a scan lets it change further
before the pixel is looked at again. Where a pixel's events of one polarity follow each other m scans apart, that
further change is 1 / (2 m) of the whole in the mean, so such an event stands for 1 / (1 - 1 / (2 m)) thresholds. Why
so: a gel that sticks and slips is drawn slowly one way and snaps back the other, so that scans merge more events of one
polarity than of the other.

Over many strokes the brightness of a pixel rises as much as it falls, whatever its dots do: its ON events times their
threshold are its OFF events times theirs, but for less than one event of each. Their ratio is the inverse of that of
the thresholds. How it differs from pixel to pixel tells how far thresholds do, where each pixel has one of its own for
either polarity; where it has one for both, it hardly differs.

Where a pixel has one for both, its neighbours tell: they see nearly the same, and what a pixel has more or less than
the eight around it, in the logarithm, comes from its own threshold and from chance. Chance is another in every stroke,
the threshold is not: the covariance of two halves of the strokes is that of the thresholds alone.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from evetac_cli.arrays import Floats, Ints
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.estimates import Estimate, of_samples

SCAN_US = 200.0  # of a DVXplorer
LONGEST_US = 20_000  # between two events that one passing rim makes
LONG_AGO_US = -(10**12)

FEWEST_OF_EITHER = 10  # of either polarity that a pixel counts with
FEWEST_PIXELS = 1500
FARTHEST = 0.5  # from the usual ratio, or the neighbours, in the logarithm: more is a hot pixel, or an edge
# Bounds between which pixels are looked at together.
EVENTS = (10.0, 13.0, 17.0, 22.0, 30.0, 40.0, 60.0, 90.0, 150.0, 400.0)
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

FEWEST_OF_HALF = 20  # of a pixel in each half
FEWEST_PIXELS_OF_HALF = 5000
# A threshold that is 1 % higher takes away 1.22 % of the events: what moves back before it has reached the threshold
# makes none. Pixels with equal thresholds differ, too, in the same way in both halves, as they are stroked alike: by
# 0.24 over contrast / threshold. Both chosen on simulated press scenes (sensors evetac, with mismatches of 0, 0.03 and
# 0.08, second, randomized:3 to 5; seeds 1 to 9; strokes of 15 to 60 mm/s), and how far single ones were off (sd).
SENSITIVITY, SENSITIVITY_SD = 1.22, 0.1
ALIKE, ALIKE_SQUARED_SD = 0.24, 0.35  # the second is a share of the first's square

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]) / 8.0


@dataclass(slots=True)
class StrokeEvents:
    """Thresholds that each pixel has passed so far; `add` changes it in place.

    `events` as they came, `on` and `off` with those that were merged (halves of the strokes, height, width); `merged`
    sums 1 / (2 m) over `intervals` of both polarities; of each pixel the last event, and whether it began its run.
    """

    events: Ints
    on: Floats
    off: Floats
    merged: Floats
    intervals: Ints
    last_us: Ints
    last_p: NDArray[np.int8]
    first: NDArray[np.bool_]

    @property
    def kept_share(self) -> float:
        """Share of the events that scans leave; 1 where no events followed each other."""
        return float(1.0 - self.merged.sum() / max(1, self.intervals.sum()))


def start(frame_px: tuple[int, int]) -> StrokeEvents:
    """No events yet; frame_px is (width, height)."""
    shape = frame_px[1], frame_px[0]
    return StrokeEvents(
        events=np.zeros((2, *shape), np.int64),
        on=np.zeros((2, *shape)),
        off=np.zeros((2, *shape)),
        merged=np.zeros(1),
        intervals=np.zeros(1, np.int64),
        last_us=np.full(shape, LONG_AGO_US, np.int64),
        last_p=np.full(shape, -1, np.int8),
        first=np.zeros(shape, np.bool_),
    )


def add(
    state: StrokeEvents, t_us: Ints, x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], half: int
) -> None:
    """Take in the next events, in order of time, of one half of the strokes, 0 or 1; those outside the frame are not.

    ValueError if the columns differ in length.
    """
    if not len(t_us) == len(x) == len(y) == len(p):
        raise ValueError(f"expected columns of equal length, found {len(t_us)}, {len(x)}, {len(y)} and {len(p)}")
    counts = state.events[half], state.on[half], state.off[half], state.merged, state.intervals
    _add((t_us, x, y, p), counts, (state.last_us, state.last_p, state.first))


@njit(cache=True)
def _add(
    columns: tuple[Ints, NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]],
    counts: tuple[Ints, Floats, Floats, Floats, Ints],
    last: tuple[Ints, NDArray[np.int8], NDArray[np.bool_]],
) -> None:
    t_us, x, y, p = columns
    events, on, off, merged, intervals = counts
    last_us, last_p, first = last
    height, width = on.shape
    for event in range(len(t_us)):
        row, column = y[event], x[event]
        if row >= height or column >= width:
            continue
        events[row, column] += 1
        polarity = np.int8(p[event] != 0)
        between_us = t_us[event] - last_us[row, column]
        thresholds = 1.0
        follows = last_p[row, column] == polarity and between_us < LONGEST_US
        if follows:
            share = 0.5 / max(1.0, np.round(between_us / SCAN_US))
            merged[0] += share
            intervals[0] += 1
            thresholds = 1.0 / (1.0 - share)
            if first[row, column]:  # it came as fast, but nothing before it told how fast
                thresholds += thresholds - 1.0
        first[row, column] = not follows
        if polarity:
            on[row, column] += thresholds
        else:
            off[row, column] += thresholds
        last_us[row, column] = t_us[event]
        last_p[row, column] = polarity


class Polarity(NamedTuple):
    """Threshold of OFF over that of ON, as events have it, and the relative sd of thresholds if both differ apart."""

    off_over_on: Estimate
    mismatch: Estimate


def without_last_thresholds(off_over_on: Estimate, contrast_over_threshold: float) -> Estimate:
    """The ratio of the thresholds, corrected for the last, unfinished one of each passing dot."""
    return Estimate(*(one * (1.0 - RATIO_TOO_HIGH / contrast_over_threshold**2) for one in off_over_on))


def of_either_polarity(on: Floats, off: Floats, noise: float, rng: np.random.Generator) -> Polarity:
    """Ratio and spread from the ON and OFF events of each pixel (height, width); `noise` of each are a pixel's noise.

    ValueError where too few pixels had enough events. Intervals: bootstrap over pieces of the picture, and the scatter
    over simulated sensors.
    """
    busy = (on >= FEWEST_OF_EITHER) & (off >= FEWEST_OF_EITHER)
    if busy.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels with {FEWEST_OF_EITHER} events of each polarity")
    events = np.sqrt(on * off).astype(np.float32)
    busy &= events < HOT_TIMES * cv2.medianBlur(events, 5) + FEWEST_OF_EITHER
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
    tile = _tiles(inside)
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


def of_both_polarities(
    first: NDArray[np.integer],
    second: NDArray[np.integer],
    contrast_over_threshold: float,
    rng: np.random.Generator,
) -> Estimate:
    """Relative sd of thresholds that are one for ON and OFF, from events of each pixel (height, width) in two halves.

    ValueError where too few pixels had enough events. Interval: bootstrap over pieces of the picture, and the scatter
    over simulated sensors.
    """
    busy = (first >= FEWEST_OF_HALF) & (second >= FEWEST_OF_HALF)
    usable = busy & (convolve(busy.astype(np.float64), _AROUND, mode="constant") > 0.99)
    if usable.sum() < FEWEST_PIXELS_OF_HALF:
        raise ValueError(
            f"expected {FEWEST_PIXELS_OF_HALF} pixels with {FEWEST_OF_HALF} events a half, found {usable.sum()}"
        )
    own, other = (np.clip(_beyond_neighbours(half), -FARTHEST, FARTHEST)[usable] for half in (first, second))
    tile = _tiles(usable)
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


def _tiles(pixels: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Number of the piece of the picture (height, width) that each of the chosen pixels lies in."""
    y, x = np.nonzero(pixels)
    tile: NDArray[np.intp] = np.unique(y // TILE_PX * pixels.shape[1] + x // TILE_PX, return_inverse=True)[1]
    return tile


def _beyond_neighbours(events: NDArray[np.integer]) -> Floats:
    """The logarithm of each pixel's events less the mean of that of its neighbours."""
    log_events = np.log(np.maximum(events, 1).astype(np.float64))
    beyond: Floats = log_events - convolve(log_events, _AROUND)
    return beyond
