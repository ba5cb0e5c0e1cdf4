"""Checks that all imported events go through: columns of any number type in, our columns out, or an InputError.

Readers differ in everything (unsigned times, polarity -1/+1, floats), so none of them checks what all files share: they
hand over batches of raw columns, which are checked and converted here.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate
from evetac_cli.formats.note import CLOCK_LIMIT_US as CLOCK_LIMIT_US
from evetac_cli.formats.note import Note
from evetac_cli.formats.read import events_on_disk
from evetac_cli.formats.read.events_on_disk import EventsOnDisk

# Every millisecond costs a row of the slice index, so one broken time stamp must not make billions of empty slices.
SPAN_LIMIT_US = 6 * 3600 * 1_000_000  # 8 bytes a millisecond, some copies at a time: below 1 GB
# uint16 coordinates
FRAME_LIMIT_PX = 2**16


class Columns(NamedTuple):
    """A batch of raw events: t in us, x and y in px, p as in the file; `place` says where the user finds row i."""

    t: NDArray[Any]
    x: NDArray[Any]
    y: NDArray[Any]
    p: NDArray[Any]
    place: Callable[[int], str]


@dataclass
class Foreign:
    """What a reader hands over: raw batches, in file order, and what the file says about itself."""

    format: str
    frame_px: tuple[int, int]
    batches: Iterable[Columns]
    clock_us: int = 0  # to be added to every t, where a file keeps it apart
    notes: list[str] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)  # what the file holds beside the events, and how much of it
    assumed: str = ""  # what the file does not say of its columns
    note: Note | None = None  # if the file is an export of ours; its times are in the clock of t
    cut_short: bool = False  # its end is known to be missing
    may_be_empty: bool = False  # the file is whole, also where it holds no event


def at_index(start: int, row: int) -> str:
    """Where an event stands in a file that has no lines: its number, counted from 0."""
    return f"at index {start + row}"


class FrameUnknown(InputError):
    """Neither the file nor the user says how large the frame is (exit code 2)."""


@dataclass
class Normal:
    """What was found of events that passed every check, and what became of the others."""

    size: int = 0
    first_us: int = 0  # where t = 0 is in the file's clock; 0 without events
    last_us: int = 0  # of the last event, in the file's clock; 0 without events
    dropped: dict[str, int] = field(default_factory=dict)  # events left out, by reason
    sorted: int = 0  # events put back in order: those that came after a later one


def checked_frame(frame_px: tuple[int, int] | None, where: str, hint: str) -> tuple[int, int]:
    """Width and height in px, or an InputError that asks for them."""
    if frame_px is None:
        raise FrameUnknown("the file does not say how large the frame is", where=where, hint=hint)
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
    own: tuple[int, int] | None, asked: tuple[int, int] | None, where: str, hint: str = ""
) -> tuple[int, int]:
    """The file's own frame, or else the one asked for; asking for another than the file says is refused.

    It would have no effect. InputError with `hint` where neither is known.
    """
    wanted = None if asked is None else checked_frame(asked, where, "")
    if wanted and own and wanted != tuple(own):
        raise InputError(
            "the file says another frame size",
            where=where,
            expected="{}x{}".format(*own),
            found="{}x{}".format(*wanted),
            hint="leave out --frame-size",
        )
    return checked_frame(own or wanted, where, hint or "say it: --frame-size WIDTHxHEIGHT")


def normalise(
    batches: Iterable[Columns],
    frame_px: tuple[int, int],
    normal: Normal,
    *,
    sort: bool = False,
    start_us: int | None = None,
    may_be_empty: bool = False,
    where: str = "",
    folder: Path | None = None,
) -> Iterator[Events]:
    """Turn raw batches into one stream of events that starts at t = 0: with its first event, or at `start_us`.

    Events outside the frame and events that are no numbers are dropped and counted; at the end `normal` is filled. What
    was given out counts only then: InputError comes as late as at the end, where columns differ in length, a
    coordinate is no whole number, a polarity is none of {0, 1} or of {-1, 1}, a time lies beyond 2^53 us or before
    `start_us`, time goes backwards and sort is off, the events span more than 6 h, none of them can be used, or the
    file holds none at all and that was not expected (`may_be_empty`). With `sort` nothing is given out before the end,
    and events wait on the disk of `folder`.
    """
    seen, first_us = _Seen(), 0
    waiting = EventsOnDisk(folder) if sort else None
    for part in _in_blocks(_checked(batches, frame_px, seen, where)):
        if not normal.size:
            first_us = int(part.t[0])
        normal.size += part.size
        if waiting is not None:
            waiting.append(part)
            continue
        zero_us = first_us if start_us is None else start_us
        if not seen.late and zero_us <= first_us and seen.latest_us - zero_us <= SPAN_LIMIT_US:
            yield part._replace(t=part.t - zero_us)
    _refuse_all(seen, normal.size, frame_px, sort=sort, may_be_empty=may_be_empty, where=where)
    normal.dropped, normal.sorted = seen.dropped, seen.late
    if not normal.size:
        normal.first_us = normal.last_us = start_us or 0
        return
    normal.last_us = seen.latest_us
    normal.first_us = _start(first_us if waiting is None else waiting.first_us, normal.last_us, start_us, where)
    if waiting is not None:
        for part in waiting.blocks():
            yield part._replace(t=part.t - normal.first_us)


def _in_blocks(parts: Iterable[Events]) -> Iterator[Events]:
    """The same events in blocks of some hundred thousand, so that what is done once a block costs little."""
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


def _refuse_all(
    seen: "_Seen", usable: int, frame_px: tuple[int, int], *, sort: bool, may_be_empty: bool, where: str
) -> None:
    """InputError where all batches together are none that can be used."""
    if not seen.total and not may_be_empty:
        raise no_events(where)
    if seen.negative and seen.zero:
        raise InputError("polarity mixes two codes", where=where, expected="0 and 1, or -1 and 1", found="-1 and 0")
    dropped = seen.dropped
    if seen.total and not usable:
        raise InputError(
            "none of the events can be used",
            where=where,
            expected=f"events inside the frame of {frame_px[0]}x{frame_px[1]} px",
            found=f"{dropped['out_of_frame']} outside, {dropped['not_a_number']} that are no numbers",
            hint="check the frame size and the order of the columns" if dropped["out_of_frame"] else "",
        )
    if seen.late and not sort:
        raise InputError(
            "time goes backwards",
            where=where,
            expected="events in the order of their time",
            found=f"{seen.late} of {seen.total} events come after a later one, first {seen.first_late}",
            hint="--sort puts them back in order",
        )


@dataclass
class _Seen:
    """What was noticed so far of a stream of batches."""

    dropped: dict[str, int] = field(default_factory=lambda: {"not_a_number": 0, "out_of_frame": 0})
    total: int = 0
    late: int = 0  # events that came after a later one
    first_late: str = ""
    latest_us: int = -CLOCK_LIMIT_US + 1  # before any that is allowed
    negative: bool = False
    zero: bool = False


def _checked(batches: Iterable[Columns], frame_px: tuple[int, int], seen: _Seen, where: str) -> Iterator[Events]:
    """The events of each batch that can be used, in our types."""
    for given in batches:
        check_lengths([len(column) for column in given[:4]], where)
        seen.total += len(given.t)
        if (events := _without_fault(given, frame_px, seen.latest_us)) is not None:
            seen.latest_us = int(events.t[-1])
            seen.zero = seen.zero or not events.p.all()
            yield events
            continue
        finite = _finite(given)
        numbers = int(np.count_nonzero(finite))
        seen.dropped["not_a_number"] += len(given.t) - numbers
        batch = _at(given, np.flatnonzero(finite)) if numbers < len(given.t) else given
        _check_values(batch, where)
        t, x, y, p, place = batch
        seen.negative = seen.negative or (p.dtype.kind != "b" and bool(np.any(p == -1)))
        seen.zero = seen.zero or bool(np.any(p == 0))

        inside = (x >= 0) & (x < frame_px[0]) & (y >= 0) & (y < frame_px[1])
        outside = len(t) - int(np.count_nonzero(inside))
        if outside:
            seen.dropped["out_of_frame"] += outside
            t, x, y, p = (column[inside] for column in (t, x, y, p))
        part = Events(
            (np.rint(t) if t.dtype.kind == "f" else t).astype(np.int64),
            x.astype(np.uint16),
            y.astype(np.uint16),
            (p > 0).view(np.uint8),
        )
        if part.size and part.t[0] >= seen.latest_us and (part.t[1:] >= part.t[:-1]).all():
            seen.latest_us = int(part.t[-1])
        elif part.size:
            latest_so_far = np.maximum(np.maximum.accumulate(part.t), seen.latest_us)
            seen.latest_us = int(latest_so_far[-1])
            is_late = part.t < latest_so_far
            if not seen.late:
                seen.first_late = place(int(np.flatnonzero(inside)[is_late][0]))
            seen.late += int(np.count_nonzero(is_late))
        yield part


def _without_fault(batch: Columns, frame_px: tuple[int, int], latest_us: int) -> Events | None:
    """The events of a batch, where they are whole numbers and all of them inside the frame and in order: most are.

    These few comparisons take a tenth of what it takes to look at every number for itself. None for other batches.
    """
    t, x, y, p, _ = batch
    fine = (
        (t.dtype.kind, x.dtype.kind, y.dtype.kind) in (("i", "u", "u"), ("u", "u", "u"))
        and p.dtype.kind in "bu"
        and len(t)
        and x.max() < frame_px[0]
        and y.max() < frame_px[1]
        and p.max() <= 1
        and latest_us <= int(t[0])
        and int(t[-1]) < CLOCK_LIMIT_US
        and (t[1:] >= t[:-1]).all()
    )
    if not fine:
        return None
    types = (np.int64, np.uint16, np.uint16, np.uint8)
    return Events(*(column.astype(type_, copy=False) for column, type_ in zip(batch[:4], types, strict=True)))


def no_events(where: str) -> InputError:
    """The error for a file without any event."""
    return InputError("holds no events", where=where, hint="was the recorder stopped before the camera began?")


def check_lengths(lengths: Sequence[int], where: str) -> None:
    """InputError unless the columns t, x, y, p have one length."""
    if len(set(lengths)) != 1:
        each = ", ".join(f"{name} {length}" for name, length in zip("txyp", lengths, strict=True))
        raise InputError("columns differ in length", where=where, expected="t, x, y, p of one length", found=each)


def _finite(batch: Columns) -> NDArray[np.bool_]:
    """Which rows hold four numbers; NaN and infinity have no place in time or frame."""
    finite = np.ones(len(batch.t), bool)
    for column in batch[:4]:
        if column.dtype.kind not in "iub":
            finite &= np.isfinite(column)
    return finite


def _at(batch: Columns, rows: NDArray[np.intp]) -> Columns:
    """Some rows of a batch, which still know their place in the file."""
    t, x, y, p = (column[rows] for column in batch[:4])
    return Columns(t, x, y, p, lambda row: batch.place(int(rows[row])))


def _check_values(batch: Columns, where: str) -> None:
    """Refuse values that mean the columns are not what we take them for; comparisons only, so nothing can wrap."""

    def refuse(bad: NDArray[np.bool_], column: NDArray[Any], message: str, expected: str, hint: str = "") -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                message, where=where, expected=expected, found=f"{column[row]} {batch.place(row)}", hint=hint
            )

    t, x, y, p, _ = batch
    known = np.ones(len(p), bool) if p.dtype.kind == "b" else (p == 0) | (p == 1) | (p == -1)
    refuse(~known, p, "unknown polarity", "0 and 1, or -1 and 1", "is the order t x y p?")
    for name, column in (("x", x), ("y", y)):
        if column.dtype.kind == "f":
            refuse(
                column != np.rint(column), column, f"{name} lies between pixels", "whole pixels, before undistortion"
            )
    far = (t >= CLOCK_LIMIT_US) | (t <= -CLOCK_LIMIT_US)
    refuse(far, t, "time out of range", "microseconds within 285 years of 0", "is the unit of time right?")


def _start(earliest_us: int, last_us: int, start_us: int | None, where: str) -> int:
    """The time that becomes 0: the start of the recording, or without one the first event."""
    first_us = earliest_us if start_us is None else start_us
    if earliest_us < first_us:
        raise InputError(
            "an event lies before the start of the recording that the file's own note says",
            where=where,
            expected=f"times from {first_us} us on",
            found=f"{earliest_us} us",
        )
    span_us = last_us - first_us
    if span_us > SPAN_LIMIT_US:
        raise InputError(
            "the events span too long a time",
            where=where,
            expected=f"at most {SPAN_LIMIT_US // 3_600_000_000} h from first to last",
            found=f"{span_us / 3.6e9:.1f} h",
            hint="a broken time stamp, or the wrong unit (a first line `t_us x y p` or `t_s x y p` names it in text)",
        )
    return first_us
