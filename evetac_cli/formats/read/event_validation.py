"""Validate all imported events: columns of any number type in, evetac's columns out, or an InputError.

Formats differ in their number types (unsigned times, polarity -1/+1, floats). Readers therefore only return batches of
raw columns; the checks that apply to all formats, and the conversion, are done here.
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
from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.formats.note import CLOCK_LIMIT_US as CLOCK_LIMIT_US
from evetac_cli.formats.note import LONGEST_SLICES, Note
from evetac_cli.formats.read import events_on_disk
from evetac_cli.formats.read.column_times import FLAG, ColumnTimes
from evetac_cli.formats.read.events_on_disk import EventsOnDisk
from evetac_cli.formats.read.time_order import IN_ORDER, OrderOptions, Placed, TimeOrder
from evetac_cli.store.recordings.streams import Stream

# Every millisecond takes a row of the slice index, so one wrong time stamp must not cause billions of empty slices.
SPAN_LIMIT_US = (LONGEST_SLICES - 1) * SLICE_US
# Coordinates are uint16.
FRAME_LIMIT_PX = 2**16
MINUS_ONES = (2**8 - 1, 2**16 - 1, 2**32 - 1, 2**64 - 1)  # a polarity of -1 that was stored as an unsigned number
SMALL_BATCH = 1 << 16  # events; smaller batches are joined
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
class Foreign:
    """The result of a reader: raw batches in file order, and facts that the file states about itself."""

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


def at_index(start: int, row: int) -> str:
    """Return a text on the position of an event in a file that has no lines: its index, counted from 0."""
    return f"at index {start + row}"


class FrameUnknown(InputError):
    """Neither the file nor the user states the frame size (exit code 2)."""


@dataclass
class Normal:
    """Facts about the events that passed all checks, and about those that did not."""

    size: int = 0
    first_us: int = 0  # t = 0 on the file's clock; 0 without events
    last_us: int = 0  # of the last event, in the file's clock; 0 without events
    dropped: dict[str, int] = field(default_factory=dict)  # events left out, by reason
    sorted: int = 0  # events that came after a later one and were sorted
    notes: list[str] = field(default_factory=list)  # on corrections of order and polarity


def checked_frame(frame_px: tuple[int, int] | None, where: str, hint: str) -> tuple[int, int]:
    """Return width and height in px; raise FrameUnknown if they are None, InputError if they are impossible."""
    if frame_px is None:
        raise FrameUnknown("the file does not state its frame size", where=where, hint=hint)
    width, height = frame_px
    if not (1 <= width <= FRAME_LIMIT_PX and 1 <= height <= FRAME_LIMIT_PX):
        raise InputError(
            "impossible frame size",
            where=where,
            expected=f"width and height from 1 to {FRAME_LIMIT_PX} px",
            found=f"{width}x{height}",
        )
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
        raise InputError(
            "the file's frame size differs from --frame-size",
            where=where,
            expected="{}x{}".format(*own),
            found="{}x{}".format(*wanted),
            hint="leave out --frame-size",
        )
    return checked_frame(own or wanted, where, hint or "give it with --frame-size WIDTHxHEIGHT")


def normalise(
    foreign: Foreign, normal: Normal, *, order: OrderOptions = IN_ORDER, where: str = "", folder: Path | None = None
) -> Iterator[Events]:
    """Convert the batches of a file into one stream of events that starts at t = 0.

    t = 0 is the first event, or the start that evetac's note in the file states. Events outside the frame and events
    that are not numbers are dropped and counted; at the end `normal` is filled. The events are valid only then, because
    InputError may be raised as late as at the end. It is raised if
    - columns differ in length, or a coordinate is not a whole number,
    - polarities are neither of {0, 1} nor of {-1, 1},
    - a time is beyond 2^53 us or before the start of the recording,
    - time goes backwards and `order` does not cover the case (time_order),
    - the unit of time was guessed and is implausible,
    - the events span more than 6 h, none of them can be used, or the file unexpectedly has none.

    With `order.sort`, no event is yielded before all are read; they are stored temporarily in `folder`.
    """
    seen, in_order, first_us, last_us = _Seen(foreign.frame_px), TimeOrder(order), 0, 0
    start_us = foreign.note.start_us if foreign.note and not order.from_restart else None
    waiting = EventsOnDisk(folder) if order.sort else None
    for part in _in_blocks(in_order.ordered(_checked(foreign, seen, where))):
        first_us = first_us if normal.size else int(part.t[0])
        last_us = max(last_us, int(part.t[-1])) if normal.size else int(part.t[-1])
        normal.size += part.size
        seen.pixels(part)
        if waiting is not None:
            waiting.append(part)
            continue
        zero_us = first_us if start_us is None else start_us
        if not in_order.refused and zero_us <= first_us and last_us - zero_us <= SPAN_LIMIT_US:
            yield part._replace(t=part.t - zero_us)
    _refuse_all(seen, foreign, where)
    in_order.refuse(where)
    normal.dropped, normal.sorted = seen.dropped | in_order.dropped, in_order.small
    normal.notes = [*seen.notes(), *in_order.notes]
    if not normal.size:
        normal.first_us = normal.last_us = start_us or 0
        return
    if waiting is not None:
        first_us, last_us = waiting.first_us, waiting.last_us
    if foreign.times is not None:
        foreign.times.check(normal.size, last_us - first_us, foreign.frame_px, seen.lit_hz_us())
    normal.last_us = last_us
    normal.first_us = _start(first_us, last_us, start_us, where, foreign)
    if waiting is not None:
        for part in waiting.blocks():
            yield part._replace(t=part.t - normal.first_us)


def _in_blocks(parts: Iterable[Events]) -> Iterator[Events]:
    """Yield the same events in blocks of some hundred thousand, so that the work per block costs little."""
    waiting: list[Events] = []
    count = 0
    for part in parts:
        for first in range(0, part.size, events_on_disk.BLOCK_EVENTS):
            waiting.append(part.part(first, first + events_on_disk.BLOCK_EVENTS))
            count += waiting[-1].size
            if count >= events_on_disk.BLOCK_EVENTS:
                yield concatenate(waiting) if len(waiting) > 1 else waiting[0]
                waiting, count = [], 0
    if waiting:
        yield concatenate(waiting)


def _refuse_all(seen: "_Seen", foreign: Foreign, where: str) -> None:
    """Raise InputError if no event of all batches can be used, or if the polarities are invalid."""
    note = foreign.note
    if not seen.total and not (foreign.may_be_empty or (note is not None and not note.events)):
        raise no_events(where)
    seen.check_polarities(where)
    dropped = seen.dropped
    if seen.total and seen.total == sum(dropped.values()):
        frame = "{}x{}".format(*foreign.frame_px)
        raise InputError(
            "none of the events can be used",
            where=where,
            expected=f"events inside the frame of {frame} px",
            found=f"{dropped['out_of_frame']} events outside, {dropped['not_a_number']} that are not numbers",
            hint="check the frame size and the order of the columns" if dropped["out_of_frame"] else "",
        )


class _Seen:
    """Counts and values seen so far in a stream of batches."""

    def __init__(self, frame_px: tuple[int, int]) -> None:
        self.dropped = {"not_a_number": 0, "out_of_frame": 0}
        self.total = 0
        self._polarities: set[int] = set()
        self._width = frame_px[0]
        self._lit = np.zeros(min(frame_px[0] * frame_px[1], LIT_PIXELS), bool)
        self._lit_events = 0
        self._lit_us = (0, 0)

    def pixels(self, part: Events) -> None:
        """Remember the pixels of the first events, and the time that they span."""
        if self._lit_events < LIT_EVENTS and part.size:
            self._lit[(part.y * np.int64(self._width) + part.x) % len(self._lit)] = True
            first_us, last_us = self._lit_us if self._lit_events else (int(part.t[0]), int(part.t[0]))
            self._lit_us = min(first_us, int(part.t.min())), max(last_us, int(part.t.max()))
            self._lit_events += part.size

    def lit_hz_us(self) -> float:
        """Return events per us and pixel, of those pixels that had an event."""
        span_us = self._lit_us[1] - self._lit_us[0]
        lit = int(np.count_nonzero(self._lit))
        return self._lit_events / span_us / lit if span_us > 0 and lit else math.inf

    def polarities(self, p: NDArray[Any]) -> None:
        """Remember which polarity values occur; all of them have been checked to be valid."""
        if p.dtype.kind == "b" or not len(p):
            return
        codes = (0, 1) if (p.dtype.kind == "u" or p.min() >= 0) and p.max() <= 1 else (-1, 0, 1, *MINUS_ONES)
        self._polarities.update(code for code in codes if code not in self._polarities and (p == code).any())

    def check_polarities(self, where: str) -> None:
        """Raise InputError if the values mix the conventions 0/1 and -1/1, or might do so."""
        codes = sorted(self._polarities)
        unsigned = [value for value in codes if value in MINUS_ONES]
        if (-1 in codes and 0 in codes) or (unsigned and codes != [1, unsigned[0]]):
            raise InputError(
                "the polarities mix two conventions" if len(codes) > 1 else "unknown polarity",
                where=where,
                expected="0 and 1, or -1 and 1",
                found=" and ".join(map(str, codes)),
                hint="save 1 for ON (brighter) and 0 for OFF (darker)" if unsigned else "",
            )

    def notes(self) -> list[str]:
        """Return notes on values that were interpreted as a polarity of -1."""
        return [
            f"polarity {value} was read as -1 (darker)" for value in sorted(self._polarities) if value in MINUS_ONES
        ]


def _gathered(batches: Iterable[EventColumns], where: str) -> Iterator[EventColumns]:
    """Yield the same batches, small ones of the same types joined, so that the work per batch costs little."""
    waiting: list[EventColumns] = []
    count = 0

    def joined() -> EventColumns:
        nonlocal count
        parts, starts = list(waiting), np.cumsum([0, *(len(part.t) for part in waiting)]).tolist()
        waiting.clear()
        count = 0
        if len(parts) == 1:
            return parts[0]
        t, x, y, p = (np.concatenate(column) for column in zip(*(part[:4] for part in parts), strict=True))
        return EventColumns(t, x, y, p, lambda row: parts[at := bisect_right(starts, row) - 1].place(row - starts[at]))

    for batch in batches:
        if not isinstance(batch, EventColumns) or not all(map(_is_column, batch[:4])):
            found = ", ".join(str(getattr(column, "dtype", type(column).__name__)) for column in batch)
            expected = "EventColumns of four arrays of numbers, of one dimension"
            raise InputError("the reader returned no columns of events", where=where, expected=expected, found=found)
        check_lengths([len(column) for column in batch[:4]], where)
        if waiting and any(a.dtype != b.dtype for a, b in zip(waiting[0][:4], batch[:4], strict=True)):
            yield joined()
        waiting.append(batch)
        count += len(batch.t)
        if count >= SMALL_BATCH:
            yield joined()
    if waiting:
        yield joined()


def _is_column(column: Any) -> bool:
    return isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "biuf"


def _checked(foreign: Foreign, seen: _Seen, where: str) -> Iterator[Placed]:
    """Yield the usable events of each batch in evetac's types, and the function that locates them in the file."""
    width, height = foreign.frame_px
    for raw_batch in _gathered(foreign.batches, where):
        seen.total += len(raw_batch.t)
        if (events := _without_fault(raw_batch, foreign.frame_px)) is not None:
            seen.polarities(raw_batch.p)
            yield events, raw_batch.place
            continue
        finite = _finite(raw_batch)
        numbers = int(np.count_nonzero(finite))
        seen.dropped["not_a_number"] += len(raw_batch.t) - numbers
        batch = _at(raw_batch, np.flatnonzero(finite)) if numbers < len(raw_batch.t) else raw_batch
        _check_values(batch, where, foreign)
        seen.polarities(batch.p)
        inside = (batch.x >= 0) & (batch.x < width) & (batch.y >= 0) & (batch.y < height)
        if outside := len(batch.t) - int(np.count_nonzero(inside)):
            seen.dropped["out_of_frame"] += outside
            batch = _at(batch, np.flatnonzero(inside))
        t, x, y, p, place = batch
        part = Events(
            (np.rint(t) if t.dtype.kind == "f" else t).astype(np.int64),
            x.astype(np.uint16),
            y.astype(np.uint16),
            (p == 1).view(np.uint8),
        )
        yield part, place


def _without_fault(batch: EventColumns, frame_px: tuple[int, int]) -> Events | None:
    """Return the events of a batch if all are whole numbers inside the frame, which is usual; None otherwise.

    These few comparisons take a tenth of the time of checking every number.
    """
    t, x, y, p, _ = batch
    fine = (
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
    if not fine:
        return None
    types = (np.int64, np.uint16, np.uint16, np.uint8)
    return Events(*(column.astype(type_, copy=False) for column, type_ in zip(batch[:4], types, strict=True)))


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


def _check_values(batch: EventColumns, where: str, foreign: Foreign) -> None:
    """Raise InputError for values that show that the columns were misinterpreted.

    Only comparisons are used, so that no integer can overflow.
    """

    def refuse(bad: NDArray[np.bool_], column: NDArray[Any], message: str, expected: str, hint: str = "") -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                message, where=where, expected=expected, found=f"{column[row]} {batch.place(row)}", hint=hint
            )

    t, x, y, p, _ = batch
    is_polarity = np.ones(len(p), bool) if p.dtype.kind == "b" else (p == 0) | (p == 1) | (p == -1)
    if not is_polarity.all():
        for value in MINUS_ONES:
            is_polarity |= p == value
        other = next((name for name, column in (("t", t), ("x", x), ("y", y)) if np.isin(column, (-1, 0, 1)).all()), "")
        hint = f"the column read as {other} looks like polarities: name the columns with --columns" if other else ""
        refuse(~is_polarity, p, "unknown polarity", "0 and 1, or -1 and 1", hint if foreign.guessed_order else "")
    for name, column in (("x", x), ("y", y)):
        if column.dtype.kind == "f":
            refuse(
                column != np.rint(column), column, f"{name} is not a whole pixel", "whole pixels, before undistortion"
            )
    far = (t >= CLOCK_LIMIT_US) | (t <= -CLOCK_LIMIT_US)
    refuse(far, t, "time out of range", "at most 285 years before or after 0", _unit_hint(foreign))


def _unit_hint(foreign: Foreign) -> str:
    """Return a hint for times that are too large, if a wrong unit may be the cause."""
    return f"is the unit of time right? {FLAG} sets another" if foreign.times is not None else ""


def _start(earliest_us: int, last_us: int, start_us: int | None, where: str, foreign: Foreign) -> int:
    """Return the time that becomes 0: the start of the recording, or the first event if no start is stated."""
    first_us = earliest_us if start_us is None else start_us
    if earliest_us < first_us:
        raise InputError(
            "an event is before the start of the recording that evetac's note in the file states",
            where=where,
            expected=f"times from {first_us} us",
            found=f"{earliest_us} us",
        )
    span_us = last_us - first_us
    if span_us > SPAN_LIMIT_US:
        raise InputError(
            "the events span too much time",
            where=where,
            expected=f"at most {SPAN_LIMIT_US // 3_600_000_000} h from first to last",
            found=f"{span_us / 3.6e9:.1f} h",
            hint=_unit_hint(foreign) or "is a time stamp wrong?",
        )
    return first_us
