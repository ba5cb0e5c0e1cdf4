"""Events without a cause in the image: background noise of all pixels, and hot pixels.

They are added to the other events and do not change the references. They occur at uniform random times, unless the
sensor sets `timestamp_step_us`. Hot pixels are Poisson processes at random positions, or those of a `hot_pixel_table`:
positions, rates, polarities and intervals as measured on a camera.

The model follows 2.7 s of a real DVXplorer at rest. The intervals of a hot pixel are at least two scans, hardly depend
on earlier intervals, and mix short and long ones. Two exponentials describe them; a gamma distribution is 15 to 25 %
off in the median. The polarity of an event depends on the previous one: most pixels alternate more, or less, than by
chance.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.camera.readout import event_key
from evetac_cli.sim.setup.sensor import HotPixelTable


def hot_rates(hot_rate_hz: ArrayLike, hot_pixels: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the rates of hot pixels by the inverse of their distribution (evenly spaced quantiles)."""
    quantile_hz = np.asarray(hot_rate_hz, np.float64)
    return np.interp(rng.random(hot_pixels), np.linspace(0.0, 1.0, len(quantile_hz)), quantile_hz)


class Noise(NamedTuple):
    """The noise of a camera: the background rate of a pixel, and the hot pixels as y * width + x.

    `hot_cumulative_hz` are the summed rates before each hot pixel, and of all; `step_us` is the step of time stamps, or
    0.
    """

    rate_hz: float
    hot_pixel: NDArray[np.int64]
    hot_cumulative_hz: NDArray[np.float64]
    on_share: float = 0.5
    step_us: float = 0.0


def add_noise(
    noise: Noise,
    frame_px: tuple[int, int],
    t0_us: int,
    rng: np.random.Generator,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Add the noise of a slice to `event_count` events; return their number, with those that do not fit into `keys`.

    One Poisson process has the summed rate; a uniform random number selects the pixel of each event. `t0_us`, the start
    of the slice, matters only for time stamps in steps.
    """
    rate_hz, hot_pixel, hot_cumulative_hz, on_share, step_us = noise
    background_hz = rate_hz * frame_px[0] * frame_px[1]
    total_hz = background_hz + float(hot_cumulative_hz[-1])
    uniform = rng.random((rng.poisson(total_hz * SLICE_US * 1e-6), 2))
    if on_share == 0.5 and step_us == 0.0:
        return int(_place(uniform, background_hz, hot_pixel, hot_cumulative_hz, frame_px, keys, event_count))
    hot, stamps = (hot_pixel, hot_cumulative_hz), (on_share, step_us, t0_us)
    return int(_place_in_steps(uniform, background_hz, hot, frame_px, stamps, keys, event_count))


class HotPixels:
    """The hot pixels of a table, from slice to slice; `rng` must not be used elsewhere."""

    def __init__(self, table: HotPixelTable, rng: np.random.Generator) -> None:
        self._rng = rng
        self._x, self._y = np.array(table.x_px, np.int64), np.array(table.y_px, np.int64)
        share, short_us = np.array(table.short_interval_share), np.array(table.short_interval_us, np.float64)
        mean_us = 1e6 / np.array(table.rate_hz, np.float64)
        long_us = (mean_us - table.dead_time_us - share * short_us) / (1.0 - share)
        on, change = np.array(table.on_share), np.array(table.polarity_change_share)
        with np.errstate(divide="ignore", invalid="ignore"):
            to_off = np.where(on > 0.0, change / (2 * on), 1.0)
            to_on = np.where(on < 1.0, change / (2 * (1 - on)), 1.0)
        self._law = np.stack([np.full_like(share, table.dead_time_us), share, short_us, long_us, to_off, to_on], axis=1)
        self._brighter = (rng.random(len(on)) < on).astype(np.uint8)
        self._next_us = self._first_us(mean_us)
        self._last_us = np.full(len(on), -np.inf)

    def _first_us(self, mean_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draw the times to the first event of pixels that have been on for long: long intervals are more likely."""
        dead_us, share, short_us, long_us = self._law[:, :4].T
        met_short = share * (dead_us + short_us) / mean_us
        tail_us = np.where(self._rng.random(len(share)) < met_short, short_us, long_us)
        length_biased = self._rng.random(len(share)) < tail_us / np.maximum(dead_us + tail_us, 1e-9)
        beyond_us = tail_us * self._rng.gamma(np.where(length_biased, 2.0, 1.0))
        first_us: NDArray[np.float64] = self._rng.random(len(share)) * (dead_us + beyond_us)
        return first_us

    def add(self, t0_us: int, width: int, step_us: float, keys: NDArray[np.int64], event_count: int) -> int:
        """Add the events of the slice that starts at `t0_us` to `event_count` events, and return their number."""
        state = (self._next_us, self._last_us, self._brighter)
        places = (self._x, self._y)
        return int(_hot_events(self._rng, places, self._law, state, float(t0_us), width, step_us, keys, event_count))


@njit(cache=True, _nrt=False)
def _whose(
    place_hz: float,
    background_hz: float,
    hot_pixel: NDArray[np.int64],
    hot_cumulative_hz: NDArray[np.float64],
    pixels: int,
) -> int:
    """Return the pixel of an event, from a position in the summed rates: first the background, then hot pixels."""
    if place_hz < background_hz:
        return min(int(place_hz / background_hz * pixels), pixels - 1)
    hot = int(np.searchsorted(hot_cumulative_hz, place_hz - background_hz, side="right")) - 1
    return int(hot_pixel[min(hot, len(hot_pixel) - 1)])


@njit(cache=True, _nrt=False)
def _place(
    uniform: NDArray[np.float64],
    background_hz: float,
    hot_pixel: NDArray[np.int64],
    hot_cumulative_hz: NDArray[np.float64],
    frame_px: tuple[int, int],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    width, height = frame_px
    total_hz = background_hz + hot_cumulative_hz[-1]
    for event in range(len(uniform)):
        pixel = _whose(uniform[event, 0] * total_hz, background_hz, hot_pixel, hot_cumulative_hz, width * height)
        time_and_sign = int(uniform[event, 1] * 2 * SLICE_US)
        if event_count < len(keys):
            keys[event_count] = event_key(time_and_sign >> 1, pixel % width, pixel // width, time_and_sign & 1 == 1)
        event_count += 1
    return event_count


@njit(cache=True, _nrt=False)
def _grid_time(time_us: float, x: int, width: int, step_us: float) -> float:
    """Return the first time at or after `time_us` at which column x is read out, if time stamps have steps."""
    if step_us == 0.0:
        return time_us
    phase_us = step_us * x / width
    return float(np.ceil((time_us - phase_us) / step_us) * step_us + phase_us)


@njit(cache=True, _nrt=False)
def _place_in_steps(
    uniform: NDArray[np.float64],
    background_hz: float,
    hot: tuple[NDArray[np.int64], NDArray[np.float64]],
    frame_px: tuple[int, int],
    stamps: tuple[float, float, int],
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Add events like `_place`, with a share of ON events, at times in the slice at which the column is read out.

    hot: pixels and summed rates; stamps: share of ON events, step of time stamps and start of the slice, in us.
    """
    hot_pixel, hot_cumulative_hz = hot
    on_share, step_us, t0_us = stamps
    width, height = frame_px
    total_hz = background_hz + hot_cumulative_hz[-1]
    for event in range(len(uniform)):
        pixel = _whose(uniform[event, 0] * total_hz, background_hz, hot_pixel, hot_cumulative_hz, width * height)
        brighter = uniform[event, 1] < on_share
        share = uniform[event, 1] / on_share if brighter else (uniform[event, 1] - on_share) / (1.0 - on_share)
        time_us = share * SLICE_US
        if step_us > 0.0:
            first_us = _grid_time(float(t0_us), pixel % width, width, step_us) - t0_us
            readouts = int(np.ceil((SLICE_US - first_us) / step_us))
            time_us = first_us + int(share * readouts) * step_us
        if event_count < len(keys):
            time = min(int(time_us), SLICE_US - 1)
            keys[event_count] = event_key(time, pixel % width, pixel // width, brighter)
        event_count += 1
    return event_count


@njit(cache=True)
def _hot_events(
    rng: np.random.Generator,
    places: tuple[NDArray[np.int64], NDArray[np.int64]],
    law: NDArray[np.float64],
    state: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]],
    t0_us: float,
    width: int,
    step_us: float,
    keys: NDArray[np.int64],
    event_count: int,
) -> int:
    """Add events of hot pixels before the end of a slice; of two in one step the second is lost, as in a scan.

    places: columns and rows; state: time of the next event and of the last one, and the polarity of the next.
    """
    x, y = places
    next_us, last_us, brighter = state
    end_us = t0_us + SLICE_US
    for pixel in range(len(x)):
        while next_us[pixel] < end_us:
            time_us = _grid_time(next_us[pixel], x[pixel], width, step_us)
            if time_us >= end_us:
                break
            dead_us, short_share, short_us, long_us, to_off, to_on = law[pixel]
            mean_us = short_us if rng.random() < short_share else long_us
            next_us[pixel] += dead_us - mean_us * np.log(1.0 - rng.random())
            if time_us <= last_us[pixel]:
                continue
            last_us[pixel] = time_us
            if event_count < len(keys):
                time = max(0, min(int(time_us - t0_us), SLICE_US - 1))
                keys[event_count] = event_key(time, x[pixel], y[pixel], brighter[pixel] == 1)
            event_count += 1
            if rng.random() < (to_off if brighter[pixel] == 1 else to_on):
                brighter[pixel] = 1 - brighter[pixel]
    return event_count
