"""evaluate stability: whether a part stays within stated bounds in stiff and extreme cases.

Every part is a function `(seed, full) -> cases`. A case is a function that runs it and returns its rows: one per
measured quantity, with the bound and its reason (cases.py). Cases that are refused with an error message are counted
separately from cases that were measured and are within their bounds.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import EvetacError, attach_outcome
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each
from evetac_cli.evaluate.stability import EvaluateStability, grasp, tracker
from evetac_cli.evaluate.stability import simulator as simulator_stability
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent

METHOD = 5


class StabilityPart(NamedTuple):
    """The cases of a part, and the column by which they are counted."""

    cases: Callable[[int, bool], Sequence[Callable[[], Rows]]]
    counted_by: str


PARTS: dict[str, StabilityPart] = {
    "sim": StabilityPart(simulator_stability.cases, "part"),
    "track": StabilityPart(tracker.cases, "preset"),
    "grasp": StabilityPart(grasp.cases, "controller"),
}


def jobs(files: list[Path], params: EvaluateStability, out: Path | None) -> list[Job]:
    """Return the job of the report on the part: `<part>.stability.report.h5`, by default in the working folder."""
    return report_job([], "stability", out, name=params.part)


def run(job: Job, params: EvaluateStability, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return the rows of all cases, failed ones first, because a terminal shows at most a hundred.

    With --strict, raise EvetacError if a case is not ok; the report is written anyway.
    """
    part = PARTS[params.part]

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows = [row for run_case in each(part.cases(params.seed, params.full), progress) for row in run_case()]
        return sorted(rows, key=lambda row: bool(row["ok"])), summary(rows, part)

    outcome = report(
        job, "evaluate stability", METHOD, recipe_of(params), [], measure, force=force, simulated_source=True
    )
    failed = outcome.summary["cases_not_ok"]
    if params.strict and failed:
        counted = f"{failed} of {outcome.summary['measured']} not ok"
        error = EvetacError(
            "some cases are outside their bounds", where=params.part, expected="all cases ok", found=counted
        )
        raise attach_outcome(error, outcome)
    return outcome


def for_people(rows: Rows, params: EvaluateStability) -> tuple[Rows, list[str]]:
    """Return the rows that are not ok, or all if all are; and the numbers of failed and refused cases."""
    refused = len({_case(row, PARTS[params.part]) for row in rows if _is_refused(row)})
    apart = f" {refused} cases are refused with an error message." if refused else ""
    failed = [row for row in rows if not row["ok"]]
    if failed:
        cases = len({row["case"] for row in failed})
        return failed, [f"Outside their bounds: {cases} cases; --json also prints those that are ok.{apart}"]
    return rows, [f"All measured cases are within their bounds.{apart}"]


def summary(rows: Rows, part: StabilityPart) -> dict[str, Any]:
    """Return the numbers of cases, refused, measured and not ok, also by a column, and the names of failed cases.

    A case is ok if all its rows are. A refused case is not measured: there is no result that could be within a bound.
    """
    ok: dict[tuple[str, str], bool] = {}
    for row in rows:
        key = _case(row, part)
        ok[key] = ok.get(key, True) and row["ok"]
    refused = {_case(row, part) for row in rows if _is_refused(row)}
    counts = []
    for group in dict.fromkeys(group for group, _ in ok):
        own = {key: good for key, good in ok.items() if key[0] == group}
        in_words = len(own.keys() & refused)
        apart = f" ({in_words} refused)" if in_words else ""
        counts.append(f"{group} {sum(not good for good in own.values())} of {len(own) - in_words}{apart}")
    return {
        "cases": len(ok),
        "refused": len(refused),
        "measured": len(ok) - len(refused),
        "cases_not_ok": sum(not good for good in ok.values()),
        f"not_ok_by_{part.counted_by}": ", ".join(counts),
        "not_ok": "; ".join(f"{group}: {case}" for (group, case), good in ok.items() if not good) or None,
    }


def _case(row: Row, part: StabilityPart) -> tuple[str, str]:
    return row[part.counted_by], row["case"]


def _is_refused(row: Row) -> bool:
    """Whether a case was refused with a message; a refusal without a message is a failure."""
    return bool(row["ok"]) and str(row["outcome"]).startswith("refused")


STAGE = Stage(jobs, run, for_people=for_people)
