"""evaluate stability: whether a part stays within stated bounds where it is stiff, extreme, or given nonsense.

Every part is a function `(seed, full) -> cases`, in which a case is a function that runs it and returns its rows: one
for each quantity that is measured of it, with the bound and the reason for it (bounds.py).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.commands.evaluate import EvaluateStability
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import EvetacError, attach_outcome
from evetac_cli.evaluate import own_report, report
from evetac_cli.evaluate.stability import grasp, tracker
from evetac_cli.evaluate.stability import simulator as simulator_stability
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent

OUTPUT = "report"
METHOD = 2


class StabilityPart(NamedTuple):
    """How a part is tried, and the column by which its cases are counted."""

    cases: Callable[[int, bool], Sequence[Callable[[], Rows]]]
    counted_by: str


PARTS: dict[str, StabilityPart] = {
    "sim": StabilityPart(simulator_stability.cases, "part"),
    "track": StabilityPart(tracker.cases, "preset"),
    "grasp": StabilityPart(grasp.cases, "controller"),
}


def jobs(files: list[Path], params: EvaluateStability, out: Path | None) -> list[Job]:
    """One report on the part: `<part>.stability.report.h5`, in the present folder if no other is given."""
    return [Job((), own_report(params.part, "stability", out))]


def run(job: Job, params: EvaluateStability, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """The rows of all cases, those that are not ok first, because a terminal shows no more than a hundred.

    EvetacError, with --strict, where a case is not ok; the report is made all the same.
    """
    part = PARTS[params.part]

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows: Rows = []
        cases = part.cases(params.seed, params.full)
        for number, run_case in enumerate(cases, start=1):
            rows += run_case()
            progress(number, len(cases))
        return sorted(rows, key=lambda row: bool(row["ok"])), summary(rows, part.counted_by)

    made = report(job, "evaluate stability", METHOD, recipe_of(params), [], measure, force=force, simulated_source=True)
    failed = made.summary["cases_not_ok"]
    if params.strict and failed:
        counted = f"{failed} of {made.summary['cases']} that are not ok"
        error = EvetacError("cases outside their bounds", where=params.part, expected="all cases ok", found=counted)
        raise attach_outcome(error, made)
    return made


def for_people(rows: Rows, params: EvaluateStability) -> tuple[Rows, list[str]]:
    """The rows that are not ok, or all where all are; and how many cases that is."""
    failed = [row for row in rows if not row["ok"]]
    if failed:
        cases = len({row["case"] for row in failed})
        return failed, [f"Outside their bounds: {cases} cases; --json prints those that are ok, too."]
    return rows, ["All cases are within their bounds, or refused in words."]


def summary(rows: Rows, counted_by: str) -> dict[str, Any]:
    """How many cases there are, refused and not ok, by a column too, and the names of all that are not ok.

    A case is ok where all its rows are.
    """
    ok: dict[tuple[str, str], bool] = {}
    for row in rows:
        key = (row[counted_by], row["case"])
        ok[key] = ok.get(key, True) and row["ok"]
    groups = {group: [good for (of, _), good in ok.items() if of == group] for group, _ in ok}
    counts = [f"{group} {len(cases) - sum(cases)} of {len(cases)}" for group, cases in groups.items()]
    refused = {(row[counted_by], row["case"]) for row in rows if row["outcome"].startswith("refused")}
    return {
        "cases": len(ok),
        "refused": len(refused),
        "cases_not_ok": sum(not good for good in ok.values()),
        f"not_ok_by_{counted_by}": ", ".join(counts),
        "not_ok": "; ".join(f"{group}: {case}" for (group, case), good in ok.items() if not good) or None,
    }


STAGE = Stage(jobs, run, for_people=for_people)
