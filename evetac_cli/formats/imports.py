"""Other people's event files -> our columns: one function, and one table of the formats that are read.

The content decides, not the file's name. What all formats share is checked in one place, read/event_validation.
"""

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli import names, plugins
from evetac_cli.errors import InputError, cannot_read
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.formats.read import read_numpy
from evetac_cli.formats.read.aedat import read_aedat2, read_aedat3
from evetac_cli.formats.read.aedat.read_aedat4 import open_aedat4
from evetac_cli.formats.read.bags import read_rosbag
from evetac_cli.formats.read.bags.bag_files import is_bag_folder
from evetac_cli.formats.read.bags.read_rosbag import open_rosbag
from evetac_cli.formats.read.column_order import assumption
from evetac_cli.formats.read.event_validation import EventColumns, Foreign, FrameUnknown, Normal, normalise
from evetac_cli.formats.read.prophesee import read_prophesee
from evetac_cli.formats.read.prophesee.read_prophesee import open_prophesee
from evetac_cli.formats.read.read_hdf5 import open_hdf5
from evetac_cli.formats.read.read_other_streams import Other, aedat3_streams, aedat4_streams, bag_streams
from evetac_cli.formats.read.read_text import is_text_of_events, open_text
from evetac_cli.formats.read.time_order import IN_ORDER, OrderOptions
from evetac_cli.interrupts import leave_if_interrupted
from evetac_cli.jobs import Progress, silent
from evetac_cli.store.recordings.streams import Stream, free_name
from evetac_cli.text_files import Steady

EXPECTED = names.either(names.IMPORTS.values())
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
HDF5_SIGNATURE_AT = (0, 512, 1024, 2048)  # a user block may come before it
HEAD_BYTES = 4096
LEAST_MARK = 4  # bytes by which a file of a plug-in's format is known: fewer would be found by chance
BINARY_SUFFIXES = (".aedat4", ".h5", ".hdf5", ".bag", ".db3", ".mcap", ".raw", ".npy", ".npz", ".aedat", ".bin", ".es")
# Frames of event cameras that are sold or in data sets, smallest first; and one that holds them all.
FRAMES_PX = ((128, 128), (240, 180), (304, 240), (320, 240), (346, 260), (320, 320), (640, 480), (1280, 720))
ANY_FRAME_PX = (2048, 2048)
MOST_NAMED = 12  # of what was left out
LARGE_LOSS = 0.02  # share of events dropped for one reason, above which a note says so


# What a user may say of a file, by name, and which files it is for.
SAID = {
    "stream": ("--stream", "files that may hold several streams of events: AEDAT4, HDF5, npz and bags"),
    "columns": ("--columns", "files of four columns without names: text, numpy and HDF5"),
    "time_unit": ("--time-unit", "files that do not say their unit of time: text, numpy and HDF5"),
}


class ImportFormat(NamedTuple):
    """How a file of the format begins, at one of which places, who reads it, and what a user may say of it (SAID).

    read: takes the path, the frame (width, height) or None, and what the user says, and gives a Foreign. A plug-in's
    row is one of these; it is asked where no format of ours knows the file, which then begins with its mark.
    """

    begins: tuple[bytes, ...]
    read: Callable[..., Foreign]
    said: tuple[str, ...] = ()
    at: tuple[int, ...] = (0,)


BAG = ImportFormat(read_rosbag.SIGNS, open_rosbag, ("stream",))
TEXT = ImportFormat((), open_text, ("columns", "time_unit"))  # begins with anything, so it is tried last
FORMATS = {
    "aedat4": ImportFormat((b"#!AER-DAT4",), open_aedat4, ("stream",)),
    "aedat3": ImportFormat((read_aedat3.SIGN,), read_aedat3.open_aedat3),
    "aedat2": ImportFormat((read_aedat2.SIGN,), read_aedat2.open_aedat2),
    "hdf5": ImportFormat((HDF5_SIGNATURE,), open_hdf5, ("stream", "columns", "time_unit"), at=HDF5_SIGNATURE_AT),
    "numpy": ImportFormat((read_numpy.NPY, read_numpy.ZIP), read_numpy.open_numpy, ("stream", "columns", "time_unit")),
    "prophesee": ImportFormat(read_prophesee.SIGNS, open_prophesee),
    "rosbag": BAG,
    "text": TEXT,
}

# Who reads what is kept beside the events.
OTHER_STREAMS = {"aedat3": aedat3_streams, "aedat4": aedat4_streams, "rosbag": bag_streams}
SAVED = "numpy.savez('A.npz', t_us=t, x=x, y=y, p=p) saves columns, x and y from 0, p 1 where it got brighter"
# The five bytes of an event of N-MNIST and N-Caltech101, whose files begin with no mark.
FIVE_BYTES = (
    "if it is of N-MNIST or N-Caltech101: b = numpy.fromfile('A.bin', 'u1').astype(int).reshape(-1, 5); numpy.savez("
    "'A.npz', t_us=(b[:, 2] & 127) << 16 | b[:, 3] << 8 | b[:, 4], x=b[:, 0], y=b[:, 1], p=b[:, 2] >> 7)"
)
# Files that people keep beside their event files: how they begin, what they are, and how to convert them.
OTHER_FILES: tuple[tuple[tuple[bytes, ...], str, str], ...] = (
    ((b"#!AER-DAT",), "AEDAT of another version", "convert it to AEDAT4 with the maker's DV, or to text"),
    ((b"#ROSBAG",), "a ROS bag older than 2.0", "rosbag migrate"),
    ((b"PK\x05\x06",), "an empty archive", "pack it again"),
    ((b"\x1f\x8b",), "gzip", "unpack it with gunzip"),
    ((b"\x28\xb5\x2f\xfd",), "Zstandard", "unpack it with zstd -d, or name the folder of the bag that it belongs to"),
    (
        (b"Event Stream",),
        "Event Stream (.es)",
        "faery converts it, if it is of a DVS or ATIS: python -c"
        " \"import faery; faery.events_stream_from_file('A.es').to_file('A.aedat4')\"",
    ),
    ((b"MATLAB 5.0 MAT-file",), "a file of MATLAB", f"scipy.io.loadmat('A.mat') reads it; {SAVED}"),
    ((b"MATLAB 7.3 MAT-file",), "a file of MATLAB", f"h5py.File('A.mat')['TD/ts'][()].ravel() is a column; {SAVED}"),
    (
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "a Python pickle",
        "pickles are never loaded, as they can run code: write it as text or HDF5",
    ),
)


@dataclass(frozen=True)
class Facts:
    """What is known of another program's file once its events were read."""

    size: int  # events; the first one at t = 0, unless the file says when its recording began
    frame_px: tuple[int, int]  # width, height
    t_offset_us: int  # where t = 0 is in the file's own clock
    slices: int  # up to and with the slice of the last event; 0 without events; more where an export of ours had more
    format: str  # aedat2, aedat3, aedat4, hdf5, numpy, prophesee, rosbag or text
    counts: dict[str, int]  # events dropped, by reason: not_a_number, out_of_frame
    sorted: int  # events put back in order
    notes: list[str]  # what the user should know: other streams, losses, what was assumed and what was left out
    streams: list[Stream]  # IMU samples, triggers, frames: in the recording's clock
    left_out: dict[str, int]  # what the file holds beside these events, and how much of it: frames, IMU samples, ...
    simulated: bool  # an export of ours says that its events come from a simulation


@dataclass(frozen=True)
class Imported(Facts):
    """The events of another program's file, in our columns, in memory."""

    events: Events


class EventFile:
    """Another program's event file: its frame at once, then its events in blocks, and with the last of them its facts.

    The number of slices is the last event's slice + 1, not the duration rounded up: an event at exactly 2 ms lies in
    the third slice. A file without any event is a recording without any where the format says that it is whole
    (AEDAT4 that was closed, HDF5, an export of ours), and refused elsewhere.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        frame_px: tuple[int, int] | None = None,
        order: OrderOptions = IN_ORDER,
        stream: str | None = None,
        columns: str | None = None,
        time_unit: str | None = None,
        frames: bool = False,
        folder: Path | None = None,
        progress: Progress = silent,
    ) -> None:
        """Recognize the file and find its frame; InputError for what is no event file.

        columns: names of four columns that have none, as in "x y t p"; without it, the first known order that fits.
        folder: on whose disk events wait that are to be sorted; the one for temporary files otherwise.
        frame_px: (width, height), refused if it contradicts the file; without it, where the file does not say it (text,
        HDF5), that of the smallest known sensor that holds all events, and a note says so.
        frames: keep frames too, which may be many times larger than the events; IMU samples and triggers always are.
        order: what becomes of events that are not in the order of their time; without options such a file is refused.
        path: a file, or the folder of a ROS 2 bag.
        progress: of the events that were read; how many there will be, no format says.
        stream: the event stream of an AEDAT4 file, the topic of a bag, the camera of an HDF5 file, or the array of an
        npz, that has several; the first by name otherwise.
        time_unit: s, ms, us or ns, where the file does not say it; without it, us if all times are whole, else s.
        """
        self._path, self._where = Path(path), str(path)
        self._steady = Steady(self._path)
        self._order = order
        self._frames, self._folder, self._progress = frames, folder, progress
        options = {"stream": stream, "columns": columns, "time_unit": time_unit}
        said = {name: value for name, value in options.items() if value is not None}
        self._stream = stream
        with _reading(self._path, self._steady):
            try:
                self._foreign = _open(self._path, frame_px, said)
            except FrameUnknown as unknown:
                self._foreign = _open_with_guessed_frame(self._path, said, unknown)
        self.frame_px = self._foreign.frame_px

    def blocks(self) -> Iterator[Events]:
        """All events in the order of their time; after them there is `facts`.

        InputError, as late as after the last block, where the file cannot be used: then all of them are void. Of a
        damaged AEDAT4 file what is intact.
        """
        foreign, normal = self._foreign, Normal()
        batches = foreign.batches
        foreign.batches = _counted(batches, self._progress)
        blocks = normalise(foreign, normal, order=self._order, where=self._where, folder=self._folder)
        try:
            while True:
                with _reading(self._path, self._steady):
                    block = next(blocks, None)
                if block is None:
                    break
                yield block
        finally:
            if isinstance(batches, Generator):  # a refusal leaves it with its file open
                batches.close()
        self.facts = self._facts(normal)
        self._steady.check()

    def _facts(self, normal: Normal) -> Facts:
        foreign, note = self._foreign, self._foreign.note
        notes = [*foreign.notes, *_losses(foreign, normal)]
        if note is None and not normal.size:
            notes.append("the file holds no events")
        notes += normal.notes
        notes += foreign.times.notes if foreign.times else []
        slices = (normal.last_us - normal.first_us) // SLICE_US + 1 if normal.size else 0
        if note and not foreign.cut_short and not _lacks_events(foreign, normal):
            slices = max(slices, note.slices)  # what a cut file lost is unknown: it gets no empty slices instead
        t_offset_us = normal.first_us + foreign.clock_us if normal.size or note else 0
        with _reading(self._path, self._steady):
            if self._order.from_restart is None:
                options = {"frames": self._frames, "folder": self._folder, "topic": self._stream}
                streams, said = _kept(self._path, foreign, t_offset_us, slices, options)
            else:  # their times do not say which part they belong to
                streams, said = [], []
                foreign.left_out |= {stream.name: len(stream.t_us) for stream in foreign.streams}
        notes += [*said, *_unsaid(foreign, streams)]
        return Facts(
            size=normal.size,
            frame_px=foreign.frame_px,
            t_offset_us=t_offset_us,
            slices=slices,
            format=foreign.format,
            counts=normal.dropped,
            sorted=normal.sorted,
            notes=notes,
            streams=streams,
            left_out=foreign.left_out,
            simulated=note is not None and note.simulated,
        )


def read_events(path: str | Path, **options: Any) -> Imported:
    """Read another program's event file into memory: all of it or an InputError; options are those of EventFile."""
    file = EventFile(path, **options)
    events = concatenate(list(file.blocks()))
    return Imported(**vars(file.facts), events=events)


@contextmanager
def _reading(path: Path, before: Steady) -> Iterator[None]:
    """What goes wrong while a file is read, in words; a fault of one that is being written is none of its own."""
    try:
        yield
    except InputError:
        before.check()
        raise
    except OSError as error:
        raise cannot_read(error, path) from error
    except MemoryError as error:
        raise InputError(
            "does not fit in memory", where=str(path), hint="cut it into parts with the program that wrote it"
        ) from error


def _kept(
    path: Path, foreign: Foreign, t_offset_us: int, slices: int, options: dict[str, Any]
) -> tuple[list[Stream], list[str]]:
    """The other streams of the file that are kept, in the recording's clock, and notes on how they came there.

    What came is no longer left out.
    """
    read = OTHER_STREAMS.get(foreign.format)
    streams: list[Stream] = []
    notes: list[str] = []
    counts: Counter[str] = Counter()
    span_us = (t_offset_us, t_offset_us + slices * SLICE_US)
    others = read(path, span_us=span_us, **options) if read is not None and foreign.left_out else ()
    for stream, name, unreadable, note in chain((Other(one, one.name) for one in foreign.streams), others):
        for counted in (name, f"packets of {name}"):
            foreign.left_out.pop(counted, None)
        taken = [one.name for one in streams]
        free = free_name(stream.name, taken) if stream.name in taken else stream.name
        within = replace(stream, name=free, t_us=stream.t_us - t_offset_us).within(slices)
        notes += [note] if note else []
        counts[f"{name} outside the recording"] += within.left_out
        counts[f"unreadable packets of {name}"] += unreadable
        if len(within.t_us):
            streams.append(within)
    foreign.left_out |= +counts
    return streams, notes


def _unsaid(foreign: Foreign, streams: list[Stream]) -> Iterator[str]:
    """What was kept beside the events, what was left out, counted, and what was assumed, in words."""
    if streams:
        yield "kept: " + ", ".join(f"{len(stream.t_us):,} samples of {stream.name}" for stream in streams)
    if foreign.left_out:
        yield f"left out: {left_out_text(foreign.left_out)}"
    unit = foreign.times.assumed if foreign.times else None
    if assumed := ": ".join(filter(None, (foreign.assumed, assumption(foreign.guessed_order, unit)))):
        yield f"assumed: {assumed}"


def left_out_text(left_out: dict[str, int]) -> str:
    """Names and counts on one line; of very many the first, and how many there are."""
    named = [f"{name} {count:,}" for name, count in left_out.items()]
    more = [f"and {len(named) - MOST_NAMED} more kinds"] if len(named) > MOST_NAMED else []
    return ", ".join([*named[:MOST_NAMED], *more])


def _counted(batches: Iterable[EventColumns], progress: Progress) -> Iterator[EventColumns]:
    """The same batches, with their events counted. Ctrl-C is heard here."""
    count = 0
    for batch in batches:
        leave_if_interrupted()
        yield batch
        count += len(batch.t)
        progress(count, 0, "events read")


def _lacks_events(foreign: Foreign, normal: Normal) -> bool:
    """Whether an export of ours has fewer events than were written into it."""
    written = foreign.note.events if foreign.note else None
    return written is not None and normal.size + sum(normal.dropped.values()) < written


def _losses(foreign: Foreign, normal: Normal) -> Iterator[str]:
    """What is missing and was not said by the reader, in words; of dropped events only where they are many."""
    if foreign.note and not foreign.cut_short and _lacks_events(foreign, normal):
        yield f"cut short: {normal.size} events of the {foreign.note.events} that were exported"
    dropped = normal.dropped
    read = normal.size + sum(dropped.values())
    if dropped["out_of_frame"] > LARGE_LOSS * read:
        frame = "{}x{}".format(*foreign.frame_px)
        share = f"{dropped['out_of_frame'] / read:.0%}"
        yield f"{share} of the events lie outside {frame} and were dropped; is it the frame?"
    if dropped["not_a_number"] > LARGE_LOSS * read:
        yield f"{dropped['not_a_number'] / read:.0%} of the events were dropped: not all of t, x, y, p are numbers"


def _open(path: Path, frame_px: tuple[int, int] | None, said: Mapping[str, str]) -> Foreign:
    """Recognize the format by the first bytes and hand over to its reader, with what the user says of the file."""
    format_ = BAG if path.is_dir() and is_bag_folder(path) else _format(path)
    for name in said.keys() - set(format_.said):  # an option that would do nothing is an error
        flag, files = SAID[name]
        raise InputError(f"{flag} is for {files}", where=str(path), found=said[name], hint="leave it out")
    return format_.read(path, frame_px, **said)


def _open_with_guessed_frame(path: Path, said: Mapping[str, str], unknown: FrameUnknown) -> Foreign:
    """The file with the frame of the smallest known sensor that holds all its events; `unknown` where none does."""
    width = height = 0
    batches = _open(path, ANY_FRAME_PX, said).batches
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
    foreign = _open(path, fitting[0], said)
    frame = "{}x{}".format(*fitting[0])
    foreign.notes.append(
        f"the file does not state its frame size: took {frame}, of the smallest known sensor that holds all events"
        f" ({width}x{height}); --frame-size sets another"
    )
    if swapped := _swapped(width, height, fitting[0]):
        foreign.notes.append(swapped)
    return foreign


def _swapped(width: int, height: int, frame_px: tuple[int, int]) -> str:
    """A note where the events fill a smaller sensor with columns and rows exchanged; empty otherwise."""
    exchanged = next(((w, h) for w, h in FRAMES_PX if w >= height and h >= width), None)
    if width >= height or exchanged is None or math.prod(exchanged) >= math.prod(frame_px):
        return ""
    sensor = "{}x{}".format(*exchanged)
    return (
        f"x reaches {width - 1} and y reaches {height - 1}: are they exchanged? The other way round they fit {sensor}"
    )


def _format(path: Path) -> ImportFormat:
    """The row that a file belongs to; text if its first line looks like text."""
    where = str(path)
    head = _head(path)
    for format_ in FORMATS.values():
        if head.startswith(format_.begins):
            return format_
    for starts, name, hint in OTHER_FILES:
        if head.startswith(starts):
            raise InputError(
                "not a file of events that can be read", where=where, expected=EXPECTED, found=name, hint=hint
            )
    for format_ in FORMATS.values():  # behind a block of somebody's own
        if any(head.startswith(format_.begins, at) for at in format_.at):
            return format_
    first_line = head.partition(b"\n")[0]
    binary = any(byte < 32 and byte not in b"\t\f\r" for byte in first_line)
    unusable: list[str] = []
    if binary or not is_text_of_events(first_line.decode(errors="replace")):
        of_plugin = _format_of_plugin(head, unusable)
        if of_plugin is not None:
            return of_plugin
    if binary or path.suffix.lower() in BINARY_SUFFIXES:
        raise InputError(
            "not a file of events that can be read",
            where=where,
            expected=EXPECTED,
            found=f"a file that begins with {head[:16]!r}",
            hint=FIVE_BYTES
            if path.suffix.lower() == ".bin" and not path.stat().st_size % 5
            else f"evetac doctor lists all plug-ins; left out: {'; '.join(unusable)}"
            if unusable
            else "",
        )
    return TEXT


def _format_of_plugin(head: bytes, unusable: list[str]) -> ImportFormat | None:
    """The row of a plug-in whose files begin so; those that cannot be used are added to `unusable`, with the reason."""
    for plugin in plugins.installed(plugins.IMPORTERS):
        try:
            format_ = format_of_plugin(plugin)
        except InputError as error:
            unusable.append(f"{plugin.what}: {error.found}")
            continue
        if head.startswith(tuple(mark for mark in format_.begins if len(mark) >= LEAST_MARK)):
            plugin.use()
            return format_
    return None


def format_of_plugin(plugin: plugins.Plugin) -> ImportFormat:
    """The row of a plug-in; InputError if it cannot be used."""
    format_ = plugin.load(ImportFormat)
    begins, said = format_.begins, format_.said
    if not isinstance(begins, tuple) or not all(isinstance(mark, bytes) for mark in begins):
        raise plugin.error(f"its `begins` is {begins!r}, and a tuple of bytes is wanted")
    if not any(len(mark) >= LEAST_MARK for mark in begins):
        raise plugin.error(f"its `begins` is {begins!r}, and a mark of at least {LEAST_MARK} bytes is wanted")
    if not callable(format_.read):
        raise plugin.error(f"its `read` is {format_.read!r}, and a function is wanted")
    if not isinstance(said, tuple) or not all(name in SAID for name in said):
        raise plugin.error(f"its `said` is {said!r}, and a tuple of {', '.join(SAID)} is wanted")
    return format_


def _head(path: Path) -> bytes:
    """The first bytes of a plain file that has some."""
    if path.is_dir():
        hint = "name a file in it; of a bag of ROS 2, the folder that holds its .db3 or .mcap files"
        raise InputError("this is a folder", where=str(path), expected=EXPECTED, hint=hint)
    if not path.is_file():
        what = "a device or pipe" if path.exists() else "no such file"
        raise InputError("cannot be read", where=str(path), expected=EXPECTED, found=what)
    with path.open("rb") as handle:
        head = handle.read(HEAD_BYTES)
    if not head:
        raise InputError("the file is empty", where=str(path), expected=EXPECTED)
    return head
