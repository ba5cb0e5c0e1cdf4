"""Write events as AEDAT4 with faery, the extra `convert`: one stream, compressed with LZ4, which dv-processing reads.

The note goes among the stream's metadata. faery's encoder says nothing where a disk is full, so the file is looked at
afterwards.
"""

from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.formats.read.aedat.aedat4_packets import COMPRESSIONS, EVENT, description, is_whole
from evetac_cli.formats.read.faery_library import load_faery
from evetac_cli.formats.write.pieces import note_for, pieces, t_offset_us
from evetac_cli.jobs import Progress
from evetac_cli.store.read import Recording

PACKET_EVENTS = 8192  # some 10 ms of a busy sensor, as recorders cut them
LZ4 = 1


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """One stream of events, t on the source's clock; InputError with the library's words where it does not work."""
    where = str(path.parent)
    aedat = load_faery("AEDAT4 needs", where).extension.aedat
    offset_us = t_offset_us(recording)
    if recording.event_count and int(recording.events(0, 1).t[0]) + offset_us < 0:
        raise InputError(
            "AEDAT4 has no times before 0",
            where=str(recording.path),
            found=f"a first event at {int(recording.events(0, 1).t[0]) + offset_us} us of the source's clock",
            hint="export it as text or dsec",
        )
    header = description(recording.frame_px, note_for(recording, offset_us).text())
    try:
        with aedat.Encoder(path, header, COMPRESSIONS[LZ4]) as encoder:
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
