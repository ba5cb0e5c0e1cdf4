"""evaluate slip: slip timing and F1 of models on trajectories they never saw (paper, "Evaluation Procedure & Metrics").

Several models are judged at once. Those that differ in their seed alone are one setting, and a setting's figures are
means over objects and seeds, as in the paper's bars: every object counts the same in every seed. Each model is judged
at its own threshold, which `train` chose on validation trajectories; slip that is predicted ahead of time is counted
against shifted labels in F1 and against the unshifted onset in the timing.

The rows are five tables, told apart by their columns: a setting's figures beside the paper's; how far before or after
the labels' onset it first felt slip; the same by object; by model; by trajectory.
"""

import glob
from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.params import EvaluateSlip, recipe_of
from evetac_cli.stages.evaluate import ModelsReportJob, Rows, picture, report, report_job, slip_picture
from evetac_cli.stages.evaluate.slip_models import Model, check, judge
from evetac_cli.stages.evaluate.slip_tables import tables
from evetac_cli.store.files import StageFile

INPUTS = ("features", "model")
OUTPUT = "report"
METHOD = 4


def jobs(files: list[Path], params: EvaluateSlip, out: Path | None) -> list[ModelsReportJob]:
    """One report over all features files and models."""
    features, models = sort_out(files, params.model)
    if not features:
        raise InputError("on which trajectories?", expected="labelled features that the models never saw")
    (job,) = report_job(features, "slip", out, *models)
    return [ModelsReportJob(job.inputs, job.output, len(models))]


def sort_out(files: list[Path], given: Path | None) -> tuple[list[Path], list[Path]]:
    """Tell models and all other files apart: `--model models/*.model.h5` puts all models but the first among the files.

    `given` is a model file, a folder of them, or a glob. A model that is given twice, even as two files, counts once.
    InputError without a model.
    """
    named: list[Path] = []
    if given is not None:
        pattern = str(given / "*.model.h5") if given.is_dir() else str(given)
        named = [Path(name) for name in sorted(glob.glob(pattern))] or [given]
    models: dict[str, Path] = {}
    others: list[Path] = []
    for path, kind in [*((path, "model") for path in named), *((path, None) for path in files)]:
        with StageFile(path, kind) as file:
            if file.kind == "model":
                models.setdefault(file.header["id"], path)
            else:
                others.append(path)
    if not models:
        raise InputError("which model?", where="--model", expected="model files, or their folder")
    return others, list(models.values())


def run(job: ModelsReportJob, params: EvaluateSlip, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Rows of settings, moments, objects, models and trajectories, and a picture of them."""
    split = len(job.inputs) - job.models
    paths = job.inputs[:split]
    models = [Model.read(path) for path in job.inputs[split:]]
    headers = check(models, paths)
    thresholds = [model.threshold if params.threshold is None else params.threshold for model in models]
    parameters: dict[str, Any] = {**recipe_of(params), "thresholds": thresholds}

    def measure() -> tuple[Rows, dict[str, Any]]:
        judged = judge(models, paths, headers, progress)
        return tables(models, thresholds, judged, paths)

    parents = [*(model.header for model in models), *headers]
    outcome = report(job, "evaluate slip", METHOD, parameters, parents, measure, force=force)
    size_in = slip_picture.size_in(outcome.rows)
    return picture.beside(outcome, job.output, lambda figure: slip_picture.draw(figure, outcome), size_in)
