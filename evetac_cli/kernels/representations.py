"""Events as images for networks, at a fixed rate: counts, histograms, voxels and time surfaces, online as offline.

What they are is as in tonic (ToFrame, to_voxel_grid, to_timesurface); but a voxel grid is of a window of fixed length
there and here, not from the first of its events to the last. `start` and `step` take one slice after the other, and
give an image whenever one is due; `fold` takes blocks of slices, and gives the same bits.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range
from evetac_cli.events import SLICE_US, SLICES_PER_S, Events, SliceBlock, concatenate, empty
from evetac_cli.kernels.compiled import njit

Kind = Literal["frames", "histogram", "voxels", "surface"]
Polarity = Literal["split", "signed", "sum"]
KINDS: tuple[Kind, ...] = ("frames", "histogram", "voxels", "surface")
POLARITIES: tuple[Polarity, ...] = ("split", "signed", "sum")
MOST_COUNTED = np.iinfo(np.int16).max  # of a pixel: a count goes no further
MOST_WINDOW_MS, MOST_BINS, MOST_DECAY_MS = 100_000, 1_000, 100_000.0
NEVER = -1  # time of the last event of a pixel that had none
AT_ONCE_BYTES = 1 << 24  # of images in a block, unless a single one is larger


@dataclass(frozen=True)
class Representation:
    """What images show of events. ValueError for numbers that cannot be.

    kind: `frames`, counts of the window (channels, height, width), int16; `histogram`, counts of each of its `bins`
    (channels, bins, height, width), int16; `voxels`, ON as 1 and OFF as -1, shared between the two nearest bins by how
    near they are, (bins, height, width), float32; `surface`, exp(-(age of the last event) / decay_ms), 0 where there
    was none, (channels, height, width), float32.
    frame_px: width and height of the sensor's frame; size_px: of the images, whose pixels add up the sensor's.
    rate_hz: image k ends with slice floor((k + 1) * 1000 / rate_hz); window_ms: what it looks back on (not `surface`);
    one that ends earlier looks back on less. polarity: `split` has two channels, OFF and ON; `signed` has one, ON less
    OFF; `sum` has one of both. Voxels are always signed, surfaces never.
    """

    kind: Kind
    frame_px: tuple[int, int]
    size_px: tuple[int, int]
    rate_hz: float
    window_ms: int
    bins: int = 5
    polarity: Polarity = "split"
    decay_ms: float = 10.0

    def __post_init__(self) -> None:
        for name, value, allowed in (("kind", self.kind, KINDS), ("polarity", self.polarity, POLARITIES)):
            if value not in allowed:
                raise ValueError(f"{name}: expected {', '.join(allowed)}, found {value!r}")
        if self.kind == "surface" and self.polarity == "signed":
            raise ValueError("polarity: expected split or sum for surface, found 'signed'")
        for place, name in enumerate(("width", "height")):
            check_range(f"{name} of size_px", self.size_px[place], 1, self.frame_px[place], "px")
        check_range("rate_hz", self.rate_hz, 0.0, SLICES_PER_S, "1/s", above=True)
        check_range("window_ms", self.window_ms, 1, MOST_WINDOW_MS, "ms")
        check_range("bins", self.bins, 1, MOST_BINS)
        check_range("decay_ms", self.decay_ms, 0.0, MOST_DECAY_MS, "ms", above=True)

    @property
    def used(self) -> tuple[str, ...]:
        """The fields that matter for its kind."""
        of_kind = {
            "frames": ("window_ms", "polarity"),
            "histogram": ("window_ms", "bins", "polarity"),
            "voxels": ("window_ms", "bins"),
            "surface": ("decay_ms", "polarity"),
        }
        return ("kind", "frame_px", "size_px", "rate_hz", *of_kind[self.kind])

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one image."""
        width, height = self.size_px
        channels = 2 if self.polarity == "split" else 1
        if self.kind == "voxels":
            return self.bins, height, width
        return (channels, self.bins, height, width) if self.kind == "histogram" else (channels, height, width)

    @property
    def dtype(self) -> type[Any]:
        """Of its values."""
        return np.int16 if self.kind in ("frames", "histogram") else np.float32

    def end(self, image: int) -> int:
        """The slice that the image, counted from 0, ends before."""
        return math.floor((image + 1) * SLICES_PER_S / self.rate_hz + 1e-9)

    def images(self, slices: int) -> int:
        """How many images end within so many slices."""
        images = math.floor(slices * self.rate_hz / SLICES_PER_S)
        return images + (self.end(images) <= slices)


def representation(
    kind: Kind, frame_px: tuple[int, int], size_px: tuple[int, int] | None, rate_hz: float, window_ms: int | None,
    **more: Any,
) -> Representation:  # fmt: skip
    """A Representation of the size of the frame, and of a window from one image to the next, unless they are given."""
    check_range("rate_hz", rate_hz, 0.0, SLICES_PER_S, "1/s", above=True)
    window_ms = math.ceil(SLICES_PER_S / rate_hz - 1e-9) if window_ms is None else window_ms
    return Representation(kind, frame_px, frame_px if size_px is None else size_px, rate_hz, window_ms, **more)


class ImageBlock(NamedTuple):
    """Consecutive images (n, ...) and the time in us that each ends at (n,), from the start of the recording.

    torch.from_numpy(block.images) makes a tensor of them without a copy.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     block = next(recording.frames(rate_hz=100))
    >>> block.end_us[:2].tolist(), block.images.shape[1:]
    ([10000, 20000], (2, 480, 640))
    """

    end_us: NDArray[np.int64]
    images: NDArray[Any]


@dataclass
class ImageState:
    """What is kept between slices: where pixels go, the slices of the window, and the last event of each pixel."""

    of: Representation
    column: NDArray[np.int64]  # of the image, by that of the sensor
    row: NDArray[np.int64]
    last_us: NDArray[np.int64]  # of a surface, by channel; else empty
    window: deque[Events] = field(default_factory=deque)
    slices: int = 0
    images: int = 0


def start(of: Representation) -> ImageState:
    """Before the first slice."""
    column, row = (
        np.arange(frame, dtype=np.int64) * size // frame for frame, size in zip(of.frame_px, of.size_px, strict=True)
    )
    last_us = np.full(of.shape if of.kind == "surface" else (0, 0, 0), NEVER, np.int64)
    window: deque[Events] = deque(maxlen=0 if of.kind == "surface" else of.window_ms)
    return ImageState(of, column, row, last_us, window)


def step(state: ImageState, events: Events) -> NDArray[Any] | None:
    """Take one more slice; an image, a new array, where one ends with it, else None.

    Times are from the first slice on. ValueError for events beside the frame, or of another time than their slice's.
    """
    state.window.append(events)
    state.slices += 1
    if state.of.kind == "surface":
        _remember_events(state, events)
    if state.slices < state.of.end(state.images):
        return None
    state.images += 1
    image = np.zeros(state.of.shape, state.of.dtype)
    _draw(state, concatenate(list(state.window)), state.slices, image)
    return image


def fold(of: Representation, blocks: Iterable[SliceBlock]) -> Iterator[ImageBlock]:
    """The images of consecutive blocks of slices, in blocks of some; the first block begins with slice 0."""
    state, kept = start(of), empty()
    at_once = max(1, AT_ONCE_BYTES // (int(np.prod(of.shape)) * np.dtype(of.dtype).itemsize))
    for block in blocks:
        events = concatenate([kept, block.events])
        due = range(state.images, of.images(block.stop))
        for first in range(0, len(due), at_once):
            ends = [of.end(image) for image in due[first : first + at_once]]
            images = np.zeros((len(ends), *of.shape), of.dtype)
            for end, image in zip(ends, images, strict=True):
                begin = state.slices if of.kind == "surface" else max(end - of.window_ms, 0)
                part = events.part(*np.searchsorted(events.t, (begin * SLICE_US, end * SLICE_US)).tolist())
                if of.kind == "surface":
                    _remember_events(state, part)
                    state.slices = end
                _draw(state, part, end, image)
            yield ImageBlock(np.array(ends, np.int64) * SLICE_US, images)
        state.images = due.stop
        needed = state.slices if of.kind == "surface" else of.end(due.stop) - of.window_ms
        kept = events.part(int(np.searchsorted(events.t, needed * SLICE_US)), events.size)


def _remember_events(state: ImageState, events: Events) -> None:
    split = state.of.polarity == "split"
    if not _remember(*events, state.column, state.row, split, state.last_us):
        raise _beside(state)


def _draw(state: ImageState, events: Events, end: int, image: NDArray[Any]) -> None:
    """Draw the image that ends before a slice; events: of its window."""
    of = state.of
    t, x, y, p = events
    places = state.column, state.row
    if of.kind == "surface":
        _decay(state.last_us, end * SLICE_US, of.decay_ms * SLICE_US, image)
        return
    window_us = of.window_ms * SLICE_US
    begin_us = end * SLICE_US - window_us
    if of.kind == "voxels":
        inside = _share(t, x, y, p, *places, begin_us, window_us, image)
    else:
        binned = image.reshape(image.shape[0], of.bins if of.kind == "histogram" else 1, *image.shape[-2:])
        inside = _count(t, x, y, p, *places, begin_us, window_us, POLARITIES.index(of.polarity), binned)
    if not inside:
        raise _beside(state)


def _beside(state: ImageState) -> ValueError:
    width, height = state.of.frame_px
    return ValueError(f"expected events within {width} x {height} px and the time of their slices, found others")


@njit(cache=True)
def _count(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], begin_us: int, window_us: int, polarity: int,
    image: NDArray[np.int16],
) -> bool:  # fmt: skip
    """Count events by channel and bin; whether all were within frame and window.

    polarity: its place in POLARITIES.
    """
    bins = image.shape[1]
    for i in range(t.shape[0]):
        place = (t[i] - begin_us) * bins // window_us if bins > 1 else 0
        if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0] and 0 <= place < bins):
            return False
        channel = 1 if polarity == 0 and p[i] > 0 else 0
        more = -1 if polarity == 1 and p[i] == 0 else 1
        value = image[channel, place, row[y[i]], column[x[i]]] + more
        if -MOST_COUNTED <= value <= MOST_COUNTED:
            image[channel, place, row[y[i]], column[x[i]]] = value
    return True


@njit(cache=True)
def _share(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], begin_us: int, window_us: int, image: NDArray[np.float32],
) -> bool:  # fmt: skip
    """Share each event between the two bins about it; whether all were within frame and window."""
    bins = image.shape[0]
    for i in range(t.shape[0]):
        place = (t[i] - begin_us) * bins / window_us
        if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0] and 0.0 <= place < bins):
            return False
        left = int(place)
        right = place - left
        sign = 1.0 if p[i] > 0 else -1.0
        image[left, row[y[i]], column[x[i]]] += np.float32(sign * (1.0 - right))
        if left + 1 < bins:
            image[left + 1, row[y[i]], column[x[i]]] += np.float32(sign * right)
    return True


@njit(cache=True)
def _remember(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], split: bool, last_us: NDArray[np.int64],
) -> bool:  # fmt: skip
    """Note the time of the last event of each pixel; whether all were within the frame."""
    for i in range(t.shape[0]):
        if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0]):
            return False
        last_us[1 if split and p[i] > 0 else 0, row[y[i]], column[x[i]]] = t[i]
    return True


@njit(cache=True)
def _decay(last_us: NDArray[np.int64], end_us: int, decay_us: float, image: NDArray[np.float32]) -> None:
    """How recent the last event of each pixel is: 1 now, 0 never."""
    for channel in range(last_us.shape[0]):
        for row in range(last_us.shape[1]):
            for column in range(last_us.shape[2]):
                if last_us[channel, row, column] >= 0:
                    age_us = end_us - last_us[channel, row, column]
                    image[channel, row, column] = np.exp(-age_us / decay_us)
