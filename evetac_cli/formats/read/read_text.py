"""Read events from text: one event a line, `t x y p`, separated by blanks or commas, `#` begins a comment.

The order of the columns is t x y p unless the first line names another (`x,y,p,t`). The unit of time is what the names
say (`t_s`, `t_us`), else what the first time looks like: an integer is microseconds, with a point or an exponent it is
seconds.
"""

import re
from collections.abc import Generator, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.formats.note import NAME, Note, read_note
from evetac_cli.formats.read.event_validation import Columns, Foreign, choose_frame, no_events

BLOCK_CHARS = 1 << 22  # some 200,000 lines
LINE_LIMIT_CHARS = 1 << 16
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
UNIT_HINT = "name the unit in a first line: `t_s x y p` or `t_us x y p`"


class Layout(NamedTuple):
    """How a line is read: the columns of t, x, y, p, us per unit of t, and the separator (None: blanks)."""

    order: tuple[int, int, int, int]
    us_per_unit: float
    separator: str | None


def open_text(path: Path, frame_px: tuple[int, int] | None) -> Foreign:
    """Events of a text file; FrameUnknown without frame_px: text does not say it (an export of ours does)."""
    note = _note(path)
    if note is None and frame_px is None:
        with closing(_batches(path)) as batches:  # what is no text of events has no frame either
            if next(batches, None) is None:
                raise no_events(str(path))
    hint = "say it: --frame-size WIDTHxHEIGHT, for example 640x480"
    frame = choose_frame(note.frame_px if note else None, frame_px, str(path), hint)
    return Foreign("text", frame, _batches(path), note=note)


def _note(path: Path) -> Note | None:
    """The first line, if it is a comment that evetac wrote."""
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        sign, name, text = [*handle.readline(LINE_LIMIT_CHARS).strip().split(" ", 2), "", ""][:3]
    return read_note(text, str(path)) if (sign, name) == ("#", NAME) else None


def _batches(path: Path) -> Generator[Columns, None, None]:
    """One batch a block of lines; raises InputError with the number of the line that cannot be read."""
    layout = names = None
    for number, lines in _blocks(path):
        if layout is None:
            at = next((i for i, line in enumerate(lines) if _data(line)), None)
            if at is None:
                continue
            if header := _names(_data(lines[at])):
                names = header
                lines[at] = ""
            layout = _layout(lines, names or ["t", "x", "y", "p"])
            if layout is None:  # only the line of names so far
                continue
        table = _table(path, number, lines, layout.separator)
        t, x, y, p = (table[:, column] for column in layout.order)
        if layout.us_per_unit == 1:
            odd = np.flatnonzero((t != np.rint(t)) & np.isfinite(t))
            if len(odd):
                odd_line = f"{t[odd[0]]:.9g} {_place(number, lines, int(odd[0]))}"
                expected = "whole microseconds, as in the first line"
                raise InputError(
                    "time changes its unit", where=str(path), expected=expected, found=odd_line, hint=UNIT_HINT
                )
        yield Columns(t * layout.us_per_unit, x, y, p, partial(_place, number, lines))


def _blocks(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Lines in blocks, each with the number of its first line (from 1)."""
    number = 1
    rest = ""
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        while block := handle.read(BLOCK_CHARS):
            *lines, rest = (rest + block).split("\n")
            if len(rest) > LINE_LIMIT_CHARS:
                odd_line = f"line {number + len(lines)} has more than {LINE_LIMIT_CHARS} characters"
                raise InputError(
                    "not a text file of events", where=str(path), expected="one event a line", found=odd_line
                )
            yield number, lines
            number += len(lines)
    if rest:
        yield number, [rest]


def _data(line: str) -> str:
    """The line without its comment."""
    return line.partition("#")[0].strip()


def _fields(line: str, separator: str | None) -> list[str]:
    return [part.strip() for part in _data(line).split(separator)]


def _place(number: int, lines: list[str], row: int) -> str:
    """Where the row-th event of a block stands in the file."""
    data_lines = (i for i, line in enumerate(lines) if _data(line))
    for _ in range(row):
        next(data_lines)
    return f"in line {number + next(data_lines)}"


def _names(text: str) -> list[str] | None:
    """Names of the columns, or None where the text does not name them."""
    names = text.lower().replace(",", " ").split()
    return names if sorted(name[:1] if name in ("t_s", "t_us") else name for name in names) == list("ptxy") else None


def _layout(lines: list[str], names: list[str]) -> Layout | None:
    """Separator from the first line with data, unit of time from the first finite time; None without data."""
    first = next((line for line in map(_data, lines) if line), None)
    if first is None:
        return None
    separator = "," if "," in first else None
    at = next(i for i, name in enumerate(names) if name[0] == "t")
    order = (at, names.index("x"), names.index("y"), names.index("p"))
    if names[at] == "t":
        times = (fields[at] for line in lines if len(fields := _fields(line, separator)) > at)
        sample = next(
            (time for time in times if NUMBER.fullmatch(time) and time.lower().lstrip("+-")[0] not in "ni"), "0"
        )
        microseconds = INTEGER.fullmatch(sample) is not None
    else:
        microseconds = names[at] == "t_us"
    return Layout(order, 1.0 if microseconds else 1e6, separator)


def _table(path: Path, number: int, lines: list[str], separator: str | None) -> NDArray[np.float64]:
    """The numbers of a block, shape (events, 4)."""
    if not any(map(_data, lines)):
        return np.empty((0, 4))
    reason = "more or fewer than 4 columns"
    try:
        table = np.loadtxt(lines, dtype=np.float64, delimiter=separator, ndmin=2)
        if table.shape[1] == 4:
            return table
    except ValueError as error:
        reason = str(error)
    # numpy numbers rows without comments and from the block's start: find the line as the user counts it
    for offset, line in enumerate(lines):
        fields = _fields(line, separator)
        if _data(line) and (len(fields) != 4 or not all(map(NUMBER.fullmatch, fields))):
            expected = f"4 numbers separated by {'commas' if separator else 'blanks'}: t x y p"
            bad_line = f"line {number + offset}: {_clip(line)}"
            cut = offset == len(lines) - 1 and len(fields) < 4 and number + offset > 1
            hint = "if the file was cut short in its last line, remove that line" if cut else ""
            raise InputError("a line cannot be read", where=str(path), expected=expected, found=bad_line, hint=hint)
    raise InputError(f"lines {number} to {number + len(lines) - 1} cannot be read", where=str(path), found=reason)


def _clip(line: str) -> str:
    return repr(line if len(line) <= 80 else line[:77] + "...")
