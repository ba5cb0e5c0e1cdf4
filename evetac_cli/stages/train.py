"""train: slip detectors from labelled features (paper, "Model Training & Data Selection").

Checkpoint and threshold are chosen on validation trajectories (paper, "Evaluation Procedure & Metrics"), which are
never trained on: those named by --validate, or every 8th of the inputs.

A run that was interrupted leaves `NAME.model.part`, a numpy archive of at most half a minute ago, from which the same
command goes on to the same result.
"""

import glob
import time
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels import features, inputs, sampling, slip
from evetac_cli.kernels.detector import Detector
from evetac_cli.kernels.inputs import Trajectory
from evetac_cli.kernels.sampling import Samples
from evetac_cli.params import Train, recipe_of
from evetac_cli.sim import scene
from evetac_cli.stages import Job, Outcome, Progress, one_file, outcome, silent
from evetac_cli.store.disk import taking_the_place_of
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Header, Recipe

if TYPE_CHECKING:  # torch takes more than a second to import
    from evetac_cli.kernels.training import Kept, Training

INPUTS = ("features",)
OUTPUT = "model"
METHOD = 3
VALIDATE_EVERY = 8
KEEP_S = 30.0  # at most so much work is lost when a run is interrupted


def jobs(files: list[Path], params: Train, out: Path | None) -> list[Job]:
    """One model for every seed, each from all features files together."""
    pattern = params.validate if not Path(params.validate).is_dir() else f"{params.validate}/*.{INPUTS[0]}.h5"
    validate = [Path(name) for name in sorted(glob.glob(pattern))] if params.validate else []
    if params.validate and not validate:
        raise InputError("no features there", where="--validate", found=params.validate)
    files, validate = _of_objects(files, params), _of_objects(validate, params)
    if not validate:
        validate = files[VALIDATE_EVERY - 1 :: VALIDATE_EVERY] or files[-1:]
    learn = [file for file in files if file not in validate]
    if not learn:
        raise InputError(
            "nothing is left to train on", expected="at least two features files", found=f"{len(files)}, all validate"
        )
    one_file(range(params.seeds), out)
    found = []
    for seed in range(params.seed, params.seed + params.seeds):
        ahead = f"-{params.ahead}ms" if params.ahead else ""
        number = f"-s{seed}" if params.seeds > 1 else ""
        name = f"{params.model}{ahead}{number}.model.h5"
        output = out if out is not None and out.suffix == ".h5" else (out or learn[0].parent) / name
        found.append(Job((*learn, *validate), output, {"learn": len(learn), "seed": seed}))
    return found


def _of_objects(files: list[Path], params: Train) -> list[Path]:
    """The files of the objects that are wanted; InputError if there is none of them."""
    if not params.objects or not files:
        return files
    wanted = {str(number) for number in scene.numbers(params.objects)}
    found = [file for file in files if object_of(_header(file)) in wanted]
    if not found:
        raise InputError("no features of these objects", where="--object", found=params.objects)
    return found


def run(job: Job, params: Train, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Train, choose checkpoint and threshold, store weights and ONNX graphs."""
    headers = [_header(path) for path in job.inputs]
    learn, seed = job.choice["learn"], job.choice["seed"]
    check_disjoint(headers[:learn], headers[learn:], "validated on", job.inputs[learn:])
    labels = _label_method(job.inputs[:learn], headers[:learn])
    parameters = {**recipe_of(params), "seed": seed, "trained_on": learn}
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=seed, parents=tuple(headers))
    simulated = any(header["simulated"] for header in headers)
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=simulated)

    import torch

    from evetac_cli.kernels import networks

    if params.device == "cuda" and not torch.cuda.is_available():
        raise InputError("torch finds no GPU", where="--device", expected="cpu", found=params.device)
    torch.set_num_threads(1)  # these networks are too small to share, and one thread gives one result
    shape = _common_shape(job.inputs)
    architecture = slip.ARCHITECTURES[params.model]
    try:
        learned = (read_trajectory(path, architecture) for path in job.inputs[:learn])
        samples = sampling.gather(learned, architecture, *shape, params.ahead)
        result, resumed = _train(job, params, recipe, samples, progress)
        kept = result.checkpoints[-slip.LAST_CHECKPOINTS :]
        graphs = [networks.onnx_graph(networks.from_weights(architecture, one.weights, *shape)) for one in kept]
        detectors = [Detector(graph, architecture) for graph in graphs]
        predictions: list[list[slip.Prediction]] = [[] for _ in detectors]
        for path, header in zip(job.inputs[learn:], headers[learn:], strict=True):
            trajectory = read_trajectory(path, architecture)
            for detector, found in zip(detectors, predictions, strict=True):
                found.append(predict(detector, trajectory, header, params.ahead))
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
        "ahead_ms": np.int64(params.ahead),
        "dot_shape": np.array(shape, np.int32),
        "threshold": np.float64(choice.threshold),
        "curve/step": result.curve_step,
        "curve/loss": result.curve_loss,
        "checkpoint/step": np.array([checkpoint.step for checkpoint in kept], np.int64),
        "checkpoint/score": choice.scores,
        "checkpoint/threshold": choice.thresholds,
        "checkpoint/chosen": np.int64(choice.checkpoint),
        "checkpoint/onnx": np.stack([np.frombuffer(graph, np.uint8) for graph in graphs]),
    }
    write_stage(job.output, recipe, arrays)
    _part(job).unlink(missing_ok=True)
    return outcome(
        job,
        made=True,
        simulated=simulated,
        model=params.model,
        recipe=params.recipe,
        seed=seed,
        ahead_ms=params.ahead,
        labels=labels,
        trajectories=learn,
        validated_on=len(job.inputs) - learn,
        steps=result.steps,
        steps_of_all_epochs=result.steps_planned,
        cut=result.cut,
        resumed_at_step=resumed,
        loss=float(result.curve_loss[-1]),
        threshold=choice.threshold,
        validation_score=choice.score,
    )


def _train(
    job: Job, params: Train, recipe: Recipe, samples: Samples, progress: Progress
) -> tuple["Training", int | None]:
    """Train from the beginning or from where an interrupted run was kept; says at which step that was."""
    from evetac_cli.kernels import training

    part = _part(job)
    kept = _read_part(part, recipe)
    written = time.monotonic()

    def keep(state: Callable[[], "Kept"]) -> None:
        nonlocal written
        if time.monotonic() - written >= KEEP_S:
            _write_part(part, recipe, state())
            written = time.monotonic()

    result = training.train(
        samples,
        training.RECIPES[params.recipe],
        np.random.default_rng(job.choice["seed"]),
        epochs=params.epochs,
        max_steps=params.max_steps,
        on_progress=lambda step, steps, loss: progress(step, steps),
        device=params.device,
        kept=kept,
        on_keep=keep,
    )
    return result, None if kept is None else int(kept["step"])


def _part(job: Job) -> Path:
    """Where an interrupted run is kept: NAME.model.part beside NAME.model.h5."""
    return job.output.with_name(job.output.name.removesuffix(".h5") + ".part")


def _read_part(path: Path, recipe: Recipe) -> "Kept | None":
    """A kept run of this recipe; None where there is none, or one of another recipe, or a damaged one."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    return arrays if str(arrays.pop("recipe", "")) == recipe.id else None


def _write_part(path: Path, recipe: Recipe, kept: "Kept") -> None:
    """Keep a run, all or nothing."""
    with taking_the_place_of(path) as temporary, temporary.open("wb") as file:
        np.savez(file, recipe=np.array(recipe.id), **kept)  # type: ignore[arg-type]


def read_trajectory(path: Path, architecture: slip.Architecture) -> Trajectory:
    """What an architecture sees of a labelled features file, and its labels."""
    with StageFile(path, "features") as file:
        if not file.has("label"):
            raise InputError(
                "these features have no labels", where=str(path), hint="evetac label, then evetac featurize"
            )
        return Trajectory(
            series_of(file, architecture),
            file.read("events_outside"),
            file.read("label"),
            int(file.read("onset_slice")),
        )


def series_of(
    file: StageFile, architecture: slip.Architecture, start: int = 0, stop: int | None = None
) -> inputs.Series:
    """What an architecture sees of the slices [start, stop) of a features file; InputError if it is not there."""
    if isinstance(architecture, slip.ImageArchitecture):
        if not file.has("image"):
            raise InputError(
                f"{architecture.name} sees event images, and these features have none",
                where=str(file.path),
                hint="evetac featurize --images",
            )
        begin = file.read("image/start", start, None if stop is None else stop + 1)
        pixels = (file.read(f"image/{name}", int(begin[0]), int(begin[-1])) for name in ("pixel", "sign"))
        return features.EventImages(begin - begin[0], *pixels)
    across = None
    if {"x", "y"} & {view.channel for view in architecture.views}:
        if not file.has("displacement_xy_px"):
            raise InputError(
                f"{architecture.name} sees displacements with their direction, and these features have none",
                where=str(file.path),
                hint="they were made by an older evetac; evetac featurize --force",
            )
        across = file.read("displacement_xy_px", start, stop)
    return features.series(file.read("displacement_px", start, stop), file.read("events_per_dot", start, stop), across)


def predict(detector: Detector, trajectory: Trajectory, header: Header, ahead_ms: int) -> slip.Prediction:
    """What a detector says of a trajectory, beside its labels, from the first slice that is labelled.

    The labels are shifted by `ahead_ms`, as F1 is counted; the onset is not, as the timing is judged.
    """
    probability = detector.over(trajectory.series)
    examined = np.flatnonzero(trajectory.label >= 0)
    probability[: examined[0] if len(examined) else len(probability)] = np.nan
    label = slip.shift(trajectory.label, ahead_ms)
    return slip.Prediction(probability, label, trajectory.onset, object_of(header))


def ahead_of(model: StageFile) -> int:
    """How far ahead a model predicts slip, in ms."""
    return int(model.read("ahead_ms")) if model.has("ahead_ms") else 0


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


def check_disjoint(learn: list[Header], held_out: list[Header], what: str, paths: Sequence[Path]) -> None:
    """Refuse to judge a model on a recording that it was trained on; `paths` are the files held out."""
    seen = set().union(*(recordings_of(header) for header in learn))
    shared = [
        (path, common) for path, header in zip(paths, held_out, strict=True) if (common := recordings_of(header) & seen)
    ]
    if shared:
        path, common = shared[0]
        raise InputError(
            f"a recording is both trained on and {what}",
            where=str(path),
            found=f"{len(shared)} such files, this one from the recording {min(common)[:12]}",
            hint="split by trajectory: every recording belongs to one side",
        )


def _label_method(paths: tuple[Path, ...], headers: list[Header]) -> str:
    """How the onset of slip was found in the training files, `truth` among them; one way for all."""
    found: dict[str, Path] = {}
    for path, header in zip(paths, headers, strict=True):
        for ancestor in header["history"].values():
            if ancestor["kind"] == "labels":
                found.setdefault(str(ancestor["parameters"].get("method", "farneback")), path)
    if len(found) > 1:
        (first, path), (other, elsewhere) = list(found.items())[:2]
        raise InputError(
            "the files to train on are labelled in different ways",
            where=str(elsewhere),
            expected=f"{first} as in {path}",
            found=other,
        )
    return next(iter(found), "none")


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
