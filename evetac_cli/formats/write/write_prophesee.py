"""Write events as Prophesee's RAW (EVT3 and EVT2) and DAT: text lines that begin with "% ", then words.

    EVT3   16 bits, the upper four are the type: 8 high bits of time, 6 low bits of time, 0 row, 2 column and polarity;
           only values that change are written again
    EVT2   32 bits, the upper four are the type: 8 high bits of time, 0 and 1 an event, with the 6 low bits of its time
    DAT    64 bits per event: time, then column, row and polarity

Times count from the start of the recording, because the formats have few bits for them. The start on the source's clock
is stored in the text lines, and so is the note. faery writes these files too, but not evetac's text lines; therefore
the words are encoded here. Sources: Prophesee's documentation of EVT 2.0, EVT 3.0 and DAT.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.formats.note import NAME
from evetac_cli.formats.read.prophesee.read_prophesee import OFFSET
from evetac_cli.formats.write.event_files import note_for, pieces, t_offset_us
from evetac_cli.jobs import Progress
from evetac_cli.store.recordings.read import Recording

TIME_HIGH, TIME_LOW, ROW, COLUMN = 8, 6, 0, 2  # the upper four bits of a word
EVENT_OF_DAT = bytes((0x0C, 8))  # "contrast detection", of 8 bytes


class PropheseeLayout(NamedTuple):
    """A format: its first text lines, the bytes after all text lines, its limits, and the encoder of its words."""

    name: str
    head: str
    after: bytes
    most_px: int  # columns and rows
    most_us: float
    words: Callable[[Iterator[Events]], Iterator[NDArray[Any]]]


def evt3_words(parts: Iterator[Events]) -> Iterator[NDArray[Any]]:
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


def evt2_words(parts: Iterator[Events]) -> Iterator[NDArray[Any]]:
    """Encode EVT2 words: the high bits of time whenever they change, then the event."""
    before = -1
    for events in parts:
        high = events.t >> 6
        event = events.p.astype(np.int64) << 28 | (events.t & 0x3F) << 22 | events.x.astype(np.int64) << 11 | events.y
        words = np.stack([TIME_HIGH << 28 | high, event], axis=1)
        changes = np.diff(high, prepend=before) != 0
        yield words[np.stack([changes, np.ones_like(changes)], axis=1)].astype("<u4")
        before = int(high[-1])


def dat_words(parts: Iterator[Events]) -> Iterator[NDArray[Any]]:
    """Encode DAT words, two of 32 bits per event."""
    for events in parts:
        place = events.p.astype(np.int64) << 28 | events.y.astype(np.int64) << 14 | events.x
        yield np.stack([events.t, place], axis=1).astype("<u4")


RAW_HEAD = "% evt {}.0\n% format EVT{};height={{height}};width={{width}}\n% geometry {{width}}x{{height}}\n"
DAT_HEAD = "% Data file containing CD events.\n% Version 2\n% Height {height}\n% Width {width}\n"
EVT3 = PropheseeLayout("EVT3", RAW_HEAD.format(3, 3), b"% end\n", 2**11, np.inf, evt3_words)
EVT2 = PropheseeLayout("EVT2", RAW_HEAD.format(2, 2), b"% end\n", 2**11, 2**34, evt2_words)
DAT = PropheseeLayout("DAT", DAT_HEAD, EVENT_OF_DAT, 2**14, 2**32, dat_words)


def _write(layout: PropheseeLayout, recording: Recording, path: Path, progress: Progress) -> None:
    """Write all events in a layout; raise InputError before writing if frame or times need more bits."""
    width, height = recording.frame_px
    length_us = len(recording) * SLICE_US
    for fits, expected, there_is in (
        (max(width, height) <= layout.most_px, f"at most {layout.most_px}x{layout.most_px} px", f"{width}x{height}"),
        (length_us <= layout.most_us, f"at most {layout.most_us / 6e7:.0f} min", f"{length_us / 6e7:.1f} min"),
    ):
        if not fits:
            message, where = f"the recording does not fit into {layout.name}", str(recording.path)
            hint = "export the recording as dsec or text, or cut out a part with `evetac trim`"
            raise InputError(message, where=where, expected=expected, found=there_is, hint=hint)
    lines = f"% {NAME} {note_for(recording, 0).text()}\n% {OFFSET} {t_offset_us(recording)}\n"
    with path.open("wb") as file:
        file.write((layout.head.format(width=width, height=height) + lines).encode() + layout.after)
        for words in layout.words(pieces(recording, progress)):
            file.write(words.tobytes())


write_evt3, write_evt2, write_dat = (partial(_write, layout) for layout in (EVT3, EVT2, DAT))
