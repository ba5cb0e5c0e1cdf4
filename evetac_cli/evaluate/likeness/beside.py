"""Files beside a recording that tell more of it: labels its onset of slip, tracks where its dots are."""

from collections.abc import Iterator
from contextlib import contextmanager

from evetac_cli.evaluate.data_rate import labels_beside
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import Recording


def headers(recording: Recording) -> list[Header]:
    """Headers of a recording and of the files beside it that tell more of it; InputError if those are another's."""
    labels = None if recording.has("truth") else labels_beside(recording)
    with dot_places(recording) as dots:
        tracks = dots[0] if dots is not None and dots[0] is not recording else None
        return [recording.header, *([labels.header] if labels else []), *([tracks.header] if tracks else [])]


@contextmanager
def dot_places(recording: Recording) -> Iterator[tuple[StageFile, str] | None]:
    """Where the dots of a recording are, as a file and its dataset: its truth, or the tracks beside it; None without.

    InputError for tracks beside it that are another recording's.
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
