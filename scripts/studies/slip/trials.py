"""Evaluate one trial: alarms, lead times, timing and F1 of every score at every threshold, as one row.

A score is an oracle's, or the probability of a slip detector, from the dots of the tracker or from true ones.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Singles
from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip import alarms, metrics
from evetac_cli.kernels.slip.detector import over_each
from evetac_cli.kernels.slip.metrics import F1_CUT_MS, is_slip, shift_labels
from evetac_cli.kernels.slip.reliability import ABOVE
from scripts.studies import motions
from scripts.studies.motions import EVETAC, Planned, Trial
from scripts.studies.slip import oracles as slip_oracles
from scripts.studies.slip import seen as slip_seen
from scripts.studies.slip.seen import DOTS, SeenTrial

THRESHOLDS: tuple[float, ...] = tuple(alarms.THRESHOLDS[::2].tolist())
SLIPS = ("slip", "slip-varied", "slip-speeds")  # motions with an onset for the evaluation of timing
RAMP_MS = 900  # in these motions, the time before the onset is ignored, because the weight is being transferred
SENSORS = 20
SPEED_MS = 300  # ms before slip, over which the unloading speed is measured
MOST_TRIALS = 100_000
Scores = Mapping[str, tuple[Singles, int]]  # probability of each slice by name, and its horizon in ms


def oracle_scores(trial: Trial) -> dict[str, tuple[Singles, int]]:
    """Return the scores of the oracles, each for each horizon; the share has one, because it knows only the present."""
    pairs = itertools.product(slip_oracles.ORACLES[1:], slip_oracles.HORIZONS_MS)
    every = {f"{name} {ms} ms": (slip_oracles.score(trial, name, ms), ms) for name, ms in pairs}
    return {"share": (slip_oracles.score(trial, "share"), 0)} | every


def scores_of(one: SeenTrial, models: Mapping[str, Model]) -> dict[str, tuple[Singles, int]]:
    """Return the scores of the oracles, and by kind of dots those of the sticking network and of models with memory.

    The scores that the trial has of networks over dots are of tracked dots.
    """
    assert one.trial is not None
    scores = oracle_scores(one.trial) | {f"{name}, {DOTS[0]} dots": score for name, score in one.scores.items()}
    for dots, view in one.views.items():
        scores[f"sticking share, {dots} dots"] = 1 - view.sticking_share, 0
        scores[f"slip has begun, {dots} dots"] = view.slip_begun, 0
        for name, model in ((name, model) for name, model in models.items() if name not in one.scores):
            scores[f"{name}, {dots} dots"] = over_each([model.detector()], view.path)[0], model.horizon_ms
    return scores


def planned_at(
    motion: str, objects: tuple[int, ...], seed: int, place: int, sensors: int, several: int = SENSORS
) -> tuple[int, Planned]:
    """Return object and plan of a motion's trial number `place`; every second trial has a random sensor.

    Objects differ from the table's in shape, width, weight and friction, with another object in each trial.
    """
    number = objects[place // 2 % len(objects)]
    sensor = EVETAC if place % 2 == 0 else f"randomized:{sensors + place // 2 % several}"
    return number, planned_on(sensor, motion, number, seed + place)


def planned_on(sensor: str, motion: str, number: int, seed: int) -> Planned:
    """Return the plan of a trial on a sensor with a cut gel."""
    trial = motions.planned(motion, number, seed, sensor, reshaped=motion != "data-rate")
    scene = replace(trial.plan.scene, gel=replace(trial.plan.scene.gel, cut=True))
    return trial._replace(plan=replace(trial.plan, scene=scene))


def judged(motion: str, trial: Trial, scores: Scores) -> Row:
    """Return the results of every score in a trial: counts by threshold."""
    held = trial.normal_n > 0.0
    slips = trial.slips & held
    begins = slip_warnings.slip_begins(slips)
    row: Row = {"minutes": minutes_of(trial), "slips": len(begins)}
    if motion in SLIPS and begins and begins[0] >= RAMP_MS:
        before = trial.normal_n[max(begins[0] - SPEED_MS, 0) : begins[0]]
        row["unloading_n_s"] = round(float(before[0] - before[-1]) / (1e-3 * len(before)), 3)
    row["scores"] = {
        name: _counted(motion, trial, score, horizon_ms, slips) for name, (score, horizon_ms) in scores.items()
    }
    return row


def _counted(motion: str, trial: Trial, score: Singles, horizon_ms: int, slips: Any) -> Row:
    held = trial.normal_n > 0.0
    level = alarms.levels(score)
    every = [slip_warnings.judge(is_slip(level, at) & held, trial.slip_share, slips) for at in THRESHOLDS]
    counted: Row = {
        "horizon_ms": horizon_ms,
        "calibration": _calibration(trial, score, horizon_ms, slips),
        "false": [one.false for one in every],
        "leads_ms": [one.leads_ms for one in every],
    }
    begins = slip_warnings.slip_begins(slips)
    if motion not in SLIPS or not begins or begins[0] < RAMP_MS:
        return counted
    onset = begins[0]
    label = np.where(np.arange(len(slips)) < RAMP_MS, np.int8(-1), trial.slips.astype(np.int8))
    shifted = shift_labels(label, horizon_ms)
    counted |= {"first_ms": [], "counts": []}
    for at in THRESHOLDS:
        on = is_slip(score, at)
        on[:RAMP_MS] = False
        first = metrics.onset(on)
        counted["first_ms"].append(None if first < 0 else first - onset)
        counted["counts"].append(list(metrics.counts(shifted, on, onset)))
    return counted


def _calibration(trial: Trial, score: Singles, horizon_ms: int, slips: Any) -> list[list[float]]:
    """Return the calibration by tenths of the score from ABOVE: slices, sum of scores, and slips after the horizon.

    Slices count while the object is held, up to F1_CUT_MS after its first slip, as in a report on slip.
    """
    begins = slip_warnings.slip_begins(slips)
    stop = min((begins[0] + F1_CUT_MS) if begins else len(score), len(score) - horizon_ms)
    predicted = np.nan_to_num(score[: max(stop, 0)])
    counted = (trial.normal_n[: len(predicted)] > 0.0) & (predicted >= ABOVE)
    tenth = np.minimum((10 * predicted).astype(int), 9)[counted]
    observed = trial.slips[horizon_ms : horizon_ms + len(predicted)][counted].astype(np.float64)
    columns = [np.bincount(tenth, of, 10) for of in (np.ones(len(tenth)), predicted[counted], observed)]
    return [[round(float(value), 2) for value in column] for column in columns]


def minutes_of(trial: Trial) -> float:
    """Return the minutes in which the object is held."""
    return round(float((trial.normal_n > 0.0).sum()) / 60_000, 5)


def see(
    folder: Path, motion: str, trials: Iterator[tuple[int, Planned]], seed: int, models: Mapping[str, Model],
    minutes: float, most: int = MOST_TRIALS,
) -> int:  # fmt: skip
    """Simulate trials of a motion until they reach the minutes or the number; return the number of those not refused.

    Existing files are not made again. SystemExit if a file has another trial.
    """
    so_far, count = 0.0, 0
    for place, (number, planned) in enumerate(trials):
        if so_far >= minutes or count >= most:
            break
        row: Row = {"object": number, "seed": seed + place, "sensor": planned.plan.sensor_name}
        path = folder / motion / f"{place:05d}.npz"
        if path.exists():
            one = slip_seen.read(path)
            if there := {key: one.row[key] for key in row if one.row[key] != row[key]}:
                raise SystemExit(f"{path}: expected {row}, found {there}; name another folder")
        else:
            one = slip_seen.seen(motion, row, planned, seed + place, models)
            slip_seen.write(path, one)
        if one.trial is not None:
            so_far, count = so_far + minutes_of(one.trial), count + 1
    return count
