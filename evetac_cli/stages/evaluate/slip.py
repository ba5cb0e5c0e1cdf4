"""evaluate slip: slip timing and F1 of a model (paper, "Evaluation Procedure & Metrics")."""

from pathlib import Path
from typing import Any

from evetac_cli.errors import InputError
from evetac_cli.kernels import slip
from evetac_cli.params import EvaluateSlip, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, silent
from evetac_cli.stages.evaluate import Rows, report, report_job
from evetac_cli.stages.train import check_disjoint, detector_of, predict, read_trajectory
from evetac_cli.store.files import StageFile

INPUTS = ("features", "model")
OUTPUT = "report"
METHOD = 1


def jobs(files: list[Path], params: EvaluateSlip, out: Path | None) -> list[Job]:
    """One report over all features files."""
    if params.model is None:
        raise InputError("which model?", where="--model", expected="a model file")
    return report_job(files, "slip", out, params.model)


def run(job: Job, params: EvaluateSlip, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """A row for every trajectory and one for every object; figures over all in the summary."""
    *features_paths, model_path = job.inputs
    with StageFile(model_path, "model") as model:
        detector = detector_of(model)
        threshold = float(model.read("threshold")) if params.threshold is None else params.threshold
        dot_shape = model.read("dot_shape").tolist()
        model_header = model.header
    headers = []
    for path in features_paths:
        with StageFile(path, "features") as file:
            if not file.has("label"):
                raise InputError("these features have no labels", where=str(path), hint="evetac label, then featurize")
            if file.read("dot_shape").tolist() != dot_shape:
                raise InputError(
                    "another dot grid than the model's",
                    where=str(path),
                    expected=str(dot_shape),
                    found=str(file.read("dot_shape").tolist()),
                )
            headers.append(file.header)
    check_disjoint([model_header], headers, "evaluated on")
    parameters: dict[str, Any] = {**recipe_of(params), "threshold": threshold}

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows = []
        predictions = []
        for number, (path, header) in enumerate(zip(features_paths, headers, strict=True)):
            prediction = predict(detector, read_trajectory(path), header)
            first = slip.onset(prediction.detected(threshold))
            labelled = prediction.onset >= 0
            rows.append(
                {
                    "file": path.name,
                    "object": prediction.object,
                    "t_c_ms": prediction.onset if labelled else None,
                    "t_m_ms": first if first >= 0 else None,
                    "t_m_minus_t_c_ms": first - prediction.onset if labelled and first >= 0 else None,
                    "timing": slip.timing(first, prediction.onset) if labelled else None,
                    "f1": prediction.counts(threshold).f1,
                }
            )
            predictions.append(prediction)
            progress(number + 1, len(features_paths))
        return rows, slip.score(predictions, threshold)

    return report(job, "evaluate slip", METHOD, parameters, [model_header, *headers], measure, force=force)
