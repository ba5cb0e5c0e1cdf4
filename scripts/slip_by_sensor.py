"""How well slip detectors travel: timing and F1 sensor by sensor, and false alarms in light contact.

    python scripts/slip_by_sensor.py data/evetac data/randomized-* \\
        --model shipped=evetac_cli/data/models/slip-10ms.model.h5 --model "first edition=first.model.h5" \\
        --contact data/grasps --publish                                  # the tables of docs/slip-detector.md

A folder holds the labelled features of one sensor, their recordings beside them or one folder up. Intervals of 95 % are
of whole objects drawn again with replacement, as trials of one object are alike. `--contact` folders hold recordings
with light contact, tracked and featurized: of their slices in contact without slip, and of those below 0.3 N, the share
that is called slip. All of it simulated. --publish writes docs/results/slip-by-sensor.json, slip-in-contact.json and
their tables.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from reproduce import commit, facts, methods, ranges
from results import publish, text

from evetac_cli.kernels.slip.labels import is_slip
from evetac_cli.kernels.slip.metrics import Prediction, score
from evetac_cli.stages.evaluate.slip_models import Model
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.stages.slip_detectors import predict, read_series, read_trajectory
from evetac_cli.stages.splits import check_disjoint
from evetac_cli.store.files import StageFile
from evetac_cli.store.provenance import Header

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "slip-detector.md"
LIGHT_N = 0.3
RESAMPLES = 2000
AROUND_SLIP_MS = 20  # before a true slip, where a detector that looks ahead may call it already
FIGURES = ("slip_correct", "f1")
Row = dict[str, Any]


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
        raise SystemExit(f"{folder}: no features")
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


def sensor_columns(models: Sequence[str]) -> list[Row]:
    """How the rows are shown: all figures of the first model, and timing and F1 of the others beside."""

    def cell(model: str, figure: str, *, interval: bool = False) -> str:
        one = f"{key(model)}_{figure}"
        return f"{{{one}:.2f}}" + (f" ({{{one}_low:.2f}} to {{{one}_high:.2f}})" if interval else "")

    first, *others = models
    return [
        {"heading": "sensor", "cell": "{sensor}"},
        {"heading": "trials", "cell": "{trials}"},
        {"heading": "early", "cell": cell(first, "slip_early")},
        {"heading": "correct", "cell": cell(first, "slip_correct", interval=True)},
        {"heading": "late", "cell": cell(first, "slip_late")},
        {"heading": "F1", "cell": cell(first, "f1", interval=True)},
        *(
            {"heading": f"{heading}, {other}", "cell": cell(other, figure)}
            for other in others
            for heading, figure in (("correct", "slip_correct"), ("F1", "f1"))
        ),
    ]


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


CONTACT_COLUMNS = [
    {"heading": "detector", "cell": "{detector}"},
    {"heading": "trials", "cell": "{trials}"},
    {"heading": f"slices below {LIGHT_N} N", "cell": "{light_slices:,}"},
    {"heading": "of these called slip", "cell": "{light_called_slip:.2%}"},
    {"heading": "slices in contact", "cell": "{contact_slices:,}"},
    {"heading": "of these called slip", "cell": "{called_slip:.2%}"},
]


def near_slip(slips: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Slices that slip, those shortly before, and, as an object that slipped is let go, all after the first."""
    first = int(np.argmax(slips)) if slips.any() else len(slips)
    return np.arange(len(slips)) >= first - AROUND_SLIP_MS


def result(name: str, title: str, rows: list[Row], columns: list[Row], headers: list[Header], about: Row) -> Row:
    """A file of docs/results, with what the headers of the features say."""
    known = facts(headers)
    head, changed = commit()
    return {
        "name": name,
        "title": title,
        "simulated": any(header["simulated"] for header in headers),
        "made": f"commit {head}, seeds {ranges(known['recording_seeds'])}",
        "commit": head,
        "uncommitted_changes": changed,
        "methods": methods(headers),
        "sizes": {size: known[size] for size in ("recordings", "objects", "sensors", "recording_seeds")},
        "columns": columns,
        "across": None,
        "rows": rows,
        **about,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--model", action="append", required=True, metavar="NAME=FILE", help="the first in full")
    parser.add_argument("--contact", nargs="*", type=Path, default=[])
    parser.add_argument("--seed", type=int, default=0, help="of the intervals")
    parser.add_argument("--publish", action="store_true", help="write docs/results and the page")
    options = parser.parse_args()
    models = {name: Model.read(Path(path)) for name, _, path in (given.partition("=") for given in options.model)}
    sensors = [sensor_in(folder) for folder in options.folders]
    words = [folder.name for folder in options.folders]
    words += [f'--model "{name}={model.path.name}"' for name, model in models.items()]
    words += ["--contact", *(folder.name for folder in options.contact)] if options.contact else []
    about = {
        "commands": [f"python scripts/slip_by_sensor.py {' '.join(words)} --publish"],
        "recipe_ids": [model.header["id"] for model in models.values()],
        "thresholds": {name: model.threshold for name, model in models.items()},
        "notes": [],
    }
    title = "Slip detection sensor by sensor, with intervals of 95 %"
    headers = [header for sensor in sensors for header in sensor.headers]
    rows = sensor_rows(models, sensors, options.seed)
    tables = [result("slip-by-sensor", title, rows, sensor_columns(list(models)), headers, about)]
    if options.contact:
        grasps = [features(folder) for folder in options.contact]
        paths, headers = [path for group, _ in grasps for path in group], [one for _, group in grasps for one in group]
        rows = [in_contact(name, model, paths) for name, model in models.items()]
        title = "Contact without slip: slices at which nothing slips, nor will within 20 ms, that are called slip"
        tables.append(result("slip-in-contact", title, rows, CONTACT_COLUMNS, headers, about))
    for table in tables:
        print(text(table))
        if options.publish:
            publish(table, PAGE)


if __name__ == "__main__":
    main()
