"""Common parts of the rows of `evaluate cost`: selectable solver settings, amounts to measure, run times."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.parameter import flag_of
from evetac_cli.commands.trials import SOLVER_OPTIONS, Trials
from evetac_cli.jobs import Progress, Row, Rows

Amount = TypeVar("Amount")

FLAGS = {item.name: flag_of(item) for item in fields(Trials) if item.name in SOLVER_OPTIONS}


@dataclass(frozen=True)
class Extent(Generic[Amount]):
    """Amount to measure, without and with `--full`."""

    quick: Amount
    full: Amount

    def pick(self, full: bool) -> Amount:
        """Return the amount with `--full` or without."""
        return self.full if full else self.quick


def collect(rows: Iterable[Row], total: int, progress: Progress) -> Rows:
    """Measure row after row, and report the progress towards `total`."""
    measured: Rows = []
    for row in rows:
        measured.append(row)
        progress(len(measured), total)
    return measured


def run_times(times_us: NDArray[np.float64], name: str = "time") -> Row:
    """Return the columns `<name>_us_median` and `<name>_us_p99` of run times; None if nothing was timed."""
    if not len(times_us):
        return {f"{name}_us_median": None, f"{name}_us_p99": None}
    return {
        f"{name}_us_median": float(np.median(times_us)),
        f"{name}_us_p99": float(np.percentile(times_us, 99)),
    }


@dataclass(frozen=True)
class SolverSetting:
    """One solver setting: its line in the plot, its value on that line, and the scene's table [solver]."""

    line: str
    value: str = ""
    solver: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The entry in the column `setting`: `fixed step, 0.25 ms`."""
        return f"{self.line}, {self.value}" if self.value else self.line

    @property
    def flags(self) -> str:
        """The flags of `record` and `grasp` for this setting, such as `--step-ms 0.25`; empty for the default."""
        return " ".join(f"{FLAGS[key]} {value:g}" for key, value in self.solver.items())


def line(name: str, key: str, values: tuple[float, ...], unit: str = "", **others: float) -> list[SolverSetting]:
    """Return the settings of one line: a key of the table [solver] with each of these values, plus other fixed keys."""
    return [SolverSetting(name, f"{value:g} {unit}".rstrip(), {key: value, **others}) for value in values]
