"""A subject of `evaluate`: its command, its section of the report page, and the paper's figures beside its rows.

A subject stands in one folder. Whoever lists, prints or documents subjects asks `SUBJECTS` of this package. Nothing
that a subject is made from imports numpy, which keeps `--help` fast.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from evetac_cli.commands.parameter import Command
from evetac_cli.evaluate.common.marks import Paper
from evetac_cli.jobs import Row, Rows

PANELS = OWN_DATA, SIMULATOR, THE_PAPER = "Your data", "Judge the simulator", "The paper"  # of `evaluate --help`


@dataclass(frozen=True)
class SubjectTable:
    """A table of the report page: the rows that it takes from a report, and their columns; empty: all columns."""

    title: str
    rows: Callable[[Rows, Row], Rows]  # (rows, summary) of a report -> rows of the table
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class Subject(Command):
    """A subject of `evaluate`; rows of its tables come from its reports."""

    unit: str = "files"
    panel: str = field(kw_only=True)
    title: str = field(kw_only=True)  # of its section of the report page ...
    about: str = field(kw_only=True)  # ... and what is said there on its contents
    tables: tuple[SubjectTable, ...] = field(kw_only=True)
    paper: Paper = field(kw_only=True, default=Paper())


def having(*keys: str) -> Callable[[Rows, Row], Rows]:
    """Return a function that selects rows with these columns; each table of a report has its own columns."""
    return lambda rows, summary: [row for row in rows if all(key in row for key in keys)]


def grouped(rows: Iterable[Row], keys: tuple[str, ...]) -> list[Rows]:
    """Return rows in groups with equal values of these columns."""
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return list(groups.values())
