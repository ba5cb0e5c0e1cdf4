"""What an experiment, a study and a check are; the studies and the engine have this in common."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from evetac_cli.jobs import Rows
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.tables import Column, Evaluations, Table


@dataclass(frozen=True)
class Experiment:
    """One experiment: its commands, its sizes and its results."""

    name: str
    shows: str
    folder: str  # folder of its files; experiments that build on each other share one
    hours: float  # at full size on two cores: an estimate
    full: Sizes
    small: Sizes  # the sizes that differ from full size
    steps: Callable[[Sizes], Iterator[Command]] = lambda sizes: iter(())
    evaluations: Callable[[Sizes], dict[str, Command]] = lambda sizes: {}
    # of sizes, folder and jobs: makes the measurements that no command makes
    measure: Callable[[Sizes, Path, int], Evaluations] | None = None
    tables: tuple[Table, ...] = ()
    after: tuple[str, ...] = ()  # experiments that must run first
    published: bool = True  # whether its tables go to docs/results/; otherwise they stay in its folder


@dataclass(frozen=True)
class Figure:
    """A figure that is judged: the column `above`, or the ratio of two columns, summed over trials.

    A mean over trials needs no second column.

    - squared: the figure is a root mean square, so that squares are averaged.
    - count: in a table without rows of trials, the column with the number of trials of a share.
    """

    above: str
    below: str = ""
    count: str = ""
    squared: bool = False

    @property
    def name(self) -> str:
        return f"{self.above}/{self.below}" if self.below else self.above


@dataclass(frozen=True)
class Check:
    """How a table is checked.

    - key: the columns by which its rows are matched, also the rows of single trials.
    - trials: returns a row per trial, with the columns of `key` and of the figures, and with `unit`: the object, sensor
      or recording that is resampled. Without it, the figures of the table itself must be ratios of counts, or shares of
      a count.
    - training: words of the command that trains again, for a table with frozen models.
    - unpromised: columns of figures that no run repeats, such as run times.
    """

    key: tuple[str, ...]
    figures: tuple[Figure, ...] = ()
    trials: Callable[[Evaluations], Rows] | None = None
    training: tuple[str, ...] = ()
    unpromised: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScriptCheck:
    """How a table that its own script makes is checked: commands that put it into the folder `tables`, and minutes."""

    commands: tuple[Command, ...]
    minutes: float  # of a core, measured
    check: Check
    whole: bool = False  # whether all trials of the table are repeated


@dataclass(frozen=True)
class Study:
    """What a study offers to the engine.

    - experiments: its experiments, with their tables.
    - checks: how these tables are checked; or why they are not.
    - check_sizes: by experiment, the sizes that a check repeats; experiments without them are repeated whole.
    - scripts: how tables are checked that scripts of the study make.
    - pages: by name, functions that return tables of pages as Markdown, from the folder of the results.
    """

    experiments: tuple[Experiment, ...] = ()
    checks: dict[str, Check | str] = field(default_factory=dict)
    check_sizes: dict[str, Sizes] = field(default_factory=dict)
    scripts: dict[str, ScriptCheck] = field(default_factory=dict)
    pages: dict[str, Callable[[Path], str]] = field(default_factory=dict)


def all_rows(evaluations: Evaluations) -> Rows:
    """Return the measured rows unchanged."""
    return [row for evaluation in evaluations.values() for row in evaluation.rows]


def measured(name: str, title: str, *columns: tuple[str, str], notes: tuple[str, ...] = ()) -> Table:
    """Return the table of a measurement of the same name; columns are heading and cell."""
    return Table(name, title, (name,), all_rows, tuple(Column(*one) for one in columns), notes=notes, measured=True)
