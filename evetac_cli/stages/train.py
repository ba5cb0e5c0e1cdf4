"""train: a slip detector from labelled features (paper, "Model Training & Data Selection").

Checkpoint and threshold are chosen on validation trajectories (paper, "Evaluation Procedure & Metrics"), which are
never trained on: those named by --validate, or every 8th of the inputs.
"""

import glob
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels import slip
from evetac_cli.kernels.detector import Detector
from evetac_cli.params import Train, recipe_of
from evetac_cli.stages import Job, Outcome, Progress, outcome, silent
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Header, Recipe

INPUTS = ("features",)
OUTPUT = "model"
METHOD = 1
VALIDATE_EVERY = 8


def jobs(files: list[Path], params: Train, out: Path | None) -> list[Job]:
    """One model from all features files together."""
    pattern = params.validate if not Path(params.validate).is_dir() else f"{params.validate}/*.{INPUTS[0]}.h5"
    validate = [Path(name) for name in sorted(glob.glob(pattern))] if params.validate else []
    if params.validate and not validate:
        raise InputError("no features there", where="--validate", found=params.validate)
    if not params.validate:
        validate = files[VALIDATE_EVERY - 1 :: VALIDATE_EVERY] or files[-1:]
    learn = [file for file in files if file not in validate]
    if not learn:
        raise InputError(
            "nothing is left to train on", expected="at least two features files", found=f"{len(files)}, all validate"
        )
    name = f"{params.model}.model.h5"
    output = out if out is not None and out.suffix == ".h5" else (out or learn[0].parent) / name
    return [Job((*learn, *validate), output, {"learn": len(learn)})]


def run(job: Job, params: Train, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Train, choose checkpoint and threshold, store weights and ONNX graph."""
    headers = [_header(path) for path in job.inputs]
    learn = job.choice["learn"]
    check_disjoint(headers[:learn], headers[learn:], "validated on")
    parameters = {**recipe_of(params), "trained_on": learn}
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=tuple(headers))
    simulated = any(header["simulated"] for header in headers)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=simulated)

    import torch

    from evetac_cli.kernels import networks, training

    torch.set_num_threads(1)  # these networks are too small to share, and one thread gives one result
    shape = _common_shape(job.inputs)
    trajectories = [read_trajectory(path) for path in job.inputs]
    architecture = slip.ARCHITECTURES[params.model]
    try:
        samples = training.gather(trajectories[:learn], architecture, *shape)
        result = training.train(
            samples,
            training.RECIPES[params.recipe],
            np.random.default_rng(params.seed),
            epochs=params.epochs,
            max_steps=params.max_steps,
            on_progress=lambda step, steps, loss: progress(step, steps),
        )
        kept = result.checkpoints[-slip.LAST_CHECKPOINTS :]
        graphs = [networks.onnx_graph(networks.from_weights(architecture, one.weights, *shape)) for one in kept]
        predictions = [
            [
                predict(detector, trajectory, header)
                for trajectory, header in zip(trajectories[learn:], headers[learn:], strict=True)
            ]
            for detector in (Detector(graph, architecture) for graph in graphs)
        ]
        choice = slip.choose_threshold(predictions)
    except ValueError as error:
        raise InputError(
            f"cannot be trained: {error}", where=f"{job.inputs[0]} and {len(job.inputs) - 1} more"
        ) from error
    arrays: dict[str, Any] = {
        **{f"weights/{name}": value for name, value in kept[choice.checkpoint].weights.items()},
        "onnx": np.frombuffer(graphs[choice.checkpoint], np.uint8),
        "architecture": architecture.name,
        "history": np.int64(architecture.history),
        "dot_shape": np.array(shape, np.int32),
        "threshold": np.float64(choice.threshold),
        "curve/step": result.curve_step,
        "curve/loss": result.curve_loss,
        "checkpoint/step": np.array([checkpoint.step for checkpoint in kept], np.int64),
        "checkpoint/score": choice.scores,
        "checkpoint/threshold": choice.thresholds,
        "checkpoint/chosen": np.int64(choice.checkpoint),
    }
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=simulated,
        recipe=params.recipe,
        trajectories=learn,
        validated_on=len(job.inputs) - learn,
        steps=result.steps,
        steps_of_all_epochs=result.steps_planned,
        loss=float(result.curve_loss[-1]),
        threshold=choice.threshold,
        validation_score=choice.score,
    )


def read_trajectory(path: Path) -> slip.Trajectory:
    """The arrays of a labelled features file."""
    with StageFile(path, "features") as file:
        if not file.has("label"):
            raise InputError(
                "these features have no labels", where=str(path), hint="evetac label, then evetac featurize"
            )
        return slip.Trajectory(
            file.read("displacement_px"),
            file.read("events_per_dot"),
            file.read("events_outside"),
            file.read("label"),
            int(file.read("onset_slice")),
        )


def predict(detector: Detector, trajectory: slip.Trajectory, header: Header) -> slip.Prediction:
    """What a detector says of a trajectory, beside its labels, from the first slice that is labelled."""
    probability = detector.over(trajectory.displacement_px, trajectory.events_per_dot)
    examined = np.flatnonzero(trajectory.label >= 0)
    probability[: examined[0] if len(examined) else len(probability)] = np.nan
    return slip.Prediction(probability, trajectory.label, trajectory.onset, object_of(header))


def detector_of(model: StageFile) -> Detector:
    """The detector in a model file; InputError if its architecture is unknown or its graph damaged."""
    name = model.read("architecture")
    if name not in slip.ARCHITECTURES:
        known = ", ".join(slip.ARCHITECTURES)
        raise InputError("unknown architecture", where=str(model.path), expected=known, found=str(name))
    try:
        return Detector(model.read("onnx").tobytes(), slip.ARCHITECTURES[name])
    except ValueError as error:
        raise InputError(str(error), where=str(model.path), hint="the file is damaged; train it again") from error


def object_of(header: Header) -> str:
    """The object of the recording that a file descends from, or `unknown`."""
    for ancestor in (header, *header["history"].values()):
        if ancestor["kind"] == "recording" and "object" in ancestor["parameters"]:
            return str(ancestor["parameters"]["object"])
    return "unknown"


def recordings_of(header: Header) -> set[str]:
    """Ids of all recordings that a file descends from."""
    everybody = {header["id"]: header, **header["history"]}
    return {id_ for id_, ancestor in everybody.items() if ancestor["kind"] == "recording"}


def check_disjoint(learn: list[Header], held_out: list[Header], what: str) -> None:
    """Refuse to judge a model on a recording that it was trained on."""
    seen = set().union(*(recordings_of(header) for header in learn))
    shared = seen & set().union(*(recordings_of(header) for header in held_out))
    if shared:
        raise InputError(
            f"a recording is both trained on and {what}",
            found=f"{len(shared)} shared, the first has id {sorted(shared)[0][:12]}",
            hint="split by trajectory: every recording belongs to one side",
        )


def _header(path: Path) -> Header:
    with StageFile(path, "features") as file:
        return file.header


def _common_shape(paths: tuple[Path, ...]) -> tuple[int, int]:
    """Rows and columns of the dot grid, which all files must share."""
    shapes: dict[tuple[int, int], Path] = {}
    for path in paths:
        with StageFile(path, "features") as file:
            rows, columns = (int(size) for size in file.read("dot_shape"))
            shapes.setdefault((rows, columns), path)
    if len(shapes) > 1:
        (first, path), (other, elsewhere) = list(shapes.items())[:2]
        raise InputError(
            "the files have different dot grids",
            where=str(elsewhere),
            expected=f"{first[0]} x {first[1]} as in {path}",
            found=f"{other[0]} x {other[1]}",
        )
    return next(iter(shapes))
