"""train-force: force from the displacements of dots (paper, "Dot-based Shear Force Reconstruction").

This module has the paper's method; adapt_touch.py adapts touch maps to a user's sensor. The paper's method writes two
models to one file: a linear regression and the paper's network. The regression on the mean displacement is fitted to
all trajectories. The network is trained on all but the last, which is used to choose the best epoch. The target is the
reading of a force sensor: the true force of a simulated recording, with noise.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of, refuse_unused
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError, made_by
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.calibration.grid import in_words
from evetac_cli.kernels.force import models as forces
from evetac_cli.names import TouchOption
from evetac_cli.stages import output_in
from evetac_cli.stages.force import adapt_touch
from evetac_cli.stages.related_files import check_disjoint, check_same, recording_with_truth
from evetac_cli.stages.track_rgb import PRESET
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe

OUTPUT = "force-model"
METHOD = 1
SAMPLE_MS = 40  # samples are at the frames of a 25 Hz sensor, also for tracks from events
LAYERS = 3
OF_THE_PAPER = ("samples", "noise_n", "epochs", "seed")  # parameters of the paper's method


class ForceSamples(NamedTuple):
    """Samples of one trajectory, to train or evaluate a force model."""

    slice_: NDArray[np.int64]  # (samples,)
    moved_px: Floats  # (samples, dots, 2)
    force_n: Floats  # (samples, 2), with the noise of a force sensor


class ForceModel(NamedTuple):
    """The contents of a force-model file of the paper's method: both models, and the sensor for which they are."""

    sensor: str
    sensor_name: str
    dot_shape: tuple[int, int]
    regression: forces.Regression
    network: forces.Network


def _refuse_unused(params: TrainForce) -> None:
    """Raise InputError for an option that has no effect in this training."""
    has = {TouchOption.TOUCH if params.method == "touch" else TouchOption.PAPER}
    flags = f"--method {params.method}"
    if params.method == "touch":
        has |= set() if params.sensor is None else {TouchOption.SENSOR}
        flags += "" if params.sensor else ", no --sensor"
    refuse_unused(params, has, flags, never=[TouchOption.OF_NO_MODEL])


def jobs(files: list[Path], params: TrainForce, out: Path | None) -> list[Job]:
    """Return the job of one model from all tracks files: `shear.force-model.h5` or `own.force-model.h5`."""
    _refuse_unused(params)
    if params.method == "touch":
        return [adapt_touch.job(files, params, out)]
    if len(files) < 2:
        raise InputError("no file is left to hold out", expected="at least two tracks files", hint=made_by("tracks"))
    return [Job(tuple(files), output_in(out, files[0].parent, f"shear.{OUTPUT}.h5"))]


def run(job: Job, params: TrainForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Fit both models of the paper and store them as arrays, or adapt touch maps."""
    if params.method == "touch":
        return adapt_touch.run(job, params, force=force, progress=progress)
    headers, sensor = _inspect(job.inputs)
    parameters = {key: value for key, value in recipe_of(params).items() if key in OF_THE_PAPER}
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=tuple(headers))
    simulated = recipe.simulated
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=simulated)

    from evetac_cli.kernels.force import training as force_training  # brings torch

    noise, training = np.random.default_rng(params.seed).spawn(2)
    samples = [read_samples(path, params.samples, params.noise_n, noise) for path in job.inputs]
    moved_px = np.concatenate([one.moved_px for one in samples])
    force_n = np.concatenate([one.force_n for one in samples])
    learned, held_out = len(force_n) - len(samples[-1].force_n), (samples[-1].moved_px, samples[-1].force_n)
    try:
        regression = forces.fit_regression(moved_px, force_n)
        trained = force_training.train(
            moved_px[:learned], force_n[:learned], *held_out, training, params.epochs, progress
        )
    except ValueError as error:
        where = f"{job.inputs[0]} and {len(job.inputs) - 1} more"
        raise InputError(f"no force can be fitted: {error}", where=where) from error
    arrays: dict[str, Any] = {
        **sensor,
        "regression/slope_n_px": regression.slope_n_px,
        "regression/offset_n": regression.offset_n,
        "network/scale_px": np.float64(trained.network.scale_px),
        "network/scale_n": np.float64(trained.network.scale_n),
        "curve/learned_n": trained.learned_n,
        "curve/held_out_n": trained.held_out_n,
        "curve/chosen": np.int64(trained.best_epoch),
    }
    for number, layer in enumerate(trained.network.layers):
        arrays |= {f"network/{number}/weight": layer.weight, f"network/{number}/bias": layer.bias}
    made = write_stage(job.output, recipe, arrays, force=force) is not None
    return outcome(
        job,
        made=made,
        simulated=simulated,
        sensor=sensor["sensor"],
        sensor_name=sensor["sensor_name"],
        trajectories=len(job.inputs),
        samples=len(force_n),
        best_epoch=trained.best_epoch + 1,
        held_out_error_n_rms=float(trained.held_out_n[trained.best_epoch]),
    )


def _inspect(paths: Sequence[Path]) -> tuple[list[Header], dict[str, Any]]:
    """Return the headers of the tracks, and the datasets of the model on their sensor.

    InputError if sensors or dot grids differ, or if the file to hold out has a recording in common with the others.
    """
    headers, sensors, sensor_names, shapes = [], [], [], []
    for path in paths:
        with StageFile(path, "tracks") as tracks, recording_with_truth(tracks):
            headers.append(tracks.header)
            sensors.append(sensor_sort(tracks.header))
            sensor_names.append(tracks.read("sensor/name"))
            shapes.append(read_dot_shape(tracks))
    check_disjoint(headers[:-1], headers[-1:], "held out", paths[-1:])
    for what, values in (("sensors", sensors), ("dot grids", shapes)):
        check_same(what, values, paths)
    names = ", ".join(dict.fromkeys(sensor_names))
    return headers, {"sensor": sensors[0], "sensor_name": names, "dot_shape": np.array(shapes[0], np.int32)}


def read_samples(path: Path, count: int, noise_n: float, noise: np.random.Generator) -> ForceSamples:
    """Return `count` samples of a trajectory, with noise added to the force; InputError if there are none."""
    with StageFile(path, "tracks") as tracks, recording_with_truth(tracks) as recording:
        try:
            slices = forces.sample_slices(recording.read("truth/normal_force_n"), count, SAMPLE_MS)
            moved_px = forces.displacement(tracks.read("dot_xy_px")[slices], read_rest_px(tracks))
        except ValueError as error:
            raise InputError(f"there are no forces to compare with: {error}", where=str(path)) from error
        force_n = recording.read("truth/shear_force_n")[slices].astype(float)
    return ForceSamples(slices, moved_px, force_n + noise.normal(0.0, noise_n, force_n.shape))


def read_rest_px(tracks: StageFile) -> Floats:
    """Return the positions of the dots at rest, (dots, 2) in px."""
    rest: Floats = tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    return rest


def read_dot_shape(tracks: StageFile) -> tuple[int, int]:
    """Return the rows and columns of the dot grid."""
    rows, columns, _ = tracks.contents()["sensor/dot_xy_px"][1]
    return rows, columns


def sensor_sort(header: Header) -> str:
    """Return the type of sensor that tracked the dots: `events`, or `frames` of an RGB sensor."""
    return "frames" if header["parameters"].get("preset") == PRESET else "events"


def read_model(path: Path) -> tuple[Header, ForceModel]:
    """Return header and contents of a force model of the paper's method; InputError for another."""
    with StageFile(path, OUTPUT) as file:
        if not file.has("regression"):
            expected = "a model of train-force --method paper"
            raise InputError("the force model is not of the paper's method", where=str(path), expected=expected)
        rows, columns = file.read("dot_shape").tolist()
        regression = forces.Regression(file.read("regression/slope_n_px"), file.read("regression/offset_n"))
        layers = tuple(
            forces.DenseLayer(file.read(f"network/{number}/weight"), file.read(f"network/{number}/bias"))
            for number in range(LAYERS)
        )
        network = forces.Network(layers, float(file.read("network/scale_px")), float(file.read("network/scale_n")))
        shape = (int(rows), int(columns))
        if network.layers[0].weight.shape[1] != 2 * rows * columns:
            raise InputError("the network does not fit the dot grid", where=str(path), hint="the file is damaged")
        return file.header, ForceModel(file.read("sensor"), file.read("sensor_name"), shape, regression, network)


def check_grid(model: ForceModel, model_path: Path, tracks: StageFile) -> None:
    """Raise InputError if the tracks do not have the dot grid of the model."""
    shape = read_dot_shape(tracks)
    if shape != model.dot_shape:
        expected, found = f"{in_words(*model.dot_shape)}, as in {model_path}", in_words(*shape)
        message = "the tracks have a different dot grid from the force model"
        raise InputError(message, where=str(tracks.path), expected=expected, found=found)


STAGE = Stage(jobs, run)
