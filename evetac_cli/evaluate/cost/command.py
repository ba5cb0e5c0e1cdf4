"""evaluate cost: error against run time of a part's numerical choices, as rows and as a plot next to the report.

Every part is a function `(params, inputs, progress) -> rows`. A row has `setting`, errors, `time_us_median` and
`time_us_p99`. Run times depend on the machine and its load, so the same recipe gives other figures elsewhere. An
existing report is kept: delete it to measure again.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import draw, size_in
from evetac_cli.evaluate.cost import EvaluateCost, grasp, models, tracker
from evetac_cli.evaluate.cost import simulator as simulator_cost
from evetac_cli.jobs import Job, Outcome, Progress, Rows, Stage, silent
from evetac_cli.store.files import header_of

METHOD = 7


class CostPart(NamedTuple):
    """How a part is measured; title, errors, plot if it has one; its input files, if any; whether it takes --trials.

    inputs: (files, --model) -> the files from which the report is made.
    """

    title: str
    errors: tuple[str, ...]
    measure: Callable[[EvaluateCost, Sequence[Path], Progress], Rows]
    summary: Callable[[Rows], dict[str, Any]] = lambda rows: {"rows": len(rows)}
    draw: Callable[[Any, Rows, Sequence[str]], None] | None = draw
    size_in: Callable[[Rows], tuple[float, float]] = size_in
    takes_trials: bool = True
    inputs: Callable[[list[Path], Path | None], tuple[Path, ...]] | None = None


PARTS: dict[str, CostPart] = {
    "sim": CostPart(
        "Simulated gel and camera: error against run time",
        simulator_cost.ERRORS,
        simulator_cost.measure,
    ),
    "track": CostPart(
        "Dot tracker: error against run time",
        ("error_px_rms", "error_px_worst"),
        tracker.measure,
        tracker.summary,
        takes_trials=False,
    ),
    "model": CostPart(
        "Slip detectors: error against the time of one inference",
        ("error_share_timing", "error_share_f1"),
        models.measure,
        models.summary,
        models.draw,
        models.size_in,
        takes_trials=False,
        inputs=models.inputs,
    ),
    "grasp": CostPart(
        "Grasps with a late detector, a slow controller, another detector",
        ("error_share_lost", "error_mm_moved"),
        grasp.measure,
        grasp.summary,
        draw=None,  # delays and detectors are no points on an axis of run time
        inputs=grasp.inputs,
    ),
}


def jobs(files: list[Path], params: EvaluateCost, out: Path | None) -> list[Job]:
    """Return the job of one report: next to its input files, else `<part>.cost.report.h5` in the working folder."""
    part = PARTS[params.part]
    if part.inputs is None and (files or params.model):
        expected = "files only with part model; --model only with part model or grasp"
        raise InputError("takes no files or models", where=f"evaluate cost {params.part}", expected=expected)
    if params.trials is not None and not part.takes_trials:
        taking = ", ".join(name for name, other in PARTS.items() if other.takes_trials)
        raise InputError("not of this part", where="--trials", expected=f"part {taking}", found=params.part)
    inputs = part.inputs(files, params.model) if part.inputs else ()
    beside = inputs[: bool(files)]
    return report_job([*beside], "cost", out, *inputs[len(beside) :], name="" if files else params.part)


def run(job: Job, params: EvaluateCost, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per setting; the plot is redrawn if it is missing."""
    part = PARTS[params.part]
    parents = [header_of(path) for path in job.inputs]  # of any kind: `measure` checks them
    simulated = not any(header["kind"] == "report" for header in parents)  # figures of a real report are real

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows = part.measure(params, job.inputs, progress)
        return rows, part.summary(rows)

    outcome = report(
        job, "evaluate cost", METHOD, recipe_of(params), parents, measure, force=force, simulated_source=simulated
    )

    if part.draw is None:
        return outcome
    draw_part = part.draw

    def draw(figure: Any) -> None:
        figure.suptitle(f"{part.title}{' (simulated)' if outcome.simulated else ''}")
        draw_part(figure, outcome.rows, part.errors)

    return picture.beside(outcome, job.output, draw, part.size_in(outcome.rows))


def for_people(rows: Rows, params: EvaluateCost) -> tuple[Rows, list[str]]:
    """Return all rows, and for each error the settings with the smallest error and with the shortest run time."""
    lines = []
    for error in PARTS[params.part].errors:
        measured = [row for row in rows if row.get(error) is not None and row.get("time_us_median") is not None]
        measured = [row for row in measured if not row["setting"].startswith("reference")]
        if measured:
            least = min(measured, key=lambda row: (row[error], row["time_us_median"]))
            fastest = min(measured, key=lambda row: (row["time_us_median"], row[error]))
            words = [
                f"{row['setting']}, {row[error]:.3g} in {row['time_us_median']:.4g} us" for row in (least, fastest)
            ]
            lines.append(f"{error}: smallest with {words[0]}; fastest with {words[1]}.")
    return rows, lines


STAGE = Stage(jobs, run, for_people=for_people)
