"""Events as images for networks, at a fixed rate: counts, histograms, voxels and time surfaces, online and offline.

The images are those of tonic (ToFrame, to_voxel_grid, to_timesurface), with one exception: the window of a voxel grid
does not begin and end with its first and last event. `start` and `step` take one slice after the other, and return an
image whenever one is due. `fold` takes blocks of slices, and returns identical bits.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events, SliceBlock, concatenate, empty
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.event_representation import POLARITIES, Representation

MOST_COUNTED = np.iinfo(np.int16).max  # counts of a pixel saturate here
NEVER = -1  # time of the last event of a pixel without events
AT_ONCE_BYTES = 1 << 26  # of images in a block; smaller ones are slower, because numpy must clear reused memory


class ImageBlock(NamedTuple):
    """Consecutive images (n, ...) and the time in us at which each ends, (n,), from the start of the recording.

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
    """State between slices: the mapping of pixels, the slices of the window, and the last event of each pixel."""

    of: Representation
    column: NDArray[np.int64]  # of the image, for each column of the sensor
    row: NDArray[np.int64]
    last_us: NDArray[np.int64]  # of a surface, per channel; else empty
    window: deque[Events] = field(default_factory=deque)
    slices: int = 0
    images: int = 0


def start(of: Representation) -> ImageState:
    """Return the state before the first slice."""
    column, row = (
        np.arange(frame, dtype=np.int64) * size // frame for frame, size in zip(of.frame_px, of.size_px, strict=True)
    )
    last_us = np.full(of.shape if of.kind == "surface" else (0, 0, 0), NEVER, np.int64)
    window: deque[Events] = deque(maxlen=1 if of.kind == "surface" else of.longest_ms)
    return ImageState(of, column, row, last_us, window)


def step(state: ImageState, events: Events) -> NDArray[Any] | None:
    """Process one more slice; return a new image if one ends with it, else None.

    Times count from the first slice. ValueError for events outside the frame, or outside the time of their slice.
    """
    first_us = state.slices * SLICE_US
    if events.size and not first_us <= events.t[0] <= events.t[-1] < first_us + SLICE_US:
        expected = f"times from {first_us} to {first_us + SLICE_US - 1} us in slice {state.slices}"
        raise ValueError(f"expected {expected}, found {events.t[0]} to {events.t[-1]}")
    state.window.append(events)
    state.slices += 1
    due = state.slices >= state.of.end(state.images)
    images = np.zeros((int(due), *state.of.shape), state.of.dtype)
    if due or state.of.kind == "surface":  # a surface must see every event; its window holds only the newest slice
        begins = np.full(int(due), state.of.begin(state.images))
        _draw(state, concatenate(list(state.window)), begins, np.full(int(due), state.slices), images)
    state.images += due
    return images[0] if due else None


def fold(of: Representation, blocks: Iterable[SliceBlock]) -> Iterator[ImageBlock]:
    """Yield the images of consecutive blocks of slices, several per block; the first block starts at slice 0."""
    state, kept = start(of), empty()
    at_once = max(1, AT_ONCE_BYTES // (int(np.prod(of.shape)) * np.dtype(of.dtype).itemsize))
    for block in blocks:
        events = concatenate([kept, block.events])
        due = range(state.images, of.images(block.stop))
        for first in range(0, len(due), at_once):
            numbers = due[first : first + at_once]
            begins, ends = (np.array([edge(image) for image in numbers], np.int64) for edge in (of.begin, of.end))
            images = np.zeros((len(ends), *of.shape), of.dtype)
            _draw(state, events, begins, ends, images)
            if of.kind == "surface":
                events = events.part(int(np.searchsorted(events.t, ends[-1] * SLICE_US)), events.size)
            yield ImageBlock(ends * SLICE_US, images)
        state.images = due.stop
        kept = events
        if of.kind != "surface":
            oldest_us = of.begin(due.stop) * SLICE_US
            kept = events.part(int(np.searchsorted(events.t, oldest_us)), events.size)


def images_ending(of: Representation, events: Events, ends: NDArray[np.int64]) -> NDArray[Any]:
    """Return the images (n, ...) that end before these slices, in order; times of events count from slice 0.

    Each covers the longest window of the representation. A surface only uses these events. ValueError for events
    outside the frame.
    """
    images = np.zeros((len(ends), *of.shape), of.dtype)
    _draw(start(of), events, ends - of.longest_ms, ends, images)
    return images


def _draw(
    state: ImageState, events: Events, begins: NDArray[np.int64], ends: NDArray[np.int64], images: NDArray[Any]
) -> None:
    """Draw the images of the slices [begins, ends).

    For a surface, the events are those since its last image; without an image they are only stored.
    """
    of = state.of
    t, x, y, p = events
    places = state.column, state.row
    end_us = ends * SLICE_US
    last = np.searchsorted(t, end_us)
    if of.kind == "surface":
        edges = np.append(0, last if len(last) else len(t))
        of_channel = of.polarity == "split", edges, end_us, of.decay_ms * SLICE_US, state.last_us
        inside = _remember_and_decay(t, x, y, p, *places, *of_channel, images)
    else:
        begin_us = begins * SLICE_US
        windows = np.searchsorted(t, begin_us), last, begin_us, end_us - begin_us
        if of.kind == "voxels":
            inside = _share(t, x, y, p, *places, *windows, images)
        else:
            bins = of.bins if of.kind == "histogram" else 1
            binned = images.reshape(*images.shape[:2], bins, *images.shape[-2:])
            inside = _count(t, x, y, p, *places, *windows, POLARITIES.index(of.polarity), binned)
    if not inside:
        width, height = of.frame_px
        raise ValueError(f"expected events within {width} x {height} px, found events outside")


@njit(cache=True)
def _count(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64],
    begin_us: NDArray[np.int64], window_us: NDArray[np.int64], polarity: int, images: NDArray[np.int16],
) -> bool:  # fmt: skip
    """Count the events [first, last) of each image by channel and bin; return whether all were within the frame.

    polarity: index in POLARITIES.
    """
    bins = images.shape[2]
    for number in range(images.shape[0]):
        image = images[number]
        for i in range(first[number], last[number]):
            if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0]):
                return False
            place = (t[i] - begin_us[number]) * bins // window_us[number] if bins > 1 else 0
            channel = 1 if polarity == 0 and p[i] > 0 else 0
            more = -1 if polarity == 1 and p[i] == 0 else 1
            value = image[channel, place, row[y[i]], column[x[i]]] + more
            if -MOST_COUNTED <= value <= MOST_COUNTED:
                image[channel, place, row[y[i]], column[x[i]]] = value
    return True


@njit(cache=True)
def _share(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], first: NDArray[np.int64], last: NDArray[np.int64],
    begin_us: NDArray[np.int64], window_us: NDArray[np.int64], images: NDArray[np.float32],
) -> bool:  # fmt: skip
    """Distribute each event of an image over the two nearest bins; return whether all were within the frame."""
    bins = images.shape[1]
    for number in range(images.shape[0]):
        image = images[number]
        for i in range(first[number], last[number]):
            if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0]):
                return False
            place = (t[i] - begin_us[number]) * bins / window_us[number]
            left = int(place)
            right = place - left
            sign = 1.0 if p[i] > 0 else -1.0
            image[left, row[y[i]], column[x[i]]] += np.float32(sign * (1.0 - right))
            if left + 1 < bins:
                image[left + 1, row[y[i]], column[x[i]]] += np.float32(sign * right)
    return True


@njit(cache=True)
def _remember_and_decay(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8],
    column: NDArray[np.int64], row: NDArray[np.int64], split: bool, edges: NDArray[np.int64],
    end_us: NDArray[np.int64], decay_us: float, last_us: NDArray[np.int64], images: NDArray[np.float32],
) -> bool:  # fmt: skip
    """Store the time of the last event of each pixel, and draw its decay: 1 now, 0 for no event.

    Image k follows the events [edges[k], edges[k + 1]). Return whether all were within the frame.
    """
    for number in range(edges.shape[0] - 1):
        for i in range(edges[number], edges[number + 1]):
            if not (0 <= x[i] < column.shape[0] and 0 <= y[i] < row.shape[0]):
                return False
            last_us[1 if split and p[i] > 0 else 0, row[y[i]], column[x[i]]] = t[i]
        if number == images.shape[0]:
            return True
        image = images[number]
        for channel in range(last_us.shape[0]):
            for i in range(last_us.shape[1]):
                for j in range(last_us.shape[2]):
                    if last_us[channel, i, j] >= 0:
                        image[channel, i, j] = np.exp((last_us[channel, i, j] - end_us[number]) / decay_us)
    return True
