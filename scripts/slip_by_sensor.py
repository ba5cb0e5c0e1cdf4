"""How well slip detectors travel: timing and F1 sensor by sensor, and false alarms in light contact.

    python scripts/slip_by_sensor.py data/evetac data/second data/randomized-* \\
        --model shipped=evetac_cli/data/models/slip-10ms.model.h5 --contact lifts handling -o slip-by-sensor.json

A folder holds the labelled features of one sensor, their recordings beside them or one folder up. Intervals of 95 % are
of whole objects drawn again with replacement, as trials of one object are alike. `--contact` folders hold recordings
with light contact, tracked and featurized: of their slices in contact without slip, and of those below 0.3 N, the share
that is called slip. All of it simulated.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.decision import is_slip
from evetac_cli.kernels.slip.metrics import Prediction, score
from evetac_cli.stages.evaluate.slip_models import Model
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.stages.slip_detectors import predict, read_series, read_trajectory
from evetac_cli.store.files import StageFile

LIGHT_N = 0.3
RESAMPLES = 2000
AROUND_SLIP_MS = 20  # before a true slip, where a detector that looks ahead may call it already
FIGURES = ("slip_correct", "f1")
Row = dict[str, Any]


def predictions(model: Model, folder: Path) -> list[Prediction]:
    """What a model says of every labelled trajectory in a folder."""
    detector, trials = model.detector(), []
    for path in sorted(folder.glob("*.features.h5")):
        with StageFile(path, "features") as file:
            header = file.header
        trials.append(predict(detector, read_trajectory(path, model.architecture), header, model.horizon_ms))
    if not trials:
        raise SystemExit(f"{folder}: no features")
    return trials


def by_object(trials: Sequence[Prediction]) -> list[list[Prediction]]:
    """The trials of each object."""
    groups: dict[str, list[Prediction]] = {}
    for trial in trials:
        groups.setdefault(trial.object, []).append(trial)
    return list(groups.values())


def intervals(
    sets: Sequence[Sequence[Prediction]], threshold: float, rng: np.random.Generator
) -> dict[str, list[float]]:
    """Of the mean over sensors: intervals from objects that are drawn again, in each sensor's trials."""
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
            resampled[name].append(float(np.mean(means[name])))
    return {name: [float(end) for end in np.percentile(values, [2.5, 97.5])] for name, values in resampled.items()}


def row_of(name: str, sensor: str, sets: Sequence[Sequence[Prediction]], threshold: float, seed: int) -> Row:
    """Figures of one sensor, or the mean over several."""
    scores = [score(trials, threshold) for trials in sets]
    mean = {
        key: float(np.mean([one[key] for one in scores])) for key in ("slip_early", "slip_correct", "slip_late", "f1")
    }
    ends = intervals(sets, threshold, np.random.default_rng(seed))
    return {
        "detector": name,
        "sensor": sensor,
        "trajectories": sum(len(trials) for trials in sets),
        "objects": len({trial.object for trials in sets for trial in trials}),
        **mean,
        "slip_correct_95": ends["slip_correct"],
        "f1_95": ends["f1"],
    }


def in_contact(name: str, model: Model, folder: Path) -> Row:
    """Share of slices that are called slip in contact without slip, all and below 0.3 N."""
    detector = model.detector()
    counts = np.zeros(4, np.int64)  # slices in contact, called slip, in light contact, called slip
    trials = 0
    for path in sorted(folder.glob("*.features.h5")):
        with StageFile(path, "features") as file, recording_with_truth(file) as recording:
            called = is_slip(detector.over(read_series(file, model.architecture)), model.threshold)
            force_n, slips = recording.read("truth/normal_force_n"), recording.read("truth/slip")
            still = (force_n > 0) & ~near_slip(slips == 1)
            light = still & (force_n < LIGHT_N)
            counts += [still.sum(), (still & called).sum(), light.sum(), (light & called).sum()]
            trials += 1
    if not trials:
        raise SystemExit(f"{folder}: no features")
    contact, called_slip, light_contact, light_called = counts.tolist()
    return {
        "detector": name,
        "recordings": folder.name,
        "trials": trials,
        "slices_in_contact": contact,
        "called_slip": called_slip / max(contact, 1),
        "slices_below_0.3_n": light_contact,
        "called_slip_below_0.3_n": light_called / max(light_contact, 1),
    }


def near_slip(slips: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Slices that slip, those shortly before, and, as an object that slipped is let go, all after the first."""
    first = int(np.argmax(slips)) if slips.any() else len(slips)
    return np.arange(len(slips)) >= first - AROUND_SLIP_MS


def shown(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table."""

    def text(value: Any) -> str:
        if isinstance(value, list):
            return "{:.2f} to {:.2f}".format(*value)
        return f"{value:.3f}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)

    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([text(row[name]) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--model", action="append", required=True, metavar="NAME=FILE")
    parser.add_argument("--contact", nargs="*", type=Path, default=[])
    parser.add_argument("--seed", type=int, default=0, help="of the intervals")
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    models = [(name, Model.read(Path(path))) for name, _, path in (given.partition("=") for given in options.model)]
    rows: list[Row] = []
    for name, model in models:
        by_sensor = {folder.name: predictions(model, folder) for folder in options.folders}
        drawn = [trials for sensor, trials in by_sensor.items() if sensor.startswith("randomized")]
        rows += [row_of(name, sensor, [trials], model.threshold, options.seed) for sensor, trials in by_sensor.items()]
        if len(drawn) > 1:
            rows.append(row_of(name, f"mean of {len(drawn)} randomized", drawn, model.threshold, options.seed))
    print(shown(rows))
    contacts = [in_contact(name, model, folder) for name, model in models for folder in options.contact]
    if contacts:
        print("\n" + shown(contacts))
    if options.out is not None:
        options.out.write_text(json.dumps({"simulated": True, "sensors": rows, "contact": contacts}, indent=1) + "\n")


if __name__ == "__main__":
    main()
