"""Contents of event images: kind, size, rate and window, which event_drawing.py draws; and an image for people.

Free of compiled code, so that tables, pages and exports do not load numba.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import check_range, check_whole
from evetac_cli.events import FRAME_PX, SLICES_PER_S

Kind = Literal["frames", "histogram", "voxels", "surface"]
Polarity = Literal["split", "signed", "sum"]
KINDS: tuple[Kind, ...] = ("frames", "histogram", "voxels", "surface")
POLARITIES: tuple[Polarity, ...] = ("split", "signed", "sum")
MOST_WINDOW_MS, MOST_BINS, MOST_DECAY_MS = 100_000, 1_000, 100_000.0  # upper limits, beyond any practical use


@dataclass(frozen=True)
class Representation:
    """Contents of event images. ValueError for impossible numbers.

    `kind` is one of:

    - `frames`: counts of the window, (channels, height, width), int16.
    - `histogram`: counts of each of its `bins`, (channels, bins, height, width), int16.
    - `voxels`: ON as 1 and OFF as -1, distributed linearly over the two nearest bins, (bins, height, width), float32.
    - `surface`: exp(-(age of the last event) / decay_ms), 0 without an event, (channels, height, width), float32.

    `frame_px`: width and height of the sensor's frame. `size_px`: of the images, whose pixels sum those of the sensor.
    `rate_hz`: image k ends with slice floor((k + 1) * 1000 / rate_hz). `window_ms`: time that an image covers (not
    `surface`); the first images may cover less. With None, an image begins where the one before it ended, so each event
    counts once. `polarity`: `split` has two channels, OFF and ON; `signed` has one, ON
    minus OFF; `sum` has one of both. Voxels are always signed, surfaces never.
    """

    kind: Kind
    frame_px: tuple[int, int]
    size_px: tuple[int, int]
    rate_hz: float
    window_ms: int | None = None
    bins: int = 5
    polarity: Polarity = "split"
    decay_ms: float = 10.0

    def __post_init__(self) -> None:
        for name, value, allowed in (("kind", self.kind, KINDS), ("polarity", self.polarity, POLARITIES)):
            if value not in allowed:
                raise ValueError(f"{name}: expected {', '.join(allowed)}, found {value!r}")
        if self.kind == "surface" and self.polarity == "signed":
            raise ValueError("polarity: expected split or sum for surface, found 'signed'")
        if np.shape(self.size_px) != (2,):
            raise ValueError(f"size_px: expected width and height, found {self.size_px!r}")
        for place, name in enumerate(("width", "height")):
            check_whole(f"{name} of size_px", self.size_px[place], 1, self.frame_px[place])
        check_range("rate_hz", self.rate_hz, 0.0, SLICES_PER_S, "1/s", above=True)
        if self.window_ms is not None:
            check_whole("window_ms", self.window_ms, 1, MOST_WINDOW_MS)
        check_whole("bins", self.bins, 1, MOST_BINS)
        check_range("decay_ms", self.decay_ms, 0.0, MOST_DECAY_MS, "ms", above=True)

    @property
    def used(self) -> tuple[str, ...]:
        """The fields that matter for this kind."""
        of_kind = {
            "frames": ("window_ms", "polarity"),
            "histogram": ("window_ms", "bins", "polarity"),
            "voxels": ("window_ms", "bins"),
            "surface": ("decay_ms", "polarity"),
        }
        return ("kind", "frame_px", "size_px", "rate_hz", *of_kind[self.kind])

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one image."""
        width, height = self.size_px
        channels = 2 if self.polarity == "split" else 1
        if self.kind == "voxels":
            return self.bins, height, width
        return (channels, self.bins, height, width) if self.kind == "histogram" else (channels, height, width)

    @property
    def dtype(self) -> type[Any]:
        """Type of the values."""
        return np.int16 if self.kind in ("frames", "histogram") else np.float32

    @property
    def longest_ms(self) -> int:
        """The most slices that an image covers."""
        return math.ceil(SLICES_PER_S / self.rate_hz - 1e-9) if self.window_ms is None else self.window_ms

    def begin(self, image: int) -> int:
        """Return the slice with which an image, counted from 0, begins; below 0 if before the recording."""
        return self.end(image - 1) if self.window_ms is None else self.end(image) - self.window_ms

    def end(self, image: int) -> int:
        """Return the slice before which an image, counted from 0, ends."""
        return math.floor((image + 1) * SLICES_PER_S / self.rate_hz + 1e-9)

    def images(self, slices: int) -> int:
        """Return the number of images that end within this number of slices."""
        images = math.floor(slices * self.rate_hz / SLICES_PER_S)
        return images + (self.end(images) <= slices)


def representation(
    kind: Kind, frame_px: tuple[int, int], size_px: tuple[int, int] | None, rate_hz: float, window_ms: int | None,
    **more: Any,
) -> Representation:  # fmt: skip
    """Return a Representation; by default images have the size of the frame."""
    return Representation(kind, frame_px, frame_px if size_px is None else size_px, rate_hz, window_ms, **more)


def event_image(
    x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], frame_px: tuple[int, int] = FRAME_PX
) -> NDArray[np.int8]:
    """Draw events, in order of time, as (height, width): +1 brighter, -1 darker, 0 none; a pixel's last event wins.

    frame_px is (width, height); events outside it are left out.
    Source: paper, "Evetac Touch Features", the set of events in image form.
    """
    assert x.ndim == 1 and x.shape == y.shape == p.shape
    width, height = frame_px
    image = np.zeros((height, width), np.int8)
    inside = (x < width) & (y < height)
    image[y[inside], x[inside]] = np.where(p[inside], np.int8(1), np.int8(-1))  # the last of several events stays
    return image
