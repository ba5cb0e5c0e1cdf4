"""Reading of recordings, slice by slice or in blocks of slices; the onset of their slip; windows of features."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, SchemaError
from evetac_cli.events import SLICE_US, Events, SliceBlock, empty
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.streams import Mark, marks_of

if TYPE_CHECKING:
    from evetac_cli.kernels.event_drawing import ImageBlock
    from evetac_cli.kernels.event_representation import Kind, Polarity, Representation

BLOCK_SLICES = 1000
RATE_HZ = 200.0  # default rate of images of events
HOT_PIXELS = "sensor/hot_xy_px"
UNKNOWN_SENSOR = "unknown"  # the name of the sensor of an imported recording


class Recording(StageFile):
    """A recording as a sequence of slices: len() is its length in ms; [k] and iteration return Events.

    Slices are read in blocks. To process many slices at a time, `blocks` is faster.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     burst = recording.between(120, 170)          # all events of the slices [120, 170)
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
        self._last = SliceBlock(0, np.zeros(1, np.int64), empty())  # last block read by [k]

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
        """The window of a cut gel, x0, y0, x1, y1, or None for a closed gel."""
        if not self.has("sensor/window_px"):
            return None
        x0, y0, x1, y1 = self.read("sensor/window_px").tolist()
        return x0, y0, x1, y1

    @property
    def dot_xy_px(self) -> NDArray[np.float64] | None:
        """Dot centres at rest (rows, columns, 2), or None if no calibration is stored."""
        return self.read("sensor/dot_xy_px") if self.has("sensor/dot_xy_px") else None

    @property
    def dot_radius_px(self) -> float | None:
        """Radius of the printed dots, or None if no calibration is stored."""
        return float(self.read("sensor/dot_radius_px")) if self.has("sensor/dot_radius_px") else None

    def hot_pixels(self) -> NDArray[np.bool_]:
        """Return a mask of the hot pixels in the stored calibration, (height, width)."""
        width, height = self.frame_px
        hot = np.zeros((height, width), np.bool_)
        if self.has(HOT_PIXELS):
            x, y = self.read(HOT_PIXELS).T
            hot[y, x] = True
        return hot

    @property
    def marks(self) -> list[Mark]:
        """The marks by a robot's program during the recording (`record --listen`): slice, t_us and text of each.

        >>> with evetac.open_recording("a.recording.h5") as recording:
        ...     lifted = [mark.slice for mark in recording.marks if mark.text == "lifted"]
        >>> lifted
        []
        """
        return marks_of(self)

    def sensor_datasets(self) -> dict[str, Any]:
        """Return the datasets of the sensor, `sensor/...` by name: dot grid, window, frame size, for copying."""
        return {name: self.read(name) for name in self.contents() if name.startswith("sensor/")}

    def between(self, start: int, stop: int) -> Events:
        """Return all events of the slices [start, stop) together; t is absolute."""
        self._check_range(start, stop)
        return self.events(int(self.starts[start]), int(self.starts[stop]))

    def blocks(self, ms: int = BLOCK_SLICES, start: int = 0, stop: int | None = None) -> Iterator[SliceBlock]:
        """Iterate over all slices, or the slices [start, stop), in blocks of `ms` slices; the last may be shorter.

        A block without events is also returned. Blocks are read when they are requested, and stay valid.
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
            raise InputError("invalid length of a block", where="ms", expected="at least 1", found=str(ms))
        return (self._block(first, min(first + ms, stop)) for first in range(start, stop, ms))

    def frames(
        self,
        rate_hz: float = RATE_HZ,
        size_px: tuple[int, int] | None = None,
        window_ms: int | None = None,
        polarity: "Polarity" = "split",
    ) -> Iterator["ImageBlock"]:
        """Iterate over blocks of event-count images (channels, height, width) at a fixed rate; see `Representation`.

        - size_px: width and height; default: the sensor's.
        - window_ms: length of the time window that an image covers; default: from the end of the image before.
        - InputError: a number is out of range.

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
        """Iterate over blocks of histograms (channels, bins, height, width): as `frames`, with counts per time bin.

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
        """Iterate over blocks of voxel grids (bins, height, width); otherwise as `frames`.

        An ON event counts 1, an OFF event -1, shared between the two nearest bins.

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
        """Iterate over blocks of time surfaces; otherwise as `frames`.

        A pixel has the value exp(-(age of its last event) / decay_ms), or 0 if it had no event.

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
        """Return the representation for the parameters of `frames` and similar methods; InputError as there."""
        from evetac_cli.kernels.event_representation import representation

        try:
            return representation(kind, self.frame_px, size_px, rate_hz, window_ms, **more)
        except ValueError as error:
            raise InputError(f"invalid images: {error}", where=str(self.path)) from None

    def images(self, of: "Representation") -> Iterator["ImageBlock"]:
        """Iterate over blocks of images in a representation; ValueError if it is for another frame."""
        from evetac_cli.kernels.event_drawing import fold

        return fold(of, self.blocks())

    def _block(self, first: int, stop: int) -> SliceBlock:
        starts = self.starts[first : stop + 1]
        return SliceBlock(first, starts - starts[0], self.events(int(starts[0]), int(starts[-1])))

    def _check_range(self, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= len(self):
            expected = f"0 <= start <= stop <= {len(self)}"
            raise InputError("slices out of range", where=str(self.path), expected=expected, found=f"{start}, {stop}")

    def events(self, first: int, last: int) -> Events:
        """Return the events [first, last), by their index in the recording; SchemaError if one is in a wrong slice."""
        events = Events(*(self.read(f"events/{column}", first, last) for column in Events._fields))
        if events.size:
            self.check_slices(events.t, first, last)
        return events

    def check_slices(self, t: NDArray[np.int64], first: int, last: int) -> None:
        """Raise SchemaError unless the events [first, last), whose times do not decrease, are in their slices."""
        begin, end = np.searchsorted(self.starts, (first, last - 1), side="right")
        edges = np.clip(self.starts[begin - 1 : end + 1], first, last) - first
        slices = np.arange(begin - 1, end)
        has_events = edges[1:] > edges[:-1]
        earliest, latest = t[edges[:-1][has_events]], t[edges[1:][has_events] - 1]
        wrong = (earliest < slices[has_events] * SLICE_US) | (latest >= (slices[has_events] + 1) * SLICE_US)
        if wrong.any():
            slice_ = slices[has_events][np.argmax(wrong)]
            raise SchemaError(f"ms_to_idx does not fit events/t in slice {slice_}", where=str(self.path))

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
    """Open a recording to read its slices; InputError if the file is of another kind.

    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     counts = [events.size for events in recording]      # one Events per slice of 1 ms
    ...     shear_n = recording.read("truth/shear_force_n")     # any dataset by its path
    >>> len(counts) == len(shear_n)
    True
    """
    return Recording(Path(path))


def ramp_start(recording: Recording) -> int:
    """Return the slice in which the holding current first changes, or position mode begins; 0 if there is none."""
    if not recording.has("gripper"):
        return 0
    target_ma = recording.read("gripper/current_target_ma")
    in_current_mode = np.isfinite(target_ma[:-1])  # NaN in position mode
    changed = np.flatnonzero(in_current_mode & (target_ma[1:] != target_ma[:-1]))
    return int(recording.read("gripper/t_us")[changed[0] + 1] // SLICE_US) if len(changed) else 0


def true_onset(recording: Recording, first: int = 0, stop: int | None = None) -> int | None:
    """Return the first slice of gross slip within [first, stop), after the current began to fall; None without one."""
    return first_slice(recording.read("truth/slip")[:stop] > 0, max(first, ramp_start(recording)))


def first_slice(is_so: NDArray[np.bool_], start: int) -> int | None:
    """Return the first slice, at `start` or later, for which `is_so` (slices,) is true; None without one."""
    slices = start + np.flatnonzero(is_so[start:])
    return int(slices[0]) if len(slices) else None


class SlipWindows:
    """Windows of features with their labels, as a map-style data set for torch's DataLoader.

    Item i is (window (dots, 2 * history) float32, label 0.0 or 1.0 float32). A window has for every dot its distances
    from rest in px, then its event counts, for the last `history` slices, the newest first. Left out are slices without
    a full history, slices without an examined label, and slices `after_onset` or more after the onset.

    All features are read into memory: 448 bytes per slice of 56 dots.

    >>> import torch
    >>> windows = evetac.SlipWindows(["a.features.h5"], history=10)
    >>> loader = torch.utils.data.DataLoader(windows, batch_size=16, shuffle=True)
    >>> batch, label = next(iter(loader))
    >>> batch.shape, label.shape
    (torch.Size([16, 56, 20]), torch.Size([16]))
    """

    def __init__(self, paths: Sequence[str | Path], history: int = 10, after_onset: int = 15) -> None:
        self.paths, self.history, self.after_onset = [Path(path) for path in paths], history, after_onset
        self._values: list[NDArray[np.float32]] = []  # of each file: distances and event counts, (slices, 2, dots)
        # for each window: its file, its last slice among the values of the file, its label
        index: list[NDArray[np.int32]] = [np.empty((0, 3), np.int32)]
        for number, path in enumerate(self.paths):
            with StageFile(path, "features") as file:
                index.append(self._windows_of(number, file))
        self._index = np.concatenate(index)

    def _windows_of(self, number: int, file: StageFile) -> NDArray[np.int32]:
        """Read the slices of a file that its windows need, and return its rows of the index."""
        if not file.has("label"):
            message = "the features have no labels: run evetac label, then evetac featurize"
            raise InputError(message, where=str(file.path))
        label, onset = file.read("label"), int(file.read("onset_slice"))
        stop = len(label) if onset < 0 else min(len(label), onset + self.after_onset)
        usable = np.flatnonzero(label[:stop] >= 0)
        usable = usable[usable >= self.history - 1]
        first, end = (int(usable[0]) + 1 - self.history, int(usable[-1]) + 1) if len(usable) else (0, 0)
        columns = [file.read(name, first, end) for name in ("displacement_px", "events_per_dot")]
        self._values.append(np.stack(columns, axis=1, dtype=np.float32))
        return np.stack([np.full_like(usable, number), usable - first, label[usable]], axis=1, dtype=np.int32)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], np.float32]:
        number, last, label = self._index[index].tolist()
        values = self._values[number][last + 1 - self.history : last + 1]
        # newest first; for each dot its distances, then its event counts
        return values[::-1].transpose(2, 1, 0).reshape(-1, 2 * self.history), np.float32(label)
