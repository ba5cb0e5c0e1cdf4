"""Reading of external text files, TOML and JSON, with a limit on their size.

All numbers read here are plain: finite, whole numbers of 64 bits, and no negative zero, which numpy treats as negative.
"""

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from evetac_cli.errors import InputError, cannot_read, changed_meanwhile

MOST_TOML_BYTES = 1 << 18  # a scene has a few kB; the sensor file of a real camera with its hot pixels has 43 kB
MOST_KEY_PARTS = 32  # of a dotted key: tomllib's memory grows with their square, 1 GB for 16,000
MOST_JSON_BYTES = 1 << 22  # a calibration has 10 kB; this size is enough for ten thousand dots
WHOLE_BITS = 64  # of a whole number, with its sign
SEED_BITS = 129  # numpy's seeds in headers have up to 128 bits, and a sign
_LONG_KEY = re.compile(rf"""(?:\.[ \t]*+(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+){{{MOST_KEY_PARTS}}}""")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    InputError for a pipe, socket or device, which might block; the error of errors.cannot_read if opening fails.
    """
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError("cannot be read", where=str(path), expected="a regular file", found="a pipe or device")
        return path.open("rb")
    except OSError as error:
        raise cannot_read(error, path) from None


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Return the contents of a regular file.

    InputError if it is larger than `most_bytes`; the error of errors.cannot_read if reading fails.
    """
    with open_regular(path) as file:
        try:
            content = file.read(most_bytes + 1)
        except OSError as error:
            raise cannot_read(error, path) from None
    if len(content) > most_bytes:
        raise InputError("the file is too large", where=str(path), expected=f"at most {most_bytes:,} bytes")
    return content


class FileStamps:
    """Detects changes of a file, or of files in a folder, which another program may be writing during reading."""

    def __init__(self, path: Path) -> None:
        self._path, self._before = path, self._stamps(path)

    @staticmethod
    def _stamps(path: Path) -> list[tuple[str, int, int]]:
        """Return name, size and time of change of each file; nothing if these fail, which the reader then reports."""
        try:
            inside = [path] if not path.is_dir() else [Path(entry.path) for entry in os.scandir(path)]
            looked = [(one.name, one.stat()) for one in sorted(inside)]
        except OSError:
            return []
        return [(name, stat.st_size, stat.st_mtime_ns) for name, stat in looked]

    def check(self) -> None:
        """Raise UnavailableError if a file changed since this object was created."""
        if self._stamps(self._path) != self._before:
            raise changed_meanwhile(self._path)


def read_text(path: Path, most_bytes: int) -> str:
    """Return the text of a regular file in UTF-8; InputError for anything else."""
    try:
        return read_bytes(path, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"not text in UTF-8: first invalid byte at {error.start}", where=str(path)) from None


def read_toml(path: Path, refusal: type[InputError] = InputError) -> dict[str, Any]:
    """Return the contents of a TOML file of limited size; raise `refusal`, an InputError, for anything else."""
    import tomllib  # here, as most commands read none

    try:
        text = read_text(path, MOST_TOML_BYTES)
        if _LONG_KEY.search(text):
            raise ValueError(f"a key of more than {MOST_KEY_PARTS} parts")
        table = tomllib.loads(text, parse_float=lambda number: plain_number(float(number)))
    except RecursionError:
        raise refusal("nested too deeply", where=str(path)) from None
    except ValueError as error:
        raise refusal(f"not valid TOML: {error}", where=str(path)) from None
    except InputError as error:
        raise refusal(error.message, where=error.where, expected=error.expected, found=error.found) from None
    require_finite(table, str(path), refusal)
    return table


def require_finite(table: Mapping[str, Any], where: str, refusal: type[InputError] = InputError) -> None:
    """Refuse nan and inf, which TOML allows and JSON Schema does not detect, and whole numbers beyond 64 bits."""
    for place, value in _values(table):
        if isinstance(value, float) and not math.isfinite(value):
            raise refusal(f"{place}: not a finite number", where=where, found=str(value))
        if isinstance(value, int) and value.bit_length() >= WHOLE_BITS:
            raise refusal(f"{place}: a whole number of more than {WHOLE_BITS} bits", where=where)


def plain_number(value: float) -> float:
    """Return a number, with -0.0 replaced by 0.0."""
    return value + 0.0


def as_toml(table: Mapping[str, Any]) -> str:
    """Return a table as TOML text, with its own values first, then its tables; the standard library only reads TOML."""
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
    if isinstance(value, str):  # as in JSON, except for pairs of escapes beyond U+FFFF, and DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value) if isinstance(value, bool) else str(value)  # TOML allows nan and inf


def as_utf8(text: str) -> str:
    """Return a text that can be stored in UTF-8: surrogates for invalid bytes in a name are escaped, e.g. `\\udcff`."""
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode()


def csv_text(text: str) -> str:
    """Return a text as a CSV cell that no spreadsheet executes: an apostrophe is put before a possible formula.

    A possible formula is a text whose first character, apart from blanks, is one of = + - @, also in full width, or
    which begins with a tab or line break. Numbers, also with a sign, stay as they are.
    """
    formula = text[:1] in ("\t", "\r", "\n") or text.lstrip()[:1] in tuple("=+-@\uff1d\uff0b\uff0d\uff20")
    return f"'{text}" if formula and not _NUMBER.fullmatch(text) else text


def parse_json(text: str, *, whole_bits: int = WHOLE_BITS) -> Any:
    """Parse JSON with finite numbers, and whole ones of limited size. ValueError states what is wrong."""

    def whole(digits: str) -> int:
        number = int(digits)  # ValueError for more than 4,300 digits
        if number.bit_length() < whole_bits:
            return number
        raise ValueError(f"a whole number of more than {whole_bits} bits")

    try:
        return json.loads(text, parse_int=whole, parse_float=_finite, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits[:20]} is too large a number")
    return value


def _no_number(name: str) -> Any:
    raise ValueError(f"{name} is not allowed in JSON")


def _values(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over all values in tables and lists, with their paths, e.g. `a.b.0`."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _values(item, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _values(item, f"{place}.{number}")
    else:
        yield place, value
