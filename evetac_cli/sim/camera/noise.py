"""Events that nothing in the picture makes: background noise of all pixels, and hot pixels.

They come at uniform times on top of the others: they do not wait for a scan and leave the references alone.
"""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evetac_cli.events import SLICE_US
from evetac_cli.sim.camera.event_keys import event_key


def hot_rates(hot_rate_hz: ArrayLike, hot_pixels: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Rates of so many hot pixels, drawn by the inverse of their distribution (evenly spaced quantiles)."""
    quantile_hz = np.asarray(hot_rate_hz, np.float64)
    return np.interp(rng.random(hot_pixels), np.linspace(0.0, 1.0, len(quantile_hz)), quantile_hz)


def add_noise(
    noise_rate_hz: float,
    hot_pixel: NDArray[np.int64],
    hot_cumulative_hz: NDArray[np.float64],
    frame_px: tuple[int, int],
    rng: np.random.Generator,
    keys: NDArray[np.int64],
    made: int,
) -> int:
    """Add the noise of a slice to `made` events; returns their number, also of those that do not fit into `keys`.

    One Poisson process of all rates; a uniform number says whose event it is. `noise_rate_hz` is that of a pixel,
    `hot_pixel` y * width + x, `hot_cumulative_hz` the summed rates before each hot pixel, and of all.
    """
    background_hz = noise_rate_hz * frame_px[0] * frame_px[1]
    total_hz = background_hz + hot_cumulative_hz[-1]
    uniform = rng.random((rng.poisson(total_hz * SLICE_US * 1e-6), 2))
    return int(_place(uniform, background_hz, hot_pixel, hot_cumulative_hz, frame_px, keys, made))


@njit(cache=True)
def _place(
    uniform: NDArray[np.float64],
    background_hz: float,
    hot_pixel: NDArray[np.int64],
    hot_cumulative_hz: NDArray[np.float64],
    frame_px: tuple[int, int],
    keys: NDArray[np.int64],
    made: int,
) -> int:
    width, height = frame_px
    total_hz = background_hz + hot_cumulative_hz[-1]
    for event in range(len(uniform)):
        place_hz = uniform[event, 0] * total_hz
        if place_hz < background_hz:
            pixel = min(int(place_hz / background_hz * width * height), width * height - 1)
        else:
            hot = np.searchsorted(hot_cumulative_hz, place_hz - background_hz, side="right") - 1
            pixel = hot_pixel[min(hot, len(hot_pixel) - 1)]
        time_and_sign = int(uniform[event, 1] * 2 * SLICE_US)
        if made < len(keys):
            keys[made] = event_key(time_and_sign >> 1, pixel % width, pixel // width, time_and_sign & 1 == 1)
        made += 1
    return made
