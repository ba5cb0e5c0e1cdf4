"""A card of the Hugging Face Hub: README.md, which begins with fields that the Hub reads, and the same as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli.console import format_value

NO_LICENSE = "**No license is chosen.** Before you upload this, write one into the field `license` above."
SIMULATED = "**Simulated.** Data and figures on this page come from a simulation, all of them or some."
TAGS = ("tactile", "event-camera", "robotics", "evetac")


@dataclass(frozen=True)
class Card:
    """What a shared folder holds: fields for the Hub, the page below them, all of it as data, and the files."""

    fields: dict[str, Any]  # of the front matter
    page: list[str]  # paragraphs of Markdown
    about: dict[str, Any]  # card.json
    links: dict[str, Path]  # name in the folder -> file that lies elsewhere
    written: dict[str, bytes]  # name in the folder -> content

    def text(self) -> str:
        """README.md. JSON is YAML too, so values are written as JSON: nothing in a name can end a value."""
        lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in self.fields.items()]
        return "\n".join(["---", *lines, "---", "", "\n\n".join(self.page), ""])


def shared_fields(simulated: bool, license_: str | None) -> dict[str, Any]:
    """The fields that models and data sets have alike; `other` is the Hub's word for a license not in its list."""
    license_fields = {"license": license_} if license_ else {"license": "other", "license_name": "not-chosen"}
    return {**license_fields, "tags": [*TAGS, *(["simulated"] if simulated else [])]}


def opening(title: str, *, simulated: bool, license_: str | None) -> list[str]:
    """The first paragraphs of a page: its title, and the marks that must not be missed."""
    return [f"# {inline(title)}", *([SIMULATED] if simulated else []), *([] if license_ else [NO_LICENSE])]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as a table of Markdown, with the columns of the first; nothing where there are none."""
    if not rows:
        return ""
    lines = [" | ".join(rows[0]), " | ".join("---" for _ in rows[0])]
    lines += [" | ".join(inline(format_value(row.get(name))) for name in rows[0]) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)


def inline(text: str) -> str:
    """A text from a file in one line, in which nothing is markup."""
    plain = " ".join(text.split())[:300]
    return "".join(f"\\{letter}" if letter in "\\`*_[]<>|#" else letter for letter in plain)
