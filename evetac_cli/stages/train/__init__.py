"""train: slip detectors from labelled features (paper, "Model Training & Data Selection").

Checkpoint and threshold are chosen on validation trajectories (paper, "Evaluation Procedure & Metrics"), which are
never used for training: those given by --validate, or every 8th input. With --folds they are chosen on held-out
objects, by networks that are trained only for this purpose. --adapt continues from a trained model.

On the same trajectories, probabilities are calibrated, and the threshold is chosen by the rate of false alarms, except
with preset paper (validating.py). So the validation trajectories should include trials without slip.

An interrupted run leaves `NAME.model.RECIPE.part` for each network, and so does one that was refused at its end because
another has made the output. The same command continues from there, with the same result as without the interruption.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.parameter import recipe_of
from evetac_cli.commands.train import LEAST_MINUTES, Train
from evetac_cli.errors import InputError, made_by
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.calibration import grid
from evetac_cli.kernels.slip.architectures import (
    LEAST_COLUMNS,
    LEAST_ROWS,
    Architecture,
    DotArchitecture,
    MemoryArchitecture,
    PluginLayers,
    last_layer,
    with_scaled_logit,
)
from evetac_cli.resources import model_file
from evetac_cli.sim.setup.plan import numbers
from evetac_cli.stages import output_in
from evetac_cli.stages.model_files import (
    TRUE_SLIP_SHARE,
    USELESS_HINT,
    learned_true_slip_share,
    read_calibration,
    read_weights,
    why_useless,
)
from evetac_cli.stages.related_files import check_disjoint, check_same, make_folds, named_files, object_name
from evetac_cli.stages.train import validating
from evetac_cli.stages.train.plan import group_parameters, series_bytes
from evetac_cli.store.files import StageFile, header_of, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.layout.rules import named_architecture
from evetac_cli.store.recordings.onset import PERSON, abstains

if TYPE_CHECKING:  # torch takes more than a second to import, numba half of it
    from evetac_cli.stages.train.networks import TrainedFolds

OUTPUT = "model"
METHOD = 11
VALIDATE_EVERY = 8
FEWEST_VALIDATED_ON = 4  # trajectories; with fewer, a far too low threshold may score as well as a good one


class Settings(NamedTuple):
    """Settings of a training from the flags, from a model to adapt, or from defaults; part of the recipe."""

    model: str
    horizon_ms: int
    preset: str
    max_steps: int


USUAL = Settings("hist10", 0, "paper", max_steps=40000)
USUAL_MEMORY = USUAL._replace(preset="memory", max_steps=2000)
ADAPT_STEPS = 1000


@dataclass(frozen=True)
class TrainJob(Job):
    """One model to train with a seed on the first `learned` inputs; the others are for validation."""

    learned: int
    seed: int
    withheld: int  # inputs not trained on because --validate names them, too


@dataclass(frozen=True)
class NetworkJob(TrainJob):
    """One network of a model. It writes its final state (plan.state_file), from which the model is then made.

    Its output is only its name among the jobs: that of the state depends on the recipe, which needs all inputs.
    """

    number: int
    model: Path


def jobs(files: list[Path], params: Train, out: Path | None) -> list[TrainJob]:
    """Return a job for every seed, each with all features files."""
    validate = named_files(params.validate, "features", "--validate") if params.validate else []
    files, validate = _with_objects(files, params), _with_objects(validate, params)
    withheld = len(set(files) & set(validate))
    if not validate:
        validate = files[VALIDATE_EVERY - 1 :: VALIDATE_EVERY] or files[-1:]
    learn = [file for file in files if file not in validate]
    if not learn:
        for file in files:  # a missing file, or one of another kind, is the likelier cause
            header_of(file, "features")
        expected, found = "at least two features files", f"{len(files)}, all used for validation"
        raise InputError("no file is left to train on", expected=expected, found=found, hint=made_by("features"))
    settings, _ = _settings(params)
    trainings = []
    for seed in range(params.seed, params.seed + params.seeds):
        horizon_ms = f"-{settings.horizon_ms}ms" if settings.horizon_ms else ""
        number = f"-s{seed}" if params.seeds > 1 else ""
        output = output_in(out, learn[0].parent, f"{settings.model}{horizon_ms}{number}.model.h5")
        trainings.append(TrainJob((*learn, *validate), output, len(learn), seed, withheld))
    return trainings


def parts(job: TrainJob, params: Train) -> list[NetworkJob]:
    """Return the networks of a model, which can be trained at the same time; none for a single network."""
    return [
        NetworkJob(
            job.inputs,
            job.output.with_name(f"{job.output.name}.network{number + 1}"),
            job.learned,
            job.seed,
            job.withheld,
            number,
            job.output,
        )
        for number in range(params.folds + 1 if params.folds else 0)
    ]


def cautions(jobs: Sequence[TrainJob], params: Train) -> list[str]:
    """Return notes to print before a training, which may take long."""
    notes = {_few(len(job.inputs) - (0 if params.folds else job.learned)) for job in jobs}
    notes |= {
        f"{job.withheld} of the given files only validate, because --validate names them, too"
        for job in jobs
        if job.withheld
    }
    return sorted(notes - {""})


def for_people(rows: list[dict[str, Any]], params: Train) -> tuple[list[dict[str, Any]], list[str]]:
    """Return all rows, with notes on models that detect nothing and on unreliable thresholds."""
    useless = [f"{row['output']} is not a slip detector: {row['warning']}" for row in rows if row.get("warning")]
    useless += [f"`grasp` refuses it. Try: {USELESS_HINT}."] if useless else []
    few = {_few(row["validated_on"]) for row in rows if "validated_on" in row}
    few |= {_short(row["minutes_without_slip"]) for row in rows if row.get("calibrated")}
    return rows, [*useless, *sorted(few - {""})]


def _few(validated_on: int) -> str:
    """Return a note if a threshold is chosen on too few trajectories; otherwise an empty text."""
    if validated_on >= FEWEST_VALIDATED_ON:
        return ""
    count = f"{validated_on} trajector{'y' if validated_on == 1 else 'ies'}"
    return (
        f"checkpoint and threshold are chosen on {count}, which is too few: the model may fail on others; use at least"
        f" {FEWEST_VALIDATED_ON} trajectories, not used for training, with --validate"
    )


def _short(minutes: float) -> str:
    """Return a note if false alarms are counted in too short a time to choose a threshold; otherwise an empty text."""
    if minutes >= LEAST_MINUTES:
        return ""
    return (
        f"false alarms are counted in {minutes:.1f} minutes without slip, which is too short to measure their rate; add"
        f" at least {LEAST_MINUTES:g} minutes to --validate in which fingers open or push and nothing slips"
    )


def _with_objects(files: list[Path], params: Train) -> list[Path]:
    """Return the files of the objects given by `--object`, or all; InputError if there are none of these objects."""
    if not params.objects or not files:
        return files
    wanted = {str(number) for number in numbers(params.objects)}
    selected_files = [file for file in files if object_name(header_of(file, "features")) in wanted]
    if not selected_files:
        raise InputError("there are no features of these objects", where="--object", found=params.objects)
    return selected_files


class TrainedModel(NamedTuple):
    """A trained model to adapt, as read from its file."""

    path: Path
    header: Header
    dot_shape: tuple[int, int]
    weights: dict[str, NDArray[np.float32]]


def _settings(params: Train) -> tuple[Settings, TrainedModel | None]:
    """Return the settings of a training and the model given by --adapt, if any; InputError if they do not fit."""
    if not params.adapt:
        has_memory = isinstance(named_architecture(params.model or USUAL.model), MemoryArchitecture)
        usual, trained = USUAL_MEMORY if has_memory else USUAL, None
        if has_memory and params.preset is not None:
            message = f"cannot be combined with --model {params.model}, which has one recipe"
            raise InputError(message, where="--preset", expected="left out", found=params.preset)
    else:
        usual, trained = _to_adapt(model_file(params.adapt, flag="--adapt"))
        fixed: dict[str, Any] = {"preset": None, "folds": 0}
        fixed |= {name: getattr(usual, name) for name in ("model", "horizon_ms")}
        for name, value in fixed.items():
            if getattr(params, name) not in (value, None):
                flag, expected = f"--{name.replace('_', '-')}", f"{value}, as in the model" if value else "left out"
                raise InputError("cannot be combined with --adapt", where=flag, expected=expected)
    values = {name: getattr(params, name) for name in Settings._fields}
    return usual._replace(**{name: value for name, value in values.items() if value is not None}), trained


def _to_adapt(path: Path) -> tuple[Settings, TrainedModel]:
    """Return the default settings for adapting a model, and the model."""
    with StageFile(path, "model") as file:
        rows, columns = (int(size) for size in file.read("dot_shape"))
        architecture, horizon_ms = str(file.read("architecture")), int(file.read("horizon_ms"))
        weights = read_weights(file)
        if (calibration := read_calibration(file)) is not None:  # the calibration was not learned from balanced batches
            layer = last_layer(named_architecture(architecture), rows, columns)
            weights = with_scaled_logit(weights, layer, *calibration.inverse())
        settings = Settings(architecture, horizon_ms, "adapt", ADAPT_STEPS)
        return settings, TrainedModel(path, file.header, (rows, columns), weights)


class InputFacts(NamedTuple):
    """What a training needs to know of a features file before it reads the features."""

    header: Header
    dot_shape: tuple[int, int]
    memory_bytes: int  # for the features that the architecture needs
    knows_truth: bool  # whether it has the true slipping share
    slips: bool  # whether the object slips, as far as is known
    abstains: bool


def _inspect(paths: Sequence[Path], architecture: Architecture, progress: Progress) -> list[InputFacts]:
    inputs = []
    for number, path in enumerate(paths):
        progress(number, len(paths), "files inspected")
        with StageFile(path, "features") as file:
            rows, columns = file.read("dot_shape").tolist()
            slips = not file.has("onset_slice") or int(file.read("onset_slice")) >= 0
            memory_bytes, knows_truth = series_bytes(file, architecture), file.has(TRUE_SLIP_SHARE)
            inputs.append(InputFacts(file.header, (rows, columns), memory_bytes, knows_truth, slips, abstains(file)))
    return inputs


def _recipe(job: TrainJob, params: Train, inputs: Sequence[InputFacts]) -> Recipe:
    """Return the recipe.

    InputError if files to train on and to validate on have a recording in common, or if the true slipping share is to
    be learned and no file has it.
    """
    settings, adapted = _settings(params)
    adapted_from = [] if adapted is None else [adapted.header]
    headers = [each.header for each in inputs]
    learned_from = [*headers[: job.learned], *adapted_from]
    check_disjoint(learned_from, headers[job.learned :], "validated on", job.inputs[job.learned :])
    if params.learn_true_slip_share and not any(each.knows_truth for each in inputs[: job.learned]):
        hint = "evetac featurize --true-slip-share copies it from simulated recordings"
        raise InputError("no features file has the true slipping share", where="--learn-true-slip-share", hint=hint)
    parameters = {**recipe_of(params), **settings._asdict(), "seed": job.seed, "trained_on": job.learned}
    if params.false_alarms_per_min is not None:
        parameters["false_alarms_per_min"] = params.false_alarms_per_min
    parameters |= group_parameters([each.memory_bytes for each in inputs[: job.learned]])
    architecture = named_architecture(settings.model)
    if isinstance(architecture, PluginLayers):
        parameters["model_method"] = architecture.method
    return Recipe(OUTPUT, METHOD, parameters, seed=job.seed, parents=(*headers, *adapted_from))


def run(job: TrainJob, params: Train, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Train a model, choose checkpoint and threshold, and store weights and ONNX graphs."""
    settings, adapted = _settings(params)
    architecture = named_architecture(settings.model)
    inputs = _inspect(job.inputs, architecture, progress)
    recipe = _recipe(job, params, inputs)
    labels = _label_method(job.inputs[: job.learned], inputs)
    headers = [each.header for each in inputs]
    folds = make_folds(headers, job.learned, params.folds)
    simulated = recipe.simulated
    output = job.model if isinstance(job, NetworkJob) else job.output
    if up_to_date(output, recipe, force=force):
        if isinstance(job, NetworkJob):
            return outcome(job, made=False, simulated=simulated)
        return outcome(job, made=False, simulated=simulated, warning=_warning(output))

    progress(0, 0, "loading torch")
    from evetac_cli.stages.train.networks import Networks, prepare_torch

    prepare_torch(params.device)
    shape = _shape_of_all(job.inputs, inputs, architecture, adapted)
    start = None if adapted is None else adapted.weights
    networks = Networks(output, job.inputs, [each.memory_bytes for each in inputs], folds, recipe, shape, start)
    try:
        if isinstance(job, NetworkJob):
            networks.train(job.number, progress)
            return Outcome([], simulated)
        trained = networks.train_folds(headers, progress)
        validated = validating.Validated.of(trained.predictions, networks.preset, params.false_alarms_per_min)
        arrays = _arrays(architecture, shape, trained, validated)
    except ValueError as error:
        where = f"{job.inputs[0]} and {len(job.inputs) - 1} more"
        raise InputError(f"cannot be trained: {error}", where=where) from error
    arrays["horizon_ms"] = np.int64(settings.horizon_ms)
    arrays |= validated.arrays("objects left out in turn" if params.folds else "named or held back")
    made = write_stage(job.output, recipe, arrays, force=force) is not None
    networks.remove_states()
    return outcome(
        job,
        made=made,
        simulated=simulated,
        model=settings.model,
        preset=settings.preset,
        seed=job.seed,
        horizon_ms=settings.horizon_ms,
        labels=labels,
        learned_true_slip_share=_learned_truth(params, adapted) or None,
        trajectories=job.learned,
        abstained=sum(each.abstains for each in inputs),
        validated_on=sum(len(fold.evaluated_on) for fold in folds),
        folds=params.folds,
        **trained.figures(),
        **validated.figures(),
        warning=_warning(job.output),
    )


def _shape_of_all(
    paths: Sequence[Path], inputs: Sequence[InputFacts], architecture: Architecture, adapted: TrainedModel | None
) -> tuple[int, int]:
    """Return rows and columns of the dots; InputError if they differ, or do not fit the network or model to adapt."""
    check_same("dot grids", [grid.in_words(*each.dot_shape) for each in inputs], paths)
    shape = inputs[0].dot_shape
    found = grid.in_words(*shape)
    if adapted is not None and adapted.dot_shape != shape:
        of_model = grid.in_words(*adapted.dot_shape)
        raise InputError("the model is for another dot grid", where=str(adapted.path), expected=found, found=of_model)
    if isinstance(architecture, DotArchitecture) and (shape[0] < LEAST_ROWS or shape[1] < LEAST_COLUMNS):
        expected = f"at least {LEAST_ROWS} rows and {LEAST_COLUMNS} columns"
        message, hint = "this network needs a grid of dots", "--model no-hist-img-6x6 uses events"
        raise InputError(message, where=str(paths[0]), expected=expected, found=found, hint=hint)
    return shape


def _arrays(
    architecture: Architecture, shape: tuple[int, int], trained: "TrainedFolds", validated: validating.Validated
) -> dict[str, Any]:
    """Return the datasets of the model, calibrated, but for those on its validation alone."""
    from evetac_cli.kernels.slip import onnx_graphs

    choice, layer = validated.choice, last_layer(architecture, *shape)
    calibrated = [
        checkpoint.weights if each is None else with_scaled_logit(checkpoint.weights, layer, *each)
        for checkpoint, each in zip(trained.checkpoints, validated.calibrations, strict=True)
    ]
    graphs = [np.frombuffer(onnx_graphs.build(architecture, weights, *shape), np.uint8) for weights in calibrated]
    return {
        **{f"weights/{name}": value for name, value in calibrated[choice.checkpoint].items()},
        "onnx": graphs[choice.checkpoint],
        "architecture": architecture.name,
        "history": np.int64(architecture.history),
        "dot_shape": np.array(shape, np.int32),
        "threshold": np.float64(choice.threshold),
        "validation/detected_share": np.float64(choice.detected_share),
        "validation/slip_share": np.float64(choice.slip_share),
        "curve/step": trained.network.curve_step,
        "curve/loss": trained.network.curve_loss,
        "checkpoint/step": np.array([checkpoint.step for checkpoint in trained.checkpoints], np.int64),
        "checkpoint/score": choice.scores,
        "checkpoint/threshold": choice.thresholds,
        "checkpoint/chosen": np.int64(choice.checkpoint),
        "checkpoint/onnx": np.stack(graphs),
    }


def _learned_truth(params: Train, adapted: TrainedModel | None) -> bool:
    """Whether the model, or the model from which it was adapted, learned the true slipping share of the contact."""
    return params.learn_true_slip_share or (adapted is not None and learned_true_slip_share(adapted.header))


def _warning(model: Path) -> str | None:
    """Return the reason why a model detects nothing; None if it does detect slip."""
    with StageFile(model, "model") as file:
        return why_useless(file) or None


def _label_method(learn: Sequence[Path], inputs: Sequence[InputFacts]) -> str:
    """Return the methods that labelled the training files, also `truth`; InputError if the methods differ.

    Files without slip may be labelled by another method, since no onset depends on it. Manual labels may be combined
    with those of any method, which they correct, but not with copies of the truth.
    """
    methods: dict[str, Path] = {}
    for path, facts in zip(learn, inputs, strict=False):
        for ancestor in facts.header["history"].values():
            if facts.slips and ancestor["kind"] == "labels":
                methods.setdefault(str(ancestor["parameters"].get("method", "farneback")), path)
    if len(methods) > 1 and (len(methods.keys() - {PERSON}) > 1 or "truth" in methods):
        (first, path), (other, elsewhere) = list(methods.items())[:2]
        message, expected = "the files to train on are labelled by different methods", f"{first}, as in {path}"
        raise InputError(message, where=str(elsewhere), expected=expected, found=other)
    return ", ".join(sorted(methods)) or "none"


STAGE = Stage(jobs, run, cautions=cautions, parts=parts, for_people=for_people)
