"""Measures by which two recordings differ, and whether they can be distinguished by logistic regression.

Windows of half a second are classified. The features of a window describe the camera, not the positions of dots or hot
pixels. They are rates, polarities, times between events of a pixel, pixels that are busy without motion, the spectrum,
the difference of a pixel from its neighbours, and the spatial correlation of events. Features that a window does not
determine, for lack of rest or motion, are NaN.

The regression has no free choices: features are standardised, weights have a penalty, and windows are held out in
blocks of time, the same times in both sets. The result is the area under the ROC curve (AUC): the probability that a
window of the second set has a higher score than one of the first. It is 0.5 if the sets cannot be distinguished, and 1
if they always can.

Hot pixels are those above 20 Hz, the usual limit, whether or not the sensor lists them.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from evetac_cli.arrays import Floats, Ints
from evetac_cli.events import SLICE_US, SLICES_PER_S, Events
from evetac_cli.kernels import estimates

HOT_HZ = 20.0  # lowest rate of a hot pixel
FEWEST_INTERVALS = 10  # of a pixel that counts in the measures of the typical pixel
SPECTRUM_SLICES = 256  # of a spectrum
BANDS_HZ = (3, 10, 30, 100, 500)  # edges of the spectral bands, the last at half the slice rate
POLARITIES = {"": None, "on_": 1, "off_": 0}  # of the events between which times are measured


class PixelEvents(NamedTuple):
    """Events of a set of pixels, hot or ordinary, sorted by pixel and then by time."""

    pixel: Ints
    t_us: Ints
    p: NDArray[np.uint8]


def split_hot(
    t_us: Ints, x: NDArray, y: NDArray, p: NDArray, frame_px: tuple[int, int], duration_s: float
) -> tuple[PixelEvents, PixelEvents, int]:
    """Return the events of hot pixels, those of all other pixels, and the number of hot pixels."""
    pixel = y.astype(np.int64) * frame_px[0] + x
    is_hot = np.bincount(pixel, minlength=frame_px[0] * frame_px[1]) > HOT_HZ * duration_s
    order = np.lexsort((t_us, pixel))
    events = PixelEvents(pixel[order], t_us[order], p[order])
    hot = is_hot[events.pixel]
    first, second = (PixelEvents(events.pixel[own], events.t_us[own], events.p[own]) for own in (hot, ~hot))
    return first, second, int(is_hot.sum())


def times_between(events: PixelEvents, polarity: int | None = None) -> tuple[Floats, Ints]:
    """Return the times in us between successive events of a pixel, of one polarity or all, and the pixel of each."""
    pixel, t_us = events.pixel, events.t_us
    if polarity is not None:
        pixel, t_us = pixel[events.p == polarity], t_us[events.p == polarity]
    same = pixel[1:] == pixel[:-1]
    return np.diff(t_us)[same].astype(np.float64), pixel[1:][same]


def at_rest(
    t_us: Ints, x: NDArray, y: NDArray, p: NDArray, frame_px: tuple[int, int], duration_us: int
) -> dict[str, float]:
    """Return the measures of events at rest, in order of time; NaN with too few events.

    `interval_*`: quantiles over all times between events of hot pixels. `typical_*`: medians over hot pixels of each
    pixel's own quantile. `on_` and `off_`: times between events of one polarity.
    """
    duration_s = duration_us * 1e-6
    hot, ordinary, hot_pixels = split_hot(t_us, x, y, p, frame_px, duration_s)
    pixels = frame_px[0] * frame_px[1]
    figures = {
        "events_a_slice": len(t_us) * SLICE_US / duration_us,
        "on_share": _mean(p),
        "ordinary_hz": len(ordinary.t_us) / duration_s / max(1, pixels - hot_pixels),
        "ordinary_on_share": _mean(ordinary.p),
        "hot_pixels": float(hot_pixels),
        "hot_event_share": len(hot.t_us) / len(t_us) if len(t_us) else np.nan,
        "hot_on_share": _mean(hot.p),
    }
    for name, polarity in POLARITIES.items():
        between_us, pixel = times_between(hot, polarity)
        for quantile, share in (("median", 50), ("p90", 90)):
            figures[f"hot_{name}interval_us_{quantile}"] = _percentile(between_us, share)
        own = _own_quantiles(between_us, pixel)
        for place, quantile in enumerate(("median", "p90")):
            figures[f"hot_{name}interval_us_{quantile}_of_typical_pixel"] = _percentile(own[:, place], 50)
    return figures


def _own_quantiles(between_us: Floats, pixel: Ints) -> Floats:
    """Return median and 90th percentile of each pixel's times (pixels, 2), for pixels with enough of them."""
    if not len(pixel):
        return np.empty((0, 2))
    first = np.flatnonzero(np.diff(pixel)) + 1
    parts = [part for part in np.split(between_us, first) if len(part) >= FEWEST_INTERVALS]
    return np.array([np.percentile(part, [50, 90]) for part in parts]).reshape(-1, 2)


def _mean(values: NDArray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _percentile(values: Floats, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else float("nan")


def in_motion(
    t_us: Ints, x: NDArray, y: NDArray, p: NDArray, frame_px: tuple[int, int], events_a_slice: Ints
) -> dict[str, float]:
    """Return the measures of events while something moves, in order of time; NaN with too few events.

    `band_*` are shares of the variance of the events per slice, by frequency.
    """
    pixel = y.astype(np.int64) * frame_px[0] + x
    order = np.lexsort((t_us, pixel))
    between_us, _ = times_between(PixelEvents(pixel[order], t_us[order], p[order]))
    counts = events_a_slice.astype(np.float64)
    figures = {
        "events_a_slice": _mean(counts),
        "events_a_slice_median": _percentile(counts, 50),
        "events_a_slice_p90": _percentile(counts, 90),
        "on_share": _mean(p),
        "pixels_with_events_share": len(np.unique(pixel)) / (frame_px[0] * frame_px[1]),
        "interval_us_median": _percentile(between_us, 50),
        "interval_us_p90": _percentile(between_us, 90),
    }
    frequency_hz, power = spectrum(events_a_slice)
    for low, high in zip(BANDS_HZ, BANDS_HZ[1:], strict=False):
        is_in_band = (frequency_hz >= low) & ((frequency_hz < high) | (high == BANDS_HZ[-1]))
        share = power[is_in_band].sum() / power.sum() if power.sum() > 0 else np.nan
        figures[f"band_{low}_{high}_hz"] = float(share)
    return figures


def spectrum(events_a_slice: Ints) -> tuple[Floats, Floats]:
    """Return frequencies in Hz and power of the events per slice (Welch, 256 ms), without mean; empty if too short."""
    counts = np.asarray(events_a_slice, np.float64)
    if len(counts) < SPECTRUM_SLICES:
        return np.empty(0), np.empty(0)
    frequency_hz, power = signal.welch(counts, SLICES_PER_S, nperseg=SPECTRUM_SLICES)
    return frequency_hz[1:], power[1:]


def largest_gap(first: NDArray, second: NDArray) -> float:
    """Return the largest difference of two samples' cumulative shares (Kolmogorov-Smirnov); NaN if one is empty."""
    if not len(first) or not len(second):
        return float("nan")
    return float(stats.ks_2samp(first, second, method="asymp").statistic)


WINDOW_SLICES = 500  # of a window
FEWEST_SLICES = 50  # of rest, or of motion, for their features
FEWEST_EVENTS = 100  # in motion
BUSY_HZ = 20.0  # rate of a busy pixel at rest
FEWEST_OF_PIXEL = 8  # events of a pixel that is compared with its neighbours, or ON with OFF
FEWEST_PIXELS = 200  # for such comparisons
LAGS_PX = (2, 5)  # distances of the spatial correlation
QUANTILES = (10, 50, 90)  # of the times between events
FEATURES = (
    "rest, log events per slice",
    "rest, ON share",
    "rest, log busy pixels",
    "rest, busy pixels' share of events",
    "motion, log events per slice",
    "motion, ON share",
    "motion, log pixels with events",
    *(f"motion, log time between {side} events, {share} %" for side in ("ON", "OFF") for share in QUANTILES),
    *(f"motion, band {low} to {high} Hz" for low, high in zip(BANDS_HZ, BANDS_HZ[1:], strict=False)),
    *(f"motion, log {side} events of a pixel, {share} %" for side in ("ON", "OFF") for share in (50, 90)),
    "motion, spread about neighbours, ON",
    "motion, spread about neighbours, OFF",
    "motion, spread of ON over OFF",
    *(f"motion, correlation over {lag} px" for lag in LAGS_PX),
)

FOLDS = 4  # of the cross-validation
BLOCK = 2  # adjacent windows that are held out together
FEWEST_WINDOWS = 8  # of a set
PENALTY, PENALTY_OF_OFFSET = 1.0, 1e-6  # of the weights of standardised features; the offset is practically free
LARGEST_VALUE = 1e12  # of a feature: squares must stay finite
LARGEST = 6.0  # in standard deviations: larger values are clipped


def features(
    events: Events, starts: NDArray[np.int64], at_rest: NDArray[np.bool_], frame_px: tuple[int, int]
) -> Floats:
    """Return FEATURES of a window from its events, in order of time.

    starts: index of the first event of each slice, plus the end; at_rest: flag per slice.
    """
    counts = np.diff(starts)
    of_slice = np.repeat(at_rest, counts)
    still, moving = (
        Events(events.t[own], events.x[own], events.y[own], events.p[own]) for own in (of_slice, ~of_slice)
    )
    rest = _rest(still, int(at_rest.sum()), frame_px)
    return np.array([*rest, *_motion(moving, counts[~at_rest], counts, frame_px)], np.float64)


def _rest(events: Events, slices: int, frame_px: tuple[int, int]) -> list[float]:
    if slices < FEWEST_SLICES or len(events.t) < 1:
        return [np.nan] * 4
    of_pixel = np.bincount(_pixel(events, frame_px))
    busy = of_pixel >= max(3.0, BUSY_HZ * slices * 1e-3)
    return [
        float(np.log(len(events.t) / slices)),
        float(events.p.mean()),
        float(np.log1p(busy.sum())),
        float(of_pixel[busy].sum() / len(events.t)),
    ]


def _motion(
    events: Events, counts: NDArray[np.int64], all_counts: NDArray[np.int64], frame_px: tuple[int, int]
) -> list[float]:
    if len(counts) < FEWEST_SLICES or len(events.t) < FEWEST_EVENTS:
        return [np.nan] * (len(FEATURES) - 4)
    pixel = _pixel(events, frame_px)
    pictures = [
        np.bincount(pixel[events.p == side], minlength=frame_px[0] * frame_px[1]).reshape(frame_px[::-1])
        for side in (1, 0)
    ]
    both = pictures[0] + pictures[1]
    numbers = [
        float(np.log(counts.mean())),
        float(events.p.mean()),
        float(np.log((both > 0).sum())),
    ]
    order = np.lexsort((events.t, pixel))
    sorted_events = PixelEvents(pixel[order], events.t[order], events.p[order])
    for side in (1, 0):
        between_us, _ = times_between(sorted_events, side)
        numbers += np.log1p(np.percentile(between_us, QUANTILES)).tolist() if len(between_us) else [np.nan] * 3
    frequency_hz, power = spectrum(all_counts)
    for low, high in zip(BANDS_HZ, BANDS_HZ[1:], strict=False):
        is_in_band = (frequency_hz >= low) & (frequency_hz < high)
        numbers.append(float(power[is_in_band].sum() / power.sum()) if power.sum() > 0 else np.nan)
    for picture in pictures:
        events_of = picture[picture > 0]
        numbers += np.log(np.percentile(events_of, [50, 90])).tolist() if len(events_of) else [np.nan] * 2
    return [*numbers, *(_about_neighbours(picture) for picture in pictures), _apart(*pictures), *_together(both)]


def _pixel(events: Events, frame_px: tuple[int, int]) -> NDArray[np.int64]:
    return events.y.astype(np.int64) * frame_px[0] + events.x


def _about_neighbours(picture: NDArray[np.int64]) -> float:
    """Return the median deviation of busy pixels' log events from the log of the mean around them."""
    around = cv2.blur(picture.astype(np.float32), (3, 3))
    busy = (picture >= FEWEST_OF_PIXEL) & (around >= FEWEST_OF_PIXEL)
    return float(np.median(np.abs(np.log(picture[busy] / around[busy])))) if busy.sum() >= FEWEST_PIXELS else np.nan


def _apart(on: NDArray[np.int64], off: NDArray[np.int64]) -> float:
    """Return half of the range of log(ON / OFF) that contains two thirds of the busy pixels."""
    busy = (on >= FEWEST_OF_PIXEL) & (off >= FEWEST_OF_PIXEL)
    if busy.sum() < FEWEST_PIXELS:
        return np.nan
    low, high = np.percentile(np.log(on[busy] / off[busy]), [16, 84])
    return float(high - low) / 2


def _together(picture: NDArray[np.int64]) -> list[float]:
    """Return the correlation of log events with those of pixels at LAGS_PX to the right."""
    level = np.log1p(picture.astype(np.float64))
    return [float(np.corrcoef(level[:, lag:].ravel(), level[:, :-lag].ravel())[0, 1]) for lag in LAGS_PX]


def area(first: Floats, second: Floats) -> float:
    """Return the share of pairs in which the second score is higher, ties half;"""
    assert len(first) and len(second)
    ranks = stats.rankdata(np.concatenate([first, second]))[len(first) :]
    return float((ranks.sum() - len(second) * (len(second) + 1) / 2) / (len(first) * len(second)))


def separability(first: Floats, second: Floats) -> float:
    """Return the AUC of held-out windows (windows, features) in order of time; a feature that is NaN gets its mean.

    The longer set is cut, so that both have windows at the same times. ValueError with fewer than FEWEST_WINDOWS, or if
    the numbers of features differ.
    """
    windows = min(len(first), len(second))
    if windows < FEWEST_WINDOWS or first.shape[1:] != second.shape[1:]:
        raise ValueError(f"expected at least {FEWEST_WINDOWS} windows of both, with the same features, found {windows}")
    first, second = (np.clip(part, -LARGEST_VALUE, LARGEST_VALUE) for part in (first, second))
    fold = np.arange(windows) // BLOCK % FOLDS
    penalty = np.concatenate([[PENALTY_OF_OFFSET], np.full(first.shape[1], PENALTY)])
    scores: list[Floats] = [np.empty(windows), np.empty(windows)]
    for left_out in range(FOLDS):
        is_left_out = fold == left_out
        train = np.concatenate([first[:windows][~is_left_out], second[:windows][~is_left_out]])
        is_known = np.isfinite(train)
        count = np.maximum(is_known.sum(axis=0), 1)
        mean = np.where(is_known, train, 0.0).sum(axis=0) / count
        sd = np.sqrt(np.where(is_known, (train - mean) ** 2, 0.0).sum(axis=0) / count)
        sd[sd <= 1e-9 * (1.0 + np.abs(mean))] = np.inf

        def standardised(windows_of: Floats, mean: Floats = mean, sd: Floats = sd) -> Floats:
            values: Floats = np.clip((windows_of - mean) / sd, -LARGEST, LARGEST)
            return np.where(np.isfinite(values), values, 0.0)

        label = np.repeat([0.0, 1.0], (~is_left_out).sum())
        columns = np.column_stack([np.ones(len(train)), standardised(train)])
        weights = estimates.logistic_weights(columns, label, penalty, np.ones(len(train)))
        for score, of in zip(scores, (first, second), strict=True):
            score[is_left_out] = standardised(of[:windows][is_left_out]) @ weights[1:] + weights[0]
    # Each fold has its own regression, so scores are only compared within a fold.
    return float(np.mean([area(scores[0][fold == one], scores[1][fold == one]) for one in range(FOLDS)]))
