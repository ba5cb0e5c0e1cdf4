"""Write events as text that numpy.loadtxt reads: one line `t x y p` per event, t in us on the source's clock."""

from pathlib import Path

import numpy as np

from evetac_cli.formats.note import NAME
from evetac_cli.formats.write.pieces import note_for, pieces, t_offset_us
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

LINES = 1 << 14  # events whose text is built in memory at once


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write two comment lines, then one line per event."""
    offset_us = t_offset_us(recording)
    with path.open("w", encoding="ascii") as file:
        file.write(f"# {NAME} {note_for(recording, offset_us).text()}\n# t_us x y p\n")
        for events in pieces(recording, progress):
            for first in range(0, events.size, LINES):
                t, x, y, p = events.part(first, first + LINES)
                rows = np.stack([t + offset_us, x, y, p], axis=1).ravel().tolist()
                file.write("%d %d %d %d\n" * len(t) % tuple(rows))
