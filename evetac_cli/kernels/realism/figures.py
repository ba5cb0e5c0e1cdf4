"""Measures by which two recordings are compared: rates, polarities, hot pixels, times between events, spectra.

Hot pixels are those above 20 Hz, the usual limit, whether or not the sensor lists them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from evetac_cli.arrays import Floats, Ints
from evetac_cli.events import SLICE_US, SLICES_PER_S

HOT_HZ = 20.0  # lowest rate of a hot pixel
FEWEST_INTERVALS = 10  # of a pixel that counts in the measures of the typical pixel
WINDOW_SLICES = 256  # of a spectrum
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
    if len(counts) < WINDOW_SLICES:
        return np.empty(0), np.empty(0)
    frequency_hz, power = signal.welch(counts, SLICES_PER_S, nperseg=WINDOW_SLICES)
    return frequency_hz[1:], power[1:]


def largest_gap(first: NDArray, second: NDArray) -> float:
    """Return the largest difference of two samples' cumulative shares (Kolmogorov-Smirnov); NaN if one is empty."""
    if not len(first) or not len(second):
        return float("nan")
    first, second = np.sort(first), np.sort(second)
    places = np.concatenate([first, second])
    shares = (np.searchsorted(one, places, side="right") / len(one) for one in (first, second))
    return float(np.abs(np.subtract(*shares)).max())
