"""The event words of a DVXplorer Mini: 32-bit words of its USB data endpoint, to events and back.

A frame is what the sensor reads out at one time: columns from left to right, in each column groups of eight rows. The
first COLUMN word of a frame carries the flag SOF, all of them the microseconds within the millisecond of the last
TIMESTAMP word. A frame is accepted or dropped whole, as by the maker's parser. `start` and `step` take the byte stream
however it is cut (loops: event_word_loops.py).

After damage that may hide lost words nothing is believed before the next TIMESTAMP (at most 1 ms of a busy sensor),
since one may be among them; where only a row or a column is impossible, nothing before the next frame is. The maker's
parser (dv-processing 2.0.4, run beside this one) makes the same of sound streams; of damaged ones it also hands out
pixels outside the frame and frames with unknown words in them.

Why so: a TIMESTAMP counts milliseconds modulo 2**22, so that a single damaged one would read as up to 70 minutes. None
is believed that the host's clock does not allow, since the first one or, of one that is far ahead of the last, by its
estimate of device time; from many refused in a row the decoder concludes that the camera started its clock anew, and
goes on from the host's time.

What is counted as lost events is never more than there were: of words that are damaged, or stand beside such that are,
the bits say nothing. How the format shows that bytes are missing: hardly one in ten words that begin at a wrong byte is
one that a camera sends, so that words are looked for at the other three places (torn_bytes).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evetac_cli.checks import check_range
from evetac_cli.devices.dvxplorer import event_word_loops as loops
from evetac_cli.events import FRAME_PX, SLICE_US, Events, concatenate, empty

LOSSES = loops.LOSSES
QUIET_MS = loops.QUIET_MS
WORD_BYTES = 4
SEARCH_WORDS = 64  # behind damage, in which the byte is looked for at which words begin
MOST_SEARCH_WORDS = 4096  # where the damage goes on: four times as many each time


@dataclass
class EventWordDecoder:
    """State of the decoding of one stream, between two calls of `step`."""

    registers: NDArray[np.int64] = field(default_factory=loops.new_registers)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(LOSSES), np.int64))
    frame: Events = field(default_factory=empty)  # events of the frame that is not over yet
    rest: bytes = b""  # of a word that was split between two buffers

    @property
    def first_ms(self) -> int | None:
        """Device time of the first TIMESTAMP; None before it."""
        ms = int(self.registers[loops.FIRST_MS])
        return ms if ms >= 0 else None

    @property
    def now_us(self) -> int:
        """Device time that the stream has reached, wraps undone."""
        return SLICE_US * int(self.registers[loops.MS]) + max(0, int(self.registers[loops.LAST_US]))

    @property
    def unmeasured_times(self) -> int:
        """How many TIMESTAMPs do not say how much later they are than the one before: the first, and refused ones."""
        return int(self.counts[loops.REFUSED]) + (self.first_ms is not None)

    @property
    def counted(self) -> Mapping[str, int]:
        """What was lost so far: occurrences by reason, and events."""
        return {name: int(count) for name, count in zip(LOSSES, self.counts, strict=True)}


def start() -> EventWordDecoder:
    """A decoder before the first byte of a stream."""
    return EventWordDecoder()


def step(
    decoder: EventWordDecoder,
    data: bytes | bytearray | memoryview,
    host_ms: int | None = None,
    most_ms: int | None = None,
) -> Events:
    """Events of the frames that the next bytes complete; t in us, int64, never decreasing.

    host_ms: device time by the host's clock, as far as known: a TIMESTAMP more than loops.JUMP_MS ahead of the last
    is believed only up to there. most_ms: so much can have passed since the first TIMESTAMP, and no later one is
    believed. Without both, as with words from a file, every TIMESTAMP is that is ahead by less than half the range.
    All events of a frame have one time; they come by column, in a column as the words do.
    """
    suspicious = bool(decoder.rest) or bool(decoder.registers[loops.DAMAGED])
    stream = memoryview(decoder.rest + bytes(data))
    parts = []
    searched = SEARCH_WORDS
    while len(stream) >= WORD_BYTES:
        if suspicious:
            skipped = loops.torn_bytes(np.frombuffer(stream[: searched * WORD_BYTES], np.uint8))
            if skipped:
                decoder.counts[LOSSES.index("torn_bytes")] += skipped
                _distrust(decoder)
            stream = stream[skipped:]
        words = np.frombuffer(stream, "<u4", len(stream) // WORD_BYTES)
        count = max(loops.sound_words(words), min(searched, len(words)) if suspicious else 0)
        parts.append(_decode(decoder, words[:count], host_ms, most_ms))
        stream = stream[count * WORD_BYTES :]
        searched = min(4 * searched, MOST_SEARCH_WORDS) if suspicious else searched
        suspicious = True
    decoder.rest = bytes(stream)
    return parts[0] if len(parts) == 1 else concatenate(parts)


def _decode(decoder: EventWordDecoder, words: NDArray[np.uint32], host_ms: int | None, most_ms: int | None) -> Events:
    """Events of the frames that these words complete."""
    most = decoder.frame.size + loops.events_in(words)
    events = Events(
        np.empty(most, np.int64), np.empty(most, np.uint16), np.empty(most, np.uint16), np.empty(most, np.uint8)
    )
    before = decoder.frame.size
    if before:
        events.t[:before], events.x[:before], events.y[:before], events.p[:before] = decoder.frame
    complete, total = loops.decode(
        words,
        -1 if host_ms is None else host_ms,
        -1 if most_ms is None else max(0, most_ms),
        decoder.registers,
        decoder.counts,
        before,
        *events,
    )
    frame = events.part(complete, total)
    decoder.frame = Events(frame.t.copy(), frame.x.copy(), frame.y.copy(), frame.p.copy())
    return events.part(0, complete)


def flush(decoder: EventWordDecoder) -> Events:
    """Events of the frame that is not over: for a sensor gone silent. What else comes of that frame is still taken."""
    frame = decoder.frame
    decoder.frame = empty()
    return frame


def bytes_were_lost(decoder: EventWordDecoder) -> None:
    """Say that bytes are missing between the last and the next step."""
    decoder.counts[LOSSES.index("torn_bytes")] += len(decoder.rest)
    decoder.rest = b""
    decoder.registers[loops.GAP] = 1
    _distrust(decoder)


def _distrust(decoder: EventWordDecoder) -> None:
    """Drop the open frame, and believe nothing before the next TIMESTAMP."""
    decoder.counts[LOSSES.index("events_in_dropped_frames")] += decoder.frame.size
    decoder.frame = empty()
    decoder.registers[loops.WHERE] = loops.LOST
    decoder.registers[loops.TRUST] = 0


def timestamp(ms: int) -> NDArray[np.uint32]:
    """The TIMESTAMP word of a millisecond, alone: after it a decoder knows that all before is complete."""
    return np.array([2 << 26 | ms & loops.REF_MASK], np.uint32)


def encode(events: Events, first_ms: int = 1, frame_us: int = 1) -> NDArray[np.uint32]:
    """Words in which a camera would send these events, whose t = 0 is device time `first_ms`.

    Times are rounded down to the readout period `frame_us`, which starts anew every millisecond. A frame can hold one
    event of a pixel, and one polarity of a group of rows: what does not fit goes to the next free microsecond of the
    same millisecond, so that no event is lost and none changes its slice. ValueError for what no camera could send.
    (The maker's parser, not ours, gives up if the very first frame of a stream has the time of its TIMESTAMP.)
    """
    check_range("frame_us", frame_us, 1, SLICE_US)
    check_range("first_ms", first_ms)
    if len({len(column) for column in events}) != 1:
        raise ValueError(f"expected columns of one length, found {[len(column) for column in events]}")
    if events.size == 0:
        return np.empty(0, np.uint32)
    if events.t.min() < 0 or events.t.max() >= loops.LONGEST_MS * SLICE_US:
        raise ValueError(f"t: expected 0..{loops.LONGEST_MS} ms, found {events.t.min()}..{events.t.max()} us")
    if events.x.max() >= FRAME_PX[0] or events.y.max() >= FRAME_PX[1] or events.p.max() > 1:
        largest = [int(column.max()) for column in events[1:]]
        raise ValueError(f"x, y, p: expected below {FRAME_PX[0]}, {FRAME_PX[1]} and 2, found up to {largest}")
    keys = loops.keys_by_group(*events, frame_us)
    keys.sort()
    loops.place(keys)
    keys.sort()
    words: NDArray[np.uint32] = loops.write(keys, first_ms)
    return words
