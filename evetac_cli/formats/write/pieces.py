"""Shared by the writers of event formats: the events of a recording in pieces, and the note about it."""

from collections.abc import Iterator

from evetac_cli.events import Events
from evetac_cli.formats.note import Note
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

PIECE_EVENTS = 1 << 18  # some 3 MB: memory use does not depend on the length of the recording


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
