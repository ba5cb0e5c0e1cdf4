"""Common parts of cards for the Hugging Face Hub: README.md begins with fields that the Hub reads; Markdown follows.

`share` writes such a card for models and data sets, the LeRobot export for its data set.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Progress
from evetac_cli.text_files import as_utf8

TAGS = ("tactile", "event-camera", "robotics", "evetac")
NO_LICENSE = "**No license is chosen.** Before you upload this, write one into the field `license` above."
SIMULATED = "**Simulated.** Some or all of the data and figures on this page come from a simulation."


@dataclass(frozen=True)
class Card:
    """The contents of a shared folder: fields for the Hub, the page below them, and the files."""

    what: str  # slip detector, force model or data set
    title: str
    simulated: bool
    fields: dict[str, Any]  # of the front matter
    page: list[str]  # paragraphs of Markdown
    links: dict[str, Path]  # name in the folder -> existing file outside the folder
    written: dict[str, bytes]  # name in the folder -> content
    note: str = ""  # a note for the person who shares the folder
    more: Callable[[Path, Progress], str] | None = None  # writes further files into the folder, returns a note

    def text(self) -> str:
        """Return the content of README.md."""
        return card_text(self.fields, self.page)


def card_text(fields: Mapping[str, Any], paragraphs: Sequence[str]) -> str:
    """Return the content of README.md. Values are JSON, which is also YAML, so no character in a name can end one."""
    lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in fields.items()]
    return as_utf8("\n".join(["---", *lines, "---", "", "\n\n".join(paragraphs), ""]))


def card_fields(simulated: bool, license_: str | None, *tags: str) -> dict[str, Any]:
    """Return the fields that all cards have; `other` is the Hub's term for a license that is not in its list."""
    license_fields = {"license": license_} if license_ else {"license": "other", "license_name": "not-chosen"}
    return {**license_fields, "tags": [*tags, *TAGS, *(["simulated"] if simulated else [])]}


def opening(title: str, *, simulated: bool, license_: str | None) -> list[str]:
    """Return the first paragraphs of a page: its title, and the warnings about simulation and license."""
    return [f"# {inline(title)}", *([SIMULATED] if simulated else []), *([] if license_ else [NO_LICENSE])]


def table(rows: Sequence[Mapping[str, Any]], text: Callable[[Any], str] | None = None) -> str:
    """Return rows as a Markdown table with the columns of the first row; empty if there are no rows.

    text: formats a value as plain text; without it, cells must already be Markdown.
    """
    if not rows:
        return ""
    cells = [[row.get(name, "") if text is None else inline(text(row.get(name))) for name in rows[0]] for row in rows]
    lines = [list(rows[0]), ["---"] * len(rows[0]), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def inline(text: str, longest: int = 300) -> str:
    """Return a text from a file on one line, cut to `longest` characters, with all markup escaped."""
    line = " ".join(text.split())[:longest]
    plain = (letter if letter.isprintable() else " " for letter in line)
    return "".join(f"\\{letter}" if letter in "\\`*_[]<>|#" else letter for letter in plain)
