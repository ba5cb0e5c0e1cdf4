"""evaluate stability: what a part does where it is stiff, extreme, or handed nonsense; a row for every case."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Job, Outcome, Progress, silent
from evetac_cli.numerics import tracker_stability
from evetac_cli.numerics.simulator import gel_stability
from evetac_cli.params import EvaluateStability, recipe_of
from evetac_cli.stages.evaluate import Rows, own_report, report

OUTPUT = "report"
METHOD = 1


def jobs(files: list[Path], params: EvaluateStability, out: Path | None) -> list[Job]:
    """One report on the part: `<part>.stability.report.h5`, in the present folder if no other is given."""
    return [Job((), own_report(params.part, "stability", out))]


def run(job: Job, params: EvaluateStability, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every case; how many are ok in the summary."""

    def measure() -> tuple[Rows, dict[str, Any]]:
        cases = _suite(params.part)(params.seed, full=params.full)
        rows: Rows = []
        for case in cases:
            rows.append(case())
            progress(len(rows), len(cases))
        return rows, {
            "cases": len(rows),
            "ok": sum(row["ok"] for row in rows),
            "refused": sum(row["outcome"].startswith("refused") for row in rows),
            "not_ok": ", ".join(row["case"] for row in rows if not row["ok"]) or None,
            **_worst(rows),
        }

    return report(job, "evaluate stability", METHOD, recipe_of(params), [], measure, force=force, simulated_source=True)


def _suite(part: str) -> Callable[..., Sequence[Callable[[], dict[str, Any]]]]:
    """The cases of a part."""
    if part == "grasp":
        from evetac_cli.numerics import grasp_stability

        return grasp_stability.suite
    return tracker_stability.suite if part == "track" else gel_stability.suite


def _worst(rows: Rows) -> dict[str, Any]:
    """The largest residual of the mechanics, the dots that the tracker lost in all, or the largest current."""
    if "current_most_ma" in rows[0]:
        return {"current_most_ma": max(row["current_most_ma"] or 0.0 for row in rows)}
    if "dots_lost" in rows[0]:
        return {"dots_lost": sum(row["dots_lost"] or 0 for row in rows)}
    return {"residual_most": max(row["residual_most"] for row in rows if row["residual_most"] is not None)}
