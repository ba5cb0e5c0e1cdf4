"""Evaluate one trial: alarms, lead times, timing and F1 of every score at every threshold, as one row.

A score is an oracle's, or the probability of a slip detector that sees the trial through camera and tracker.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Singles
from evetac_cli.errors import SceneError
from evetac_cli.evaluate.slip import warnings as slip_warnings
from evetac_cli.evaluate.slip.warnings import RULES
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip import alarms, metrics
from evetac_cli.kernels.slip.metrics import F1_CUT_MS, is_slip, shift_labels
from evetac_cli.kernels.slip.reliability import ABOVE
from scripts.studies import motions
from scripts.studies.motions import EVETAC, Planned, Trial
from scripts.studies.rows import add_rows, rows_in
from scripts.studies.slip import oracles as slip_oracles

# Thresholds are denser near 0 and 1, where the rare scores differ.
THRESHOLDS = (
    *(0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9),
    *(0.925, 0.95, 0.96, 0.97, 0.98, 0.985, 0.99, 0.995, 0.998, 0.999),
)
SLIPS = ("slip", "slip-varied", "slip-speeds")  # motions with an onset for the evaluation of timing
RAMP_MS = 900  # in these motions, the time before the onset is ignored, because the weight is being transferred
SENSORS = 20
SPEED_MS = 300  # ms before slip, over which the unloading speed is measured
Scores = Mapping[str, tuple[Singles, int]]  # probability of each slice by name, and its horizon in ms


def oracle_scores(trial: Trial) -> dict[str, tuple[Singles, int]]:
    """Return the scores of the oracles, each for each horizon."""
    pairs = itertools.product(slip_oracles.ORACLES, slip_oracles.HORIZONS_MS)
    return {f"{name} {ms} ms": (slip_oracles.score(trial, name, ms), ms) for name, ms in pairs}


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
    row: Row = {"minutes": round(float(held.sum()) / 60_000, 5), "slips": len(slip_warnings.slip_begins(slips))}
    begins = slip_warnings.slip_begins(slips)
    if motion in SLIPS and begins and begins[0] >= RAMP_MS:
        before = trial.normal_n[max(begins[0] - SPEED_MS, 0) : begins[0]]
        row["unloading_n_s"] = round(float(before[0] - before[-1]) / (1e-3 * len(before)), 3)
    row["scores"] = {
        name: _counted(motion, trial, score, horizon_ms, slips) for name, (score, horizon_ms) in scores.items()
    }
    return row


def _counted(motion: str, trial: Trial, score: Singles, horizon_ms: int, slips: Any) -> Row:
    held = trial.normal_n > 0.0
    every = [slip_warnings.judge(alarms.alarming(score, at) & held, trial.slip_share, slips) for at in THRESHOLDS]
    counted: Row = {
        "horizon_ms": horizon_ms,
        "calibration": _calibration(trial, score, horizon_ms, slips),
        "false": {rule: [one.false[rule] for one in every] for rule in RULES},
        "leads_ms": {rule: [one.leads_ms[rule] for one in every] for rule in RULES},
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


def rows_of(
    path: Path, motion: str, trials: Iterator[tuple[int, Planned]], seed: int, minutes: float, most: int,
    play: Callable[[Planned, int], tuple[Trial, Scores]],
) -> list[Row]:  # fmt: skip
    """Return the rows of a motion until its trials reach the minutes or the number, from the file if they exist.

    A trial that the simulator refuses leaves a row with the reason, which is not returned. SystemExit if the file has
    rows of other trials.
    """
    known = rows_in(path)
    rows: list[Row] = []
    for place, (number, planned) in enumerate(trials):
        judged_so_far = [row for row in rows if "refused" not in row]
        if sum(row["minutes"] for row in judged_so_far) >= minutes or len(judged_so_far) >= most:
            return judged_so_far
        row: Row = {"object": number, "seed": seed + place, "sensor": planned.plan.sensor_name}
        if place < len(known):
            there = {key: known[place].get(key) for key in row}
            if there != row:
                raise SystemExit(
                    f"{path}, line {place + 1}: expected {row}, found {there}; name another folder with --rows"
                )
            rows.append(known[place])
            continue
        try:
            row |= judged(motion, *play(planned, seed + place))
        except SceneError as error:  # a heavy object would compress a soft gel beyond the layer's limit
            row["refused"] = error.message
        rows.append(row)
        add_rows(path, [row])
    raise ValueError(f"{motion}: expected more than {len(rows)} trials for {minutes:g} minutes or {most} trials")
