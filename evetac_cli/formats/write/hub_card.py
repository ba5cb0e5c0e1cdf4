"""What cards of the Hugging Face Hub have alike: README.md, which begins with fields that the Hub reads, then Markdown.

`share` lays out models and data sets with such a card, the export to LeRobot writes one.
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
SIMULATED = "**Simulated.** Data and figures on this page come from a simulation, all of them or some."


@dataclass(frozen=True)
class Card:
    """What a shared folder holds: fields for the Hub, the page below them, all of it as data, and the files."""

    fields: dict[str, Any]  # of the front matter
    page: list[str]  # paragraphs of Markdown
    about: dict[str, Any]  # card.json
    links: dict[str, Path]  # name in the folder -> file that lies elsewhere
    written: dict[str, bytes]  # name in the folder -> content
    note: str = ""  # what whoever shares it has to know, in words
    more: Callable[[Path, Progress], object] | None = None  # writes further files into the folder

    def text(self) -> str:
        """README.md."""
        return card_text(self.fields, self.page)


def card_text(fields: Mapping[str, Any], paragraphs: Sequence[str]) -> str:
    """README.md. JSON is YAML too, so values are written as JSON: nothing in a name can end a value."""
    lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in fields.items()]
    return as_utf8("\n".join(["---", *lines, "---", "", "\n\n".join(paragraphs), ""]))


def card_fields(simulated: bool, license_: str | None, *tags: str) -> dict[str, Any]:
    """The fields that all cards have; `other` is the Hub's word for a license not in its list."""
    license_fields = {"license": license_} if license_ else {"license": "other", "license_name": "not-chosen"}
    return {**license_fields, "tags": [*tags, *TAGS, *(["simulated"] if simulated else [])]}


def opening(title: str, *, simulated: bool, license_: str | None) -> list[str]:
    """The first paragraphs of a page: its title, and the marks that must not be missed."""
    return [f"# {inline(title)}", *([SIMULATED] if simulated else []), *([] if license_ else [NO_LICENSE])]


def table(rows: Sequence[Mapping[str, Any]], text: Callable[[Any], str] | None = None) -> str:
    """Rows as a table of Markdown, with the columns of the first; nothing where there are none.

    text: how a value is written; without it, cells are Markdown.
    """
    if not rows:
        return ""
    cells = [[row.get(name, "") if text is None else inline(text(row.get(name))) for name in rows[0]] for row in rows]
    lines = [list(rows[0]), ["---"] * len(rows[0]), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def inline(text: str, longest: int = 300) -> str:
    """A text from a file in one line, cut to so many characters, in which nothing is markup."""
    line = " ".join(text.split())[:longest]
    plain = (letter if letter.isprintable() else " " for letter in line)
    return "".join(f"\\{letter}" if letter in "\\`*_[]<>|#" else letter for letter in plain)
