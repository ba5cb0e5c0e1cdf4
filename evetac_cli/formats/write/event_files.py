"""Write the events of a recording as text, as HDF5 of the DSEC data set, as AEDAT4, and as Prophesee's RAW.

In text, one line per event is `t x y p`, t in us on the source's clock; numpy.loadtxt reads it. In HDF5, the columns
are events/{x,y,t,p}; t counts in us from t_offset, and ms_to_idx[k] is the first event at k ms or later. They are
compressed with gzip, which every HDF5 tool reads; DSEC's Blosc needs a plugin. t has 32 bits as in DSEC, enough for 71
minutes, otherwise 64. Dimension scales, which evetac's own files have, would be datasets that DSEC does not have.
AEDAT4 is one stream, compressed with LZ4, which dv-processing reads. faery, of the extra `convert`, writes it; its
encoder reports no error when the disk is full, so the file is checked after writing.

RAW has text lines that begin with "% ", then words of EVT3. The upper four of their 16 bits are the type: 8 high bits
of time, 6 low bits of time, 0 row, 2 column and polarity. Only values that change are written again. Times count from
the start of the recording. The text lines have the start on the source's clock and the note, which faery would not
write. Source: Prophesee's documentation of EVT 3.0.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError, needs_extra
from evetac_cli.events import Events
from evetac_cli.formats.note import NAME, Note
from evetac_cli.formats.read.aedat4_packets import read_header, walk
from evetac_cli.formats.read.prophesee.read_prophesee import OFFSET
from evetac_cli.jobs import Progress
from evetac_cli.store.hdf5.chunks import RowWriter, put
from evetac_cli.store.hdf5.disk import new_file
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.netcdf import describe_dataset
from evetac_cli.store.recordings.read import Recording

PIECE_EVENTS = 1 << 18  # some 3 MB: memory use does not depend on the length of the recording
LINES = 1 << 14  # events whose text is built in memory at once
DSEC_TYPES = {"x": np.uint16, "y": np.uint16, "p": np.uint8}
SHORT_MS = 2**32 // 1000
PACKET_EVENTS = 8192  # some 10 ms of a busy sensor, the packet length that recorders of AEDAT4 use
AEDAT4_EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])  # the type that faery accepts
LZ4 = ("lz4", 1)
TIME_HIGH, TIME_LOW, ROW, COLUMN = 8, 6, 0, 2  # types of words of EVT3
RAW_MOST_PX = 2**11  # columns and rows
RAW_HEAD = "% evt 3.0\n% format EVT3;height={height};width={width}\n% geometry {width}x{height}\n"


def pieces(recording: Recording, progress: Progress) -> Iterator[Events]:
    """Yield all events of a recording in order, PIECE_EVENTS at a time, and report progress."""
    total = recording.event_count
    progress(0, total)
    for first in range(0, total, PIECE_EVENTS):
        last = min(first + PIECE_EVENTS, total)
        yield recording.events(first, last)
        progress(last, total)


def t_offset_us(recording: Recording) -> int:
    """Return the time on the source's own clock that corresponds to t = 0."""
    return int(recording.read("t_offset"))


def note_for(recording: Recording, start_us: int) -> Note:
    """Return the note on a recording; start_us is the written time that corresponds to t = 0."""
    simulated = bool(recording.header["simulated"])
    return Note(start_us, len(recording), recording.frame_px, simulated, recording.event_count)


def write_text(recording: Recording, path: Path, progress: Progress) -> None:
    """Write two comment lines, the first of which is the note, then one line per event."""
    offset_us = t_offset_us(recording)
    with path.open("w", encoding="ascii") as file:
        file.write(f"# {NAME} {note_for(recording, offset_us).text()}\n# t_us x y p\n")
        for events in pieces(recording, progress):
            for first in range(0, events.size, LINES):
                t, x, y, p = events.part(first, first + LINES)
                rows = np.stack([t + offset_us, x, y, p], axis=1).ravel().tolist()
                file.write("%d %d %d %d\n" * len(t) % tuple(rows))


def write_dsec(recording: Recording, path: Path, progress: Progress) -> None:
    """Write all columns in pieces, each with its unit and long name; the note is an attribute of the root."""
    types = {"t": np.uint32 if len(recording) <= SHORT_MS else np.int64, **DSEC_TYPES}
    with new_file(path) as h5:
        h5.attrs[NAME] = note_for(recording, 0).text()
        count = recording.event_count
        columns = {name: RowWriter(h5, f"events/{name}", type_, (), count) for name, type_ in types.items()}
        for events in pieces(recording, progress):
            for name, column in columns.items():
                column.append(getattr(events, name))
        for column in columns.values():
            column.close()
        put(h5, "ms_to_idx", recording.starts.astype(np.uint64))
        put(h5, "t_offset", np.int64(t_offset_us(recording)))
        table = schema.load("recording")  # a recording stores its events in DSEC's layout
        for name in (*columns, "ms_to_idx", "t_offset"):
            dataset = f"events/{name}" if name in columns else name
            describe_dataset(h5[dataset], table.find(dataset))


def write_aedat4(recording: Recording, path: Path, progress: Progress) -> None:
    """Write one stream of events, t on the source's clock; raise InputError with faery's message if writing fails."""
    where = str(path.parent)
    with needs_extra("AEDAT4 needs faery", "convert", where):
        import faery
    offset_us = t_offset_us(recording)
    if recording.event_count and int(recording.events(0, 1).t[0]) + offset_us < 0:
        found, hint = f"an offset of {offset_us} us", "export the recording as text or dsec"
        raise InputError("AEDAT4 cannot store times before 0", where=str(recording.path), found=found, hint=hint)
    aedat = faery.extension.aedat
    header = aedat4_description(aedat, recording.frame_px, note_for(recording, offset_us).text())
    try:
        with aedat.Encoder(path, header, LZ4) as encoder:
            for events in pieces(recording, progress):
                rows = np.empty(events.size, AEDAT4_EVENT)
                rows["t"] = events.t + offset_us
                rows["x"], rows["y"], rows["on"] = events.x, events.y, events.p
                for first in range(0, len(rows), PACKET_EVENTS):
                    encoder.write(0, rows[first : first + PACKET_EVENTS])
        with path.open("rb") as file:
            written = read_header(file, where)
            trouble = "" if written.table >= 0 and walk(file, written, 0).whole else "the file is incomplete"
    except (RuntimeError, OSError) as error:  # faery raises RuntimeError for every error of the disk
        trouble = str(error)
    if trouble:
        raise InputError("the AEDAT4 file could not be written", where=where, found=trouble, hint="is the disk full?")


def write_raw(recording: Recording, path: Path, progress: Progress) -> None:
    """Write the text lines, then the words; raise InputError if the frame is too large for EVT3."""
    width, height = recording.frame_px
    if max(width, height) > RAW_MOST_PX:
        message, where = "the recording does not fit into EVT3", str(recording.path)
        expected, hint = f"at most {RAW_MOST_PX}x{RAW_MOST_PX} px", "export the recording as dsec or text"
        raise InputError(message, where=where, expected=expected, found=f"{width}x{height}", hint=hint)
    lines = f"% {NAME} {note_for(recording, 0).text()}\n% {OFFSET} {t_offset_us(recording)}\n% end\n"
    with path.open("wb") as file:
        file.write((RAW_HEAD.format(width=width, height=height) + lines).encode())
        for words in _evt3_words(pieces(recording, progress)):
            file.write(words.tobytes())


def _evt3_words(parts: Iterator[Events]) -> Iterator[NDArray[Any]]:
    """Encode EVT3 words. The 24 bits of time wrap every 16.8 s, so all high bits are written, as sensors do."""
    high, t_us, row = -1, -1, -1
    for events in parts:
        y = events.y.astype(np.int64)
        steps = np.diff(events.t >> 12, prepend=high)
        later, moved = np.diff(events.t, prepend=t_us) != 0, np.diff(y, prepend=row) != 0
        last = np.cumsum(steps + later + moved + 1) - 1  # the index of each event's column word, which is its last
        words = np.empty(last[-1] + 1, np.uint16)
        times = np.ones(len(words), bool)  # the indices of high bits: those that no other word occupies
        for place, word in (
            (last, COLUMN << 12 | events.p.astype(np.int64) << 11 | events.x),
            ((last - 1)[moved], (ROW << 12 | y)[moved]),
            ((last - 1 - moved)[later], (TIME_LOW << 12 | events.t & 0xFFF)[later]),
        ):
            words[place] = word
            times[place] = False
        words[times] = TIME_HIGH << 12 | (np.arange(high + 1, high + 1 + np.count_nonzero(times)) & 0xFFF)
        yield words.astype("<u2", copy=False)
        high, t_us, row = int(events.t[-1]) >> 12, int(events.t[-1]), int(y[-1])


def aedat4_description(aedat: Any, frame_px: tuple[int, int], note: str = "") -> list[Any]:
    """Return the header of a file with one event stream, in faery's types, with texts escaped (faery does not)."""

    def node(path: str, attributes: dict[str, int | str], *nodes: Any) -> Any:
        types = {int: "int", str: "string"}
        values = {
            key: aedat.DescriptionAttribute(types[type(value)], escape(value) if isinstance(value, str) else value)
            for key, value in attributes.items()
        }
        return aedat.DescriptionNode(path.rstrip("/").rpartition("/")[2], path, values, list(nodes))

    top = "/mainloop/Recorder/outInfo/"
    info: dict[str, int | str] = {"sizeX": frame_px[0], "sizeY": frame_px[1], "source": "evetac"}
    stream: dict[str, int | str] = {"originalOutputName": "events", "typeIdentifier": "EVTS"}
    noted = info | ({NAME: note} if note else {})
    return [node(top, {}, node(f"{top}0/", stream, node(f"{top}0/info/", noted)))]
