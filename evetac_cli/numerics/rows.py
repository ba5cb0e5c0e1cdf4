"""What the rows of `evaluate cost` have in common: how much is measured, and run times."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Progress
from evetac_cli.stages.evaluate import Rows

Row = dict[str, Any]
Amount = TypeVar("Amount")


@dataclass(frozen=True)
class Extent(Generic[Amount]):
    """How much of something is measured: without and with `--full`."""

    quick: Amount
    full: Amount

    def pick(self, full: bool) -> Amount:
        """The amount with `--full` or without."""
        return self.full if full else self.quick


def collect(rows: Iterable[Row], total: int, progress: Progress) -> Rows:
    """Measure row after row and report the progress towards `total` of them."""
    measured: Rows = []
    for row in rows:
        measured.append(row)
        progress(len(measured), total)
    return measured


def run_times(times_us: NDArray[np.float64], name: str = "time") -> Row:
    """The columns `<name>_us_median` and `<name>_us_p99` of some run times; None where nothing was timed."""
    if not len(times_us):
        return {f"{name}_us_median": None, f"{name}_us_p99": None}
    return {
        f"{name}_us_median": float(np.median(times_us)),
        f"{name}_us_p99": float(np.percentile(times_us, 99)),
    }
