"""Pixel thresholds from events while dots are moved over the pixels: the ratio OFF over ON, and the pixel mismatch.

Merged events. A camera scans its pixels periodically, so an event represents one threshold plus the change until the
pixel is scanned again. If events of one polarity follow each other m scans apart, that further change is on average
1 / (2 m) of the whole. Each such event then counts as 1 / (1 - 1 / (2 m)) thresholds. This matters because a gel that
sticks and slips moves slowly one way and snaps back the other way: scans then merge more events of one polarity.

Separate thresholds per polarity. Over many strokes, the brightness of a pixel rises as much as it falls, however its
dots move. So ON events times their threshold equal OFF events times theirs, up to less than one event of each. The
ratio of the events is the inverse of the ratio of the thresholds. Its variation from pixel to pixel gives the mismatch
if each pixel has an independent threshold per polarity; with one threshold for both it hardly varies.

One threshold for both polarities. A pixel is then compared with its neighbours, which see nearly the same motion. The
difference of its log events from the mean of the eight around it comes from its own threshold and from chance. Chance
differs from stroke to stroke, the threshold does not: the covariance of two halves of the strokes is that of the
thresholds alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from evetac_cli.arrays import Floats, Ints
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.estimates import Estimate, of_samples

T = TypeVar("T")
SCAN_US = 200.0  # scan period of a DVXplorer
LONGEST_US = 20_000  # longest time between two events from the same passing rim
LONG_AGO_US = -(10**12)  # time of the last event of a pixel without events

FEWEST_OF_EITHER = 10  # events of each polarity that a pixel needs to count
FEWEST_PIXELS = 1500
FARTHEST = 0.5  # largest deviation of a log from its median or the neighbours'; beyond it are hot pixels and edges
# Pixels are pooled between these numbers of events (geometric mean of ON and OFF).
EVENTS = (10.0, 13.0, 17.0, 22.0, 30.0, 40.0, 60.0, 90.0, 150.0, 400.0)
FEWEST_TOGETHER = 300  # pixels of one pool
MOST_EVENTS = 90.0  # only pixels with fewer events give the mismatch: pixels stroked most also differ for other reasons
HOT_TIMES = 2.0  # a pixel with this many times the events of the pixels around is hot
TILE_PX = 40  # side of the pieces of the picture that the bootstrap resamples
RESAMPLES = 200  # of the bootstrap
# Corrections, fitted to simulated press scenes (randomized:100 to 123); each "sd" is the scatter of single sensors.
# Relative excess of the ratio, divided by the squared number of events from dot to gel.
RATIO_TOO_HIGH, RATIO_SD = 0.35, 0.007
# Variance of the log ratio between pixels of equal thresholds.
ALIKE_VARIANCE, ALIKE_VARIANCE_SD = 0.0005, 0.0002
SPREAD_SD = 0.04  # relative sd of the mismatch
# Chance variance of the log ratio times squared events: from unfinished thresholds, and per noise event of a pixel.
UNFINISHED, OF_NOISE = 0.22, 1.2
CHANCE_SD, VARIANCE_SD = 0.12, 0.0001  # relative sd of that chance variance, and absolute sd of any variance

FEWEST_OF_HALF = 20  # events of a pixel in each half of the strokes
FEWEST_PIXELS_OF_HALF = 5000
# Both pairs were fitted to simulated press scenes: sensors evetac (with mismatches of 0, 0.03 and 0.08), second, and
# randomized:3 to 5; seeds 1 to 9; strokes of 15 to 60 mm/s. Each "sd" is the scatter of single sensors.
# A threshold that is 1 % higher removes 1.22 % of the events: motion that reverses below the threshold makes none.
SENSITIVITY, SENSITIVITY_SD = 1.22, 0.1
# Pixels with equal thresholds also differ, equally in both halves because the strokes are alike: by 0.24 over (contrast
# / threshold). The sd is a share of the square of the first value.
ALIKE, ALIKE_SQUARED_SD = 0.24, 0.35

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]) / 8.0


@dataclass(slots=True)
class StrokeEvents:
    """Thresholds that each pixel has crossed so far, in halves of the strokes; `add` changes it in place.

    `events`: raw counts, (2, height, width). `on`, `off`: counts with merged thresholds. `merged`: sum of 1 / (2 m)
    over `intervals` of both polarities. `last_us`, `last_p`, `first`: last event of each pixel, and whether it was the
    first of its run.
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
        """Share of the threshold crossings that scans leave as events; 1 if no events follow each other."""
        return float(1.0 - self.merged.sum() / max(1, self.intervals.sum()))


def start(frame_px: tuple[int, int]) -> StrokeEvents:
    """Return the state without events; frame_px is (width, height)."""
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
    """Add the next events of one half of the strokes (0 or 1), in order of time; ignores those outside the frame."""
    assert len(t_us) == len(x) == len(y) == len(p)
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
            if first[row, column]:  # the event before was as fast, but its own interval was unknown
                thresholds += thresholds - 1.0
        first[row, column] = not follows
        if polarity:
            on[row, column] += thresholds
        else:
            off[row, column] += thresholds
        last_us[row, column] = t_us[event]
        last_p[row, column] = polarity


class Polarity(NamedTuple):
    """Threshold of OFF over that of ON, and the relative sd of thresholds if both differ independently."""

    off_over_on: Estimate
    mismatch: Estimate


def without_last_thresholds(off_over_on: Estimate, contrast_over_threshold: float) -> Estimate:
    """Return the ratio of the thresholds, corrected for the last, unfinished threshold of each passing dot."""
    return Estimate(*(one * (1.0 - RATIO_TOO_HIGH / contrast_over_threshold**2) for one in off_over_on))


def of_either_polarity(on: Floats, off: Floats, noise: float, rng: np.random.Generator) -> Polarity:
    """Return ratio and mismatch from the ON and OFF events of each pixel (height, width).

    noise: noise events per pixel in either polarity. ValueError if too few pixels had enough events. Intervals:
    bootstrap over pieces of the picture, plus the scatter over simulated sensors.
    """
    busy = (on >= FEWEST_OF_EITHER) & (off >= FEWEST_OF_EITHER)
    if busy.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels with {FEWEST_OF_EITHER} ON and OFF events, found fewer")
    events = np.sqrt(on * off).astype(np.float32)
    busy &= events < HOT_TIMES * cv2.medianBlur(events, 5) + FEWEST_OF_EITHER
    if busy.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} pixels about as busy as their neighbours, found fewer")
    log_ratio = np.log(np.maximum(on - noise, 0.5) / np.maximum(off - noise, 0.5))
    off_usual = log_ratio - np.median(log_ratio[busy])
    busy &= np.abs(off_usual) < FARTHEST
    beyond = np.clip(off_usual, -FARTHEST, FARTHEST)
    beyond = beyond - convolve(beyond, _AROUND)
    inside = busy & (convolve(busy.astype(np.float64), _AROUND, mode="constant") > 0.99)
    if inside.sum() < FEWEST_PIXELS:
        raise ValueError(f"expected {FEWEST_PIXELS} usable pixels surrounded by usable pixels, found fewer")
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
        """Return the log of the ratio, the variance without that of chance, and that of chance."""
        rising, falling, squares, inverse, pixels = sums @ weights
        enough = pixels >= FEWEST_TOGETHER
        if not enough.any():
            enough = pixels == pixels.max()
        # Use the busier half of the pixels: the last, unfinished threshold weighs more in pixels with few events.
        many = enough & (np.cumsum(pixels[::-1])[::-1] <= pixels.sum() / 2)
        many[np.flatnonzero(enough)[-1]] = True
        ratio = np.log(rising[many].sum() / falling[many].sum())
        few = enough & (np.array(EVENTS[1:]) <= MOST_EVENTS)
        used = few if few.any() else enough
        variance = squares[used] / pixels[used] / (1.0 + 1.0 / 8.0)  # the mean of eight neighbours varies, too
        chance = (UNFINISHED + OF_NOISE * 2.0 * noise) * inverse[used] / pixels[used]
        weight = 1.0 / ((CHANCE_SD * chance) ** 2 + VARIANCE_SD**2)
        least = np.average(variance - chance, weights=weight)
        return float(ratio), float(least), float(np.average(chance, weights=weight))

    value, samples = _resampled(of, tiles, rng)
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
    """Return the relative sd of thresholds that ON and OFF share, from each pixel's events (height, width) in halves.

    ValueError if too few pixels had enough events. Interval: bootstrap over pieces of the picture, plus the scatter
    over simulated sensors.
    """
    busy = (first >= FEWEST_OF_HALF) & (second >= FEWEST_OF_HALF)
    usable = busy & (convolve(busy.astype(np.float64), _AROUND, mode="constant") > 0.99)
    if usable.sum() < FEWEST_PIXELS_OF_HALF:
        raise ValueError(
            f"expected {FEWEST_PIXELS_OF_HALF} pixels with {FEWEST_OF_HALF} events in each half, found {usable.sum()}"
        )
    own, other = (np.clip(_beyond_neighbours(half), -FARTHEST, FARTHEST)[usable] for half in (first, second))
    tile = _tiles(usable)
    tiles = int(tile.max()) + 1
    sums = np.stack([np.bincount(tile, values, tiles) for values in (own * other, own, other, np.ones(len(own)))])
    alike = (ALIKE / contrast_over_threshold) ** 2

    def variance(weights: Floats) -> float:
        """Return the variance of the pixels' own logarithms."""
        product, one, another, pixels = sums @ weights
        covariance = product / pixels - one * another / pixels**2
        return float(covariance) / (1.0 + 1.0 / 8.0)  # the mean of eight neighbours varies, too

    def spread(own_variance: Floats, of_alike: Floats, sensitivity: Floats) -> Floats:
        result: Floats = np.sqrt(np.maximum(own_variance - of_alike, 0.0)) / sensitivity
        return result

    whole, own_variance = _resampled(variance, tiles, rng)
    value = spread(np.array([whole]), np.array([alike]), np.array([SENSITIVITY]))[0]
    of_alike = alike * np.maximum(1.0 + ALIKE_SQUARED_SD * rng.standard_normal(RESAMPLES), 0.0)
    sensitivity = SENSITIVITY + SENSITIVITY_SD * rng.standard_normal(RESAMPLES)
    return of_samples(float(value), spread(own_variance, of_alike, sensitivity))


def _resampled(estimate: Callable[[Floats], T], tiles: int, rng: np.random.Generator) -> tuple[T, Floats]:
    """Return the estimate from all pieces of the picture, by their weights, and those of the bootstrap over pieces."""
    draws = rng.multinomial(tiles, np.full(tiles, 1.0 / tiles), RESAMPLES).astype(np.float64)
    return estimate(np.ones(tiles)), np.array([estimate(weights) for weights in draws])


def _tiles(pixels: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the number of the piece of the picture (height, width) that contains each chosen pixel."""
    y, x = np.nonzero(pixels)
    tile: NDArray[np.intp] = np.unique(y // TILE_PX * pixels.shape[1] + x // TILE_PX, return_inverse=True)[1]
    return tile


def _beyond_neighbours(events: NDArray[np.integer]) -> Floats:
    """Return the log events of each pixel, minus their mean over its neighbours."""
    log_events = np.log(np.maximum(events, 1).astype(np.float64))
    beyond: Floats = log_events - convolve(log_events, _AROUND)
    return beyond
