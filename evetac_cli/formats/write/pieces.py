"""What the writers of event formats share: the events of a recording piece by piece, and the note about it."""

from collections.abc import Iterator

from evetac_cli.events import Events
from evetac_cli.formats.note import Note
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

PIECE_EVENTS = 1 << 18  # some 3 MB: memory stays flat however long the recording is


def pieces(recording: Recording, progress: Progress) -> Iterator[Events]:
    """All events of a recording in order, PIECE_EVENTS at a time; `progress` hears how many are done."""
    total = recording.event_count
    progress(0, total)
    for first in range(0, total, PIECE_EVENTS):
        last = min(first + PIECE_EVENTS, total)
        yield recording.events(first, last)
        progress(last, total)


def t_offset_us(recording: Recording) -> int:
    """Where t = 0 is on the source's own clock."""
    return int(recording.read("t_offset"))


def note_for(recording: Recording, start_us: int) -> Note:
    """What the format itself cannot say; start_us is where t = 0 is in the times as they are written."""
    simulated = bool(recording.header["simulated"])
    return Note(start_us, len(recording), recording.frame_px, simulated, recording.event_count)
