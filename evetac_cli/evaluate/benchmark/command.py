"""evaluate benchmark: score evetac's methods, or a table of predictions made with anything, on evetac-bench."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from evetac_cli import resources
from evetac_cli.commands.parameter import flag_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.benchmark import EvaluateBenchmark, data_set, scores
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.store.layout.provenance import Header

METHOD = 3
OF_OWN = ("model", "threshold", "tracker", "shear_force", "force_model", "controller")


@dataclass(frozen=True)
class BenchmarkJob(Job):
    """One report on a benchmark's folder."""

    folder: Path


def jobs(files: list[Path], params: EvaluateBenchmark, out: Path | None) -> list[BenchmarkJob]:
    """Return the job of one report, `<folder>.benchmark.report.h5` in the working folder."""
    if len(files) != 1 or not files[0].is_dir():
        found = ", ".join(map(str, files))
        raise InputError("not a benchmark", where=found, expected="one folder", hint=data_set.MADE_BY)
    _check(params)
    (job,) = report_job([], "benchmark", out, name=files[0].resolve().name)
    return [BenchmarkJob((), job.output, files[0])]


def _check(params: EvaluateBenchmark) -> None:
    """Raise InputError for flags that contradict each other."""
    for item in fields(params):
        if params.predictions is not None and item.name in OF_OWN and getattr(params, item.name) != item.default:
            found = f"--predictions {params.predictions}"
            raise InputError("has no effect on predictions from tables", where=flag_of(item), found=found)
    with_file = params.shear_force in ("regression", "network")
    if with_file != (params.force_model is not None):
        expected = "with --shear-force regression or network, a file, else none"
        raise InputError("model and method do not fit", where="--force-model", expected=expected)


def run(job: BenchmarkJob, params: EvaluateBenchmark, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row for each task and split, and write the report.

    Predictions of evetac's methods are also written as tables, into NAME.files/predictions next to the report.
    """
    from evetac_cli.evaluate.benchmark import own_methods, predictions

    benchmark = data_set.read(job.folder)
    true = data_set.read_truth(benchmark)
    parameters: dict[str, Any] = {"benchmark": benchmark.digest, "size": benchmark.size}
    parents: list[Header] = []
    work = job.output.with_name(job.output.name.removesuffix(".h5").removesuffix(".report") + ".files")
    made, methods = predictions.Predictions(), None
    if params.predictions is not None:
        made = predictions.read(params.predictions, benchmark, true)
        parameters["tables"] = made.tables
    else:
        slip = None if str(params.model) == "none" else resources.model_file(params.model)
        methods = own_methods.methods_of(params.tracker, slip, params.threshold, params.shear_force, params.force_model)
        parameters |= {"methods": methods.for_recipe(), "threshold": params.threshold}
        parents = methods.parents()
    parameters["controller"] = params.controller
    chosen = _of_controller(params) if params.controller else {}
    lifts = own_methods.read_lifts(benchmark) if params.controller else None

    def measure() -> tuple[Rows, dict[str, Any]]:
        nonlocal made
        if methods is not None:
            made = own_methods.predict(benchmark, methods, work, progress)
            predictions.write(work / "predictions", made, true)
        played: Rows | None = None
        if lifts is not None:
            played = own_methods.play_lifts(benchmark, lifts, chosen, work / "lifts", progress)
        rows = scores.all_rows(benchmark, true, made, played)
        return rows, _summary(benchmark.size, rows)

    return report(job, "evaluate benchmark", METHOD, parameters, parents, measure, force=force, simulated_source=True)


def _of_controller(params: EvaluateBenchmark) -> Row:
    """Return the flags of `evetac grasp` for the closed loop; a law without a detector takes none."""
    from evetac_cli.commands.grasp import Grasp
    from evetac_cli.kernels.grip.control import uses_detector
    from evetac_cli.trials.grasp.settings import GraspSettings

    model = None if str(params.model) == "none" else params.model
    chosen: Row = {"controller": params.controller}
    if uses_detector(GraspSettings.of(Grasp(controller=params.controller, model=model)).law):
        chosen |= {"tracker": params.tracker, "model": model, "slip_threshold": params.threshold}
    return chosen


def _summary(size: str, rows: Rows) -> Row:
    """Return the score of each task over all splits; None for a task without predictions."""
    whole = {row["task"]: row["value"] for row in rows if row["split"] == scores.ALL}
    return {
        "benchmark": f"{data_set.NAME} {data_set.VERSION} {size}",
        **{task: whole.get(task) for task in scores.TASKS},
    }


SENTENCES = {
    "onset": "first detection from 50 ms before to 20 ms after slip: {value:.0%} ({low:.0%} to {high:.0%}) of {n}",
    "warning": "warned at least 10 ms ahead: {value:.0%} ({low:.0%} to {high:.0%}) of {n} slips, at {at}",
    "force": "mean absolute error of the shear force: {value:.3g} N ({low:.3g} to {high:.3g}) over {n} presses",
    "dots": "error of the dots, rms: {value:.3g} px ({low:.3g} to {high:.3g}) over {n} recordings",
    "grip": "held to the end with at most 3 times the force that just holds: {value:.0%} ({low:.0%} to {high:.0%})"
    " of {n} lifts",
}


def for_people(rows: Rows, params: EvaluateBenchmark) -> tuple[Rows, list[str]]:
    """Return the scores without the further columns, and a sentence for each task."""
    columns = ("task", "split", "value", "low", "high", "unit", "n", "left_out", "sensors", "objects")
    lines = []
    for row in rows:
        if row["split"] != scores.ALL:
            continue
        threshold = row.get("threshold")
        at = "no threshold with so few false alarms"
        if threshold is not None:
            at = f"threshold {threshold:.3g} with {row['false_per_min']:.2g} false alarms per minute"
        left_out = f"; {row['left_out']} recordings are left out: {row['left_out_because']}" * bool(row["left_out"])
        words = "unknown, n = 0" if row["value"] is None else SENTENCES[row["task"]].format(**row, at=at)
        lines.append(f"{row['task']}: {words}{left_out}.")
    missing = [task for task in scores.TASKS if task not in {row["task"] for row in rows}]
    if missing:
        lines.append(f"No figure, because nothing was predicted: {', '.join(missing)}.")
    lines.append("Intervals are 95 %, over sensors and objects; --json has further columns.")
    return [{name: row[name] for name in columns} for row in rows], lines


STAGE = Stage(jobs, run, for_people=for_people)
