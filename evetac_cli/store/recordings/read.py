"""Recordings slice by slice or in blocks of slices, and where their slip begins."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.events import SLICE_US, Events, SliceBlock, empty
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.marks import Mark, marks_of

if TYPE_CHECKING:
    from evetac_cli.kernels.event_drawing import ImageBlock
    from evetac_cli.kernels.event_representation import Kind, Polarity, Representation

BLOCK_SLICES = 1000
RATE_HZ = 200.0  # of images of events, unless asked for another
HOT_PIXELS = "sensor/hot_xy_px"
UNKNOWN_SENSOR = "unknown"  # the name of the sensor of an imported recording


class Recording(StageFile):
    """A recording as a sequence of slices: len() in ms, [k] and iteration give Events, read block by block.

    What takes many slices at a time is quicker on `blocks`.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     burst = recording.between(120, 170)          # the slices [120, 170) in one
    >>> bool(burst.t[-1] < 170_000)
    True
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "recording")
        try:
            self.starts: NDArray[np.int64] = self.read("ms_to_idx")
        except BaseException:
            self.close()
            raise
        self._last = SliceBlock(0, np.zeros(1, np.int64), empty())  # that [k] read from

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def event_count(self) -> int:
        """Number of events of the whole recording."""
        return int(self.starts[-1])

    @property
    def frame_px(self) -> tuple[int, int]:
        """Width and height of the sensor's frame."""
        width, height = self.read("sensor/frame_px")
        return int(width), int(height)

    @property
    def window_px(self) -> tuple[int, int, int, int] | None:
        """The cut-out strip x0, y0, x1, y1, or None for a closed gel."""
        if not self.has("sensor/window_px"):
            return None
        x0, y0, x1, y1 = self.read("sensor/window_px").tolist()
        return x0, y0, x1, y1

    @property
    def dot_xy_px(self) -> NDArray[np.float64] | None:
        """Dot centres at rest (rows, columns, 2), or None where no calibration is stored."""
        return self.read("sensor/dot_xy_px") if self.has("sensor/dot_xy_px") else None

    @property
    def dot_radius_px(self) -> float | None:
        """Radius of the printed dots, or None where no calibration is stored."""
        return float(self.read("sensor/dot_radius_px")) if self.has("sensor/dot_radius_px") else None

    def hot_pixels(self) -> NDArray[np.bool_]:
        """Mask of the pixels that its calibration names as hot, (height, width); none where it names none."""
        width, height = self.frame_px
        hot = np.zeros((height, width), np.bool_)
        if self.has(HOT_PIXELS):
            x, y = self.read(HOT_PIXELS).T
            hot[y, x] = True
        return hot

    @property
    def marks(self) -> list[Mark]:
        """What a robot's program marked while it was recorded (`record --listen`): slice, t_us and text of each.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     lifted = [mark.slice for mark in recording.marks if mark.text == "lifted"]
        >>> lifted
        []
        """
        return marks_of(self)

    def sensor_datasets(self) -> dict[str, Any]:
        """What belongs to the sensor, `sensor/...` by name: dot grid, window, frame size, to be copied along."""
        return {name: self.read(name) for name in self.contents() if name.startswith("sensor/")}

    def between(self, start: int, stop: int) -> Events:
        """All events of the slices [start, stop) in one; t stays absolute."""
        self._check_range(start, stop)
        return self.events(int(self.starts[start]), int(self.starts[stop]))

    def blocks(self, ms: int = BLOCK_SLICES, start: int = 0, stop: int | None = None) -> Iterator[SliceBlock]:
        """All slices, or the slices [start, stop), in blocks of `ms` slices each, of which the last may be shorter.

        A block without events is still a block. Each is read when it is asked for, and stays valid after that.
        InputError for less than 1 ms, or slices out of range.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     for block in recording.blocks(ms=100):
        ...         per_slice = np.diff(block.starts)
        ...         image = np.zeros((480, 640), np.int32)
        ...         np.add.at(image, (block.events.y, block.events.x), 1)
        >>> per_slice.sum() == image.sum() == block.events.size
        True
        """
        stop = len(self) if stop is None else stop
        self._check_range(start, stop)
        if ms < 1:
            raise InputError("no length of a block", where="ms", expected="at least 1", found=str(ms))
        return (self._block(first, min(first + ms, stop)) for first in range(start, stop, ms))

    def frames(
        self,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
        polarity: "Polarity" = "split",
    ) -> Iterator["ImageBlock"]:
        """Counts of events (channels, height, width) at a fixed rate, in blocks of images; see `Representation`.

        size_px: width and height, the sensor's unless given. window_ms: what an image counts, from one image to the
        next unless given. InputError for numbers that cannot be.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     for block in recording.frames(rate_hz=200, size_px=(160, 120)):
        ...         counts = block.images          # (images, 2, 120, 160): OFF, ON
        >>> counts.shape[1:], counts.dtype.name
        ((2, 120, 160), 'int16')
        """
        return self.images(self.representation("frames", rate_hz, size_px, window_ms, polarity=polarity))

    def histogram(
        self,
        bins: int = 5,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
        polarity: "Polarity" = "split",
    ) -> Iterator["ImageBlock"]:
        """Counts as of `frames`, of each of the `bins` that the window is divided into (channels, bins, height, width).

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     block = next(recording.histogram(bins=10, window_ms=50, size_px=(64, 48)))
        >>> block.images.shape[1:]
        (2, 10, 48, 64)
        """
        of = self.representation("histogram", rate_hz, size_px, window_ms, bins=bins, polarity=polarity)
        return self.images(of)

    def voxels(
        self,
        bins: int = 5,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
    ) -> Iterator["ImageBlock"]:
        """Voxel grids (bins, height, width): ON is 1, OFF -1, shared between the two nearest bins; else as `frames`.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     block = next(recording.voxels(bins=5, window_ms=50, size_px=(160, 120)))
        >>> block.images.shape[1:], block.images.dtype.name
        ((5, 120, 160), 'float32')
        """
        return self.images(self.representation("voxels", rate_hz, size_px, window_ms, bins=bins))

    def time_surface(
        self,
        decay_ms: float = 10.0,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        polarity: "Polarity" = "split",
    ) -> Iterator["ImageBlock"]:
        """Time surfaces: exp(-(age of each pixel's last event) / decay_ms), 0 where there was none; else as `frames`.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     block = next(recording.time_surface(decay_ms=20, size_px=(112, 90)))
        >>> float(block.images.min()), float(block.images.max()) <= 1.0
        (0.0, True)
        """
        of = self.representation("surface", rate_hz, size_px, polarity=polarity, decay_ms=decay_ms)
        return self.images(of)

    def representation(
        self,
        kind: "Kind",
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
        **more: Any,
    ) -> "Representation":
        """What images of this recording show, from the parameters of `frames` and its like; InputError as there."""
        from evetac_cli.kernels.event_representation import representation

        try:
            return representation(kind, self.frame_px, size_px, rate_hz, window_ms, **more)
        except ValueError as error:
            raise InputError(f"no such images: {error}", where=str(self.path)) from None

    def images(self, of: "Representation") -> Iterator["ImageBlock"]:
        """The images of a representation, in blocks of images; ValueError if it is of another frame."""
        from evetac_cli.kernels.event_drawing import fold

        return fold(of, self.blocks())

    def _block(self, first: int, stop: int) -> SliceBlock:
        starts = self.starts[first : stop + 1]
        return SliceBlock(first, starts - starts[0], self.events(int(starts[0]), int(starts[-1])))

    def _check_range(self, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= len(self):
            raise InputError(
                "slices out of range",
                where=str(self.path),
                expected=f"0 <= start <= stop <= {len(self)}",
                found=f"{start}, {stop}",
            )

    def events(self, first: int, last: int) -> Events:
        """The events [first, last), counted from the start of the recording; SchemaError if their slice is another."""
        events = Events(*(self.read(f"events/{column}", first, last) for column in Events._fields))
        if events.size:
            self.check_slices(events.t, first, last)
        return events

    def check_slices(self, t: NDArray[np.int64], first: int, last: int) -> None:
        """Raise SchemaError unless the events [first, last), whose times do not decrease, lie in their slices."""
        begin, end = np.searchsorted(self.starts, (first, last - 1), side="right")
        edges = np.clip(self.starts[begin - 1 : end + 1], first, last) - first
        slices = np.arange(begin - 1, end)
        held = edges[1:] > edges[:-1]
        earliest, latest = t[edges[:-1][held]], t[edges[1:][held] - 1]
        wrong = (earliest < slices[held] * SLICE_US) | (latest >= (slices[held] + 1) * SLICE_US)
        if wrong.any():
            index = int(np.argmax(wrong))
            slice_ = int(slices[held][index])
            raise SchemaError(
                "ms_to_idx does not fit events/t",
                where=str(self.path),
                expected=f"times from {slice_ * SLICE_US} to {(slice_ + 1) * SLICE_US - 1} us in slice {slice_}",
                found=f"{earliest[index]} to {latest[index]}",
            )

    def __getitem__(self, index: int) -> Events:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index %= len(self)
        if not self._last.first <= index < self._last.stop:
            first = index - index % BLOCK_SLICES
            self._last = self._block(first, min(first + BLOCK_SLICES, len(self)))
        at = index - self._last.first
        return self._last.events.part(*self._last.starts[at : at + 2].tolist())

    def __iter__(self) -> Iterator[Events]:
        for block in self.blocks(BLOCK_SLICES):
            yield from block.slices()


def open_recording(path: str | Path) -> Recording:
    """Open a recording for reading by slices; InputError if it is anything else.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     counts = [events.size for events in recording]      # one Events a millisecond
    ...     shear_n = recording.read("truth/shear_force_n")     # any dataset by its path
    >>> len(counts) == len(shear_n)
    True
    """
    return Recording(Path(path))


def ramp_start(recording: Recording) -> int:
    """The slice in which a current that holds the object first changes, or gives way to a position; 0 without one."""
    if not recording.has("gripper"):
        return 0
    target_ma = recording.read("gripper/current_target_ma")
    held = np.isfinite(target_ma[:-1])  # NaN in position mode
    changed = np.flatnonzero(held & (target_ma[1:] != target_ma[:-1]))
    return int(recording.read("gripper/t_us")[changed[0] + 1] // SLICE_US) if len(changed) else 0


def true_onset(recording: Recording, first: int = 0, stop: int | None = None) -> int | None:
    """The first slice of gross slip in first .. stop, since the current began to fall; None where there is none."""
    return first_slice(recording.read("truth/slip")[:stop] > 0, max(first, ramp_start(recording)))


def first_slice(is_so: NDArray[np.bool_], start: int) -> int | None:
    """The first slice from `start` on that is marked, of (slices,); None without one."""
    slices = start + np.flatnonzero(is_so[start:])
    return int(slices[0]) if len(slices) else None
