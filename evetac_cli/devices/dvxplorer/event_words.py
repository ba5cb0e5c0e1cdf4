"""Decode and encode the event words of a DVXplorer Mini: the 32-bit words of its USB data endpoint.

A frame holds what the sensor reads out at one time: columns from left to right, and in each column groups of eight
rows. The first COLUMN word of a frame carries the flag SOF. All COLUMN words carry the microseconds within the
millisecond of the last TIMESTAMP word. A frame is accepted or dropped as a whole, as in the maker's parser. `start` and
`step` accept the byte stream in pieces of any size (loops: event_word_loops.py).

After damage that may hide lost words, nothing is believed before the next TIMESTAMP (at most 1 ms of a busy sensor),
because a TIMESTAMP may be among the lost words. If only a row or a column is impossible, decoding resumes at the next
frame. The maker's parser (dv-processing 2.0.4, run alongside this one) returns the same events for undamaged streams.
For damaged streams it also returns pixels outside the frame and frames with unknown words in them.

Reason for distrust: a TIMESTAMP counts milliseconds modulo 2**22, so a single damaged one would read as up to 70
minutes. A TIMESTAMP is refused if the host's clock does not allow that much time since the first one. One far ahead of
the last is also checked against the host's estimate of device time. After many refusals in a row the decoder concludes
that the camera restarted its clock, and continues from the host's time.

The count of lost events never exceeds the true number: the bits of damaged words, and of their neighbours, prove
nothing. Missing bytes are recognised by the format: hardly one in ten words read from a wrong byte is a word that a
camera sends. Words are therefore also searched for at the other three byte offsets (torn_bytes).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evetac_cli.devices.dvxplorer import event_word_loops as loops
from evetac_cli.events import SLICE_US, Events, concatenate, empty

LOSSES = loops.LOSSES
QUIET_MS = loops.QUIET_MS
WORD_BYTES = 4
SEARCH_WORDS = 64  # words after damage in which to search for the byte where words begin
MOST_SEARCH_WORDS = 4096  # for continuing damage: four times as many each time


@dataclass
class EventWordDecoder:
    """State of decoding one stream, between two calls of `step`."""

    registers: NDArray[np.int64] = field(default_factory=loops.new_registers)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(LOSSES), np.int64))
    frame: Events = field(default_factory=empty)  # events of the frame that is still open
    rest: bytes = b""  # bytes of a word that was split between two buffers

    @property
    def first_ms(self) -> int | None:
        """Device time of the first TIMESTAMP; None before it."""
        ms = int(self.registers[loops.FIRST_MS])
        return ms if ms >= 0 else None

    @property
    def now_us(self) -> int:
        """Device time that the stream has reached, without wraps."""
        return SLICE_US * int(self.registers[loops.MS]) + max(0, int(self.registers[loops.LAST_US]))

    @property
    def unmeasured_times(self) -> int:
        """Number of TIMESTAMPs that do not measure the time since the one before: the first, and refused ones."""
        return int(self.counts[loops.REFUSED]) + (self.first_ms is not None)

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far: numbers of events, and how often each reason occurred."""
        return {name: int(count) for name, count in zip(LOSSES, self.counts, strict=True)}


def start() -> EventWordDecoder:
    """Return a decoder before the first byte of a stream."""
    return EventWordDecoder()


def step(
    decoder: EventWordDecoder,
    data: bytes | bytearray | memoryview,
    host_ms: int | None = None,
    most_ms: int | None = None,
) -> Events:
    """Return the events of the frames that the next bytes complete; t in us, int64, never decreasing.

    host_ms: device time by the host's clock, if known. A TIMESTAMP more than loops.JUMP_MS ahead of the last is
    believed only up to there. most_ms: the most that can have passed since the first TIMESTAMP; no later one is
    believed. Without both, for example for words from a file, a TIMESTAMP is believed if it is ahead by less than half
    the range. All events of a frame have the same time. They are ordered by column, and within a column by word.
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
    """Return the events of the frames that these words complete."""
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
    """Return the events of the open frame when the sensor has gone silent.

    Later words of that frame are still accepted.
    """
    frame = decoder.frame
    decoder.frame = empty()
    return frame


def bytes_were_lost(decoder: EventWordDecoder) -> None:
    """Record that bytes are missing between the last and the next step."""
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
    """Return the TIMESTAMP word of a millisecond. It shows a decoder that everything before it is complete."""
    return np.array([2 << 26 | ms & loops.REF_MASK], np.uint32)


def encode(events: Events, first_ms: int = 1, frame_us: int = 1) -> NDArray[np.uint32]:
    """Return the words in which a camera would send these events; t = 0 is device time `first_ms`.

    Times are rounded down to the readout period `frame_us`, which restarts every millisecond. A frame can hold one
    event per pixel and one polarity per group of rows. Events that do not fit go to the next free microsecond of the
    same millisecond, so no event is lost and none changes its slice. ValueError if a millisecond has no room for them.
    (The maker's parser, unlike evetac's, fails if the very first frame of a stream has the time of its TIMESTAMP.)
    """
    if events.size == 0:
        return np.empty(0, np.uint32)
    keys = loops.keys_by_group(*events, frame_us)
    keys.sort()
    loops.place(keys)
    keys.sort()
    words: NDArray[np.uint32] = loops.write(keys, first_ms)
    return words
