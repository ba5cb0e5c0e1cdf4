"""The columns of the rows that commands print: name, unit and meaning, and what tables call them.

`columns.toml` in the folder of a subject of `evaluate`, else the one beside this module, says what each column means.
A `*` in a name stands for what varies, such as the length of a window. Columns that several commands share are in the
table `common`, and a command lists those that it has.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

COMMANDS = Path(__file__).with_name("columns.toml")
SUBJECTS = Path(__file__).parents[1] / "evaluate"
UNITS = {
    **{name: name for name in ("ms", "us", "s", "px", "um", "mm", "bytes", "ticks", "g")},
    **{"hz": "Hz", "n": "N", "pa": "Pa", "ma": "mA", "mb": "MB", "per_min": "1/min"},
}


@dataclass(frozen=True)
class Column:
    """A column of rows: its name there, its meaning in a sentence, and its name in other places."""

    name: str
    meaning: str
    unit: str = ""
    heading: str = ""  # in tables of pages; empty: its name with spaces
    short: str = ""  # in tables on a terminal, if another

    @property
    def title(self) -> str:
        """Its heading on a page."""
        return self.heading or self.name.replace("_", " ")

    @property
    def in_words(self) -> str:
        """Its meaning, with its unit."""
        return f"{self.meaning} [{self.unit}]" if self.unit else self.meaning

    @classmethod
    def of(cls, name: str, about: str | Mapping[str, str]) -> "Column":
        """Read an entry of columns.toml; a unit that is not given is the one that ends the name."""
        entry = {"meaning": about} if isinstance(about, str) else dict(about)
        *_, before, last = ("", *name.removesuffix("_median").removesuffix("_mean").removesuffix("_p99").split("_"))
        return cls(name, **{"unit": UNITS.get(f"{before}_{last}", UNITS.get(last, "")), **entry})


def columns_of(command: str) -> dict[str, Column]:
    """Return the columns of a command, such as `label`, `evaluate slip` or `record --dry-run`, by name."""
    group, _, name = command.partition(" --")[0].rpartition(" ")
    every = tomllib.loads(COMMANDS.read_text(encoding="utf-8"))
    own: dict[str, Any] = every.get(group or name, {})
    if group == "evaluate":
        path = SUBJECTS / name.replace("-", "_") / "columns.toml"
        own = tomllib.loads(path.read_text(encoding="utf-8"))
    shared = {name: every["common"][name] for name in own.pop("common", ())}
    return {name: Column.of(name, about) for name, about in {**shared, **own}.items()}


def find(columns: Mapping[str, Column], name: str) -> Column | None:
    """Return the column with a name, also where the entry has a `*` or the name is the one of a terminal."""
    same = (one for one in columns.values() if name == one.short or "*" in one.name and fnmatchcase(name, one.name))
    column = columns.get(name) or next(same, None)
    return column and replace(column, name=name)
