"""What cards of the Hugging Face Hub have alike: README.md, which begins with fields that the Hub reads, then Markdown.

`share` lays out models and data sets with such a card, the export to LeRobot writes one.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from evetac_cli.text_files import as_utf8

TAGS = ("tactile", "event-camera", "robotics", "evetac")


def card_text(fields: Mapping[str, Any], paragraphs: Sequence[str]) -> str:
    """README.md. JSON is YAML too, so values are written as JSON: nothing in a name can end a value."""
    lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in fields.items()]
    return as_utf8("\n".join(["---", *lines, "---", "", "\n\n".join(paragraphs), ""]))


def card_fields(simulated: bool, license_: str | None, *tags: str) -> dict[str, Any]:
    """The fields that all cards have; `other` is the Hub's word for a license not in its list."""
    license_fields = {"license": license_} if license_ else {"license": "other", "license_name": "not-chosen"}
    return {**license_fields, "tags": [*tags, *TAGS, *(["simulated"] if simulated else [])]}


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows as a table of Markdown, with the columns of the first; nothing where there are none. Cells are Markdown."""
    if not rows:
        return ""
    lines = [" | ".join(rows[0]), " | ".join("---" for _ in rows[0])]
    lines += [" | ".join(row.get(name, "") for name in rows[0]) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)


def inline(text: str, longest: int = 300) -> str:
    """A text from a file in one line, cut to so many characters, in which nothing is markup."""
    line = " ".join(text.split())[:longest]
    plain = (letter if letter.isprintable() else " " for letter in line)
    return "".join(f"\\{letter}" if letter in "\\`*_[]<>|#" else letter for letter in plain)
