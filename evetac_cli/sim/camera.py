"""A simulated DVXplorer Mini: the events that moving dots and a sliding texture make.

The camera does not follow every crossing of the threshold as an ideal event camera would. It scans: at a fixed rate
it holds all pixels at once, compares each with the level at its last event, and reads the changed ones out, at most one
event a pixel and scan, after which the present level is the new reference (physics: 5000 scans/s, global hold, no global
reset). Several threshold steps within one scan become one event.

Timing: scan s of a slice holds the picture of its first instant, dots at start + (end - start) s / scans, and its time
stamps run on over the columns, t = scan start + column / width * scan period, rounded down to us. So an event comes up
to one scan after the change that made it, never before, and what moves in the last scan period is seen by the next slice.

Only what can have changed is looked at: the ring of a dot about where it is and where it was last looked at, once it
has moved `RESOLUTION_PX`; the window when the object has moved as far or the contrast is another. A dot's ring is finite
(see optics), so no pixel that is left behind misses its last event.

Left out: bandwidth, leak, dilation of dots, object rims, motion of the cut edge; dots beyond the cut are the caller's to
leave out. Background noise and hot pixels are added at uniform times: they neither wait for a scan nor move the reference.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ..events import FRAME_PX, SLICE_US, Events
from . import optics

# A rim's steepest slope is 0.53 log units per px, so a pixel drifts at most 0.005 (C 0.2) before it is looked at again.
RESOLUTION_PX = 0.01
FARTHEST_PX = 1e6
# No pixel's threshold is below this share of the nominal one, however the mismatch falls.
LOWEST_THRESHOLD = 0.25
# While a slice is made its events are single integers: time in the slice, column, row, polarity.
TIME_BITS = 33
COLUMN_BITS = 17
ROW_BITS = 1
COORDINATE_MASK = 0xFFFF


@dataclass(frozen=True)
class CameraModel:
    """One camera individual; ValueError where a value is out of range.

    Thresholds are in log brightness, `mismatch` is their relative standard deviation over the pixels. Noise is a rate
    per pixel; each of the hot pixels has a rate of its own, uniform in `hot_rate_hz`. A slice holds at most
    `max_events`; what is beyond is lost, as on a full bus, and counted.
    """

    frame_px: tuple[int, int] = FRAME_PX
    scans_per_ms: int = 5
    threshold: float = 0.2
    mismatch: float = 0.03
    noise_rate_hz: float = 0.03
    hot_pixels: int = 10
    hot_rate_hz: tuple[float, float] = (20.0, 200.0)
    edge_sigma_px: float = optics.EDGE_SIGMA_PX
    log_contrast: float = optics.LOG_CONTRAST
    dot_radius_px: float = 15.0
    max_events: int = 1_000_000

    def __post_init__(self) -> None:
        width, height = self.frame_px
        _check_range("frame width", width, 1, 4096)
        _check_range("frame height", height, 1, 4096)
        _check_range("scans_per_ms", self.scans_per_ms, 1, 100)
        _check_range("threshold", self.threshold, 0.01, 10.0)
        _check_range("mismatch", self.mismatch, 0.0, 1.0)
        _check_range("noise_rate_hz", self.noise_rate_hz, 0.0, 1e4)
        _check_range("hot_pixels", self.hot_pixels, 0, width * height)
        _check_range("hot_rate_hz, lowest", self.hot_rate_hz[0], 0.0, 1e5)
        _check_range("hot_rate_hz, highest", self.hot_rate_hz[1], self.hot_rate_hz[0], 1e5)
        _check_range("edge_sigma_px", self.edge_sigma_px, 0.01, 100.0)
        _check_range("log_contrast", self.log_contrast, 0.01, 20.0)
        _check_range("dot_radius_px", self.dot_radius_px, 0.01, 1000.0)
        _check_range("max_events", self.max_events, 1, 10_000_000)


@dataclass
class CameraState:
    """What a camera remembers from slice to slice; `step` changes it in place.

    `reference` and `threshold` belong to the gel's pixels, shape (height, width); under the window the threshold is
    infinite there, and the strip has its own pair. `seen_*` is what the pixels were last compared against.
    """

    model: CameraModel
    dot_radius_px: float
    profile: optics.DotProfile
    reference: NDArray[np.float32]
    threshold: NDArray[np.float32]
    seen_dot_xy_px: NDArray[np.float64]
    window_px: tuple[int, int, int, int]
    texture: NDArray[np.float32]
    strip_reference: NDArray[np.float32]
    strip_threshold: NDArray[np.float32]
    seen_object: NDArray[np.float64]  # x, y in px, contrast
    hot_xy: NDArray[np.int64]
    hot_rate_hz: NDArray[np.float64]
    dropped: int = 0
    strip_level: NDArray[np.float32] = field(init=False)
    keys: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.strip_level = np.empty_like(self.strip_reference)
        # As long as a slice may be: nothing has to grow, and memory is only taken as far as it is written.
        self.keys = np.empty(self.model.max_events, np.int64)


def start(
    model: CameraModel,
    dot_xy_px: ArrayLike,
    dot_radius_px: float | None,
    window_px: tuple[int, int, int, int] | None,
    texture: NDArray[np.float32] | None,
    rng: np.random.Generator,
) -> CameraState:
    """Switch the camera on before dots (dots, 2), draw its thresholds and hot pixels, and give every pixel a random phase.

    A pixel's reference starts at its level plus a uniform phase in (-C_i, C_i), with the window dark; without it all
    pixels of a rim would fire at once. `dot_radius_px` None takes the model's. `window_px` is x0, y0, x1, y1, ends excluded;
    its pixels see the texture (powers of two, from `optics.texture`) and no dots; without texture they see nothing.
    ValueError on non-finite positions, a window outside the frame, a texture of wrong shape or without a window.
    """
    width, height = model.frame_px
    dots = _positions("dot_xy_px", dot_xy_px)
    radius_px = model.dot_radius_px if dot_radius_px is None else float(dot_radius_px)
    _check_range("dot_radius_px", radius_px, 0.01, 1000.0)
    profile = optics.dot_profile(model.edge_sigma_px, model.log_contrast)

    threshold = model.threshold * (1.0 + model.mismatch * rng.standard_normal((height, width)))
    threshold = np.maximum(threshold, LOWEST_THRESHOLD * model.threshold)
    phase = threshold * rng.uniform(-1.0, 1.0, (height, width))
    reference = (optics.gel_level(model.frame_px, dots, radius_px, profile) + phase).astype(np.float32)
    hot = rng.choice(width * height, model.hot_pixels, replace=False)

    x0, y0, x1, y1 = _window(window_px, texture, model.frame_px)
    strip_threshold = threshold[y0:y1, x0:x1].astype(np.float32)
    strip_reference = phase[y0:y1, x0:x1].astype(np.float32)
    threshold[y0:y1, x0:x1] = np.inf
    return CameraState(
        model=model,
        dot_radius_px=radius_px,
        profile=profile,
        reference=reference,
        threshold=threshold.astype(np.float32),
        seen_dot_xy_px=dots.copy(),
        window_px=(x0, y0, x1, y1),
        texture=np.zeros((8, 8), np.float32) if texture is None else np.ascontiguousarray(texture, np.float32),
        strip_reference=strip_reference,
        strip_threshold=strip_threshold,
        seen_object=np.zeros(3),
        hot_xy=np.stack([hot % width, hot // width], axis=1),
        hot_rate_hz=rng.uniform(*model.hot_rate_hz, model.hot_pixels),
    )
