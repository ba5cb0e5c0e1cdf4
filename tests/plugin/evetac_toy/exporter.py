"""Write toy files, which importer.py reads."""

from pathlib import Path

from evetac_cli.formats.exports import ExportFormat
from evetac_cli.formats.write.event_files import pieces
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording


def write(recording: Recording, path: Path, progress: Progress) -> None:
    """Write a line for every event. The command reports which parts of the recording were left out."""
    with path.open("w", encoding="ascii") as file:
        file.write("toy events {}x{}\n".format(*recording.frame_px))
        for events in pieces(recording, progress):
            file.writelines(f"{t},{x},{y},{p}\n" for t, x, y, p in zip(*events, strict=True))


TOY = ExportFormat((".toy",), write)
