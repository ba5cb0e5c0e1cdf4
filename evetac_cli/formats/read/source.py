"""What a reader returns of a file, and the one class that checks the events of all formats.

Formats differ in their number types (unsigned times, polarity -1/+1, floats). Readers therefore only return batches of
raw columns; the checks that apply to all formats, and the conversion, are done by CleanEvents.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.formats.note import CLOCK_LIMIT_US, LONGEST_SLICES, Note
from evetac_cli.formats.read.columns import FLAG, ColumnTimes
from evetac_cli.formats.read.time_order import IN_ORDER, OrderOptions, Placed, TimeOrder
from evetac_cli.interrupts import leave_if_interrupted
from evetac_cli.jobs import Progress, silent
from evetac_cli.store.hdf5.disk import joined_on_disk
from evetac_cli.store.recordings.streams import Stream

# Every millisecond takes a row of the slice index, so one wrong time stamp must not cause billions of empty slices.
SPAN_LIMIT_US = (LONGEST_SLICES - 1) * SLICE_US
# Coordinates are uint16.
FRAME_LIMIT_PX = 2**16
MINUS_ONES = (2**8 - 1, 2**16 - 1, 2**32 - 1, 2**64 - 1)  # a polarity of -1 that was stored as an unsigned number
SMALL_BATCH = 1 << 16  # events; smaller batches are joined
BLOCK_EVENTS = 1 << 18  # sorted events that are returned at once
LIT_EVENTS = 1 << 18  # the pixels of the first events are remembered, up to this number
LIT_PIXELS = 1 << 24  # in larger frames, several pixels are counted as one


class EventColumns(NamedTuple):
    """A batch of raw events: t in us, x and y in px, p as in the file; place(i) is a text on where row i is.

    t is on the clock of the file, unwrapped (clock.py), but may go back.
    """

    t: NDArray[Any]
    x: NDArray[Any]
    y: NDArray[Any]
    p: NDArray[Any]
    place: Callable[[int], str]


@dataclass
class EventSource:
    """A file: raw batches in file order, and facts that it states about itself.

    A reader may complete notes, left_out and streams until its last batch.
    """

    format: str
    frame_px: tuple[int, int]
    batches: Iterable[EventColumns]
    clock_us: int = 0  # to be added to every t, if a file stores an offset separately
    notes: list[str] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)  # amounts of other data in the file
    assumed: str = ""  # an assumption about the columns that the file does not state
    note: Note | None = None  # if evetac exported the file; its times are in the clock of t
    cut_short: bool = False  # its end is known to be missing
    may_be_empty: bool = False  # the file is complete even if it has no events
    streams: list[Stream] = field(default_factory=list)  # read with the events, on their clock
    times: ColumnTimes | None = None  # for files whose times are a column of plain numbers
    guessed_order: str = ""  # of unnamed columns


class ImportFormat(NamedTuple):
    """The bytes that a file of the format begins with, their possible offsets, its reader, and its options.

    read: called with the path, the frame (width, height) or None, and the user's options; returns an EventSource.
    options: which of stream, columns and time_unit it takes. A plug-in provides a row of this type. It is tried if no
    built-in format matches and the file begins with the mark.
    """

    begins: tuple[bytes, ...]
    read: Callable[..., EventSource]
    options: tuple[str, ...] = ()
    at: tuple[int, ...] = (0,)


def at_index(start: int, row: int) -> str:
    """Return a text on the position of an event in a file that has no lines: its index, counted from 0."""
    return f"at index {start + row}"


class FrameUnknown(InputError):
    """Neither the file nor the user states the frame size (exit code 2)."""


def checked_frame(frame_px: tuple[int, int] | None, where: str, hint: str) -> tuple[int, int]:
    """Return width and height in px; raise FrameUnknown if they are None, InputError if they are impossible."""
    if frame_px is None:
        raise FrameUnknown("the file does not state its frame size", where=where, hint=hint)
    width, height = frame_px
    if not (1 <= width <= FRAME_LIMIT_PX and 1 <= height <= FRAME_LIMIT_PX):
        expected = f"width and height from 1 to {FRAME_LIMIT_PX} px"
        raise InputError("impossible frame size", where=where, expected=expected, found=f"{width}x{height}")
    return int(width), int(height)


def choose_frame(
    own: tuple[int, int] | None, requested: tuple[int, int] | None, where: str, hint: str = ""
) -> tuple[int, int]:
    """Return the file's own frame, or the requested one if the file states none.

    Raises InputError if both are given and differ, because the requested one would have no effect, and with `hint` if
    neither is known.
    """
    wanted = None if requested is None else checked_frame(requested, where, "")
    if wanted and own and wanted != tuple(own):
        message, (expected, found) = "the file states another frame size", ("{}x{}".format(*px) for px in (own, wanted))
        raise InputError(message, where=where, expected=expected, found=found, hint="leave out --frame-size")
    return checked_frame(own or wanted, where, hint or "give it with --frame-size WIDTHxHEIGHT")


class CleanEvents:
    """The events of a file in one stream from t = 0, and after its last block the counts of what was found in the file.

    t = 0 is the first event, or the start that evetac's note in the file states. Events outside the frame and events
    that are not numbers are dropped and counted.
    """

    def __init__(
        self,
        source: EventSource,
        order: OrderOptions = IN_ORDER,
        where: str = "",
        folder: Path | None = None,
        progress: Progress = silent,
    ) -> None:
        """where: the file, for errors; folder: where events are stored temporarily that must be sorted."""
        self._source, self._where, self._folder, self._progress = source, where, folder, progress
        self._sort = order.sort
        self._order, self._polarities, self._lit = TimeOrder(order), set[int](), _LitPixels(source.frame_px)
        self._start_us = source.note.start_us if source.note and not order.from_restart else None
        self.size = 0
        self.first_us = 0  # t = 0 on the file's clock; 0 without events
        self.last_us = 0  # of the last event, in the file's clock; 0 without events
        self.dropped = {"not_a_number": 0, "out_of_frame": 0}
        self.corrections: list[str] = []  # notes on corrections of order and polarity

    @property
    def read(self) -> int:
        """The number of events in the file, used or dropped."""
        return self.size + sum(self.dropped.values())

    @property
    def sorted(self) -> int:
        """The number of events that came after a later one and were sorted."""
        return self._order.small

    def blocks(self) -> Iterator[Events]:
        """Yield all events. They are valid only at the end, because InputError may be raised as late as then.

        It is raised if
        - columns differ in length, or a coordinate is not a whole number,
        - polarities are neither of {0, 1} nor of {-1, 1},
        - a time is beyond 2^53 us or before the start of the recording,
        - time goes backwards and `order` does not cover the case (time_order),
        - the unit of time was guessed and is implausible,
        - the events span more than 6 h, none of them can be used, or the file unexpectedly has none.

        With `order.sort`, no event is yielded before all are read.
        """
        source, where = self._source, self._where
        stored = joined_on_disk(self._folder, self._ordered()) if self._sort else ()
        for part in () if self._sort else self._ordered():
            zero_us = self.first_us if self._start_us is None else self._start_us
            if not self._order.refused and zero_us <= self.first_us and self.last_us - zero_us <= SPAN_LIMIT_US:
                yield part._replace(t=part.t - zero_us)
        _check_polarities(self._polarities, where)
        self._check_use()
        self._order.refuse(where)
        self.dropped |= self._order.dropped
        corrected = [f"polarity {value} was read as -1 (darker)" for value in sorted(self._polarities & {*MINUS_ONES})]
        self.corrections = [*corrected, *self._order.notes]
        if not self.size:
            self.first_us = self.last_us = self._start_us or 0
            return
        if source.times is not None:
            source.times.check(self.size, self.last_us - self.first_us, source.frame_px, self._lit.hz_us)
        self.first_us = self._checked_start_us()
        if stored:
            by_time = np.argsort(stored[0], kind="stable")
            for first in range(0, self.size, BLOCK_EVENTS):
                part = Events(*(column[by_time[first : first + BLOCK_EVENTS]] for column in stored))
                yield part._replace(t=part.t - self.first_us)

    def _ordered(self) -> Iterator[Events]:
        """Yield the usable events in time order, still on the file's clock."""
        for part in self._order.ordered(self._usable()):
            self.first_us = min(self.first_us, int(part.t.min())) if self.size else int(part.t.min())
            self.last_us = max(self.last_us, int(part.t.max())) if self.size else int(part.t.max())
            self.size += part.size
            if self._source.times is not None:
                self._lit.add(part)
            yield part

    def _usable(self) -> Iterator[Placed]:
        """Yield the usable events of each batch in evetac's types, and the function that locates them in the file.

        Progress is reported here, and Ctrl-C ends reading here.
        """
        width, height = self._source.frame_px
        types = (np.int64, np.uint16, np.uint16, np.uint8)
        count = 0
        for raw_batch in _gathered(self._source.batches, self._where):
            batch = raw_batch
            if faultless := _is_faultless(batch, self._source.frame_px):
                _add_polarities(batch.p, self._polarities)
            else:
                finite = _finite(batch)
                if lost := len(batch.t) - int(np.count_nonzero(finite)):
                    self.dropped["not_a_number"] += lost
                    batch = _at(batch, np.flatnonzero(finite))
                _check_values(batch, self._where, self._source)
                _add_polarities(batch.p, self._polarities)
                inside = (batch.x >= 0) & (batch.x < width) & (batch.y >= 0) & (batch.y < height)
                if outside := len(batch.t) - int(np.count_nonzero(inside)):
                    self.dropped["out_of_frame"] += outside
                    batch = _at(batch, np.flatnonzero(inside))
            t = np.rint(batch.t) if batch.t.dtype.kind == "f" else batch.t
            on = batch.p if faultless else (batch.p == 1).view(np.uint8)
            columns = zip((t, batch.x, batch.y, on), types, strict=True)
            yield Events(*(column.astype(type_, copy=False) for column, type_ in columns)), batch.place
            leave_if_interrupted()
            count += len(raw_batch.t)
            self._progress(count, 0, "events read")

    def _check_use(self) -> None:
        """Raise InputError if the file has no events, or none that can be used."""
        note, usable, lost = self._source.note, self._order.total, sum(self.dropped.values())
        if not usable and not lost and not (self._source.may_be_empty or (note is not None and not note.events)):
            raise no_events(self._where)
        if lost and not usable:
            outside, no_numbers = self.dropped["out_of_frame"], self.dropped["not_a_number"]
            expected = "events inside the frame of {}x{} px".format(*self._source.frame_px)
            found = f"{outside} events outside, {no_numbers} that are not numbers"
            hint = "check the frame size and the order of the columns" if outside else ""
            message = "none of the events can be used"
            raise InputError(message, where=self._where, expected=expected, found=found, hint=hint)

    def _checked_start_us(self) -> int:
        """Return the time that becomes 0: the start of the recording, or the first event if no start is stated."""
        first_us = self.first_us if self._start_us is None else self._start_us
        if self.first_us < first_us:
            message, found = "an event is before the start that evetac's note in the file states", f"{self.first_us} us"
            raise InputError(message, where=self._where, expected=f"from {first_us} us", found=found)
        span_us = self.last_us - first_us
        if span_us > SPAN_LIMIT_US:
            expected, found = f"at most {SPAN_LIMIT_US // 3_600_000_000} h", f"{span_us / 3.6e9:.1f} h"
            message, hint = "the events span too much time", _unit_hint(self._source) or "is a time stamp wrong?"
            raise InputError(message, where=self._where, expected=expected, found=found, hint=hint)
        return first_us


class _LitPixels:
    """The pixels of the first events, and the time that these span."""

    def __init__(self, frame_px: tuple[int, int]) -> None:
        self._width = frame_px[0]
        self._lit = np.zeros(min(frame_px[0] * frame_px[1], LIT_PIXELS), bool)
        self._events = 0
        self._first_us = self._last_us = 0

    def add(self, part: Events) -> None:
        """Remember the pixels of the next events, up to LIT_EVENTS."""
        if self._events >= LIT_EVENTS or not part.size:
            return
        self._lit[(part.y * np.int64(self._width) + part.x) % len(self._lit)] = True
        first_us, last_us = int(part.t.min()), int(part.t.max())
        self._first_us = min(self._first_us, first_us) if self._events else first_us
        self._last_us = max(self._last_us, last_us) if self._events else last_us
        self._events += part.size

    @property
    def hz_us(self) -> float:
        """Events per us and pixel, of those pixels that had an event."""
        span_us, lit = self._last_us - self._first_us, int(np.count_nonzero(self._lit))
        return self._events / span_us / lit if span_us > 0 and lit else math.inf


def _check_polarities(polarities: set[int], where: str) -> None:
    """Raise InputError if the values mix the conventions 0/1 and -1/1, or might do so."""
    codes = sorted(polarities)
    unsigned = [value for value in codes if value in MINUS_ONES]
    if (-1 in codes and 0 in codes) or (unsigned and codes != [1, unsigned[0]]):
        message, found = "the polarities mix two conventions", " and ".join(map(str, codes))
        raise InputError(message, where=where, expected="0 and 1, or -1 and 1", found=found)


def _gathered(batches: Iterable[EventColumns], where: str) -> Iterator[EventColumns]:
    """Yield the same batches, small ones of the same types joined, so that the work per batch costs little."""
    waiting: list[EventColumns] = []
    count = 0
    for batch in batches:
        check_lengths([len(column) for column in batch[:4]], where)
        if waiting and any(a.dtype != b.dtype for a, b in zip(waiting[0][:4], batch[:4], strict=True)):
            yield _joined(waiting)
            waiting, count = [], 0
        waiting.append(batch)
        count += len(batch.t)
        if count >= SMALL_BATCH:
            yield _joined(waiting)
            waiting, count = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(parts: list[EventColumns]) -> EventColumns:
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0, *(len(part.t) for part in parts)]).tolist()
    t, x, y, p = (np.concatenate(column) for column in zip(*(part[:4] for part in parts), strict=True))
    return EventColumns(t, x, y, p, lambda row: parts[at := bisect_right(starts, row) - 1].place(row - starts[at]))


def _is_faultless(batch: EventColumns, frame_px: tuple[int, int]) -> bool:
    """Whether all are unsigned whole numbers inside the frame, which is usual.

    These few comparisons take a tenth of the time of checking every number.
    """
    t, x, y, p, _ = batch
    return bool(
        t.dtype.kind in "iu"
        and x.dtype.kind == y.dtype.kind == "u"
        and p.dtype.kind in "bu"
        and len(t)
        and x.max() < frame_px[0]
        and y.max() < frame_px[1]
        and (p.dtype.kind == "b" or p.max() <= 1)
        and t.min() > -CLOCK_LIMIT_US
        and t.max() < CLOCK_LIMIT_US
    )


def _add_polarities(p: NDArray[Any], polarities: set[int]) -> None:
    """Remember which polarity values occur; all of them have been checked to be valid."""
    if p.dtype.kind == "b" or not len(p):
        return
    codes = (0, 1) if (p.dtype.kind == "u" or p.min() >= 0) and p.max() <= 1 else (-1, 0, 1, *MINUS_ONES)
    polarities.update(code for code in codes if code not in polarities and (p == code).any())


# Hint for a file that has frames, IMU samples or other messages, but no events.
NOT_RECORDED = "switch on events in the program that wrote this file and record again, or give another file"


def no_events(where: str) -> InputError:
    """Return the error for a file without events."""
    return InputError("the file has no events", where=where, hint="was the recorder stopped before the camera started?")


def check_lengths(lengths: Sequence[int], where: str) -> None:
    """Raise InputError unless the columns t, x, y, p have the same length."""
    if len(set(lengths)) != 1:
        each = ", ".join(f"{name} {length}" for name, length in zip("txyp", lengths, strict=True))
        raise InputError("the columns differ in length", where=where, expected="t, x, y, p of one length", found=each)


def _finite(batch: EventColumns) -> NDArray[np.bool_]:
    """Return which rows have four finite numbers; NaN and infinity are neither times nor pixels."""
    finite = np.ones(len(batch.t), bool)
    for column in batch[:4]:
        if column.dtype.kind not in "iub":
            finite &= np.isfinite(column)
    return finite


def _at(batch: EventColumns, rows: NDArray[np.intp]) -> EventColumns:
    """Return some rows of a batch, which keep their positions in the file."""
    t, x, y, p = (column[rows] for column in batch[:4])
    return EventColumns(t, x, y, p, lambda row: batch.place(int(rows[row])))


def _check_values(batch: EventColumns, where: str, source: EventSource) -> None:
    """Raise InputError for values that show that the columns were misinterpreted.

    Only comparisons are used, so that no integer can overflow.
    """

    def refuse(bad: NDArray[np.bool_], column: NDArray[Any], message: str, expected: str, hint: str = "") -> None:
        if bad.any():
            row = int(np.argmax(bad))
            found = f"{column[row]} {batch.place(row)}"
            raise InputError(message, where=where, expected=expected, found=found, hint=hint)

    t, x, y, p, _ = batch
    is_polarity = np.ones(len(p), bool) if p.dtype.kind == "b" else (p == 0) | (p == 1) | (p == -1)
    if not is_polarity.all():
        for value in MINUS_ONES:
            is_polarity |= p == value
        other = next((name for name, column in (("t", t), ("x", x), ("y", y)) if np.isin(column, (-1, 0, 1)).all()), "")
        hint = f"the column read as {other} looks like polarities: name the columns with --columns" if other else ""
        refuse(~is_polarity, p, "unknown polarity", "0 and 1, or -1 and 1", hint if source.guessed_order else "")
    for name, column in (("x", x), ("y", y)):
        if column.dtype.kind == "f":
            refuse(column != np.rint(column), column, f"{name} is not a whole pixel", "whole pixels")
    far = (t >= CLOCK_LIMIT_US) | (t <= -CLOCK_LIMIT_US)
    refuse(far, t, "time out of range", "at most 285 years before or after 0", _unit_hint(source))


def _unit_hint(source: EventSource) -> str:
    """Return a hint for times that are too large, if a wrong unit may be the cause."""
    return f"is the unit of time right? {FLAG} sets another" if source.times is not None else ""
