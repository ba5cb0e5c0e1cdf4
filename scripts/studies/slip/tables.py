"""Choose thresholds and make tables from rows of evaluated trials (trials.py): timing, warnings and false alarms.

Oracles use the thresholds written by `choose_thresholds`; models use those in their files:

- timing and F1: the threshold chosen by the paper's rule
- warnings: the threshold that `grasp` uses
- warnings compared with an oracle's: the threshold for PER_MINUTE

All thresholds are rounded to the nearest of THRESHOLDS.
"""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.evaluate.slip.warnings import AFTER_MS, BEFORE_MS, FOLLOWS_MS, RULES
from evetac_cli.evaluate.slip.warnings import SLIPS as SLIP_SHARE
from evetac_cli.jobs import Row
from evetac_cli.kernels.estimates import Estimate, cluster_weights, ratio_of_clusters
from evetac_cli.kernels.slip.alarms import ALARM_SLICES, LEADS_MS
from evetac_cli.kernels.slip.metrics import Counts, timing
from evetac_cli.kernels.slip.reliability import ReliabilityBin, expected_error
from evetac_cli.stages.model_files import chosen_threshold, read_curve
from evetac_cli.store.files import StageFile
from scripts.reproduce.made_tables import table_of
from scripts.studies.slip.trials import SLIPS, THRESHOLDS

HERE = Path(__file__).resolve().parent
THRESHOLD_FILE = HERE / "thresholds.json"
PER_MINUTE = 1.0  # accepted false alarms per minute, averaged over motions
WARNED_MS = 10  # least lead time of a warning when models are compared
SPEEDS_N_S = (1.5, 4.0)  # limits of slow, usual and fast unloading: the paper's ramp unloads at 2.4 to 3.3 N/s
Rows = dict[str, list[Row]]  # by motion


def names_of(rows: Rows) -> list[str]:
    """Return the names of the scores in the rows."""
    first = next(row for of_motion in rows.values() for row in of_motion)
    return list(first["scores"])


def slip_rows(rows: Rows) -> list[Row]:
    """Return the trials that have an onset for the evaluation of timing."""
    return [row for motion in SLIPS for row in rows.get(motion, []) if "unloading_n_s" in row]


def false_per_minute(of_motion: Sequence[Row], score: str, rule: str) -> NDArray[np.float64]:
    """Return false alarms per minute of contact, (thresholds,)."""
    minutes = sum(row["minutes"] for row in of_motion)
    counts = np.sum([row["scores"][score]["false"][rule] for row in of_motion], axis=0)
    rate: NDArray[np.float64] = counts / minutes
    return rate


def mean_false(rows: Rows, score: str, rule: str) -> NDArray[np.float64]:
    """Return false alarms per minute of contact, averaged over motions, (thresholds,).

    Each value is the maximum over its own and all higher thresholds, so the rate never rises with the threshold.
    """
    every = [false_per_minute(of_motion, score, rule) for of_motion in rows.values() if of_motion]
    mean = np.mean(every, axis=0)
    lowest: NDArray[np.float64] = np.maximum.accumulate(mean[::-1])[::-1]
    return lowest


def f1(of_slips: Iterable[Row], score: str, at: int) -> float:
    """Return F1 over the slices of all trials. at: index of the threshold."""
    return Counts(*np.sum([row["scores"][score]["counts"][at] for row in of_slips], axis=0).tolist()).f1


def timings(of_slips: Sequence[Row], score: str, at: int) -> NDArray[np.str_]:
    """Return `early`, `correct` or `late` for each first detection, by the paper's rule. at: index of the threshold."""
    # `timing` requires slice numbers; an onset at slice `ahead` leaves room for the earliest detection
    first = [row["scores"][score]["first_ms"][at] for row in of_slips]
    ahead = 100_000
    return np.array([timing(-1 if ms is None else ahead + ms, ahead) for ms in first])


def choose_thresholds(rows: Rows, seed: int) -> None:
    """Write THRESHOLD_FILE: for every oracle, the threshold for timing and, by rule, that for warnings.

    The threshold for timing has the highest sum of correct timing and F1, as in the paper. The threshold for warnings
    is the lowest with at most PER_MINUTE false alarms per minute, or the highest of all if none has so few.
    """
    of_slips = slip_rows(rows)
    known = {}
    for score in names_of(rows):
        merits = [
            float((timings(of_slips, score, at) == "correct").mean()) + f1(of_slips, score, at)
            for at in range(len(THRESHOLDS))
        ]
        chosen: Row = {"timing": THRESHOLDS[int(np.argmax(merits))]}
        for rule in RULES:
            within = np.flatnonzero(mean_false(rows, score, rule) <= PER_MINUTE)
            chosen[rule] = THRESHOLDS[int(within[0])] if len(within) else THRESHOLDS[-1]
        trials = {motion: len(of_motion) for motion, of_motion in rows.items()}
        known[score] = {**chosen, "seed": seed, "trials": trials}
    THRESHOLD_FILE.write_text(json.dumps(known, indent=1) + "\n")


def thresholds() -> dict[str, Row]:
    """Return the thresholds written by `choose_thresholds`."""
    loaded: dict[str, Row] = json.loads(THRESHOLD_FILE.read_text())
    return loaded


def thresholds_of(path: Path) -> Row:
    """Return the thresholds in a model's file, in the form that `thresholds` has for each oracle."""
    with StageFile(path, "model") as file:
        chosen = int(file.read("checkpoint/chosen"))
        timing_at, grasp_at = float(file.read("checkpoint/threshold")[chosen]), chosen_threshold(file)
        curve = read_curve(file)
        alarm_at = grasp_at if curve is None else curve.threshold_for(PER_MINUTE)
    at = {"timing": timing_at, "grasp": grasp_at, **dict.fromkeys(RULES, alarm_at)}
    return {name: nearest(threshold) for name, threshold in at.items()}


def nearest(threshold: float) -> float:
    """Return the nearest of THRESHOLDS, by log odds."""
    grid, at = np.array(THRESHOLDS), np.clip(threshold, 1e-6, 1 - 1e-6)
    return THRESHOLDS[int(np.argmin(np.abs(np.log(grid / (1 - grid)) - np.log(at / (1 - at)))))]


def mean_of(values: NDArray[np.floating], clusters: Sequence[str]) -> Estimate:
    """Return the mean over trials, with its confidence interval from resampled clusters."""
    mean = ratio_of_clusters(values.astype(float), np.ones(len(values)), cluster_weights(clusters))
    assert mean is not None  # there are trials
    return mean


def clusters_of(of_slips: Sequence[Row]) -> list[str]:
    """Return each trial's cluster: its sensor if randomised, else its seed, since each trial has another object."""
    return [row["sensor"] if row["sensor"] != "evetac" else str(row["seed"]) for row in of_slips]


def _share(flags: NDArray[np.bool_]) -> float | None:
    return float(flags.mean()) if len(flags) else None


def timing_table(name: str, rows: Rows, chosen: Row, command: str) -> Row:
    """Return the table of timing and F1 of every score at its threshold, for all slips and by unloading speed."""
    of_slips = slip_rows(rows)
    speed = np.array([row["unloading_n_s"] for row in of_slips])
    slow, fast = SPEEDS_N_S
    shown = []
    for score in names_of(rows):
        at = THRESHOLDS.index(chosen[score]["timing"])
        outcome = timings(of_slips, score, at)
        right = outcome == "correct"
        first = [row["scores"][score]["first_ms"][at] for row in of_slips]
        correct = mean_of(right.astype(float), clusters_of(of_slips))
        shown.append(
            {
                "score": score,
                "slips": len(of_slips),
                "threshold": THRESHOLDS[at],
                "correct": correct.value,
                "correct_low": correct.low,
                "correct_high": correct.high,
                "early": float((outcome == "early").mean()),
                "late": float((outcome == "late").mean()),
                "f1": f1(of_slips, score, at),
                "first_ms_median": float(np.median([ms for ms in first if ms is not None] or [math.nan])),
                "correct_slow": _share(right[speed < slow]),
                "correct_usual": _share(right[(speed >= slow) & (speed < fast)]),
                "correct_fast": _share(right[speed >= fast]),
            }
        )
    columns = {
        "knows, ahead": "{score}",
        "slips": "{slips}",
        "threshold": "{threshold:g}",
        "timing correct": "{correct:.3f} ({correct_low:.2f} to {correct_high:.2f})",
        "early": "{early:.3f}",
        "late": "{late:.3f}",
        "F1": "{f1:.3f}",
        "first detection, median [ms]": "{first_ms_median:.0f}",
        f"correct, below {slow:g} N/s": "{correct_slow:.2f}",
        f"{slow:g} to {fast:g} N/s": "{correct_usual:.2f}",
        f"above {fast:g} N/s": "{correct_fast:.2f}",
    }
    note = (
        "Timing and F1 as in the paper; thresholds chosen on other trials. Intervals by sensor, and by object where"
        " trials share no sensor."
    )
    return table_of(name, "Timing of slip", columns, shown, command, sizes_of(rows), notes=(note,))


def calibration_error(rows: Rows, score: str) -> float | None:
    """Return a score's calibration error, `reliability.expected_error`, as in the report of `evetac evaluate slip`."""
    every = [row["scores"][score]["calibration"] for of_motion in rows.values() for row in of_motion]
    return expected_error(
        [
            ReliabilityBin(tenth / 10, (tenth + 1) / 10, int(slices), predicted / slices, observed / slices)
            for tenth, (slices, predicted, observed) in enumerate(np.sum(every, axis=0).T.tolist())
            if slices
        ]
    )


def paired_table(name: str, rows: Rows, chosen: Row, models: Sequence[str], command: str) -> Row:
    """Return the table of paired differences of each model from the oracle `ahead` with the same horizon.

    It also has each model's worst sensor and its calibration error.
    """
    of_slips = slip_rows(rows)
    clusters = clusters_of(of_slips)
    shown = []
    for model in models:
        horizon_ms = of_slips[0]["scores"][model]["horizon_ms"]
        oracle = f"ahead {horizon_ms} ms"
        both = (oracle, model)
        right = [timings(of_slips, one, THRESHOLDS.index(chosen[one]["timing"])) == "correct" for one in both]
        row: Row = {"model": model, "slips": len(of_slips), "horizon_ms": horizon_ms}
        row |= _difference("timing", *(one.astype(float) for one in right), clusters)
        for rule in RULES:
            warned = [leads(of_slips, one, rule, THRESHOLDS.index(chosen[one][rule]), most=1) for one in both]
            row |= _difference(rule, *((one >= WARNED_MS).astype(float) for one in warned), clusters)
        by_sensor: dict[str, list[bool]] = {}
        for of_slip, one in zip(of_slips, right[1], strict=True):
            by_sensor.setdefault(of_slip["sensor"], []).append(bool(one))
        several = {sensor: float(np.mean(found)) for sensor, found in by_sensor.items() if len(found) > 1}
        row["worst_sensor"] = min(several, key=lambda sensor: several[sensor]) if several else ""
        row["worst_correct"] = several[row["worst_sensor"]] if several else None
        row["calibration_error"] = calibration_error(rows, model)
        shown.append(row)
    columns = {"detector": "{model}", "slips": "{slips}", "ahead [ms]": "{horizon_ms}"}
    for heading, key in (("timing", "timing"), *((f"warned {WARNED_MS} ms ahead, {rule}", rule) for rule in RULES)):
        columns[heading] = f"{{{key}:.3f}}"
        columns[f"oracle less that, {heading}"] = f"{{{key}_less:.3f}} ({{{key}_low:.2f}} to {{{key}_high:.2f}})"
    columns |= {"worst sensor": "{worst_sensor}: {worst_correct:.2f}", "calibration error": "{calibration_error:.3f}"}
    note = (
        "Paired by trial; intervals of 95 % by sensor, and by object where trials share none. Worst: by timing."
        f" Warnings at the thresholds of {PER_MINUTE:g} false alarm per minute on other trials."
    )
    return table_of(name, "Slip detectors against an oracle", columns, shown, command, sizes_of(rows), notes=(note,))


def _difference(key: str, oracle: NDArray[np.float64], model: NDArray[np.float64], clusters: Sequence[str]) -> Row:
    """Return the mean of a model, and the mean of the oracle minus the model with its confidence interval."""
    less = mean_of(oracle - model, clusters)
    return {key: float(model.mean()), f"{key}_less": less.value, f"{key}_low": less.low, f"{key}_high": less.high}


def sizes_of(rows: Rows) -> Row:
    """Return the seeds behind the tables, and the trials and minutes of contact by motion."""
    return {
        "seeds": f"{min(row['seed'] for of in rows.values() for row in of)}-"
        f"{max(row['seed'] for of in rows.values() for row in of)}",
        "trials": {motion: len(of_motion) for motion, of_motion in rows.items()},
        "minutes": {motion: round(sum(row["minutes"] for row in of), 2) for motion, of in rows.items()},
    }


def leads(of_slips: Sequence[Row], score: str, rule: str, at: int, most: int | None = None) -> NDArray[np.float64]:
    """Return the lead time of the warning of each slip, in ms, (slips,); minus infinity if there was no warning.

    at: index of the threshold; most: the number of slips used from each trial, starting with the first (None: all).
    """
    found = [ms for row in of_slips for ms in row["scores"][score]["leads_ms"][rule][at][:most]]
    return np.array([-math.inf if ms is None else ms for ms in found])


def warned_at(rows: Rows, score: str, rule: str, per_minute: float, least_ms: int) -> float:
    """Return the share of slips with a warning at least `least_ms` ahead, at `per_minute` false alarms per minute.

    The share is interpolated linearly between thresholds.
    """
    of_slips = slip_rows(rows)
    # Rates never rise with the threshold, so they are reversed for np.interp. Among thresholds with equal rates, the
    # lowest threshold is then the last.
    rates = mean_false(rows, score, rule)
    shares = [float((leads(of_slips, score, rule, at) >= least_ms).mean()) for at in range(len(THRESHOLDS))]
    return float(np.interp(per_minute, rates[::-1], shares[::-1]))


def shown_scores(rows: Rows) -> list[str]:
    """Return the scores shown in tables of warnings; `share` has one, because it does not depend on the horizon."""
    return [score for score in names_of(rows) if not score.startswith("share") or score == "share 0 ms"]


def alarm_threshold(chosen: Row, rule: str) -> float:
    """Return the threshold for warnings: a model's threshold for `grasp`, or an oracle's for PER_MINUTE."""
    threshold: float = chosen.get("grasp", chosen[rule])
    return threshold


MEANS = {
    "partial": f"less than {SLIP_SHARE:.0%} of the visible contact slips from {BEFORE_MS} ms before it to"
    f" {AFTER_MS} ms after",
    "gross": f"no gross slip follows within {FOLLOWS_MS} ms",
}


def warning_table(name: str, rows: Rows, chosen: Row, rule: str, command: str) -> Row:
    """Return the table of the share of slips with a warning, by lead time, and of false alarms per minute."""
    shown = []
    for score in shown_scores(rows):
        at = THRESHOLDS.index(alarm_threshold(chosen[score], rule))
        row: Row = {"score": score, "threshold": THRESHOLDS[at]}
        ahead = leads(slip_rows(rows), score, rule, at)
        row |= {f"warned_{ms}_ms": float((ahead >= ms).mean()) for ms in LEADS_MS}
        row |= {f"warned_{ms}_ms_at_one": warned_at(rows, score, rule, PER_MINUTE, ms) for ms in LEADS_MS}
        row["false_per_min"] = float(np.mean([false_per_minute(of, score, rule)[at] for of in rows.values()]))
        shown.append(row)
    columns = {"detector": "{score}", "threshold": "{threshold:g}", "false alarms per minute": "{false_per_min:.2f}"}
    columns |= {f"warned {ms} ms ahead": f"{{warned_{ms}_ms:.2f}}" for ms in LEADS_MS}
    columns |= {
        f"{ms} ms ahead, at {PER_MINUTE:g} false alarm per minute": f"{{warned_{ms}_ms_at_one:.2f}}" for ms in LEADS_MS
    }
    note = (
        f"False alarm: {MEANS[rule]}. An alarm is {ALARM_SLICES} slices in a row; the next counts 200 ms later."
        f" False alarms are per minute of contact, averaged over {len(rows)} motions. Detectors are read at the"
        f" threshold of `grasp`, oracles at that of {PER_MINUTE:g} per minute on other trials. The last columns are"
        " read from the curve of these trials."
    )
    title = f"Warnings before slip; an alarm is false if {MEANS[rule]}"
    return table_of(name, title, columns, shown, command, sizes_of(rows), notes=(note,))


def motions_table(name: str, rows: Rows, chosen: Row, scores: Sequence[str], command: str) -> Row:
    """Return the table of false alarms per minute in each motion, by both rules, for the given scores."""
    shown = []
    for motion, of_motion in rows.items():
        row: Row = {"motion": motion, "minutes": sum(one["minutes"] for one in of_motion)}
        for score in scores:
            for rule in RULES:
                row[f"{score} {rule}"] = float(
                    false_per_minute(of_motion, score, rule)[THRESHOLDS.index(alarm_threshold(chosen[score], rule))]
                )
        shown.append(row)
    columns = {"motion": "{motion}", "minutes of contact": "{minutes:.1f}"}
    columns |= {score: f"{{{score} {RULES[0]}:.2f}} / {{{score} {RULES[1]}:.2f}}" for score in scores}
    note = f"First: false if {MEANS[RULES[0]]}; second: if {MEANS[RULES[1]]}. Thresholds as above."
    return table_of(
        name, "False alarms per minute of each motion", columns, shown, command, sizes_of(rows), notes=(note,)
    )
