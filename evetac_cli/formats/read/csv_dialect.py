"""Find how a CSV file is written: its text encoding, separator, decimal sign, and the names of its columns.

Text is UTF-8, UTF-16, or else Latin-1. The separator is the one by which the first rows have as many cells as the line
of names. A separator at the end of each line adds a column without a name; it may be missing in the line of names.
Excel may state the separator in a line before the names, `sep=;`.
"""

import codecs
import csv
import io
import re
from pathlib import Path
from typing import NamedTuple

from evetac_cli.errors import InputError
from evetac_cli.text_files import open_regular

MOST_HEAD_BYTES = 1 << 16  # of the line of names
SAMPLE_BYTES = 1 << 18  # read for the separator; the decimal sign is searched in further parts of this size
OVERLAP = 100  # characters of two parts, more than a number has
SEPARATORS = ";\t, "  # in this order: names and decimal numbers have commas and blanks, hardly ever semicolons
NUMBER = re.compile(r"\s*[-+]?[.\d][\d.eE+-]*\s*")
STATED = re.compile(r"\"?sep=(.)\"?")


class Dialect(NamedTuple):
    """How a CSV file is written; names: one per column, in order. head_lines: before the numbers."""

    encoding: str
    separator: str
    decimal_sign: str
    names: list[str]
    head_lines: int


def find_dialect(path: Path, where: str) -> Dialect:
    """Return how the file is written; raise InputError if it is no table, or its first line does not name columns."""
    with open_regular(path) as file:
        sample = file.read(SAMPLE_BYTES)
    encoding = _encoding(sample)
    text = codecs.getincrementaldecoder(encoding)("replace").decode(sample)
    head, *lines = re.split(r"\r\n?|\n", text.removeprefix("\ufeff"))
    stated = STATED.fullmatch(head.strip("\r\n "))
    if stated and lines:
        head, *lines = lines
    if len(sample) == SAMPLE_BYTES:  # the last line may be cut
        lines = lines[:-1]
    head = head.strip("\r\n ")
    if not head or len(head) >= MOST_HEAD_BYTES or not head.replace("\t", "").isprintable():
        raise InputError(
            "the file is neither a table nor a bag", where=where, expected="CSV, Parquet, or a bag of ROS 1 or ROS 2"
        )
    lines = [line for line in lines if line.strip()]
    separator = stated[1] if stated else next((sign for sign in SEPARATORS if _fits(head, lines[:20], sign)), None)
    separator = separator or max(",;\t", key=head.count)
    separator = separator if separator in head else " "
    names = _cells(head, separator)
    if any(NUMBER.fullmatch(name) for name in names):
        raise InputError(
            "the first line does not name the columns", where=where, found=head[:80], hint="add a line with their names"
        )
    if lines:
        more = len(_cells(lines[0], separator)) - len(names)
        names = [*names, ""] if more == 1 and lines[0].endswith(separator) else names
        names = names[:-1] if more == -1 and not names[-1].strip() else names
    return Dialect(encoding, separator, _decimal_sign(path, encoding, separator), names, 2 if stated else 1)


def _decimal_sign(path: Path, encoding: str, separator: str) -> str:
    """Return the decimal sign of the first part of the file that has one; a point if both or none occur."""
    number = {}
    for sign in ".,":
        edge = f'["\r\n{re.escape(separator)}]' if sign != separator else '"'
        number[sign] = re.compile(rf"{edge}\s*[-+]?\d*\{sign}\d+(?:[eE][-+]?\d+)?\s*{edge}")
    before = ""
    with open_regular(path) as file, io.TextIOWrapper(file, encoding, "replace") as texts:
        texts.readline(MOST_HEAD_BYTES)  # names may have numbers
        while part := texts.read(SAMPLE_BYTES):
            text = f"{before or chr(10)}{part}" + ("" if len(part) == SAMPLE_BYTES else "\n")
            has_commas, has_points = (sign in text and bool(number[sign].search(text)) for sign in ",.")
            if has_commas or has_points:
                return "." if has_points else ","
            before = text[-OVERLAP:]
    return "."


def _encoding(sample: bytes) -> str:
    if sample.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in sample[:2]:
        return "utf-16-be" if sample[0] == 0 else "utf-16-le"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(sample)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf8"


def _cells(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:  # a field of more than 131,072 characters
        return [line]


def _fits(head: str, lines: list[str], separator: str) -> bool:
    """Whether rows have as many cells as the line of names, and more than one; one more or less if it is empty."""
    names = _cells(head, separator)
    rows = [_cells(line, separator) for line in lines]
    same = (abs(len(row) - len(names)) < 1 + (not max(row, names, key=len)[-1].strip()) for row in rows)
    return len(names) > 1 and all(same)
