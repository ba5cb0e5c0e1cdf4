"""Write events as AEDAT4 with faery, the extra `convert`: one stream, compressed with LZ4, which dv-processing reads.

The note goes among the stream's metadata. faery's encoder says nothing where a disk is full, so the file is looked at
afterwards.
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

PACKET_EVENTS = 8192  # some 10 ms of a busy sensor, as recorders cut them
EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])  # as faery takes them
LZ4 = ("lz4", 1)


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """One stream of events, t on the source's clock; InputError with the library's words where it does not work."""
    where = str(path.parent)
    try:
        import faery
    except ImportError as error:
        raise missing_extra("AEDAT4 needs faery", "convert", where=where, error=error) from None
    offset_us = t_offset_us(recording)
    if recording.event_count and int(recording.events(0, 1).t[0]) + offset_us < 0:
        raise InputError(
            "AEDAT4 has no times before 0",
            where=str(recording.path),
            found=f"a first event at {int(recording.events(0, 1).t[0]) + offset_us} us of the source's clock",
            hint="export it as text or dsec",
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
        trouble = "" if is_whole(path) else "the file is not complete"
    except (RuntimeError, OSError) as error:  # faery raises RuntimeError for whatever the disk says
        trouble = str(error)
    if trouble:
        raise InputError("AEDAT4 cannot be written", where=where, found=trouble, hint="is the disk full?")


def description(aedat: Any, frame_px: tuple[int, int], note: str = "") -> list[Any]:
    """What the header of a file with a stream of events says, as faery takes it (which writes texts as they are)."""

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
