"""predict-force: the shear force on the gel, slice by slice, from tracks and a model of train-force; without torch."""

from pathlib import Path

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.params import PredictForce, recipe_of
from evetac_cli.stages import per_file
from evetac_cli.stages.force.train_force import check_grid, read_model, read_rest_px
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.provenance import Recipe

OUTPUT = "forces"
METHOD = 1
BLOCK_SLICES = 5000


def jobs(files: list[Path], params: PredictForce, out: Path | None) -> list[Job]:
    """One forces file for every tracks file."""
    if params.model is None:
        raise InputError("no force-model file is named", where="--model", expected="a file made by evetac train-force")
    return [Job((*job.inputs, params.model), job.output) for job in per_file(files, OUTPUT, out)]


def run(job: Job, params: PredictForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Predict the force of every slice by both models of a file, regression and network."""
    path, model_path = job.inputs
    model_header, model = read_model(model_path)
    with StageFile(path, "tracks") as tracks:
        check_grid(model, model_path, tracks)
        recipe = Recipe(OUTPUT, METHOD, recipe_of(params), parents=(tracks.header, model_header))
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
