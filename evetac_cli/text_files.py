"""The one door for text files from elsewhere, TOML and JSON: regular files only, of a bounded size, depth and count.

Numbers are plain behind it: finite, whole ones of 64 bits, and no 0 with a sign, which numpy takes for a negative one.

Why the structure is looked at before the text is parsed: tomllib takes a minute for one key of 100,000 dotted parts,
and both parsers run out of stack where lists are nested deep enough. Looking takes a time in proportion to the size.
"""

import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from evetac_cli.errors import InputError, cannot_read, changed_meanwhile

MOST_TOML_BYTES = 1 << 18  # a config file or scene has a few kB; tomllib reads this in half a second
MOST_JSON_BYTES = 1 << 22  # a calibration has 10 kB; this is one of ten thousand dots
MOST_DEPTH = 32  # tables in tables, lists in lists, and dots of a key: ours have 4
MOST_VALUES = 50_000  # entries of lists and tables: so many take milliseconds
WHOLE_BITS = 64  # what TOML promises for a whole number, with its sign
SEED_BITS = 129  # seeds of numpy have up to 128 bits, and a sign: in headers

# Texts and comments, whose content is no structure. One that does not end runs to the end of its line, or of the file:
# so each match succeeds where its repetition stops, and none goes back. It is not possessive (*+), for what that
# matches in Python 3.11.2 and older is wrong.
_TOML_TEXT = re.compile(
    r'"""(?:[^\\"]+|\\.|"(?!""))*(?:"{3,5}|\\?\Z)'
    r"|'''(?:[^']+|'(?!''))*(?:'{3,5}|\Z)"
    r'|"(?:[^"\\\n]+|\\[^\n])*"?'
    r"|'[^'\n]*'?"
    r"|#[^\n]*",
    re.DOTALL,
)
_JSON_TEXT = re.compile(r'"(?:[^"\\]+|\\.)*(?:"|\\?\Z)', re.DOTALL)
_DOTTED = re.compile(rf"(?<![\w\-])[\w\-]+(?:[ \t]*\.[ \t]*[\w\-]+){{{MOST_DEPTH}}}")
_STRUCTURE = re.compile(r"[\[\]{},=:]")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_HUGE = re.compile(r"[eE]\+?[0-9]{3}|[0-9]{300}")  # what a number of JSON has that may be too large for a float


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; InputError for a pipe, socket or device, which might wait; errors.cannot_read else."""
    try:
        kind = os.stat(path).st_mode
        if not stat.S_ISDIR(kind) and not stat.S_ISREG(kind):
            raise _not_regular(path, kind)
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC), "rb")
    except OSError as error:
        raise cannot_read(error, path) from None
    kind = os.fstat(file.fileno()).st_mode
    if not stat.S_ISREG(kind):  # another took its place
        file.close()
        raise _not_regular(path, kind)
    return file


def _not_regular(path: Path, kind: int) -> InputError:
    names = ((stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"), (stat.S_ISDIR, "a folder"))
    what = next((name for is_one, name in names if is_one(kind)), "a device")
    return InputError("cannot be read", where=str(path), expected="a regular file", found=what)


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """The whole of a regular file; InputError where it is larger, errors.cannot_read where it cannot be read."""
    with open_regular(path) as file:
        try:
            content = file.read(most_bytes + 1)
        except OSError as error:
            raise cannot_read(error, path) from None
    if len(content) > most_bytes:
        raise InputError("the file is too large", where=str(path), expected=f"at most {most_bytes:,} bytes")
    return content


class Steady:
    """Whether a file, or what lies in a folder, is still as it was: another program may write what is being read."""

    def __init__(self, path: Path) -> None:
        self._path, self._before = path, self._stamps(path)

    @staticmethod
    def _stamps(path: Path) -> list[tuple[str, int, int]]:
        """Name, size and time of change of each file; nothing of what cannot be looked at, which its reader says."""
        try:
            inside = [path] if not path.is_dir() else [Path(entry.path) for entry in os.scandir(path)]
            looked = [(one.name, one.stat()) for one in sorted(inside)]
        except OSError:
            return []
        return [(name, stat.st_size, stat.st_mtime_ns) for name, stat in looked]

    def check(self) -> None:
        """Raise UnavailableError if it changed since this was made; of a path that reading alone does not change."""
        if self._stamps(self._path) != self._before:
            raise changed_meanwhile(self._path)


@contextmanager
def steady(path: Path) -> Iterator[None]:
    """UnavailableError where a file changed while the block read it, also where the block found fault with it."""
    before = Steady(path)
    try:
        yield
    except InputError:
        before.check()
        raise
    before.check()


def read_text(path: Path, most_bytes: int) -> str:
    """The whole of a regular file of UTF-8; InputError for anything else."""
    try:
        return read_bytes(path, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"not text in UTF-8 from byte {error.start} on", where=str(path)) from None


def read_toml(path: Path, refusal: type[InputError] = InputError) -> dict[str, Any]:
    """A TOML file within the limits above, of plain numbers; `refusal`, an InputError, for anything else."""
    try:
        table = parse_toml(read_text(path, MOST_TOML_BYTES))
    except ValueError as error:
        raise refusal(f"not valid TOML: {error}", where=str(path)) from None
    except InputError as error:
        raise refusal(error.message, where=error.where, expected=error.expected, found=error.found) from None
    require_finite(table, str(path), refusal)
    return table


def require_finite(table: Mapping[str, Any], where: str, refusal: type[InputError] = InputError) -> None:
    """Refuse nan and inf, which TOML can write and JSON Schema does not see."""
    for place, value in _values(table):
        if isinstance(value, float) and not math.isfinite(value):
            raise refusal(f"{place}: not a finite number", where=where, found=str(value))


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML within the limits above; ValueError says in words what is wrong with it. Floats may be nan or inf."""
    import tomllib  # here, as most commands read none

    outline = _TOML_TEXT.sub("a", text.replace("\r\n", "\n"))
    if _DOTTED.search(outline):
        raise ValueError(f"a key of more than {MOST_DEPTH} parts")
    _check_outline(outline)
    try:
        table = tomllib.loads(text, parse_float=lambda number: plain_number(float(number)))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    for _, value in _values(table):
        if type(value) is int and value.bit_length() >= WHOLE_BITS:
            raise ValueError(f"a whole number of more than {WHOLE_BITS} bits")
    return table


def plain_number(value: float) -> float:
    """A number without the sign that a 0 may have."""
    return value + 0.0


def as_toml(table: Mapping[str, Any]) -> str:
    """A table as TOML, which the standard library only reads: its own values first, then its tables."""
    values = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    tables = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    parts = [_lines(values), *(f"[{key}]\n{_lines(value)}" for key, value in tables.items())]
    return "\n".join(part for part in parts if part)


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{key} = {_toml_value(value)}\n" for key, value in table.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, str):  # as of JSON, but for pairs of escapes beyond U+FFFF, and DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value) if isinstance(value, bool) else str(value)  # nan and inf are numbers of TOML


def as_utf8(text: str) -> str:
    """A text as files can hold it: what stands in a name for bytes that are no UTF-8 is spelt out, as `\\udcff`."""
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


def csv_text(text: str) -> str:
    """A text as a cell of CSV that no spreadsheet runs: an apostrophe stands before what it would take for a formula.

    That is a text whose first sign, blanks aside, is one of = + - @, also in full width, or one that begins with a tab
    or the end of a line. A number is a number, also with a sign.
    """
    formula = text[:1] in ("\t", "\r", "\n") or text.lstrip()[:1] in tuple("=+-@\uff1d\uff0b\uff0d\uff20")
    return f"'{text}" if formula and not _NUMBER.fullmatch(text) else text


def parse_json(text: str, *, most_values: float = MOST_VALUES, whole_bits: int = WHOLE_BITS) -> Any:
    """Parse JSON within the limits above, except for size; ValueError says in words what is wrong with it.

    NaN and infinities are no JSON. most_values: math.inf for the header and the rows of a file that is small enough.
    """

    def whole(digits: str) -> int:
        if len(digits) <= whole_bits // 3:  # more are more bits, and int() takes its time for very many
            number = int(digits)
            if number.bit_length() < whole_bits:
                return number
        raise ValueError(f"a whole number of more than {whole_bits} bits")

    outline = _JSON_TEXT.sub("a", text)
    _check_outline(outline, most_values)
    try:
        huge = _finite if _HUGE.search(outline) else None
        return json.loads(text, parse_int=whole, parse_float=huge, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits[:20]} is too large a number")
    return value


def _no_number(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


def _check_outline(outline: str, most_values: float = MOST_VALUES) -> None:
    """Refuse text, without its strings, that is nested too deeply or has too many values."""
    depth = values = 0
    for match in _STRUCTURE.finditer(outline):
        sign = match[0]
        if sign in "[{":
            depth += 1
            if depth > MOST_DEPTH:
                raise ValueError(f"it is nested more than {MOST_DEPTH} deep")
        elif sign in "]}":
            depth = max(0, depth - 1)
        else:
            values += 1
            if values > most_values:
                raise ValueError(f"it has more than {most_values:,} values")


def _values(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """All that stands in tables and lists, which are not deep, with its place, as in `a.b.0`."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _values(item, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _values(item, f"{place}.{number}")
    else:
        yield place, value
