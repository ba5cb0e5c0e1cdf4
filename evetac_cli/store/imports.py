"""Foreign event files -> our columns: one function for all formats.

    AEDAT4          import_aedat4   says its frame size; needs the extra `camera` (dv-processing)
    text            import_text     `t x y p` a line, blanks or commas, `#` comments; integers are microseconds
    HDF5 as DSEC    import_hdf5     events/{t,x,y,p} in microseconds, t_offset

The content decides, not the file's name. What all formats share is checked in one place, import_door.
"""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.store.import_door import Foreign, normalise

FORMATS = "AEDAT4, text with a line `t x y p` for every event, or HDF5 with events/{t,x,y,p}"
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
HDF5_SIGNATURE_AT = (0, 512, 1024, 2048)  # a user block may come before it
HEAD_BYTES = 4096
TO_AEDAT4 = "convert it to AEDAT4 with the maker's DV, or to text"
FROM_RAW = "convert it to text with metavision_file_to_csv, and write `x,y,p,t_us` before its first line"
# What people have lying beside their event files, how it begins, and the way from there.
STRANGERS: tuple[tuple[tuple[bytes, ...], str, str], ...] = (
    ((b"#!AER-DAT2",), "AEDAT2", TO_AEDAT4),
    ((b"#!AER-DAT3",), "AEDAT3", TO_AEDAT4),
    ((b"% evt", b"% format", b"% date", b"% camera", b"% integrator", b"% Data"), "Prophesee RAW or DAT", FROM_RAW),
    ((b"#ROSBAG",), "a ROS bag", "convert it to text or HDF5"),
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

    events: Events  # the first one at t = 0
    frame_px: tuple[int, int]  # width, height
    t_offset_us: int  # time of the first event in the file's own clock
    slices: int  # up to and with the slice of the last event; 0 without events
    format: str  # aedat4, text or hdf5
    counts: dict[str, int]  # events dropped, by reason: not_a_number, out_of_frame
    sorted: int  # events put back in order
    notes: list[str]  # what the user should know: other streams, losses, ...


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
    sort: put events whose time goes backwards in order (stable) instead of refusing them.
    dialect: the columns of a text file, as in "x y p t_us". Without it a first line of names counts, else `t x y p`;
    and t is in microseconds if the first one is written as an integer, else (`0.25`, `1e-3`) in seconds.
    stream: the event stream of an AEDAT4 file that has several; the first by name otherwise.

    The number of slices is the last event's slice + 1, not the duration rounded up: an event at exactly 2 ms lies in
    the third slice.
    """
    path = Path(path)
    where = str(path)
    try:
        foreign = _open(path, frame_px, dialect, stream)
        normal = normalise(foreign.batches, foreign.frame_px, sort=sort, where=where)
    except OSError as error:
        raise InputError("cannot be read", where=where, found=error.strerror or str(error)) from error
    except MemoryError as error:
        raise InputError("does not fit in memory", where=where, hint="import it in parts") from error
    events = normal.events
    notes = list(foreign.notes)
    if normal.sorted:
        notes.append(f"time went backwards: {normal.sorted} events were put back in order")
    return Imported(
        events=events,
        frame_px=foreign.frame_px,
        t_offset_us=normal.first_us + foreign.clock_us if events.size else 0,
        slices=int(events.t[-1]) // SLICE_US + 1 if events.size else 0,
        format=foreign.format,
        counts=normal.dropped,
        sorted=normal.sorted,
        notes=notes,
    )


def _open(path: Path, frame_px: tuple[int, int] | None, dialect: str | None, stream: str | None) -> Foreign:
    """Find the format from the first bytes and hand over to its reader."""
    from evetac_cli.store.import_aedat4 import open_aedat4
    from evetac_cli.store.import_hdf5 import open_hdf5
    from evetac_cli.store.import_text import open_text

    where = str(path)
    head = _head(path)
    if head.startswith(b"#!AER-DAT4"):
        _refuse_option("dialect", dialect, "text", where)
        return open_aedat4(path, frame_px, stream)
    _refuse_option("stream", stream, "AEDAT4", where)
    if any(head.startswith(HDF5_SIGNATURE, at) for at in HDF5_SIGNATURE_AT):
        _refuse_option("dialect", dialect, "text", where)
        return open_hdf5(path, frame_px)
    for starts, name, hint in STRANGERS:
        if head.startswith(starts):
            raise InputError(
                "not a file of events that can be read", where=where, expected=FORMATS, found=name, hint=hint
            )
    first_line = head.partition(b"\n")[0]
    binary = any(byte < 32 and byte not in b"\t\f\r" for byte in first_line)
    if binary or path.suffix.lower() in (".aedat4", ".h5", ".hdf5"):
        raise InputError(
            "not a file of events that can be read",
            where=where,
            expected=FORMATS,
            found=f"a file that begins with {head[:16]!r}",
        )
    return open_text(path, frame_px, dialect)


def _head(path: Path) -> bytes:
    """The first bytes of a plain file that has some."""
    if path.is_dir():
        raise InputError("this is a folder", where=str(path), expected=FORMATS)
    if not path.is_file():
        found = "a device or pipe" if path.exists() else "no such file"
        raise InputError("cannot be read", where=str(path), expected=FORMATS, found=found)
    with path.open("rb") as handle:
        head = handle.read(HEAD_BYTES)
    if not head:
        raise InputError("the file is empty", where=str(path), expected=FORMATS)
    return head


def _refuse_option(name: str, value: str | None, format_name: str, where: str) -> None:
    """An option that would do nothing is an error."""
    if value is not None:
        raise InputError(
            f"{name} only applies to {format_name} files", where=where, found=repr(value), hint="leave it out"
        )
