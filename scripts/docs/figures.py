"""Find the sentences of pages of results whose decimal figures come from no table; a test asserts that there are none.

A comment above a paragraph names the figures that it quotes: `<!-- figure TABLE {"COLUMN": VALUE} COLUMN:FORMAT -->`,
with values that select a row of docs/results/TABLE.json. `<!-- given 0.5 -->` names figures that are no results, such
as a definition or a setting. Tables, code, headings and alternative texts of pictures are left out: tables are made
from the same files.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("slip-detector", "touch-maps", "identify", "disturbances", "labels", "simulator")),
    *(f"docs/evidence/{name}.md" for name in ("results", "likeness", "stability", "cost", "simulation", "touch")),
)
MARK = re.compile(r"<!-- figure ([\w/-]+) ({.*?}) (\w[\w ]*?)(?::(\S+))? -->")
GIVEN = re.compile(r"<!-- given ([\d. ]+) -->")
DECIMAL = re.compile(r"(?<![\w.])(?<!Python )(?<!arXiv[ :])\d+\.\d+(?!\.?\d|\w)")
MADE = re.compile(r"<!-- (?:table|measured) ([\w-]+) -->.*?<!-- end of \1 -->", re.DOTALL)


class Figure(NamedTuple):
    """A figure that a page quotes: its table, what selects the row, the column and the format."""

    table: str
    row: dict[str, Any]
    column: str
    form: str

    def text(self, results: Path = RESULTS) -> str:
        """Return the figure as the page must have it; ValueError unless one row has it."""
        rows = json.loads((results / f"{self.table}.json").read_text())["rows"]
        found = [row for row in rows if self.row.items() <= row.items()]
        if len(found) != 1 or found[0].get(self.column) is None:
            raise ValueError(f"{self.table} {self.row} {self.column}: expected one row with it, found {len(found)}")
        value = found[0][self.column]
        if isinstance(value, list):  # as of a public fact, which may have several figures
            (value,) = value
        return format(value, self.form)


class Sentence(NamedTuple):
    """A sentence with decimal figures, and those of them that have no mark."""

    page: str
    words: str
    unmarked: list[str]


def figures_in(comments: str) -> list[Figure]:
    """Return the figures that the comments above a paragraph name."""
    return [Figure(table, json.loads(row), column, form) for table, row, column, form in MARK.findall(comments)]


def paragraphs(page: str) -> Iterator[tuple[list[Figure], set[str], str]]:
    """Yield each paragraph, list or table of a page that is written by hand, with the marks above it.

    Marks are figures of tables, and figures that are no results.
    """
    page = re.sub(r"^```.*?^```$", "", MADE.sub("", page), flags=re.MULTILINE | re.DOTALL)
    marked: list[Figure] = []
    given: set[str] = set()
    for block in page.split("\n\n"):
        text = re.sub(r"<!--.*?-->", "", block, flags=re.DOTALL).strip("\n")
        marked += figures_in(block)
        given |= {number for numbers in GIVEN.findall(block) for number in numbers.split()}
        if text.strip():
            if not text.startswith("#"):
                yield marked, given, text
            marked, given = [], set()


def absent(page: str, results: Path = RESULTS) -> list[str]:
    """Return, in words, the marked figures that the paragraph below them lacks."""
    found = []
    for figures, given, text in paragraphs(page):
        found += [f"given {number}: not in: {text[:80]}" for number in given if number not in text]
        for figure in figures:
            shown = figure.text(results)
            in_text = re.escape(shown).replace("%", " ?%")
            if not re.search(rf"(?<![\d.]){in_text}(?![\d])", text):
                found.append(f"{figure.table} {figure.row} {figure.column}: expected {shown} in: {text[:80]}")
    return found


def sentences(name: str, page: str, results: Path = RESULTS) -> Iterator[Sentence]:
    """Yield the sentences, and rows of tables written by hand, that have a decimal figure."""
    for figures, given, text in paragraphs(page):
        known = {number for figure in figures for number in DECIMAL.findall(figure.text(results))}
        lines = [line for line in text.splitlines() if not line.startswith("    ")]
        plain = re.sub(r"!\[[^\]]*\]|\]\([^)]*\)|`[^`]*`", "", "\n".join(lines))
        for words in re.split(r"(?<=[.!?:])\s+(?=[A-Z*\[])|\n(?=\||- )", plain):
            if decimals := DECIMAL.findall(words):
                unmarked = [one for one in decimals if one not in known | given]
                yield Sentence(name, " ".join(words.split()), unmarked)
