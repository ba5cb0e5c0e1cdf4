"""Loops that decode and write event words; event_words.py explains their meaning.

Words, bit 31 first: GROUP `1 off[5] 00 g1[6] pol2 pol1 bits2[8] bits1[8]`: two groups of eight rows, g1 and g1 + off,
of the last column; pol is 1 for darker. COLUMN `0 00001 .. SOF[21] us[20:11] . x[9:0]`. TIMESTAMP `0 00010 ..
ms[21:0]`. Zero is padding. Sources: libcaer, and the maker's parser in dv-processing 2.0.4 as measured.
"""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICE_US
from evetac_cli.kernels.compiled import njit

WIDTH = FRAME_PX[0]
GROUPS = FRAME_PX[1] // 8
REF_MASK = (1 << 22) - 1  # mask of the milliseconds in a TIMESTAMP
JUMP_MS = 100  # a TIMESTAMP less than this far ahead of the last one needs no further evidence
# the longest time without a TIMESTAMP: beyond it the stream stalled. The slowest readout sends one every 10 ms
QUIET_MS = 100
HOST_SLACK_MS = 20  # how far device time may be ahead of the host's estimate
TRUSTED = 20  # after this many TIMESTAMPs since the last damage, the latest one is certain
REFUSED_IN_A_ROW = 20  # after this many refused TIMESTAMPs, the camera's clock was restarted

# Counted losses. The first two are events, the others occurrences of their reasons.
LOSSES = (
    "events_in_dropped_frames",
    "events_before_first_timestamp",
    "unknown_words",
    "missing_words",  # a column or a time that can only follow words that are missing
    "outside_frame",  # a row, column or microsecond that does not exist
    "repeated_rows",  # the same group of rows twice in a column
    "refused_timestamps",
    "clock_restarts",
    "torn_bytes",  # bytes of words whose other part is missing
    "ms_without_time",  # device time without any TIMESTAMP, if longer than QUIET_MS
)
REFUSED = LOSSES.index("refused_timestamps")
_EVENTS, _BEFORE, _UNKNOWN, _MISSING, _OUTSIDE, _REPEATED, _REFUSED, _RESTARTS, _, _NO_TIME = range(len(LOSSES))

# Registers of a decoder. GAP: bytes were lost since the last TIMESTAMP, so a TIMESTAMP may be missing. TRUST: number of
# TIMESTAMPs since damage. SURE_MS, SURE_REF: the last certain TIMESTAMP.
MS, REF, LAST_US, WHERE, FRAME_T, COLUMN, ROWS, REFUSALS, DAMAGED, FIRST_MS, GAP, TRUST, SURE_MS, SURE_REF = range(14)
# Values of register WHERE: inside a frame; before a frame; in a dropped frame; time unknown.
INSIDE, BEFORE, DROPPING, LOST = range(4)

_BITS = np.array([int(byte).bit_count() for byte in range(256)], np.int64)
_ROWS_OF = np.array([([row for row in range(8) if byte >> row & 1] + [0] * 8)[:8] for byte in range(256)], np.uint16)


def new_registers() -> NDArray[np.int64]:
    """Return the registers of a decoder that has seen no word yet."""
    registers = np.zeros(14, np.int64)
    registers[[MS, LAST_US, COLUMN, FIRST_MS]] = -1
    registers[WHERE] = LOST
    registers[TRUST] = TRUSTED
    return registers


@njit(cache=True)
def events_in(words: NDArray[np.uint32]) -> int:
    """Return the number of events in the GROUP words, which is the number of set bits."""
    events = 0
    for word in words:
        if word >> np.uint32(31):
            events += _BITS[word & np.uint32(0xFF)] + _BITS[(word >> np.uint32(8)) & np.uint32(0xFF)]
    return events


@njit(cache=True)
def _is_possible(word: int) -> bool:
    """Return whether a camera sends this word."""
    if word >> 31:
        first = word >> 18 & 0x3F
        return (word >> 24 & 3) == 0 and first + (word >> 26 & 0x1F) < GROUPS
    if word >> 26 == 2:
        return (word >> 22 & 0xF) == 0
    if word >> 26 == 1:
        return (word >> 22 & 0xF) == 0 and (word & 0x3FF) < WIDTH and (word >> 11 & 0x3FF) < SLICE_US
    return word == 0


@njit(cache=True)
def sound_words(words: NDArray[np.uint32]) -> int:
    """Return the number of words before the first that no camera sends."""
    for place in range(words.shape[0]):
        if not _is_possible(np.int64(words[place])):
            return place
    return int(words.shape[0])


@njit(cache=True)
def _plausible_events(words: NDArray[np.uint32], place: int) -> int:
    """Return the number of events of a GROUP word; 0 if it or a neighbour is a word that no camera sends."""
    for k in range(max(0, place - 1), min(place + 2, words.shape[0])):
        if not _is_possible(np.int64(words[k])):
            return 0
    word = words[place]
    events: int = _BITS[word & np.uint32(0xFF)] + _BITS[(word >> np.uint32(8)) & np.uint32(0xFF)]
    return events


@njit(cache=True)
def plausible_events(words: NDArray[np.uint32]) -> int:
    """Return the number of events in possibly damaged words: those of GROUP words between plausible neighbours."""
    events = 0
    for place in range(words.shape[0]):
        if words[place] >> np.uint32(31):
            events += _plausible_events(words, place)
    return events


@njit(cache=True)
def torn_bytes(data: NDArray[np.uint8]) -> int:
    """Return how many bytes (0 to 3) to skip so that words become plausible.

    0 unless another offset is clearly better.
    """
    best = 0
    best_score = 0
    for skipped in range(4):
        score = 0
        for place in range(skipped, data.shape[0] - 3, 4):
            word = (
                np.int64(data[place])
                | np.int64(data[place + 1]) << 8
                | np.int64(data[place + 2]) << 16
                | np.int64(data[place + 3]) << 24
            )
            score += 1 if _is_possible(word) else -1
        if skipped == 0:
            best_score = score
        elif score > 0 and score > best_score + 1:
            best = skipped
            best_score = score
    return best


@njit(cache=True)
def _timestamp(ref: int, host_ms: int, most_ms: int, registers: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
    """Apply the milliseconds of a TIMESTAMP word, unless they are impossible.

    After damage, words that only look like a TIMESTAMP may have been believed. Time is then counted from the last
    certain one.
    """
    registers[WHERE] = BEFORE
    if registers[MS] < 0:
        registers[MS] = ref
        registers[FIRST_MS] = ref
        registers[LAST_US] = -1
    else:
        sure = registers[TRUST] >= TRUSTED or (host_ms < 0 and most_ms < 0)
        if sure:
            step_ms = (ref - registers[REF]) & REF_MASK
        else:
            step_ms = registers[SURE_MS] + ((ref - registers[SURE_REF]) & REF_MASK) - registers[MS]
        if most_ms >= 0 and host_ms < 0:
            host_ms = registers[FIRST_MS] + most_ms
        if -JUMP_MS < step_ms < 0:  # an accepted one was ahead: time continues once it is past that
            counts[_REFUSED] += 1
            registers[WHERE] = LOST
            return
        if host_ms < 0:
            refused = step_ms > REF_MASK // 2
        else:
            refused = (step_ms > JUMP_MS or not sure) and registers[MS] + step_ms > host_ms + HOST_SLACK_MS
        refused = refused or step_ms < 0
        if most_ms >= 0:
            refused = refused or registers[MS] + step_ms > registers[FIRST_MS] + most_ms
        if refused:
            counts[_REFUSED] += 1
            registers[REFUSALS] += 1
            if registers[REFUSALS] < REFUSED_IN_A_ROW:
                registers[WHERE] = LOST
                return
            step_ms = max(1, host_ms - registers[MS])
            if most_ms >= 0:
                step_ms = min(step_ms, registers[FIRST_MS] + most_ms - registers[MS])
            if step_ms < 1:
                registers[WHERE] = LOST
                return
            counts[_RESTARTS] += 1
        if step_ms > 0:  # otherwise it is repeated, and its frames continue
            registers[MS] += step_ms
            registers[LAST_US] = -1
        # otherwise times did arrive but were not believed
        if step_ms > QUIET_MS and not registers[GAP] and not registers[REFUSALS]:
            counts[_NO_TIME] += step_ms
        # refused: the clock was restarted
        registers[TRUST] = TRUSTED if refused else min(registers[TRUST] + 1, TRUSTED)
    if registers[TRUST] >= TRUSTED:
        registers[SURE_MS] = registers[MS]
        registers[SURE_REF] = ref
    registers[GAP] = 0
    registers[REF] = ref
    registers[REFUSALS] = 0


# Ten arguments because the four columns stay separate: a tuple of them costs 0.25 us more per packet.
@njit(cache=True)
def decode(
    words: NDArray[np.uint32],
    host_ms: int,
    most_ms: int,
    registers: NDArray[np.int64],
    counts: NDArray[np.int64],
    count: int,
    t: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
) -> tuple[int, int]:
    """Write the events of all words after the `count` of the open frame.

    Return the number of events in whole frames, and in all.
    """
    complete = 0
    doubtful = 0  # events of the open frame whose words have bits that no camera sets
    where = registers[WHERE]
    frame_t = registers[FRAME_T]
    column = registers[COLUMN]
    rows = registers[ROWS]
    registers[DAMAGED] = 0
    for k in range(words.shape[0]):
        word = np.int64(words[k])
        wrong = -1  # reason to drop the frame, -1 for none
        if word >> 31:
            bits1 = word & 0xFF
            bits2 = word >> 8 & 0xFF
            if where != INSIDE:
                counts[_BEFORE if registers[MS] < 0 else _EVENTS] += _plausible_events(words, k)
                if where == BEFORE:
                    counts[_MISSING] += 1
                    where = LOST
                continue
            group1 = word >> 18 & 0x3F
            group2 = group1 + (word >> 26 & 0x1F)
            row1 = np.int64(bits1 != 0) << group1
            row2 = np.int64(bits2 != 0) << (group2 & 0x3F)
            if group1 >= GROUPS or (bits2 and group2 >= GROUPS):
                wrong = _OUTSIDE
            elif rows & (row1 | row2) or row1 & row2:
                wrong = _REPEATED
            else:
                rows |= row1 | row2
                if word >> 24 & 3:
                    doubtful += _BITS[bits1] + _BITS[bits2]
                darker = word >> 16
                for bit in range(_BITS[bits1]):
                    t[count] = frame_t
                    x[count] = column
                    y[count] = 8 * group1 + _ROWS_OF[bits1, bit]
                    p[count] = 1 - (darker & 1)
                    count += 1
                for bit in range(_BITS[bits2]):
                    t[count] = frame_t
                    x[count] = column
                    y[count] = 8 * group2 + _ROWS_OF[bits2, bit]
                    p[count] = 1 - (darker >> 1 & 1)
                    count += 1
        elif word >> 26 == 1:
            next_column = word & 0x3FF
            us = word >> 11 & 0x3FF
            if word >> 21 & 1:  # a frame begins
                if where == LOST:
                    continue
                complete = count
                doubtful = 0
                if us <= registers[LAST_US]:
                    wrong = _MISSING
                elif us >= SLICE_US or next_column >= WIDTH:
                    wrong = _OUTSIDE
                else:
                    where = INSIDE
                    registers[LAST_US] = us
                    frame_t = SLICE_US * registers[MS] + us
            elif where == BEFORE:
                wrong = _MISSING
            elif where != INSIDE:
                continue
            elif next_column >= WIDTH:
                wrong = _OUTSIDE
            elif us != registers[LAST_US] or next_column <= column:
                wrong = _MISSING
            column = next_column
            rows = 0
        elif word >> 26 == 2:
            complete = count
            doubtful = 0
            _timestamp(word & REF_MASK, host_ms, most_ms, registers, counts)
            where = registers[WHERE]
        elif word != 0:
            registers[DAMAGED] = 1
            registers[TRUST] = 0
            if where == LOST:
                counts[_UNKNOWN] += 1
                continue
            wrong = _UNKNOWN
        if wrong >= 0:
            registers[DAMAGED] = 1
            registers[TRUST] = 0
            counts[wrong] += 1
            counts[_EVENTS] += count - complete - doubtful
            doubtful = 0
            count = complete
            where = DROPPING if wrong == _OUTSIDE else LOST
    registers[WHERE] = where
    registers[FRAME_T] = frame_t
    registers[COLUMN] = column
    registers[ROWS] = rows
    return complete, count


# An event as one integer, highest bits first. For writing: ms, us, column, group, polarity, row within the group. For
# finding events that cannot share a frame: ms, column, group, us, polarity, row.
_MS_SHIFT = 30
_US_HIGH, _COLUMN_LOW, _GROUP_LOW = 20, 10, 4
_COLUMN_HIGH, _GROUP_HIGH, _US_LOW = 20, 14, 4


@njit(cache=True)
def keys_by_group(
    t: NDArray[np.int64], x: NDArray[np.uint16], y: NDArray[np.uint16], p: NDArray[np.uint8], frame_us: int
) -> NDArray[np.int64]:
    """Return keys of events in the order ms, column, group, us, polarity, row."""
    keys = np.empty(t.shape[0], np.int64)
    for k in range(t.shape[0]):
        ms = t[k] // SLICE_US
        us = (t[k] - ms * SLICE_US) // frame_us * frame_us
        row = np.int64(y[k])
        keys[k] = (
            ms << _MS_SHIFT
            | np.int64(x[k]) << _COLUMN_HIGH
            | (row >> 3) << _GROUP_HIGH
            | us << _US_LOW
            | np.int64(p[k]) << 3
            | (row & 7)
        )
    return keys


@njit(cache=True)
def place(keys: NDArray[np.int64]) -> None:
    """Assign every event a frame that can hold it, and convert the keys to the order of the words, unsorted.

    keys: sorted keys_by_group. Within one ms, column and group, an event that cannot join the previous frame goes to
    the next microsecond. If that passes the end of the millisecond, the last events are moved back.
    """
    first = 0
    taken_us = np.empty(keys.shape[0], np.int64)
    while first < keys.shape[0]:
        bucket = keys[first] >> _GROUP_HIGH
        frame_us = np.int64(-1)
        frame_p = np.int64(0)
        frame_rows = np.int64(0)
        last = first
        while last < keys.shape[0] and keys[last] >> _GROUP_HIGH == bucket:
            us = keys[last] >> _US_LOW & 0x3FF
            p = keys[last] >> 3 & 1
            row = np.int64(1) << (keys[last] & 7)
            if us > frame_us or p != frame_p or frame_rows & row:
                frame_us = max(us, frame_us + 1)
                frame_p = p
                frame_rows = np.int64(0)
            frame_rows |= row
            taken_us[last] = frame_us
            last += 1
        latest_us = np.int64(SLICE_US - 1)
        frame_us = np.int64(-1)
        for k in range(last - 1, first - 1, -1):
            if taken_us[k] != frame_us:
                frame_us = taken_us[k]
                latest_us = min(frame_us, latest_us)
                moved_us = latest_us
                latest_us -= 1
            if moved_us < 0:
                raise ValueError("expected at most 1000 frames in a millisecond, found a pixel with more events")
            column = keys[k] >> _COLUMN_HIGH & 0x3FF
            group = keys[k] >> _GROUP_HIGH & 0x3F
            keys[k] = (
                keys[k] >> _MS_SHIFT << _MS_SHIFT
                | moved_us << _US_HIGH
                | column << _COLUMN_LOW
                | group << _GROUP_LOW
                | (keys[k] & 0xF)
            )
        first = last


@njit(cache=True)
def write(keys: NDArray[np.int64], first_ms: int) -> NDArray[np.uint32]:
    """Return the words of events from the sorted keys made by `place`: as few as the format allows."""
    words = np.empty(3 * keys.shape[0], np.uint32)
    count = 0
    ms = np.int64(-1)
    frame = np.int64(-1)
    column = np.int64(-1)
    waiting = -1  # group that may share its word with the next one, -1 for none
    k = 0
    while k < keys.shape[0]:
        key = keys[k]
        if key >> _COLUMN_LOW != column:
            waiting = -1
            column = key >> _COLUMN_LOW
            if key >> _MS_SHIFT != ms:
                ms = key >> _MS_SHIFT
                words[count] = 2 << 26 | (first_ms + ms) & REF_MASK
                count += 1
            begins = np.int64(key >> _US_HIGH != frame)
            frame = key >> _US_HIGH
            words[count] = 1 << 26 | begins << 21 | (frame & 0x3FF) << 11 | (column & 0x3FF)
            count += 1
        group = key >> _GROUP_LOW & 0x3F
        darker = 1 - (key >> 3 & 1)
        bits = np.int64(0)
        while k < keys.shape[0] and keys[k] >> _GROUP_LOW == key >> _GROUP_LOW:
            bits |= np.int64(1) << (keys[k] & 7)
            k += 1
        if waiting >= 0 and group - waiting < 32:
            words[count - 1] |= np.uint32((group - waiting) << 26 | darker << 17 | bits << 8)
            waiting = -1
        else:
            words[count] = 1 << 31 | group << 18 | darker << 16 | bits
            count += 1
            waiting = group
    return words[:count].copy()
