"""Read events from text: one event per line, columns separated by blanks, commas or semicolons, comments after # or %.

The first line, or a comment before it, may define the order of the columns (`x,y,polarity,timestamp`); columns with
other names are left out. Otherwise the user defines it, or the first order that fits (columns.py). The unit of time
is defined by the names (`t_s`, `t_us`) or the user. Otherwise it follows from the first time: an integer is in
microseconds, a number with a point or exponent in seconds (columns.py). Polarity may be True and False, as pandas
writes it. The frame is known if the first line has only two numbers (rpg) or names like `x@640,y@480` (faery), or if a
comment states `%geometry:640,480` (Prophesee).
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
from evetac_cli.formats.read.columns import (
    ORDERS,
    ColumnTimes,
    Order,
    by_name,
    declared_order,
    declared_unit,
    guess_order,
    lacking_columns,
    places_of,
    refuse_columns,
)
from evetac_cli.formats.read.source import EventColumns, EventSource, ImportFormat, choose_frame, no_events

BLOCK_CHARS = 1 << 22  # some 200,000 lines
LINE_LIMIT_CHARS = 1 << 16
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
INTEGER = re.compile(r"[+-]?\d+", re.ASCII)
TRUTH = re.compile(r"\b(true|false)\b", re.IGNORECASE)
SEPARATORS = ",;"  # blanks otherwise
SPOKEN_SEPARATORS = {",": "commas", ";": "semicolons", None: "blanks"}
COMMENTS = ("#", "%")
MOST_COLUMNS = 64
GEOMETRY = re.compile(r"%\s*geometry:\s*(\d{1,5})\s*[,x]\s*(\d{1,5})\s*$", re.IGNORECASE)
IN_NAMES = re.compile(r"\bx@(\d{1,5})\b.*\by@(\d{1,5})\b")
TWO_NUMBERS = re.compile(r"\s*(\d{1,5})[ \t]+(\d{1,5})\s*$")


class TextLayout(NamedTuple):
    """The layout of a line: the order of its columns, their number, and the separator (None: blanks)."""

    order: Order
    columns: int
    separator: str | None
    guessed: str = ""  # the order as text, if neither names nor the user define it
    unused: tuple[str, ...] = ()  # names of the other columns
    truth: bool = False  # polarity is True or False


def open_text(
    path: Path, frame_px: tuple[int, int] | None, columns: str | None = None, time_unit: str | None = None
) -> EventSource:
    """Return the events of a text file; raise FrameUnknown without frame_px if the file does not state it."""
    where = str(path)
    note, own_px = _note_and_frame(path)
    source = EventSource("text", (1, 1), (), note=note)
    if note is None and own_px is None and frame_px is None:
        # First report a file that is not a text of events; the frame matters only for one that is.
        with closing(_batches(path, source, columns, time_unit)) as batches:
            if next(batches, None) is None:
                raise no_events(where)
    hint = "give it with --frame-size WIDTHxHEIGHT, for example 640x480"
    source.frame_px = choose_frame(note.frame_px if note else own_px, frame_px, where, hint)
    source.batches = _batches(path, source, columns, time_unit)
    return source


def is_text_of_events(line: str) -> bool:
    """Whether a first line is an event, names of event columns, or evetac's note."""
    words = _names(line.strip().lstrip("#% "))
    return line.startswith(f"# {NAME} ") or all(map(NUMBER.fullmatch, words)) or _order(words) is not None


def _note_and_frame(path: Path) -> tuple[Note | None, tuple[int, int] | None]:
    """Return evetac's note in the first line, and the frame that one of the first lines states; None if absent."""
    frame = None
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        line = handle.readline(LINE_LIMIT_CHARS)
        sign, name, text = [*line.strip().split(" ", 2), "", ""][:3]
        note = read_note(text, str(path)) if (sign, name) == ("#", NAME) else None
        while frame is None and line.lstrip().startswith(COMMENTS):
            if match := GEOMETRY.match(line.strip()):
                frame = int(match[1]), int(match[2])
            line = handle.readline(LINE_LIMIT_CHARS)
    if frame is None and (match := TWO_NUMBERS.match(line) or IN_NAMES.search(line)):
        frame = int(match[1]), int(match[2])
    return note, frame


def _batches(
    path: Path, source: EventSource, columns: str | None, time_unit: str | None
) -> Generator[EventColumns, None, None]:
    """Yield one batch per block of lines; raise InputError with the number of a line that cannot be read.

    Assumptions and left-out data are stored in `source`.
    """
    layout: TextLayout | None = None
    names: list[str] = []
    comment = ""
    begun = False  # whether a line with content has been read
    for number, lines in _blocks(path):
        if layout is None:
            for i, line in enumerate(lines):
                data = _data(line)
                if not data:
                    comment = line.strip().lstrip("#% ") or comment
                elif not begun and TWO_NUMBERS.match(data):
                    lines[i] = ""
                elif not begun and _are_names(data, number + i, str(path)):
                    names, lines[i] = _names(data), ""
                else:
                    layout = _layout(path, number, lines, data, names or _names(comment), columns)
                    break
                begun = begun or bool(data)
            if layout is None:  # no line with an event yet
                continue
            unit = declared_unit(time_unit, layout.order.us_per_unit, str(path))
            source.times = ColumnTimes(str(path), unit, guess=_unit(lines, layout))
            source.guessed_order = "" if source.note else layout.guessed
        table = _table(path, number, lines, layout)
        assert source.times is not None
        place = partial(_place, number, lines)
        t, x, y, p = table.T
        yield EventColumns(source.times.us(t, place), x, y, p, place)
        for name in layout.unused:
            source.left_out[name] = source.left_out.get(name, 0) + len(table)


def _blocks(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield lines in blocks, each with the number of its first line (from 1)."""
    number = 1
    rest = ""
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        while block := handle.read(BLOCK_CHARS):
            *lines, rest = (rest + block).split("\n")
            if len(rest) > LINE_LIMIT_CHARS:
                found = f"line {number + len(lines)} has more than {LINE_LIMIT_CHARS} characters"
                raise InputError("not a text file of events", where=str(path), found=found)
            yield number, lines
            number += len(lines)
    if rest:
        yield number, [rest]


def _data(line: str) -> str:
    """Return the line without its comment."""
    for sign in COMMENTS:
        line = line.partition(sign)[0]
    return line.strip()


def _fields(line: str, separator: str | None) -> list[str]:
    return [part.strip() for part in _data(line).split(separator)]


def _place(number: int, lines: list[str], row: int) -> str:
    """Return a text on the line number of the row-th event of a block."""
    data_lines = (i for i, line in enumerate(lines) if _data(line))
    for _ in range(row):
        next(data_lines)
    return f"in line {number + next(data_lines)}"


def _separator(text: str) -> str | None:
    """Return the separator of a line's fields; None for blanks."""
    return next((sign for sign in SEPARATORS if sign in text), None)


def _names(text: str) -> list[str]:
    """Split a line into names of columns."""
    return text.split(_separator(text))


def _order(names: list[str]) -> Order | None:
    """Return the order that names define; None if they define none."""
    return by_name(names) if len(names) <= MOST_COLUMNS else None


def _are_names(line: str, number: int, path: str) -> bool:
    """Whether a line names the columns of events; raise InputError if it names other columns."""
    words = _names(line)
    if _order(words):
        return True
    if len(words) < 4 or any(NUMBER.fullmatch(word.strip()) or TRUTH.fullmatch(word.strip()) for word in words):
        return False
    lacking = " or ".join(lacking_columns(words))
    what = f"no column has a name for {lacking}" if lacking else "two columns have the same meaning"
    message, expected = f"the names of the columns are unclear: {what}", "t, x, y and p once each"
    raise InputError(message, where=path, expected=expected, found=f"line {number}: {_clip(line)}")


def _layout(path: Path, number: int, lines: list[str], first: str, names: list[str], columns: str | None) -> TextLayout:
    """Return the layout of lines: from the names, from the user's order, or the first order that fits a block."""
    separator = _separator(first)
    truth = bool(TRUTH.search(first))
    order = _order(names)
    if order is not None:
        refuse_columns(columns, str(path))
        unused = [f"values of {name.strip()[:40] or i + 1}" for i, name in enumerate(names) if i not in order.places]
        return TextLayout(order, len(names), separator, unused=tuple(unused), truth=truth)
    if columns is not None:
        return TextLayout(Order(places_of(declared_order(columns, str(path))), None), 4, separator, truth=truth)
    plain = TextLayout(Order(places_of(ORDERS[0]), None), 4, separator, truth=truth)
    guessed = guess_order(_table(path, number, lines, plain))
    return plain._replace(order=Order(places_of(guessed), None), guessed=guessed)


def _unit(lines: list[str], layout: TextLayout) -> float:
    """Return the unit of time in us, guessed from the notation of the first finite time of some lines."""
    at = layout.order.places[0]
    times = (fields[at] for line in lines if len(fields := _fields(line, layout.separator)) > at)
    sample = next((time for time in times if NUMBER.fullmatch(time) and time.lower().lstrip("+-")[0] not in "ni"), "0")
    return 1.0 if INTEGER.fullmatch(sample) else 1e6


def _table(path: Path, number: int, lines: list[str], layout: TextLayout) -> NDArray[np.float64]:
    """Return the columns t, x, y, p of a block, shape (events, 4)."""
    count, separator, places = layout.columns, layout.separator, layout.order.places
    if not any(map(_data, lines)):
        return np.empty((0, 4))
    reason = f"more or fewer than {count} columns"
    plain = [line.partition("%")[0] for line in lines] if any("%" in line for line in lines) else lines
    if layout.truth:
        plain = [TRUTH.sub(lambda word: str(int(word[0].lower() == "true")), line) for line in plain]
    used = None if count == 4 else places  # other columns may contain anything
    for _ in range(2):
        try:
            table = np.loadtxt(plain, dtype=np.float64, delimiter=separator, ndmin=2, usecols=used)
            if table.shape[1] == 4:
                return table if used else table[:, places]
        except ValueError as error:
            reason = str(error)
        plain = [line if _data(line) else "" for line in plain]  # numpy would read a line of blanks as a column
    # numpy counts rows from the block's start and without comments; find the line number in the file
    for offset, line in enumerate(lines):
        fields = _fields(line, separator)
        numbers = [fields[place] for place in places] if len(fields) == count else []
        if layout.truth:
            numbers = [TRUTH.sub("0", word) for word in numbers]
        if _data(line) and not (numbers and all(map(NUMBER.fullmatch, numbers))):
            names = " ".join(name for _, name in sorted(zip(places, "txyp", strict=True)))
            expected = f"{count} numbers separated by {SPOKEN_SEPARATORS[separator]}"
            expected += f": {names}" if count == 4 else ""
            bad_line = f"line {number + offset}: {_clip(line)}"
            cut = len(lines) == 1 and len(fields) < count and number > 1  # all other blocks have more lines
            hint = "if the file ends within its last line, remove that line" if cut else ""
            raise InputError("a line cannot be read", where=str(path), expected=expected, found=bad_line, hint=hint)
    raise InputError(f"lines {number} to {number + len(lines) - 1} cannot be read", where=str(path), found=reason)


def _clip(line: str) -> str:
    return repr(line if len(line) <= 80 else line[:77] + "...")


FORMAT = ImportFormat((), open_text, ("columns", "time_unit"))
