"""Write events as AEDAT4 with faery, the extra `convert`: one stream, compressed with LZ4, which dv-processing reads.

The note is stored in the stream's metadata. faery's encoder reports no error when the disk is full, so the file is
checked after writing.
"""

from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from evetac_cli.errors import InputError, missing_extra
from evetac_cli.formats.note import NAME
from evetac_cli.formats.read.aedat.aedat4_packets import is_whole
from evetac_cli.formats.write.pieces import note_for, pieces, t_offset_us
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

PACKET_EVENTS = 8192  # some 10 ms of a busy sensor, the packet length that recorders use
EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])  # the type that faery accepts
LZ4 = ("lz4", 1)


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write one stream of events, t on the source's clock; raise InputError with faery's message if writing fails."""
    where = str(path.parent)
    try:
        import faery
    except ImportError as error:
        raise missing_extra("AEDAT4 needs faery", "convert", where=where, error=error) from None
    offset_us = t_offset_us(recording)
    if recording.event_count and int(recording.events(0, 1).t[0]) + offset_us < 0:
        raise InputError(
            "AEDAT4 cannot store times before 0",
            where=str(recording.path),
            found=f"a first event at {int(recording.events(0, 1).t[0]) + offset_us} us on the source's clock",
            hint="export the recording as text or dsec",
        )
    aedat = faery.extension.aedat
    header = description(aedat, recording.frame_px, note_for(recording, offset_us).text())
    try:
        with aedat.Encoder(path, header, LZ4) as encoder:
            for events in pieces(recording, progress):
                rows = np.empty(events.size, EVENT)
                rows["t"] = events.t + offset_us
                rows["x"], rows["y"], rows["on"] = events.x, events.y, events.p
                for first in range(0, len(rows), PACKET_EVENTS):
                    encoder.write(0, rows[first : first + PACKET_EVENTS])
        trouble = "" if is_whole(path) else "the file is incomplete"
    except (RuntimeError, OSError) as error:  # faery raises RuntimeError for every error of the disk
        trouble = str(error)
    if trouble:
        raise InputError("the AEDAT4 file could not be written", where=where, found=trouble, hint="is the disk full?")


def description(aedat: Any, frame_px: tuple[int, int], note: str = "") -> list[Any]:
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
