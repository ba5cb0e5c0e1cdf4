"""Adapt the pretrained slip detector to ten sensors that it has not seen: without a labelled slip, and with ten.

`python scripts/studies/slip/adapting.py see FOLDER` simulates a minute of holding and loading and ten slips of each
sensor, seeds 75,000 up, on other objects than the judge's. `... judge FOLDER JUDGED` adapts the detector to each sensor
and evaluates it on the trials of the same sensor in JUDGED, which `judge.py see --seed 74000` has made.

- threshold: the minute's alarms at low thresholds, compared with those of the other sensors in the same motions, tell
  by how much the sensor's log odds are too high; they are shifted by that.
- inputs: the numbers that the dots give are shifted so that their mean over the minute is that of the other sensors.
- ten slips: training continues on the labels of ten slips and the minute (`train --adapt`).
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Floats, Singles
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip import alarms, memory_training, onnx_graphs
from evetac_cli.kernels.slip.architectures import LOAD_PATH, MemoryArchitecture, with_scaled_logit
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.kernels.slip.training import ADAPT_MEMORY
from evetac_cli.resources import MODEL
from evetac_cli.stages.model_files import read_curve, read_weights
from evetac_cli.stages.train import ADAPT_STEPS
from evetac_cli.store.files import StageFile
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import table_of, write
from scripts.studies import motions
from scripts.studies.motions import CHOSEN_BY, EVETAC
from scripts.studies.slip import tables as slip_tables
from scripts.studies.slip import trials as slip_trials
from scripts.studies.slip.seen import DOTS, SeenTrial, trials_in
from scripts.studies.slip.tables import AT_ONE, PER_MINUTE, WARNED_MS, Rows

FIRST_SEED, SENSORS = 75_000, tuple(f"randomized:{number}" for number in range(74_000, 74_010))
MINUTE = ("pushes", "grip", "opening", "handling", "pushes", "light touch", "opening")  # about 8 s of contact each
SLIPS = ("slip-speeds",) * 10
PER_MIN_COMPARED = (4.0, 8.0, 16.0)  # a minute has too few alarms at lower rates
OF_DOTS = slice(0, LOAD_PATH.index("gripper_known"))
ARCHITECTURE, HORIZON_MS = MemoryArchitecture("load-path"), 10
Weights = dict[str, Singles]


def see(folder: Path) -> None:
    """Simulate the trials to adapt to each sensor."""
    for place, sensor in enumerate(SENSORS):
        for number, motion in enumerate(MINUTE + SLIPS):
            seed = FIRST_SEED + 100 * place + number
            of_object = CHOSEN_BY[number % len(CHOSEN_BY)]
            plan = of_object, slip_trials.planned_on(sensor, motion, of_object, seed)
            name = folder / sensor / f"{number:02d}"
            slip_trials.see(name, motion, iter([plan]), seed, {}, float("inf"))
        sys.stdout.write(f"{sensor}\n")
        sys.stdout.flush()


def _trials(folder: Path, sensor: str, numbers: Sequence[int]) -> list[SeenTrial]:
    return [one for n in numbers for one in trials_in(folder / sensor / f"{n:02d}", (MINUTE + SLIPS)[n])]


def _path(one: SeenTrial) -> LoadPath:
    return one.views[DOTS[0]].path


def _detector(weights: Weights) -> Detector:
    return Detector(onnx_graphs.build(ARCHITECTURE, weights), ARCHITECTURE)


def _trajectory(one: SeenTrial, *, last_ms: int = 60) -> Trajectory:
    """Return a trial with the labels that a person would give it: slip from its onset on, for 60 ms."""
    assert one.trial is not None
    slips = one.trial.slips & (one.trial.normal_n > 0)
    begins = int(np.argmax(slips)) if slips.any() else -1
    label = slips.astype(np.int8)
    if begins >= 0:
        label[begins + last_ms :] = -1
    return Trajectory(_path(one), np.zeros(len(label), np.int32), label, begins)


def _curve(detector: Detector, quiet: Sequence[SeenTrial]) -> alarms.WarningCurve:
    """Return the alarms of trials in which nothing slips; one that ends with a slip counts until 200 ms before it."""
    predictions = []
    for one in quiet:
        known = _trajectory(one)
        predictions.append(Prediction(detector.over(known.series), known.label, known.onset))
    return alarms.warning_curve(predictions)


def _log_odds_at(curve: alarms.WarningCurve) -> Floats:
    """Return the log odds of the thresholds at which alarms come at the rates that are compared."""
    odds = np.log(curve.threshold / (1 - curve.threshold))
    rates = np.maximum.accumulate(curve.false_alarms_per_min[::-1])[::-1]
    at: Floats = np.interp(-np.array(PER_MIN_COMPARED), -rates, odds)
    return at


def _numbers(quiet: Sequence[SeenTrial]) -> Floats:
    """Return the mean of the numbers of dots over the steps that touch."""
    every = np.concatenate([_path(one).numbers[_path(one).touches] for one in quiet])
    mean: Floats = every[:, OF_DOTS].mean(axis=0, dtype=np.float64)
    return mean


def adapted(weights: Weights, folder: Path, sensor: str) -> dict[str, Detector]:
    """Return the detector of each method for a sensor."""
    minute, ten = range(len(MINUTE)), range(len(MINUTE), len(MINUTE + SLIPS))
    quiet = _trials(folder, sensor, minute)
    others = [one for other in SENSORS if other != sensor for one in _trials(folder, other, minute)]
    pretrained = _detector(weights)
    too_high = float(np.mean(_log_odds_at(_curve(pretrained, quiet)) - _log_odds_at(_curve(pretrained, others))))
    moved = dict(weights)
    moved["input_offset"] = weights["input_offset"].copy()
    moved["input_offset"][OF_DOTS] += (_numbers(quiet) - _numbers(others)).astype(np.float32)
    slips = [_trajectory(one) for one in [*_trials(folder, sensor, ten), *quiet]]
    samples = memory_training.gather(slips, ARCHITECTURE, HORIZON_MS)
    rng = np.random.default_rng(FIRST_SEED)
    trained = memory_training.train(samples, ADAPT_MEMORY, rng, max_steps=ADAPT_STEPS, start=weights)
    return {
        "pretrained": pretrained,
        "threshold by a minute without slip": _detector(with_scaled_logit(weights, "last", 1.0, -too_high)),
        "inputs by a minute without slip": _detector(moved),
        "ten labelled slips and the minute": _detector(trained.checkpoints[-1].weights),
    }


def judge(folder: Path, judged: Path, out: Path) -> None:
    """Adapt to each sensor, evaluate, and write the table."""
    with StageFile(MODEL, "model") as file:
        weights, curve = read_weights(file), read_curve(file)
    assert curve is not None
    of_sensor = {sensor: adapted(weights, folder, sensor) for sensor in SENSORS}
    rows: Rows = {}
    for motion in motions.MOTIONS:
        for one in trials_in(judged, motion):
            if one.row["sensor"] == EVETAC:
                continue
            assert one.trial is not None
            detectors = of_sensor[one.row["sensor"]]
            scores = {name: (detector.over(_path(one)), HORIZON_MS) for name, detector in detectors.items()}
            rows.setdefault(motion, []).append(one.row | slip_trials.judged(motion, one.trial, scores))
    write(out, _table(rows, curve, f"python scripts/studies/slip/adapting.py judge {folder.name} {judged.name}"))


def _table(rows: Rows, curve: alarms.WarningCurve, command: str) -> Row:
    clusters = slip_tables.clusters_of(slip_tables.slip_rows(rows), each_slip=True)
    at = slip_trials.THRESHOLDS.index(slip_tables.nearest(curve.threshold_for(AT_ONE)))
    shown = []
    for name in slip_tables.names_of(rows):
        row: Row = {"method": name, "slips": len(clusters), "sensors": len(SENSORS)}
        for per_minute in PER_MINUTE:
            mean = slip_tables.mean_of(slip_tables.warned_values(rows, name, per_minute, WARNED_MS[0]), clusters)
            key = slip_tables.warned_key(WARNED_MS[0], per_minute)
            row |= {key: mean.value, f"{key}_low": mean.low, f"{key}_high": mean.high}
        row["stated"] = float(slip_tables.mean_false(rows, name)[at])
        every = [one for of in rows.values() for one in of]
        of_sensors = [[one for one in every if one["sensor"] == sensor] for sensor in SENSORS]
        false = [float(slip_tables.false_per_minute(some, name)[at]) for some in of_sensors]
        row |= {"least": min(false), "most": max(false)}
        shown.append(row)
    columns = {"adapted by": "{method}", "sensors": "{sensors}", "slips": "{slips}"}
    for per_minute in PER_MINUTE:
        key = slip_tables.warned_key(WARNED_MS[0], per_minute)
        heading = f"warned {WARNED_MS[0]} ms ahead, {per_minute:g} per minute"
        columns[heading] = f"{{{key}:.2f}} ({{{key}_low:.2f}} to {{{key}_high:.2f}})"
    columns[f"false alarms per minute where {AT_ONE:g} is stated"] = "{stated:.2f}"
    columns["of one sensor"] = "{least:.2f} to {most:.2f}"
    note = (
        "Sensors, objects and trials that the detector was not trained on. Warned: at equal false alarms per minute,"
        " averaged over motions, one threshold for all sensors. Stated: at the threshold of the pretrained detector's"
        " file; of one sensor: over its minutes of contact."
    )
    title = "Adapting the slip detector to a sensor"
    return table_of("slip-adapted", title, columns, shown, command, slip_tables.sizes_of(rows), notes=(note,))


def main() -> None:
    """Simulate the trials to adapt to, or evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("see", "judge"))
    parser.add_argument("folder", type=Path, help="folder of the trials to adapt to")
    parser.add_argument("judged", type=Path, nargs="?", help="judge: folder of the judged trials")
    parser.add_argument("--out", type=Path, default=RESULTS, help="judge: folder of the table")
    chosen = parser.parse_args()
    if chosen.what == "see":
        see(chosen.folder)
    elif chosen.judged is None:
        parser.error("judge: name the folder of the judged trials")
    else:
        judge(chosen.folder, chosen.judged, chosen.out)


if __name__ == "__main__":
    main()
