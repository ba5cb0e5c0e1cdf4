"""Read other programs' event files into evetac's columns; one table lists the formats.

A format is recognized by the file's content, not by its name. The checks that all formats share are in read/source.
"""

import math
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import names, plugins
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events, concatenate, empty
from evetac_cli.formats.read import read_aedat2, read_aedat4, read_hdf5, read_numpy, read_text
from evetac_cli.formats.read.bags import read_rosbag
from evetac_cli.formats.read.bags.bag_files import is_bag_folder
from evetac_cli.formats.read.columns import assumption
from evetac_cli.formats.read.damage import reading
from evetac_cli.formats.read.prophesee import read_prophesee
from evetac_cli.formats.read.read_other_streams import Other, aedat4_streams, bag_streams
from evetac_cli.formats.read.source import CleanEvents, EventSource, FrameUnknown, checked_frame
from evetac_cli.formats.read.source import ImportFormat as ImportFormat
from evetac_cli.formats.read.time_order import IN_ORDER, OrderOptions
from evetac_cli.jobs import Progress, silent
from evetac_cli.store.recordings.streams import Stream, free_name
from evetac_cli.text_files import FileStamps

EXPECTED = names.either(names.IMPORTS.values())
HEAD_BYTES = 4096
BINARY_SUFFIXES = (".aedat4", ".h5", ".hdf5", ".bag", ".db3", ".mcap", ".raw", ".npy", ".npz", ".aedat", ".bin", ".es")
# Frame sizes of event cameras that are sold or used in data sets, smallest first; and a frame larger than all of them.
FRAMES_PX = ((128, 128), (240, 180), (304, 240), (320, 240), (346, 260), (320, 320), (640, 480), (1280, 720))
ANY_FRAME_PX = (2048, 2048)
MOST_NAMED = 12  # kinds of left-out data that a note lists by name
LARGE_LOSS = 0.02  # share of events dropped for one reason, above which a note says so


# What a user may specify about a file: the flag, and the files that it applies to.
OPTIONS = {
    "stream": ("--stream", "files that may contain several event streams: AEDAT4, HDF5, npz and bags"),
    "columns": ("--columns", "files of four unnamed columns: text, numpy and HDF5"),
    "time_unit": ("--time-unit", "files that do not state their unit of time: text, numpy and HDF5"),
}
BAG, TEXT = read_rosbag.FORMAT, read_text.FORMAT
FORMATS = {
    "aedat4": read_aedat4.FORMAT,
    "aedat2": read_aedat2.FORMAT,
    "hdf5": read_hdf5.FORMAT,
    "numpy": read_numpy.FORMAT,
    "prophesee": read_prophesee.FORMAT,
    "rosbag": BAG,
    "text": TEXT,  # may begin with anything, so it is tried last
}

# The readers of data other than events that is kept.
OTHER_STREAMS = {"aedat4": aedat4_streams, "rosbag": bag_streams}
# Files that are often confused with event files: how they begin, what they are, and what to do.
CONVERT = "docs/recordings.md says how to convert it"
OTHER_FILES: tuple[tuple[tuple[bytes, ...], str, str], ...] = (
    ((b"#!AER-DAT",), "AEDAT of another version", "convert it to AEDAT4 with iniVation's DV, or to text"),
    ((b"#ROSBAG",), "a ROS bag older than 2.0", "convert it with `rosbag migrate`"),
    ((b"PK\x05\x06",), "an empty zip archive", "create the archive again"),
    ((b"\x1f\x8b",), "a gzip file", "unpack it with gunzip"),
    ((b"\x28\xb5\x2f\xfd",), "a Zstandard file", "unpack it with zstd -d, or give the bag's folder"),
    ((b"Event Stream",), "Event Stream (.es)", CONVERT),
    ((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"), "a MATLAB file", CONVERT),
    ((b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"), "a Python pickle", "evetac never loads pickles"),
)


@dataclass(frozen=True)
class Imported:
    """The events of another program's file in evetac's columns, and facts about the file."""

    size: int  # events; the first one is at t = 0, unless the file states when its recording began
    frame_px: tuple[int, int]  # width, height
    t_offset_us: int  # t = 0 on the file's own clock
    slices: int  # up to the slice of the last event; 0 without events; more if an evetac export had more
    format: str  # aedat2, aedat4, hdf5, numpy, prophesee, rosbag or text
    counts: dict[str, int]  # events dropped, by reason: not_a_number, out_of_frame
    sorted: int  # events that were out of order and were sorted
    notes: list[str]  # for the user: other streams, losses, assumptions and data that was left out
    streams: list[Stream]  # IMU samples, triggers, frames: in the recording's clock
    left_out: dict[str, int]  # amounts of other data in the file that were not imported: frames, IMU samples, ...
    simulated: bool  # the note of an evetac export states that its events are simulated
    events: Events = empty()  # none if they were read in blocks


@dataclass(frozen=True)
class ImportOptions:
    """What a user may say about a file, or want of it.

    - frame_px: (width, height); an error if it contradicts the file. If it is not given and the file does not state it
      (text, HDF5), the frame of the smallest known sensor that contains all events is used, and a note says so.
    - order: how to handle events that are out of order; by default such a file is refused.
    - stream: the event stream of an AEDAT4 file, topic of a bag, camera of an HDF5 file or array of an npz to read if
      there are several; by default the first by name.
    - columns: names of four unnamed columns, for example "x y t p"; by default the first known order that fits.
    - time_unit: s, ms, us or ns, if the file does not state it; by default us if all times are whole, otherwise s.
    - frames: keep frames too, which may be many times larger than the events; IMU samples and triggers are always kept.
    """

    frame_px: tuple[int, int] | None = None
    order: OrderOptions = IN_ORDER
    stream: str | None = None
    columns: str | None = None
    time_unit: str | None = None
    frames: bool = False

    def of_readers(self) -> dict[str, str]:
        """Return the options that are for readers and were given."""
        return {name: getattr(self, name) for name in OPTIONS if getattr(self, name) is not None}


DEFAULTS = ImportOptions()


class EventFile:
    """Another program's event file: its frame first, then its events in blocks, then its facts.

    The number of slices is the last event's slice + 1, not the duration rounded up: an event at exactly 2 ms belongs to
    the third slice. A file without events is imported as an empty recording if its format shows that the file is
    complete (AEDAT4 that was closed, HDF5, an export of evetac). Otherwise it is refused.
    """

    def __init__(
        self,
        path: str | Path,
        options: ImportOptions = DEFAULTS,
        folder: Path | None = None,
        progress: Progress = silent,
    ) -> None:
        """Recognize the file and determine its frame; raise InputError if it is not an event file.

        - path: a file, or the folder of a ROS 2 bag.
        - folder: where events that must be sorted are stored temporarily; by default the folder for temporary files.
        - progress: receives the number of events read; the total is unknown, because no format states it.
        """
        self._path, self._options, self._folder = Path(path), options, folder
        self._stamps = FileStamps(self._path)
        with reading(self._path, self._stamps):
            try:
                self._source = _open(self._path, options.frame_px, options.of_readers())
            except FrameUnknown as unknown:
                self._source = _open_with_guessed_frame(self._path, options.of_readers(), unknown)
        self.frame_px = self._source.frame_px
        self._events = CleanEvents(self._source, options.order, str(path), folder, progress)

    def blocks(self) -> Iterator[Events]:
        """Yield all events in time order.

        Raises InputError if the file cannot be used, possibly only after the last block: discard all blocks then. Of a
        damaged AEDAT4 file, the intact events are yielded.
        """
        blocks = self._events.blocks()
        try:
            while True:
                with reading(self._path, self._stamps):
                    block = next(blocks, None)
                if block is None:
                    break
                yield block
        finally:
            if isinstance(self._source.batches, Generator):  # after an error its file is still open
                self._source.batches.close()

    def finish(self) -> Imported:
        """Return the facts about the file, after the last block."""
        source, events, note = self._source, self._events, self._source.note
        lacks_events = note is not None and note.events is not None and events.read < note.events
        slices = (events.last_us - events.first_us) // SLICE_US + 1 if events.size else 0
        if note and not source.cut_short and not lacks_events:
            slices = max(slices, note.slices)  # not for a truncated file: its lost slices were not necessarily empty
        t_offset_us = events.first_us + source.clock_us if events.size or note else 0
        notes = [*source.notes, *_losses(source, events, lacks_events=lacks_events), *events.corrections]
        notes += source.times.notes if source.times else []
        with reading(self._path, self._stamps):
            if self._options.order.from_restart is None:
                others = {"frames": self._options.frames, "folder": self._folder, "topic": self._options.stream}
                streams, stream_notes = _kept(self._path, source, t_offset_us, slices, others)
            else:  # their times do not show which part they belong to
                streams, stream_notes = [], []
                source.left_out |= {stream.name: len(stream.t_us) for stream in source.streams}
        self._stamps.check()
        return Imported(
            size=events.size,
            frame_px=source.frame_px,
            t_offset_us=t_offset_us,
            slices=slices,
            format=source.format,
            counts=events.dropped,
            sorted=events.sorted,
            notes=[*notes, *stream_notes, *_import_notes(source, streams)],
            streams=streams,
            left_out=source.left_out,
            simulated=note is not None and note.simulated,
        )


def read_events(path: str | Path, **options: Any) -> Imported:
    """Read another program's event file into memory, or raise InputError; options are those of ImportOptions."""
    file = EventFile(path, ImportOptions(**options))
    events = concatenate(list(file.blocks()))
    return replace(file.finish(), events=events)


def _kept(
    path: Path, source: EventSource, t_offset_us: int, slices: int, options: dict[str, Any]
) -> tuple[list[Stream], list[str]]:
    """Return the other streams that are kept, in the recording's clock, and notes on their conversion.

    Streams that are kept are removed from `source.left_out`.
    """
    read = OTHER_STREAMS.get(source.format)
    streams: list[Stream] = []
    notes: list[str] = []
    counts: Counter[str] = Counter()
    span_us = (t_offset_us, t_offset_us + slices * SLICE_US)
    others = read(path, span_us=span_us, **options) if read is not None and source.left_out else ()
    for stream, name, unreadable, note in chain((Other(one, one.name) for one in source.streams), others):
        for counted in (name, f"packets of {name}"):
            source.left_out.pop(counted, None)
        taken = [one.name for one in streams]
        free = free_name(stream.name, taken) if stream.name in taken else stream.name
        within = replace(stream, name=free, t_us=stream.t_us - t_offset_us).within(slices)
        notes += [note] if note else []
        counts[f"{name} outside the recording"] += within.left_out
        counts[f"unreadable packets of {name}"] += unreadable
        if len(within.t_us):
            streams.append(within)
    source.left_out |= +counts
    return streams, notes


def _import_notes(source: EventSource, streams: list[Stream]) -> Iterator[str]:
    """Yield notes: what was kept in addition to the events, what was left out (with counts), what was assumed."""
    if streams:
        yield "kept: " + ", ".join(f"{len(stream.t_us):,} samples of {stream.name}" for stream in streams)
    if source.left_out:
        yield f"left out: {left_out_text(source.left_out)}"
    unit = source.times.assumed if source.times else None
    if assumed := ": ".join(filter(None, (source.assumed, assumption(source.guessed_order, unit)))):
        yield f"assumed: {assumed}"


def left_out_text(left_out: dict[str, int]) -> str:
    """Return names and counts on one line: the first MOST_NAMED, and the number of further kinds."""
    kinds = [f"{name} {count:,}" for name, count in left_out.items()]
    more = [f"and {len(kinds) - MOST_NAMED} more kinds"] if len(kinds) > MOST_NAMED else []
    return ", ".join([*kinds[:MOST_NAMED], *more])


def _losses(source: EventSource, events: CleanEvents, *, lacks_events: bool) -> Iterator[str]:
    """Yield notes on losses that the reader did not report; dropped events only if they exceed LARGE_LOSS."""
    if source.note and not source.cut_short and lacks_events:
        yield f"cut short: {events.size} events are left of the {source.note.events} that were exported"
    outside, no_numbers = (events.dropped[reason] for reason in ("out_of_frame", "not_a_number"))
    if outside > LARGE_LOSS * events.read:
        frame, share = "{}x{}".format(*source.frame_px), f"{outside / events.read:.0%}"
        yield f"{share} of the events are outside {frame} and were dropped; is this frame size right?"
    if no_numbers > LARGE_LOSS * events.read:
        yield f"{no_numbers / events.read:.0%} of the events were dropped: t, x, y or p is not a number"
    if source.note is None and not events.size:
        yield "the file has no events"


def _open(path: Path, frame_px: tuple[int, int] | None, options: Mapping[str, str]) -> EventSource:
    """Recognize the format by the first bytes and call its reader with the user's options."""
    format_ = BAG if path.is_dir() and is_bag_folder(path) else _format(path)
    for name in options.keys() - set(format_.options):  # an option that would do nothing is an error
        flag, files = OPTIONS[name]
        raise InputError(f"{flag} is for {files}", where=str(path), found=options[name], hint="leave it out")
    source = format_.read(path, frame_px, **options)
    source.frame_px = checked_frame(source.frame_px, str(path), "")
    return source


def _open_with_guessed_frame(path: Path, options: Mapping[str, str], unknown: FrameUnknown) -> EventSource:
    """Open the file with the frame of the smallest known sensor that fits all events; raise `unknown` if none does."""
    width = height = 0
    batches = _open(path, ANY_FRAME_PX, options).batches
    try:
        for batch in batches:
            x, y = batch.x.astype(np.float64), batch.y.astype(np.float64)
            finite = np.isfinite(x) & np.isfinite(y)
            width = max(width, int(x[finite].max(initial=-1.0)) + 1)
            height = max(height, int(y[finite].max(initial=-1.0)) + 1)
    finally:
        if isinstance(batches, Generator):
            batches.close()
    fitting = [frame for frame in FRAMES_PX if 0 < width <= frame[0] and 0 < height <= frame[1]]
    if not fitting:
        raise unknown
    source = _open(path, fitting[0], options)
    frame = "{}x{}".format(*fitting[0])
    source.notes.append(
        f"the file does not state its frame size: assumed {frame}, the smallest known sensor that fits all events"
        f" ({width}x{height}); --frame-size sets another"
    )
    exchanged = next((px for px in FRAMES_PX if px[0] >= height and px[1] >= width), ANY_FRAME_PX)
    if width < height and math.prod(exchanged) < math.prod(fitting[0]):
        sensor = "{}x{}".format(*exchanged)
        source.notes.append(f"are x and y exchanged? Exchanged, they would fit {sensor}")
    return source


def _format(path: Path) -> ImportFormat:
    """Return the row of the format that a file has; text if its first line looks like text."""
    where, message = str(path), "not an event file that evetac can read"
    head = _head(path)
    for format_ in FORMATS.values():
        if head.startswith(format_.begins):
            return format_
    for starts, name, hint in OTHER_FILES:
        if head.startswith(starts):
            raise InputError(message, where=where, expected=EXPECTED, found=name, hint=hint)
    for format_ in FORMATS.values():  # after a user block, which HDF5 allows
        if any(head.startswith(format_.begins, at) for at in format_.at):
            return format_
    first_line = head.partition(b"\n")[0]
    binary = any(byte < 32 and byte not in b"\t\f\r" for byte in first_line)
    if binary or not read_text.is_text_of_events(first_line.decode(errors="replace")):
        of_plugin = _format_of_plugin(head)
        if of_plugin is not None:
            return of_plugin
    if binary or path.suffix.lower() in BINARY_SUFFIXES:
        raise InputError(message, where=where, expected=EXPECTED, found=f"it begins with {head[:16]!r}", hint=CONVERT)
    return TEXT


def _format_of_plugin(head: bytes) -> ImportFormat | None:
    """Return the row of the plug-in whose mark the file begins with; None if there is none that can be used."""
    for plugin in plugins.installed(plugins.IMPORTERS):
        with suppress(InputError):  # `evetac doctor` says why
            format_ = plugin.load(ImportFormat)
            if head.startswith(format_.begins):
                plugin.use()
                return format_
    return None


def _head(path: Path) -> bytes:
    """Return the first bytes of a regular file; raise InputError if it is empty or not a regular file."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "a device or pipe" if path.exists() else "no such file"
        raise InputError("the file cannot be read", where=str(path), expected=EXPECTED, found=what)
    with path.open("rb") as handle:
        head = handle.read(HEAD_BYTES)
    if not head:
        raise InputError("the file is empty", where=str(path), expected=EXPECTED)
    return head
