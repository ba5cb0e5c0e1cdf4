"""predict-force: the force on the gel, slice by slice, from tracks and a model of train-force; without torch."""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of, refuse_unused
from evetac_cli.commands.predict_force import PredictForce
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, Stage, outcome, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.names import PredictionOption
from evetac_cli.resources import model_file
from evetac_cli.stages import per_file
from evetac_cli.stages.force import gel_model
from evetac_cli.stages.force.train_force import check_grid, read_model, read_rest_px
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR

OUTPUT = "forces"
METHOD = 2
BLOCK_SLICES = 5000


def jobs(files: list[Path], params: PredictForce, out: Path | None) -> list[Job]:
    """One forces file for every tracks file."""
    has = () if params.sensor is None else (PredictionOption.SENSOR,)
    refuse_unused(params, has, "no --sensor")
    return [
        Job((*job.inputs, model_file(params.model, "force-model")), job.output) for job in per_file(files, OUTPUT, out)
    ]


def run(job: Job, params: PredictForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Predict the force of every slice by all that a model file holds."""
    model_path = job.inputs[1]
    with StageFile(model_path, "force-model") as model:
        for_any_sensor = model.has("gel")
    if for_any_sensor:
        return _for_any_sensor(job, params, force=force)
    if params.sensor is not None:
        raise InputError(
            "a model of the paper's method has the stiffness of the sensor that it was trained on",
            where="--sensor",
            expected="a model of train-force --method gel, or no --sensor",
            found=str(model_path),
        )
    return _by_the_paper(job, force=force, progress=progress)


def _for_any_sensor(job: Job, params: PredictForce, *, force: bool) -> Outcome:
    path, model_path = job.inputs
    known = gel_model.known_of(params.sensor)
    with StageFile(model_path, "force-model") as file:
        model_header, model = file.header, gel_model.read_gel_model(file)
        adapted_to = str(file.read("sensor_name"))
    if model.adapted is not None and params.sensor is not None:
        raise InputError(
            "an adapted model has the stiffness of its sensor", where="--sensor", found=f"{params.sensor}, {model_path}"
        )
    given = known.named()
    chosen = {} if params.sensor is None else {**recipe_of(params), "known": given}
    with StageFile(path, "tracks") as tracks:
        name = str(tracks.read("sensor/name"))
        if model.adapted is not None and len({name, adapted_to} - {UNKNOWN_SENSOR}) > 1:
            raise InputError(
                "the tracks are of another sensor than the model was adapted to",
                where=str(path),
                expected=f"{adapted_to}, as in {model_path}",
                found=name,
                hint="adapt the model that it was made from to this sensor, or leave out --model",
            )
        if model.adapted is None:
            gel_model.check_scale(tracks, known)
        recipe = Recipe(OUTPUT, METHOD, chosen, parents=(tracks.header, model_header))
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=recipe.simulated)
        estimated = gel_model.predict(model, gel_model.gel_of(model, known, params.stiffness_error), tracks)
    contact = estimated.contact >= gel_model.CONTACT
    arrays: dict[str, Any] = {
        **{name: values.astype(np.float32) for name, values in estimated.forces._asdict().items()},
        "contact_probability": estimated.contact.astype(np.float32),
        "contact": contact.astype(np.uint8),
    }
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        slices=len(contact),
        **{
            f"{which}_modulus": "adapted" if model.adapted is not None else "known" if modulus in given else "unknown"
            for which, modulus in gel_model.MODULI.items()
        },
        contact_s=float(contact.sum() / SLICES_PER_S),
        **_most("shear_n", np.linalg.norm(estimated.forces.shear_n, axis=1), estimated.forces.shear_sd_n.max(axis=1)),
        **_most("normal_n", estimated.forces.normal_n, estimated.forces.normal_sd_n),
    )


def _most(name: str, force_n: Floats, sd_n: Floats) -> dict[str, float | None]:
    """The largest force and its standard deviation; None where there is no slice with a force."""
    if not np.isfinite(force_n).any():
        return {f"max_{name}": None, f"max_{name}_sd": None}
    at = int(np.nanargmax(force_n))
    return {f"max_{name}": float(force_n[at]), f"max_{name}_sd": float(sd_n[at])}


def _by_the_paper(job: Job, *, force: bool, progress: Progress) -> Outcome:
    path, model_path = job.inputs
    model_header, model = read_model(model_path)
    with StageFile(path, "tracks") as tracks:
        check_grid(model, model_path, tracks)
        recipe = Recipe(OUTPUT, METHOD, {}, parents=(tracks.header, model_header))
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=recipe.simulated)
        slices, rest_px = tracks.length("dot_xy_px"), read_rest_px(tracks)
        by_regression, by_network = np.empty((2, slices, 2), np.float32)
        for first in range(0, slices, BLOCK_SLICES):
            block = slice(first, first + BLOCK_SLICES)
            try:
                moved_px = forces.displacement(tracks.read("dot_xy_px", first, first + BLOCK_SLICES), rest_px)
            except ValueError as error:
                raise InputError(f"no force can be predicted: {error}", where=str(path)) from error
            by_regression[block] = forces.apply_regression(model.regression, moved_px)
            by_network[block] = forces.apply_network(model.network, moved_px)
            progress(min(first + BLOCK_SLICES, slices), slices)
    write_stage(job.output, recipe, {"regression_n": by_regression, "network_n": by_network})
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        slices=slices,
        max_force_regression_n=float(np.abs(by_regression).max(initial=0.0)),
        max_force_network_n=float(np.abs(by_network).max(initial=0.0)),
    )


STAGE = Stage(jobs, run)
