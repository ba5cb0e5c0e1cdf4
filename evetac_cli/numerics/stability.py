"""evaluate stability: what a part does where it is stiff, extreme, or given nonsense; a row for every case.

Every part is a function `(seed, full) -> cases`, in which a case is a function that runs it and returns its row:
`case`, `ok`, `outcome`, and those columns of the part that the case has.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.numerics import simulator
from evetac_cli.numerics.grasp import stability as grasp
from evetac_cli.numerics.rows import Row, collect
from evetac_cli.numerics.tracker import stability as tracker
from evetac_cli.params import EvaluateStability, recipe_of
from evetac_cli.stages.evaluate import Rows, own_report, report

OUTPUT = "report"
METHOD = 1


class Part(NamedTuple):
    """How a part is tried, the columns of its rows, and which of them is summed up over all cases, and how."""

    cases: Callable[[int, bool], Sequence[Callable[[], Row]]]
    columns: tuple[str, ...]
    overall: str
    combine: Callable[[Iterable[Any]], Any]


PARTS: dict[str, Part] = {
    "sim": Part(simulator.cases, ("sweeps_mean", "sweeps_max", "residual_max", "energy_gained_j"), "residual_max", max),
    "track": Part(tracker.cases, ("dots_lost", "error_px_worst"), "dots_lost", sum),
    "grasp": Part(grasp.cases, ("force_max_n", "current_max_ma", "swing_ticks", "moved_mm"), "current_max_ma", max),
}


def jobs(files: list[Path], params: EvaluateStability, out: Path | None) -> list[Job]:
    """One report on the part: `<part>.stability.report.h5`, in the present folder if no other is given."""
    return [Job((), own_report(params.part, "stability", out))]


def run(job: Job, params: EvaluateStability, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every case; the summary counts those that are ok or refused, and names those that are not ok."""
    part = PARTS[params.part]
    columns = dict.fromkeys(("case", "ok", "outcome", *part.columns))

    def measure() -> tuple[Rows, dict[str, Any]]:
        cases = part.cases(params.seed, params.full)
        rows = collect((columns | run_case() for run_case in cases), len(cases), progress)
        return rows, {
            "cases": len(rows),
            "ok": sum(row["ok"] for row in rows),
            "refused": sum(row["outcome"].startswith("refused") for row in rows),
            "not_ok": ", ".join(row["case"] for row in rows if not row["ok"]) or None,
            part.overall: part.combine([row[part.overall] for row in rows if row[part.overall] is not None] or [0]),
        }

    return report(job, "evaluate stability", METHOD, recipe_of(params), [], measure, force=force, simulated_source=True)
