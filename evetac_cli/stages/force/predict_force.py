"""predict-force: the shear force on the gel, slice by slice, from any tracks and a model made by train-force; needs no torch."""

from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.params import PredictForce, recipe_of
from evetac_cli.stages import per_file
from evetac_cli.stages.force.train_force import check_grid, read_model, rest_of
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe

INPUTS = ("tracks", "force-model")
OUTPUT = "forces"
METHOD = 1
BLOCK = 5000  # slices at a time


def jobs(files: list[Path], params: PredictForce, out: Path | None) -> list[Job]:
    """One forces file for every tracks file."""
    if params.model is None:
        raise InputError("no force model", where="--model", expected="a file made by evetac train-force")
    return [Job((*job.inputs, params.model), job.output) for job in per_file(files, OUTPUT, out)]


def run(job: Job, params: PredictForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Apply both models to every slice."""
    path, model_path = job.inputs
    model_header, model = read_model(model_path)
    with StageFile(path, "tracks") as tracks:
        check_grid(model, model_path, tracks)
        recipe = Recipe(OUTPUT, METHOD, recipe_of(params), parents=(tracks.header, model_header))
        if up_to_date(job.output, recipe, force=force):
            return outcome(job, made=False, simulated=recipe.simulated)
        slices, rest_px = tracks.length("dot_xy_px"), rest_of(tracks)
        by_regression, by_network = np.empty((2, slices, 2), np.float32)
        for first in range(0, slices, BLOCK):
            block = slice(first, first + BLOCK)
            try:
                moved_px = forces.displacement(tracks.read("dot_xy_px", first, first + BLOCK), rest_px)
            except ValueError as error:
                raise InputError(f"no force can be told: {error}", where=str(path)) from error
            by_regression[block] = forces.apply_regression(model.regression, moved_px)
            by_network[block] = forces.apply_network(model.network, moved_px)
            progress(min(first + BLOCK, slices), slices)
    write_stage(job.output, recipe, {"regression_n": by_regression, "network_n": by_network})
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        slices=slices,
        regression_n_most=float(np.abs(by_regression).max(initial=0.0)),
        network_n_most=float(np.abs(by_network).max(initial=0.0)),
    )
