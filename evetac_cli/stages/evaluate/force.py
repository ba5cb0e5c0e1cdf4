"""evaluate force: shear force told from dots against the true one, beside the paper's table.

Each tracks file is judged by the model of its own sensor (events, or frames of an RGB sensor). A file of an sensor_name
that the model was not fitted on has a row like any other, without the paper's figures beside it; `gain` says what a
softer or stiffer gel does: the force told for each newton that was there. Of several models of a sensor, fitted with
other seeds, rows have the means, and how much the models differ.

Why so: within a trajectory force goes with displacement to the noise; from one to the next the force for a displacement
differs by up to a tenth (simulated), with the place of contact. So an error says how far a trajectory's place is from
those of the few that were learned from, and a network's also which first weights it had: one of each tells little.
"""

import glob
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.params import EvaluateForce, recipe_of
from evetac_cli.resources import table
from evetac_cli.stages.evaluate import ModelsReportJob, Rows, picture, report, report_job, with_truth
from evetac_cli.stages.force.train_force import ForceModel, Samples, check_grid, read_model, read_samples, sensor_of
from evetac_cli.stages.splits import check_disjoint
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

INPUTS = ("tracks", "recording", "force-model")
OUTPUT = "report"
METHOD = 2
PAPER = {"events": "evetac", "frames": "rgb"}  # the sensors of the paper's table
LOOKS = {"regression": ("C0", "linear regression"), "network": ("C1", "network")}


Models = dict[str, list[tuple[Path, Header, ForceModel]]]  # by sensor


class TrialForce(NamedTuple):
    """The forces that both models tell for the samples of one trajectory."""

    path: Path
    sensor: str
    sensor_name: str
    fitted: bool  # whether the model was fitted on this sensor_name
    samples: Samples
    by: dict[str, forces.Floats]  # regression or network -> (models, samples, 2) in N


def jobs(files: list[Path], params: EvaluateForce, out: Path | None) -> list[ModelsReportJob]:
    """One report over all tracks files."""
    pattern = params.model if not Path(params.model).is_dir() else f"{params.model}/*.force-model.h5"
    models = [Path(name) for name in sorted(glob.glob(pattern))] if params.model else []
    if not models:
        raise InputError(
            "no force model",
            where="--model",
            expected="a file, folder or glob made by evetac train-force",
            found=params.model,
        )
    (job,) = report_job(files, "force", out, *models)
    return [ModelsReportJob(job.inputs, job.output, len(models))]


def run(job: ModelsReportJob, params: EvaluateForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Rows of both models for every trajectory: mean and sd of the absolute error, for x and y."""
    files, model_paths = job.inputs[: -job.models], job.inputs[-job.models :]
    models = _models(model_paths)
    headers = []
    for path in files:
        with StageFile(path, "tracks") as tracks, with_truth(tracks):
            headers.append(tracks.header)
            for model_path, model_header, model in _models_for(tracks, models):
                check_grid(model, model_path, tracks)
                check_disjoint([model_header], [tracks.header], "judged on", [path])
    parents = [*headers, *(header for of_sensor in models.values() for _, header, _ in of_sensor)]
    told: list[TrialForce] = []

    def predictions() -> list[TrialForce]:
        if not told:
            noise = np.random.default_rng(params.seed)
            for number, path in enumerate(files):
                told.append(_tell(path, models, params, noise))
                progress(number + 1, len(files))
        return told

    def measure() -> tuple[Rows, dict[str, Any]]:
        rows = [_row(one, name) for one in predictions() for name in one.by]
        return rows, _summary(predictions(), rows, params)

    outcome = report(job, "evaluate force", METHOD, recipe_of(params), parents, measure, force=force)
    sensors = len(models)
    return picture.beside(outcome, job.output, lambda figure: _draw(figure, predictions()), (13.0, 1.0 + 3.2 * sensors))


def _models(paths: tuple[Path, ...]) -> Models:
    """The models by their sensor; those of one sensor differ in nothing but the seed."""
    found: Models = {}
    for path in paths:
        header, model = read_model(path)
        of_sensor = found.setdefault(model.sensor, [])
        of_sensor.append((path, header, model))
        first_path, first_header, _ = of_sensor[0]
        if _but_seed(header) != _but_seed(first_header):
            raise InputError(
                f"two models of dots tracked in {model.sensor}, of other recipes or trajectories",
                where="--model",
                expected="one for each sensor, or several that differ in the seed",
                found=f"{first_path}, {path}",
            )
    return found


def _but_seed(header: Header) -> tuple[Any, ...]:
    """What a model was made by, and from."""
    return {**header["parameters"], "seed": None}, header["parents"]


def _models_for(tracks: StageFile, models: Models) -> list[tuple[Path, Header, ForceModel]]:
    sensor = sensor_of(tracks.header)
    if sensor not in models:
        raise InputError(
            f"no model of dots tracked in {sensor}",
            where=str(tracks.path),
            expected=f"one that was fitted to {sensor}",
            found=", ".join(str(path) for of_sensor in models.values() for path, _, _ in of_sensor),
        )
    return models[sensor]


def _tell(path: Path, models: Models, params: EvaluateForce, noise: np.random.Generator) -> TrialForce:
    with StageFile(path, "tracks") as tracks:
        chosen = [model for _, _, model in _models_for(tracks, models)]
        sensor, sensor_name = sensor_of(tracks.header), str(tracks.read("sensor/name"))
    samples = read_samples(path, params, noise)
    by = {
        "regression": np.stack([forces.apply_regression(model.regression, samples.moved_px) for model in chosen]),
        "network": np.stack([forces.apply_network(model.network, samples.moved_px) for model in chosen]),
    }
    return TrialForce(path, sensor, sensor_name, sensor_name in chosen[0].sensor_name.split(", "), samples, by)


def _row(told: TrialForce, name: str) -> dict[str, Any]:
    measured = told.samples.force_n
    errors = [forces.errors(one, measured) for one in told.by[name]]
    mean_n, sd_n = np.mean([one.mean_n for one in errors], axis=0), np.mean([one.sd_n for one in errors], axis=0)
    spread_n = np.std([one.mean_n for one in errors], axis=0)
    row: dict[str, Any] = {
        "file": told.path.name,
        "sensor_name": told.sensor_name,
        "fitted": told.fitted,
        "sensor": told.sensor,
        "model": name,
        "models": len(errors),
    }
    paper = table("paper")["force"][f"{name}_{PAPER[told.sensor]}"] if told.fitted else None
    for axis, letter in enumerate(forces.AXES):
        row[f"mae_n_{letter}"] = float(mean_n[axis])
        row[f"sd_n_{letter}"] = float(sd_n[axis])
        row[f"models_sd_n_{letter}"] = float(spread_n[axis])
        row[f"paper_mae_n_{letter}"], row[f"paper_sd_n_{letter}"] = paper[axis] if paper else (None, None)
    row["gain"] = float((told.by[name].mean(axis=0) * measured).sum() / (measured**2).sum())
    return row


def _summary(told: list[TrialForce], rows: Rows, params: EvaluateForce) -> dict[str, Any]:
    """The forces that there were, and means over the trajectories of sensor_names fitted on, which the paper's are."""
    known = [row for row in rows if row["fitted"]]
    means = {
        f"{sensor}_{model}_mae_n_{letter}": float(np.mean([row[f"mae_n_{letter}"] for row in chosen]))
        for sensor in PAPER
        for model in LOOKS
        for letter in forces.AXES
        if (chosen := [row for row in known if (row["sensor"], row["model"]) == (sensor, model)])
    }
    force = np.concatenate([one.samples.force_n for one in told])
    return {
        "trajectories": len(told),
        "samples_each": params.samples,
        "force_n_x_least": float(force[:, 0].min()),
        "force_n_x_most": float(force[:, 0].max()),
        "force_n_y_least": float(force[:, 1].min()),
        "force_n_y_most": float(force[:, 1].max()),
        **means,
    }


def _draw(figure: Any, told: list[TrialForce]) -> None:
    """The first trajectory of every sensor, as in the paper's figure: force sensor, regression and network."""
    shown: dict[str, TrialForce] = {}
    for one in sorted(told, key=lambda one: not one.fitted):  # stable: those of the fitted sensor_name first
        shown.setdefault(one.sensor, one)
    panels = figure.subplots(len(shown), 2, squeeze=False, sharex=True, sharey=True)
    for row, (sensor, one) in zip(panels, shown.items(), strict=True):
        order = one.samples.slice_ / 1000
        for axis, axes in enumerate(row):
            axes.plot(order, one.samples.force_n[:, axis], color="black", linewidth=1.5, label="force sensor")
            for name, (colour, words) in LOOKS.items():
                axes.plot(order, one.by[name][0][:, axis], color=colour, linewidth=1.0, label=words)
            axes.set_title(f"{sensor}, {one.sensor_name}: shear force {forces.AXES[axis]}")
            axes.set_ylabel("force [N]")
            picture.quiet_grid(axes)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    figure.suptitle("Shear force from dots, an unseen trajectory (simulated)")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
