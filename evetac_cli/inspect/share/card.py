"""The card of a shared folder, README.md as the Hugging Face Hub shows it, and the same as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli.console import format_value
from evetac_cli.formats.write import hub_card
from evetac_cli.formats.write.hub_card import inline

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

    def text(self) -> str:
        """README.md."""
        return hub_card.card_text(self.fields, self.page)


def opening(title: str, *, simulated: bool, license_: str | None) -> list[str]:
    """The first paragraphs of a page: its title, and the marks that must not be missed."""
    return [f"# {inline(title)}", *([SIMULATED] if simulated else []), *([] if license_ else [NO_LICENSE])]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of values as a table of Markdown, with the columns of the first; nothing where there are none."""
    return hub_card.table([{name: inline(format_value(row.get(name))) for name in rows[0]} for row in rows])
