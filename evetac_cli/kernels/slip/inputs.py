"""The inputs of a network, from slices of features: numbers for each dot, or a stack of event images.

One kernel serves training, whole trajectories and the online detector, so all three see identical bits. It takes a
series of slices, and the slices at which inputs end. The online detector passes its last slices as a series.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.event_drawing import images_ending
from evetac_cli.kernels.slip import features
from evetac_cli.kernels.slip.architectures import (
    CHANNELS,
    GEL_PX,
    Architecture,
    ChannelView,
    DotArchitecture,
    ImageArchitecture,
    MemoryArchitecture,
    OverImages,
    PluginImageArchitecture,
)
from evetac_cli.kernels.slip.features import EventImages, GelEvents
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath


def known_at_start(t_us: NDArray[np.int64], values: NDArray[np.number], slices: int) -> NDArray[np.float32]:
    """Return the last value, of rising times (rows,), at the start of each slice, (slices,); NaN before the first."""
    last = np.searchsorted(t_us, np.arange(slices, dtype=np.int64) * SLICE_US, side="right") - 1
    result = np.full(slices, np.nan, np.float32)
    result[last >= 0] = values[last[last >= 0]]
    return result


OfEvents = EventImages | GelEvents
Series = NDArray[np.float32] | OfEvents | LoadPath


class Trajectory(NamedTuple):
    """One labelled trajectory, slice by slice: to train a detector on, or to evaluate it."""

    series: Series  # dots, images or steps, depending on the architecture
    events_outside: NDArray[np.int32]  # (slices,) events outside the window strip
    label: NDArray[np.int8]  # (slices,) 1 slip, 0 no slip, -1 not examined
    onset: int  # first slice of slip, -1 if there is none
    slip_share: NDArray[np.float32] | None = None  # (slices,) share of the visible contact that slips, if known
    timed: bool = True  # whether the labels are precise enough to determine the onset


def part(series: Series, first: int, last: int) -> Series:
    """Return the slices [first, last) of a series, as a copy; of steps, first must be 0."""
    if isinstance(series, LoadPath):
        assert first == 0
        steps = last // EVERY
        return LoadPath(series.numbers[:steps].copy(), series.touches[:steps].copy(), last)
    if isinstance(series, OfEvents):
        columns: list[Any] = [column.copy() for column in series.part(first, last)]
        return type(series)(*columns)
    return series[first:last].copy()


class _EndToEnd:
    """Concatenate arrays as they arrive, without holding any of them in memory twice."""

    def __init__(self, first: NDArray[Any]) -> None:
        self._rows, self._count = first.copy(), len(first)

    def add(self, rows: NDArray[Any]) -> None:
        """Append rows."""
        count = self._count + len(rows)
        if count > len(self._rows):
            self._room_for(max(count, len(self._rows) * 9 // 8))
        self._rows[self._count : count] = rows
        self._count = count

    def joined(self) -> NDArray[Any]:
        """Return all rows; nothing can be added after that."""
        self._room_for(self._count)
        return self._rows

    def _room_for(self, rows: int) -> None:
        """Grow or shrink the array: for large arrays the system moves memory pages instead of copying the contents."""
        self._rows.resize((rows, *self._rows.shape[1:]), refcheck=False)


def join(parts: Iterable[Series]) -> Series:
    """Concatenate at least one series of one kind but steps; they are taken one by one, and none of them is kept."""
    left = iter(parts)
    first = next(left)
    columns = [_EndToEnd(column) for column in _columns(first)]
    for part in left:
        for column, rows in zip(columns, _columns(part), strict=True):
            column.add(rows)
    if not isinstance(first, OfEvents):
        return columns[0].joined()
    counts, *rest = (column.joined() for column in columns)
    return type(first)(np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)]), *rest)


def _columns(series: Series) -> Sequence[NDArray[Any]]:
    """Return the parts of a series that can be concatenated: dots, or pixels or events with their counts per slice."""
    if isinstance(series, OfEvents):
        return np.diff(series.start), *series[1:]
    assert not isinstance(series, LoadPath)
    return (series,)


def length(series: Series) -> int:
    """Return the number of slices of a series."""
    if isinstance(series, LoadPath):
        return series.slices
    return len(series.start) - 1 if isinstance(series, OfEvents) else len(series)


def at(architecture: Architecture, series: Series, slices: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the network inputs of the samples that end at these slices of a series, for a network without memory.

    Dots: (slices, n, channels) as from `features.series` -> (samples, n, inputs_per_dot). Images: `EventImages` ->
    (samples, history, height, width), newest first. Images of plug-ins: `GelEvents` -> (samples, images * channels,
    height, width), newest first.
    """
    assert not isinstance(architecture, MemoryArchitecture) and not isinstance(series, LoadPath)
    ends = np.asarray(slices).astype(np.int64, casting="same_kind")
    assert ends.ndim == 1 and (
        not len(ends) or (ends.min() >= architecture.history - 1 and ends.max() < length(series))
    )
    if isinstance(architecture, ImageArchitecture):
        assert isinstance(series, EventImages)
        images = np.zeros((len(ends), *architecture.input_shape), np.float32)
        _images(*series, ends, GEL_PX[0], architecture.pool_px, images)
        return images
    if isinstance(architecture, PluginImageArchitecture):
        assert isinstance(series, GelEvents)
        stacks = np.empty((len(ends), *architecture.input_shape), np.float32)
        for end, stack in zip(ends.tolist(), stacks, strict=True):
            stack[:] = _stack(architecture, series.part(end + 1 - architecture.history, end + 1))
        return stacks
    assert not isinstance(series, OfEvents)
    assert series.ndim == 3 and series.shape[2] == len(CHANNELS)
    dots = np.empty((len(ends), series.shape[1], architecture.inputs_per_dot), np.float32)
    fill(series, ends, view_table(architecture.views), dots)
    return dots


def _stack(architecture: PluginImageArchitecture, events: GelEvents) -> NDArray[Any]:
    """Return the images of one sample, newest first, from the events of its history."""
    t_us = np.repeat(np.arange(architecture.history) * SLICE_US, np.diff(events.start)) + events.t_us
    ends = np.arange(architecture.of.longest_ms, architecture.history + 1, architecture.every)
    images = images_ending(architecture.of, Events(t_us, *events[2:]), ends)
    return images[::-1].reshape(architecture.input_shape)


def turn(
    architecture: Architecture,
    batch: NDArray[np.float32],
    rows: int,
    columns: int,
    turns: NDArray[np.int64],
    factors: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return a batch whose samples are rotated by their quarter turns, 0 to 3, and multiplied by their factors.

    The rotation is that of `features.rotate`.
    """
    if isinstance(architecture, OverImages):
        images = batch * factors.reshape(-1, 1, 1, 1)
        for times in (1, 2, 3):
            is_turned = turns == times
            if is_turned.any():
                turned = features.rotate(np.moveaxis(images[is_turned], 1, 3), times)
                images[is_turned] = np.moveaxis(turned, 3, 1)
        return images
    assert isinstance(architecture, DotArchitecture)
    result = np.empty_like(batch)
    _turn(batch, turns, factors, _turning(rows, columns), result)
    return result


@lru_cache
def _turning(rows: int, columns: int) -> NDArray[np.int64]:
    """Return, for 0 to 3 turns, the dot from which each dot takes its inputs, or -1, (4, n)."""
    places = np.arange(1, rows * columns + 1, dtype=np.float32).reshape(1, rows, columns, 1)
    return np.stack([features.rotate(places, times).reshape(-1) for times in range(4)]).astype(np.int64) - 1


def view_table(views: Sequence[ChannelView]) -> NDArray[np.int64]:
    """Return the views of an architecture for `fill`, (views, 4): channel, recent, block, means."""
    rows = [(CHANNELS.index(view.channel), view.recent, view.block, view.means) for view in views]
    return np.array(rows, np.int64)


@njit(cache=True)
def fill(
    series: NDArray[np.float32], ends: NDArray[np.int64], views: NDArray[np.int64], inputs: NDArray[np.float32]
) -> None:
    """Do the work of `at` for dots, unchecked and into an existing array: for the online detector.

    All channels are summed, even those without a view. They are adjacent in memory, so this is one pass without gaps
    that serves all views with the same blocks.
    """
    slices, dots, channels = series.shape
    flat = series.reshape(slices, dots * channels)
    total = np.empty(dots * channels, np.float32)
    for sample in range(ends.shape[0]):
        end = ends[sample]
        first = 0
        for view in range(views.shape[0]):
            channel, recent, block, means = views[view]
            for ago in range(recent):
                for dot in range(dots):
                    inputs[sample, dot, first + ago] = series[end - ago, dot, channel]
            first += recent + means
        for view in range(views.shape[0]):
            block, means = views[view, 2:4]
            done = False  # whether an earlier view has the same blocks
            for other in range(view):
                done |= views[other, 2] == block and views[other, 3] == means
            for mean in range(0 if done else means):
                newest = end - mean * block
                total[:] = 0
                for ago in range(block):
                    row = flat[newest - ago]
                    for place in range(dots * channels):
                        total[place] += row[place]
                first = 0
                for other in range(views.shape[0]):
                    if views[other, 2] == block and views[other, 3] == means:
                        column = first + views[other, 1] + mean
                        channel = views[other, 0]
                        for dot in range(dots):
                            inputs[sample, dot, column] = total[dot * channels + channel] / np.float32(block)
                    first += views[other, 1] + views[other, 3]


@njit(cache=True)
def _turn(
    batch: NDArray[np.float32],
    turns: NDArray[np.int64],
    factors: NDArray[np.float32],
    was: NDArray[np.int64],
    result: NDArray[np.float32],
) -> None:
    for sample in range(batch.shape[0]):
        times, factor = turns[sample], factors[sample]
        for dot in range(batch.shape[1]):
            before = was[times, dot]
            for place in range(batch.shape[2]):
                result[sample, dot, place] = factor * batch[sample, before, place] if before >= 0 else np.float32(0)


@njit(cache=True)
def _images(
    start: NDArray[np.int64],
    pixel: NDArray[np.uint32],
    sign: NDArray[np.int8],
    ends: NDArray[np.int64],
    width: int,
    pool: int,
    images: NDArray[np.float32],
) -> None:
    for sample in range(ends.shape[0]):
        for ago in range(images.shape[1]):
            image = images[sample, ago]
            for k in range(start[ends[sample] - ago], start[ends[sample] - ago + 1]):
                place = np.int64(pixel[k])
                image[place // width // pool, place % width // pool] += sign[k]
