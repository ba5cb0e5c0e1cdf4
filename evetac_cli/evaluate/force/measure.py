"""evaluate force: error of the shear force estimated from dots, next to the paper's table.

Each tracks file is evaluated with the models for its type of sensor (events, or frames of an RGB sensor) and its
tracker, which must be that of the models' training trajectories. An individual sensor that the model was not fitted on
has a row like any other, but without the paper's figures. The column `gain` is the estimated force per newton of true
force and shows the effect of a softer or stiffer gel. If there are several models for a type of sensor, trained with
different seeds, the rows contain the means and the spread over the models.

Why several trajectories and models: within a trajectory, force is proportional to displacement except for noise.
Between trajectories the force at the same displacement differs by up to a tenth (simulated), depending on the position
of contact. So the error mainly shows how far the contact is from those of the few training trajectories. For a network
it also depends on the initial weights. One trajectory and one model prove little.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.report import report, report_job
from evetac_cli.evaluate.common.rows import each, mean
from evetac_cli.evaluate.force import PAPER, EvaluateForce
from evetac_cli.evaluate.force import touch_maps as touch_force
from evetac_cli.evaluate.force.touch_maps import ForceReportJob
from evetac_cli.jobs import Outcome, Progress, Row, Rows, Stage, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.stages.force.train_force import (
    ForceModel,
    ForceSamples,
    check_grid,
    read_model,
    read_samples,
    sensor_sort,
)
from evetac_cli.stages.related_files import check_disjoint, named_files, recording_with_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import TRAINING, sensor_values, trajectories
from evetac_cli.store.layout.provenance import Header

METHOD = 5
SENSORS = ("events", "frames")  # in which dots are tracked; both are in the paper's table
METHODS = ("regression", "network")

Models = dict[tuple[str, str], list[tuple[Path, Header, ForceModel]]]  # by type of sensor and tracker


class TrialForce(NamedTuple):
    """The forces that both models estimate for the samples of one trajectory."""

    path: Path
    sensor: str
    tracker: str
    sensor_name: str
    fitted: bool  # whether the model was fitted on this individual sensor
    samples: ForceSamples
    predicted_n: dict[str, Floats]  # regression or network -> (models, samples, 2)


def jobs(files: list[Path], params: EvaluateForce, out: Path | None) -> list[ForceReportJob]:
    """Return one report job over all tracks files."""
    models = named_files(params.model, "force-model", "--model") if params.model else []
    own = named_files(params.adapt_on, "tracks", "--adapt-on") if params.adapt_on else []
    for is_given, flag in ((own, "--adapt-on"), (params.identified, "--identified")):
        if is_given and models:
            raise InputError("is for touch maps alone", where=flag, expected="no --model", found=f"{params.model}")
    (job,) = report_job(files, "force", out, *own, *models)
    return [ForceReportJob(job.inputs, job.output, len(models), len(own))]


def run(job: ForceReportJob, params: EvaluateForce, *, force: bool = False, progress: Progress = silent) -> Outcome:
    """Return a row per trajectory and model of the paper: mean and sd of the absolute error, for x and y.

    Without --model, touch maps are evaluated (touch_force).
    """
    if not job.models:
        return touch_force.run(job, params, force=force, progress=progress)
    files, model_paths = job.inputs[: -job.models], job.inputs[-job.models :]
    models = _models(model_paths)
    headers = []
    for path in files:
        with StageFile(path, "tracks") as tracks, recording_with_truth(tracks):
            headers.append(tracks.header)
            for model_path, model_header, model in _models_for(tracks, models):
                check_grid(model, model_path, tracks)
                check_disjoint([model_header], [tracks.header], "evaluated on", [path])
    parents = [*headers, *(header for of_sensor in models.values() for _, header, _ in of_sensor)]

    def measure() -> tuple[Rows, dict[str, Any]]:
        noise = np.random.default_rng(params.seed)
        trials = [_predict(path, models, params, noise) for path in each(files, progress)]
        rows = [_row(one, name) for one in trials for name in one.predicted_n]
        return rows, _summary(trials, rows, params)

    return report(job, "evaluate force", METHOD, recipe_of(params), parents, measure, force=force)


def for_people(rows: Rows, params: EvaluateForce) -> tuple[Rows, list[str]]:
    """Return all rows, and the mean error of shear force by model, or for touch maps by knowledge of the gel."""
    by = "stiffness" if "stiffness" in rows[0] else "model"
    columns = {"mae_n": "", **{f"mae_n_{axis}": f"{axis} " for axis in forces.AXES}}
    lines, row_0 = [], rows[0]
    for name in dict.fromkeys(row[by] for row in rows):
        of_name = [row for row in rows if row[by] == name]
        known = [row for row in of_name if row["mae_n_x"] is not None]
        means = {word: np.mean([row[key] for row in known]) for key, word in columns.items() if known and key in row_0}
        words = ", ".join(f"{word}{mean:.3g} N" for word, mean in means.items()) or "unknown"
        count = f"n = {len(known)} of {len(of_name)} trajectories"
        if left := len(of_name) - len(known):
            count += f"; {left} without a slice in which a contact is found and enough dots are tracked"
        if others := sum(not row.get("fitted", True) for row in known):
            count += f"; {others} of sensors that the model was not fitted on"
        lines.append(f"{by} {name}: mean absolute error of shear force {words}; {count}.")
    return rows, lines


def _models(paths: tuple[Path, ...]) -> Models:
    """Return the models by type of sensor and tracker; raise InputError unless those of one differ only in the seed."""
    by_sensor: Models = {}
    for path in paths:
        header, model = read_model(path)
        same_sensor = by_sensor.setdefault((model.sensor, _trackers(header)), [])
        same_sensor.append((path, header, model))
        first_path, first_header, _ = same_sensor[0]
        if _without_seed(header) != _without_seed(first_header):
            expected = "models per sensor and tracker that differ only in the seed"
            raise InputError("two different models", where="--model", expected=expected, found=f"{first_path}, {path}")
    return by_sensor


def _trackers(header: Header) -> str:
    """Return the presets by which the dots of a model's training trajectories, or of tracks, were tracked."""
    every = [header, *header["history"].values()]
    presets = {one["parameters"].get("preset") for one in every if one["kind"] == "tracks"}
    presets |= {row["tracker"] for row in trajectories(every)}
    return " + ".join(sorted(str(preset) for preset in presets if preset is not None)) or "unknown"


def _without_seed(header: Header) -> tuple[Any, ...]:
    """Return everything that determines a model except its seed."""
    return {**header["parameters"], "seed": None}, header["parents"]


def _models_for(tracks: StageFile, models: Models) -> list[tuple[Path, Header, ForceModel]]:
    """Return the models for the sensor and tracker of a tracks file; raise InputError if there are none."""
    sensor, tracker = sensor_sort(tracks.header), _trackers(tracks.header)
    if (sensor, tracker) not in models:
        expected = f"a model for dots tracked in {sensor} by {tracker}"
        found = ", ".join(str(path) for of_sensor in models.values() for path, _, _ in of_sensor)
        raise InputError("no model for these tracks", where=str(tracks.path), expected=expected, found=found)
    return models[sensor, tracker]


def _predict(path: Path, models: Models, params: EvaluateForce, noise: np.random.Generator) -> TrialForce:
    with StageFile(path, "tracks") as tracks:
        same_kind = _models_for(tracks, models)
        selected_models = [model for _, _, model in same_kind]
        sensor, tracker = sensor_sort(tracks.header), _trackers(tracks.header)
        sensor_name = str(tracks.read("sensor/name"))
        _, model_header, model = same_kind[0]
        values = sensor_values(tracks.header)
        if values is None:  # of a real sensor only its name is known
            fitted = sensor_name in model.sensor_name.split(", ")
        else:
            learned = [row for row in trajectories([model_header]) if row["role"] == TRAINING]
            fitted = values in {row["sensor_values"] for row in learned}
    samples = read_samples(path, params.samples, params.noise_n, noise)
    moved_px = samples.moved_px
    predicted_n = {
        "regression": np.stack([forces.apply_regression(model.regression, moved_px) for model in selected_models]),
        "network": np.stack([forces.apply_network(model.network, moved_px) for model in selected_models]),
    }
    return TrialForce(path, sensor, tracker, sensor_name, fitted, samples, predicted_n)


def _row(trial: TrialForce, name: str) -> dict[str, Any]:
    measured = trial.samples.force_n
    errors = [forces.errors(one, measured) for one in trial.predicted_n[name]]
    mean_n, sd_n = np.mean([one.mean_n for one in errors], axis=0), np.mean([one.sd_n for one in errors], axis=0)
    spread_n = np.std([one.mean_n for one in errors], axis=0)
    row: dict[str, Any] = {
        "file": trial.path.name,
        "sensor_name": trial.sensor_name,
        "fitted": trial.fitted,
        "sensor": trial.sensor,
        "tracker": trial.tracker,
        "model": name,
        "models": len(errors),
    }
    for axis, letter in enumerate(forces.AXES):
        row[f"mae_n_{letter}"] = float(mean_n[axis])
        row[f"sd_n_{letter}"] = float(sd_n[axis])
        row[f"sd_over_models_n_{letter}"] = float(spread_n[axis])
        for quantity in ("mae", "sd"):
            published = PAPER.value(quantity, name, trial.sensor, letter) if trial.fitted else None
            row[f"paper_{quantity}_n_{letter}"] = published
    row["gain"] = float((trial.predicted_n[name].mean(axis=0) * measured).sum() / (measured**2).sum())
    return row


def _summary(trials: list[TrialForce], rows: Rows, params: EvaluateForce) -> dict[str, Any]:
    """Return the range of the true forces, and mean errors over trajectories of sensors that models were fitted on.

    With several trackers of a sensor, the names of the means and of their numbers of trajectories contain the tracker.
    """
    counts: Row = {}
    means: Row = {}
    fitted = [row for row in rows if row["fitted"]]
    for sensor in SENSORS:
        trackers = sorted({row["tracker"] for row in fitted if row["sensor"] == sensor})
        for tracker in trackers:
            name = sensor if len(trackers) == 1 else f"{sensor}_{tracker}"
            own = [row for row in fitted if (row["sensor"], row["tracker"]) == (sensor, tracker)]
            counts[f"{name}_trajectories"] = sum(row["model"] == own[0]["model"] for row in own)
            for model in METHODS:
                of_model = [row for row in own if row["model"] == model]
                means |= {f"{name}_{model}_mae_n_{x}": mean(row[f"mae_n_{x}"] for row in of_model) for x in forces.AXES}
    force = np.concatenate([one.samples.force_n for one in trials])
    return {
        "trajectories": len(trials),
        "trajectories_of_other_sensors": sum(not one.fitted for one in trials),
        **counts,
        "samples_per_trajectory": params.samples,
        "true_force_min_x_n": float(force[:, 0].min()),
        "true_force_max_x_n": float(force[:, 0].max()),
        "true_force_min_y_n": float(force[:, 1].min()),
        "true_force_max_y_n": float(force[:, 1].max()),
        **means,
    }


STAGE = Stage(jobs, run, for_people=for_people)
