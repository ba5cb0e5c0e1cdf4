"""How well slip detectors travel: timing and F1 sensor by sensor, and false alarms in light contact.

Intervals of 95 % are of whole objects drawn again with replacement, as trials of one object are alike. Of the slices of
grasps in contact without slip, and of those below 0.3 N, the share that is called slip is counted. All of it simulated.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from experiment_steps import Sizes
from experiment_tables import Evaluation, Evaluations
from numpy.typing import NDArray
from report_facts import facts
from results import ranges
from studies import LIGHT_N

from evetac_cli.errors import InputError
from evetac_cli.evaluate.slip_models import Model
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.labels import is_slip
from evetac_cli.kernels.slip.metrics import Prediction, score
from evetac_cli.resources import MODEL
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.stages.slip_detectors import predict, read_series, read_trajectory
from evetac_cli.stages.splits import check_disjoint
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header, Recipe

RESAMPLES, SEED = 2000, 0  # of the intervals
AROUND_SLIP_MS = 20  # before a true slip, where a detector that looks ahead may call it already
FIGURES = ("slip_correct", "f1")


class Sensor(NamedTuple):
    """The labelled features of one sensor."""

    name: str
    paths: list[Path]
    headers: list[Header]


def features(folder: Path) -> tuple[list[Path], list[Header]]:
    """The features files of a folder, and their headers."""
    paths, headers = sorted(folder.glob("*.features.h5")), []
    for path in paths:
        with StageFile(path, "features") as file:
            headers.append(file.header)
    if not paths:
        raise InputError("no features", where=str(folder))
    return paths, headers


def sensor_in(folder: Path) -> Sensor:
    """The features of a folder, under the name that their recordings give the sensor; that of the folder if several."""
    paths, headers = features(folder)
    names = facts(headers)["sensors"]
    return Sensor(names[0] if len(names) == 1 else folder.name, paths, headers)


def predictions(model: Model, sensor: Sensor) -> list[Prediction]:
    """What a model says of every labelled trajectory of a sensor."""
    check_disjoint([model.header], sensor.headers, "evaluated on", sensor.paths)
    detector = model.detector()
    return [
        predict(detector, read_trajectory(path, model.architecture), header, model.horizon_ms)
        for path, header in zip(sensor.paths, sensor.headers, strict=True)
    ]


def by_object(trials: Sequence[Prediction]) -> list[list[Prediction]]:
    """The trials of each object."""
    groups: dict[str, list[Prediction]] = {}
    for trial in trials:
        groups.setdefault(trial.object, []).append(trial)
    return list(groups.values())


def intervals(
    sets: Sequence[Sequence[Prediction]], threshold: float, rng: np.random.Generator
) -> dict[str, tuple[float, float] | None]:
    """Of the mean over sensors: intervals from objects that are drawn again, in each sensor's trials.

    None of a figure that no sensor has: there is no timing where nothing slips.
    """
    per_sensor = [[score(group, threshold) for group in by_object(trials)] for trials in sets]
    resampled: dict[str, list[float]] = {name: [] for name in FIGURES}
    for _ in range(RESAMPLES):
        means: dict[str, list[float]] = {name: [] for name in FIGURES}
        for rows in per_sensor:
            drawn = [rows[index] for index in rng.integers(len(rows), size=len(rows))]
            slips = sum(row["slips"] for row in drawn)
            if slips:
                right = sum(row["slip_correct"] * row["slips"] for row in drawn if row["slips"])
                means["slip_correct"].append(right / slips)
            means["f1"].append(float(np.mean([row["f1"] for row in drawn])))
        for name in FIGURES:
            if means[name]:
                resampled[name].append(float(np.mean(means[name])))
    ends: dict[str, tuple[float, float] | None] = dict.fromkeys(FIGURES)
    for name, values in resampled.items():
        if values:
            low, high = np.percentile(values, [2.5, 97.5])
            ends[name] = float(low), float(high)
    return ends


def figures(sets: Sequence[Sequence[Prediction]], threshold: float, seed: int) -> Row:
    """Figures of one sensor, or their means over those of several that have them; None where none has."""
    scores = [score(trials, threshold) for trials in sets]
    shown: Row = {}
    for key in ("slip_early", "slip_correct", "slip_late", "f1"):
        values = [value for one in scores if (value := one[key]) is not None]
        shown[key] = float(np.mean(values)) if values else None
    for key, ends in intervals(sets, threshold, np.random.default_rng(seed)).items():
        shown[f"{key}_low"], shown[f"{key}_high"] = ends or (None, None)
    return shown


def key(model: str) -> str:
    """The name of a model as the beginning of a column of a row."""
    return re.sub(r"\W+", "_", model)


def sensor_rows(models: dict[str, Model], sensors: Sequence[Sensor], seed: int) -> list[Row]:
    """A row for each sensor with the figures of all models, then one of the mean over the randomized ones."""
    randomized = [place for place, sensor in enumerate(sensors) if sensor.name.startswith("randomized")]
    groups = [[place] for place in range(len(sensors))] + ([randomized] if len(randomized) > 1 else [])
    rows: list[Row] = [{} for _ in groups]
    for row, group in zip(rows, groups, strict=True):
        known = facts(header for place in group for header in sensors[place].headers)
        row["sensor"] = sensors[group[0]].name if len(group) == 1 else f"mean of {len(group)} randomized"
        row |= {"trials": known["recordings"], "objects": known["objects"], "seeds": ranges(known["recording_seeds"])}
    for name, model in models.items():
        said = [predictions(model, sensor) for sensor in sensors]
        for row, group in zip(rows, groups, strict=True):
            row["slips"] = sum(trial.onset >= 0 for place in group for trial in said[place])
            made = figures([said[place] for place in group], model.threshold, seed)
            row |= {f"{key(name)}_{figure}": value for figure, value in made.items()}
    return rows


def in_contact(name: str, model: Model, paths: Sequence[Path]) -> Row:
    """Share of slices that are called slip in contact without slip, all and below 0.3 N."""
    detector = model.detector()
    counts = np.zeros(4, np.int64)  # slices in contact, called slip, in light contact, called slip
    for path in paths:
        with StageFile(path, "features") as file, recording_with_truth(file) as recording:
            called = is_slip(detector.over(read_series(file, model.architecture)), model.threshold)
            force_n, slips = recording.read("truth/normal_force_n"), recording.read("truth/slip")
            still = (force_n > 0) & ~near_slip(slips == 1)
            light = still & (force_n < LIGHT_N)
            counts += [still.sum(), (still & called).sum(), light.sum(), (light & called).sum()]
    contact, called_slip, light_contact, light_called = counts.tolist()
    return {
        "detector": name,
        "trials": len(paths),
        "contact_slices": contact,
        "called_slip": called_slip / contact if contact else None,
        "light_slices": light_contact,
        "light_called_slip": light_called / light_contact if light_contact else None,
    }


def near_slip(slips: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Slices that slip, those shortly before, and, as an object that slipped is let go, all after the first."""
    first = int(np.argmax(slips)) if slips.any() else len(slips)
    return np.arange(len(slips)) >= first - AROUND_SLIP_MS


def measure(sizes: Sizes, folder: Path, jobs: int) -> Evaluations:
    """Rows of both tables, with headers as a report on these files has them."""
    files = {"shipped": MODEL} | ({"first edition": Path(sizes["first_edition"])} if sizes["first_edition"] else {})
    models = {name: Model.read(path) for name, path in files.items()}
    randomized = (f"randomized-{number}" for number in range(sizes["seed"], sizes["seed"] + sizes["randomized"]))
    sensors = [sensor_in(folder / "slips" / name) for name in (*sizes["sensors"], *randomized)]
    grasps, of_grasps = features(folder / "grasps")
    about = {"thresholds": {name: model.threshold for name, model in models.items()}}

    def evaluation(rows: list[Row], headers: list[Header]) -> Evaluation:
        parents = (*headers, *(model.header for model in models.values()))
        report = Recipe("report", 1, {}, parents=parents).header()
        return Evaluation(rows, {}, report["simulated"], report, about)

    return {
        "slip-by-sensor": evaluation(
            sensor_rows(models, sensors, SEED), [header for sensor in sensors for header in sensor.headers]
        ),
        "slip-in-contact": evaluation([in_contact(name, model, grasps) for name, model in models.items()], of_grasps),
    }
