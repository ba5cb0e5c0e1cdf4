"""Foreign event files -> our columns: one function, one table of formats.

    AEDAT4          import_aedat4     says its frame size; needs the extra `camera` (dv-processing)
    HDF5 as DSEC    import_hdf5       events/{t,x,y,p} in microseconds, t_offset
    Prophesee       import_prophesee  RAW (EVT2, EVT3) and DAT; needs the extra `convert` (faery)
    ROS bags        import_rosbag     of ROS 1 and ROS 2; needs the extra `convert` (rosbags)
    text            import_text       `t x y p` a line, blanks or commas, `#` comments; integers are microseconds

The content decides, not the file's name. What all formats share is checked in one place, import_door.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.formats.read import read_prophesee, read_rosbag
from evetac_cli.formats.read.event_validation import Foreign, Normal, normalise
from evetac_cli.formats.read.read_aedat4 import open_aedat4
from evetac_cli.formats.read.read_dsec import open_hdf5
from evetac_cli.formats.read.read_prophesee import open_prophesee
from evetac_cli.formats.read.read_rosbag import is_bag_folder, open_rosbag
from evetac_cli.formats.read.read_text import open_text

EXPECTED = "AEDAT4, HDF5 with events/{t,x,y,p}, Prophesee RAW or DAT, a ROS bag, or text with `t x y p` a line"
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
HDF5_SIGNATURE_AT = (0, 512, 1024, 2048)  # a user block may come before it
HEAD_BYTES = 4096
LOSS_WORTH_A_WORD = 0.02  # share of events dropped for one reason


class Format(NamedTuple):
    """A row of the table: how a file begins, at one of which places, who reads it, and which option it takes."""

    begins: tuple[bytes, ...]
    read: Callable[..., Foreign]
    option: str = ""
    at: tuple[int, ...] = (0,)


TEXT = Format((), open_text, "dialect")
BAG = Format((read_rosbag.ROS1, read_rosbag.SQLITE, read_rosbag.MCAP), open_rosbag, "stream")
FORMATS = (
    Format((b"#!AER-DAT4",), open_aedat4, "stream"),
    Format((HDF5_SIGNATURE,), open_hdf5, at=HDF5_SIGNATURE_AT),
    Format(read_prophesee.SIGNS, open_prophesee),
    BAG,
)
OPTION_OF = {"dialect": "text", "stream": "AEDAT4 files and ROS bags"}

TO_AEDAT4 = "convert it to AEDAT4 with the maker's DV, or to text"
# What people have lying beside their event files, how it begins, and the way from there.
STRANGERS: tuple[tuple[tuple[bytes, ...], str, str], ...] = (
    ((b"#!AER-DAT2",), "AEDAT2", TO_AEDAT4),
    ((b"#!AER-DAT3",), "AEDAT3", TO_AEDAT4),
    ((b"#ROSBAG",), "a ROS bag older than 2.0", "rosbag migrate"),
    ((b"PK\x03\x04",), "a zip or npz archive", "unpack it"),
    ((b"\x1f\x8b",), "gzip", "unpack it with gunzip"),
    ((b"\x93NUMPY",), "a numpy array", "write it as text with numpy.savetxt, or as HDF5"),
    (
        (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"),
        "a Python pickle",
        "pickles are never loaded, as they can run code: write it as text or HDF5",
    ),
)


@dataclass(frozen=True)
class Imported:
    """A foreign recording in our columns."""

    events: Events  # the first one at t = 0, unless the file says when its recording began
    frame_px: tuple[int, int]  # width, height
    t_offset_us: int  # where t = 0 is in the file's own clock
    slices: int  # up to and with the slice of the last event; 0 without events; more where an export of ours had more
    format: str  # aedat4, hdf5, prophesee, rosbag or text
    counts: dict[str, int]  # events dropped, by reason: not_a_number, out_of_frame
    sorted: int  # events put back in order
    notes: list[str]  # what the user should know: other streams, losses, ...
    simulated: bool = False  # an export of ours says that its events come from a simulation


def read_events(
    path: str | Path,
    *,
    frame_px: tuple[int, int] | None = None,
    sort: bool = False,
    dialect: str | None = None,
    stream: str | None = None,
) -> Imported:
    """Read a foreign event file, all of it or an InputError; a broken AEDAT4 file as far as it goes, with a note.

    frame_px: (width, height), needed where the file does not say it (text, HDF5), refused if it contradicts the file.
    path: a file, or the folder of a ROS 2 bag.
    sort: put events whose time goes backwards in order (stable) instead of refusing them.
    dialect: the columns of a text file, as in "x y p t_us". Without it a first line of names counts, else `t x y p`;
    and t is in microseconds if the first one is written as an integer, else (`0.25`, `1e-3`) in seconds.
    stream: the event stream of an AEDAT4 file, or the topic of a bag, that has several; the first by name otherwise.

    The number of slices is the last event's slice + 1, not the duration rounded up: an event at exactly 2 ms lies in
    the third slice. A file without any event is refused, unless it is our export of a recording without any.
    """
    path = Path(path)
    where = str(path)
    try:
        foreign = _open(path, frame_px, {"dialect": dialect, "stream": stream})
        note = foreign.note
        try:
            normal = normalise(
                foreign.batches,
                foreign.frame_px,
                sort=sort,
                start_us=note.start_us if note else None,
                may_be_empty=note is not None and not note.events,
                where=where,
            )
        finally:
            if isinstance(foreign.batches, Generator):  # a refusal leaves it with its file open
                foreign.batches.close()
    except OSError as error:
        raise InputError("cannot be read", where=where, found=error.strerror or str(error)) from error
    except MemoryError as error:
        raise InputError("does not fit in memory", where=where, hint="import it in parts") from error
    events = normal.events
    notes = [*foreign.notes, *_losses(foreign, normal)]
    if normal.sorted:
        notes.append(f"time went backwards: {normal.sorted} events were put back in order")
    slices = int(events.t[-1]) // SLICE_US + 1 if events.size else 0
    if note and not foreign.cut_short and not _lacks_events(foreign, normal):
        slices = max(slices, note.slices)  # of a cut file nobody knows what was lost: no silence is made of it
    return Imported(
        events=events,
        frame_px=foreign.frame_px,
        t_offset_us=normal.first_us + foreign.clock_us if events.size or note else 0,
        slices=slices,
        format=foreign.format,
        counts=normal.dropped,
        sorted=normal.sorted,
        notes=notes,
        simulated=note is not None and note.simulated,
    )


def _lacks_events(foreign: Foreign, normal: Normal) -> bool:
    """Whether an export of ours has fewer events than were written into it."""
    written = foreign.note.events if foreign.note else None
    return written is not None and normal.events.size + sum(normal.dropped.values()) < written


def _losses(foreign: Foreign, normal: Normal) -> Iterator[str]:
    """What is missing and was not told by the reader, in words; of dropped events only where they are many."""
    if foreign.note and not foreign.cut_short and _lacks_events(foreign, normal):
        yield f"cut short: {normal.events.size} events of the {foreign.note.events} that were exported"
    dropped = normal.dropped
    read = normal.events.size + sum(dropped.values())
    if dropped["out_of_frame"] > LOSS_WORTH_A_WORD * read:
        frame = "{}x{}".format(*foreign.frame_px)
        share = f"{dropped['out_of_frame'] / read:.0%}"
        yield f"{share} of the events lie outside {frame} and were dropped; is it the frame?"
    if dropped["not_a_number"] > LOSS_WORTH_A_WORD * read:
        yield f"{dropped['not_a_number'] / read:.0%} of the events were dropped: not all of t, x, y, p are numbers"


def _open(path: Path, frame_px: tuple[int, int] | None, options: dict[str, str | None]) -> Foreign:
    """Find the format from the first bytes and hand over to its reader."""
    format_ = BAG if path.is_dir() and is_bag_folder(path) else _format(path)
    for name, value in options.items():
        if value is not None and name != format_.option:  # an option that would do nothing is an error
            raise InputError(
                f"{name} only applies to {OPTION_OF[name]}", where=str(path), found=repr(value), hint="leave it out"
            )
    return format_.read(path, frame_px, *([options[format_.option]] if format_.option else []))


def _format(path: Path) -> Format:
    """The row that a file belongs to; text if its first line looks like text."""
    where = str(path)
    head = _head(path)
    for format_ in FORMATS:
        if any(head.startswith(format_.begins, at) for at in format_.at):
            return format_
    for starts, name, hint in STRANGERS:
        if head.startswith(starts):
            raise InputError(
                "not a file of events that can be read", where=where, expected=EXPECTED, found=name, hint=hint
            )
    first_line = head.partition(b"\n")[0]
    binary = any(byte < 32 and byte not in b"\t\f\r" for byte in first_line)
    if binary or path.suffix.lower() in (".aedat4", ".h5", ".hdf5", ".bag", ".db3", ".mcap", ".raw"):
        raise InputError(
            "not a file of events that can be read",
            where=where,
            expected=EXPECTED,
            found=f"a file that begins with {head[:16]!r}",
        )
    return TEXT


def _head(path: Path) -> bytes:
    """The first bytes of a plain file that has some."""
    if path.is_dir():
        hint = "a ROS 2 bag without its metadata.yaml? name the .db3 or .mcap file in it"
        raise InputError("this is a folder", where=str(path), expected=EXPECTED, hint=hint)
    if not path.is_file():
        found = "a device or pipe" if path.exists() else "no such file"
        raise InputError("cannot be read", where=str(path), expected=EXPECTED, found=found)
    with path.open("rb") as handle:
        head = handle.read(HEAD_BYTES)
    if not head:
        raise InputError("the file is empty", where=str(path), expected=EXPECTED)
    return head
