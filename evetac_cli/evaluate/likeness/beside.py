"""Files next to a recording with more information: labels for its onset of slip, tracks for its dot positions."""

from collections.abc import Iterator
from contextlib import contextmanager

from evetac_cli.evaluate.data_rate import labels_beside
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import Recording


def headers(recording: Recording) -> list[Header]:
    """Return headers of a recording and of the files next to it.

    Raise InputError if these belong to another recording.
    """
    labels = None if recording.has("truth") else labels_beside(recording)
    with dot_places(recording) as dots:
        tracks = dots[0] if dots is not None and dots[0] is not recording else None
        return [recording.header, *([labels.header] if labels else []), *([tracks.header] if tracks else [])]


@contextmanager
def dot_places(recording: Recording) -> Iterator[tuple[StageFile, str] | None]:
    """Yield the file and dataset of the dot positions of a recording: its truth, or the tracks next to it, or None.

    Raises InputError if the tracks belong to another recording.
    """
    if recording.has("truth"):
        yield recording, "truth/dot_xy_px"
        return
    path = output_path(recording.path, "tracks", None)
    if not path.exists():
        yield None
        return
    with StageFile(path, "tracks") as tracks:
        check_made_from(tracks, recording)
        yield tracks, "dot_xy_px"
