"""What the rows of both commands have in common: how much is measured, run times, and what became of a case."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import EvetacError
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


def case_row(case: str, ok: bool, outcome: str, **figures: float | int | None) -> Row:
    """The row of a case: whether it is ok, what became of it in words, and the figures that it has."""
    return {"case": case, "ok": ok, "outcome": outcome, **figures}


def run_case(case: str, run: Callable[[], Row]) -> Row:
    """The row that `run` gives; where it raises, a refusal that says why is ok, and any other failure is not."""
    try:
        return run()
    except (ValueError, EvetacError) as error:
        return case_row(case, bool(str(error)), f"refused: {error}")
    except Exception as error:  # a suite has to go on after the failures that it looks for
        return case_row(case, False, f"failed: {type(error).__name__}: {error}")


def refusal(case: str, call: Callable[[], object]) -> Row:
    """The row of a call that has to be refused: ok only where it raises an error that says why."""

    def accepted() -> Row:
        call()
        return case_row(case, False, "accepted")

    return run_case(case, accepted)
