"""Choose thresholds and make tables from rows of evaluated trials (trials.py): timing, warnings and false alarms.

Timing and F1 use the threshold chosen by the paper's rule, on other trials: of oracles by `choose_thresholds`, of
models in their files. Warnings of all scores are compared at equal false alarms per minute on the judged trials;
`stated_table` compares the false alarms that a model's file states with those on the judged trials.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Row
from evetac_cli.kernels.estimates import Estimate, cluster_weights, poisson_rate, ratio_of_clusters
from evetac_cli.kernels.slip.alarms import AFTER_MS, ALARM_SLICES, APART_MS, BEFORE_MS, MUCH_SLIPS
from evetac_cli.kernels.slip.metrics import Counts, timing
from evetac_cli.kernels.slip.reliability import ReliabilityBin, expected_error
from evetac_cli.stages.model_files import read_curve
from evetac_cli.store.files import StageFile
from scripts.reproduce.made_tables import table_of
from scripts.studies.motions import EVETAC
from scripts.studies.slip.seen import DOTS
from scripts.studies.slip.trials import SLIPS, THRESHOLDS

HERE = Path(__file__).resolve().parent
THRESHOLD_FILE = HERE / "thresholds.json"
PER_MINUTE = (0.5, 1.0, 4.0)  # false alarms per minute, averaged over motions, at which warnings are compared
AT_ONE = 1.0
WARNED_MS = (10, 20)  # least lead times of warnings that are compared
SPEEDS_N_S = (1.5, 4.0)  # limits of slow, usual and fast unloading: the paper's ramp unloads at 2.4 to 3.3 N/s
Rows = dict[str, list[Row]]  # by motion


def names_of(rows: Rows) -> list[str]:
    """Return the names of the scores in the rows."""
    first = next(row for of_motion in rows.values() for row in of_motion)
    return list(first["scores"])


def slip_rows(rows: Rows) -> list[Row]:
    """Return the trials that have an onset for the evaluation of timing."""
    return [row for motion in SLIPS for row in rows.get(motion, []) if "unloading_n_s" in row]


def false_per_minute(of_motion: Sequence[Row], score: str) -> NDArray[np.float64]:
    """Return false alarms per minute of contact, (thresholds,)."""
    minutes = sum(row["minutes"] for row in of_motion)
    counts = np.sum([row["scores"][score]["false"] for row in of_motion], axis=0)
    rate: NDArray[np.float64] = counts / minutes
    return rate


def mean_false(rows: Rows, score: str) -> NDArray[np.float64]:
    """Return false alarms per minute of contact, averaged over motions, (thresholds,).

    Each value is the maximum over its own and all higher thresholds, so the rate never rises with the threshold.
    """
    every = [false_per_minute(of_motion, score) for of_motion in rows.values() if of_motion]
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


def choose_thresholds(rows: Rows) -> None:
    """Write THRESHOLD_FILE: for every oracle, the threshold with the highest sum of correct timing and F1."""
    of_slips = slip_rows(rows)
    known = {}
    for score in names_of(rows):
        if "dots" not in score:
            merits = [
                float((timings(of_slips, score, at) == "correct").mean()) + f1(of_slips, score, at)
                for at in range(len(THRESHOLDS))
            ]
            known[score] = THRESHOLDS[int(np.argmax(merits))]
    found = {"sizes": sizes_of(rows), "timing": known}
    THRESHOLD_FILE.write_text(json.dumps(found, indent=1) + "\n")


def thresholds() -> dict[str, float]:
    """Return the thresholds for timing written by `choose_thresholds`."""
    loaded: dict[str, float] = json.loads(THRESHOLD_FILE.read_text())["timing"]
    return {score: nearest(threshold) for score, threshold in loaded.items()}


def thresholds_of(models: Mapping[str, Path]) -> dict[str, float]:
    """Return the thresholds for timing in the models' files, for each kind of dots."""
    found: dict[str, float] = {}
    for name, path in models.items():
        with StageFile(path, "model") as file:
            at = nearest(float(file.read("checkpoint/threshold")[int(file.read("checkpoint/chosen"))]))
        found |= {f"{name}, {dots} dots": at for dots in DOTS}
    return found


def nearest(threshold: float) -> float:
    """Return the nearest of THRESHOLDS, by log odds."""
    grid, at = np.array(THRESHOLDS), np.clip(threshold, 1e-6, 1 - 1e-6)
    return THRESHOLDS[int(np.argmin(np.abs(np.log(grid / (1 - grid)) - np.log(at / (1 - at)))))]


def mean_of(values: NDArray[np.floating], clusters: Sequence[str]) -> Estimate:
    """Return the mean over trials, with its confidence interval from resampled clusters."""
    mean = ratio_of_clusters(values.astype(float), np.ones(len(values)), cluster_weights(clusters))
    assert mean is not None  # there are trials
    return mean


def clusters_of(of_slips: Sequence[Row], *, each_slip: bool = False) -> list[str]:
    """Return each trial's cluster: its sensor if randomised, else its seed, since each trial has another object.

    each_slip: return one for every slip of a trial.
    """
    return [
        row["sensor"] if row["sensor"] != EVETAC else str(row["seed"])
        for row in of_slips
        for _ in range(row["slips"] if each_slip else 1)
    ]


def _share(flags: NDArray[np.bool_]) -> float | None:
    return float(flags.mean()) if len(flags) else None


def timing_table(name: str, rows: Rows, chosen: Mapping[str, float], command: str) -> Row:
    """Return the table of timing and F1 of every score at its threshold, for all slips and by unloading speed."""
    of_slips = slip_rows(rows)
    speed = np.array([row["unloading_n_s"] for row in of_slips])
    slow, fast = SPEEDS_N_S
    shown = []
    for score in (one for one in names_of(rows) if one in chosen):
        at = THRESHOLDS.index(chosen[score])
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


def paired_table(name: str, rows: Rows, chosen: Mapping[str, float], models: Iterable[str], command: str) -> Row:
    """Return the table of paired differences of each model from the oracle `ahead` with the same horizon.

    It also has each model's worst sensor and its calibration error.
    """
    of_slips = slip_rows(rows)
    shown = []
    for model in (f"{one}, {DOTS[0]} dots" for one in models):
        horizon_ms = of_slips[0]["scores"][model]["horizon_ms"]
        both = (f"ahead {horizon_ms} ms", model)
        right = [timings(of_slips, one, THRESHOLDS.index(chosen[one])) == "correct" for one in both]
        row: Row = {"model": model, "slips": len(of_slips), "horizon_ms": horizon_ms}
        row |= _difference("timing", right, clusters_of(of_slips))
        warned = [warned_values(rows, one, AT_ONE, WARNED_MS[0]) for one in both]
        row |= _difference("warned", warned, clusters_of(of_slips, each_slip=True))
        by_sensor: dict[str, list[bool]] = {}
        for of_slip, one in zip(of_slips, right[1], strict=True):
            by_sensor.setdefault(of_slip["sensor"], []).append(bool(one))
        several = {sensor: float(np.mean(found)) for sensor, found in by_sensor.items() if len(found) > 1}
        row["worst_sensor"] = min(several, key=lambda sensor: several[sensor]) if several else ""
        row["worst_correct"] = several[row["worst_sensor"]] if several else None
        row["calibration_error"] = calibration_error(rows, model)
        shown.append(row)
    columns = {"detector": "{model}", "slips": "{slips}", "ahead [ms]": "{horizon_ms}"}
    for heading, key in (("timing", "timing"), (f"warned {WARNED_MS[0]} ms ahead", "warned")):
        columns[heading] = f"{{{key}:.3f}}"
        columns[f"oracle less that, {heading}"] = f"{{{key}_less:.3f}} ({{{key}_low:.2f}} to {{{key}_high:.2f}})"
    columns |= {"worst sensor": "{worst_sensor}: {worst_correct:.2f}", "calibration error": "{calibration_error:.3f}"}
    note = (
        "Paired by slip; intervals of 95 % by sensor, and by object where trials share none. Worst: by timing."
        f" Warnings at {AT_ONE:g} false alarm per minute on these trials."
    )
    return table_of(name, "Slip detectors against an oracle", columns, shown, command, sizes_of(rows), notes=(note,))


def _difference(key: str, both: Sequence[NDArray[Any]], clusters: Sequence[str]) -> Row:
    """Return the mean of a model, and the mean of the oracle minus the model with its confidence interval."""
    oracle, model = (values.astype(float) for values in both)
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


def warned_values(rows: Rows, score: str, per_minute: float, least_ms: int) -> NDArray[np.float64]:
    """Return how far each slip is warned of at least `least_ms` ahead, at `per_minute` false alarms per minute, 0 to 1.

    Between two thresholds it is interpolated linearly by their rates; 0 if the rate is exceeded at all thresholds.
    """
    rates = mean_false(rows, score)
    above = int(np.argmax(rates <= per_minute)) if rates[-1] <= per_minute else len(rates)
    if above == len(rates):
        return np.zeros(sum(row["slips"] for row in slip_rows(rows)))
    if above == 0:
        return _warned(rows, score, 0, least_ms)
    part = (per_minute - rates[above]) / (rates[above - 1] - rates[above])
    lower, upper = (_warned(rows, score, at, least_ms) for at in (above - 1, above))
    between: NDArray[np.float64] = part * lower + (1 - part) * upper
    return between


def _warned(rows: Rows, score: str, at: int, least_ms: int) -> NDArray[np.float64]:
    leads = [ms for row in slip_rows(rows) for ms in row["scores"][score]["leads_ms"][at]]
    return np.array([ms is not None and ms >= least_ms for ms in leads], np.float64)


def groups_of(rows: Rows, named: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return the scores of each line of a table: the trainings of a detector together.

    named: names of the trainings by detector.
    """
    there = names_of(rows)
    trainings = {
        f"{detector}, {dots} dots": [f"{one}, {dots} dots" for one in every]
        for detector, every in named.items()
        for dots in DOTS
        if f"{every[0]}, {dots} dots" in there
    }
    known = {one for every in trainings.values() for one in every}
    return {score: [score] for score in there if score not in known} | trainings


MEANS = f"less than {MUCH_SLIPS:.0%} of the visible contact slips from {BEFORE_MS} ms before it to {AFTER_MS} ms after"


def rate_key(per_minute: float) -> str:
    """Return a rate as part of a column's name; str.format takes a point in it for an attribute."""
    return f"{per_minute:g}".replace(".", "_")


def warned_key(ms: int, per_minute: float) -> str:
    """Return the name of a column of slips warned of."""
    return f"warned_{ms}_ms_at_{rate_key(per_minute)}"


def warning_table(name: str, rows: Rows, named: Mapping[str, Sequence[str]], command: str) -> Row:
    """Return the table of the share of slips with a warning, by lead time and false alarms per minute."""
    clusters = clusters_of(slip_rows(rows), each_slip=True)
    shown = []
    for line, scores in groups_of(rows, named).items():
        row: Row = {"score": line, "slips": len(clusters), "trainings": len(scores)}
        for per_minute in PER_MINUTE:
            for ms in WARNED_MS:
                every = np.array([warned_values(rows, score, per_minute, ms) for score in scores])
                mean, key = mean_of(every.mean(axis=0), clusters), warned_key(ms, per_minute)
                row |= {key: mean.value, f"{key}_low": mean.low, f"{key}_high": mean.high}
                of_trainings = every.mean(axis=1)
                row |= {f"{key}_worst": float(of_trainings.min()), f"{key}_best": float(of_trainings.max())}
        shown.append(row)
    columns = {"detector": "{score}", "trainings": "{trainings}", "slips": "{slips}"}
    for per_minute in PER_MINUTE:
        for ms in WARNED_MS:
            key = warned_key(ms, per_minute)
            columns[f"{ms} ms ahead, {per_minute:g} per minute"] = (
                f"{{{key}:.2f}} ({{{key}_low:.2f}} to {{{key}_high:.2f}})"
            )
    key = warned_key(WARNED_MS[0], AT_ONE)
    columns[f"trainings, {WARNED_MS[0]} ms ahead, {AT_ONE:g} per minute"] = f"{{{key}_worst:.2f}} to {{{key}_best:.2f}}"
    note = (
        f"Share of slips warned of, at equal false alarms per minute of contact, averaged over {len(rows)} motions. An"
        f" alarm is {ALARM_SLICES} slices in a row; the next counts {APART_MS} ms later. It is false if {MEANS}. The"
        " threshold is read from the curve of these trials. Intervals of 95 % over slips, by sensor, and by object"
        " where trials share no sensor."
    )
    return table_of(name, "Warnings before slip", columns, shown, command, sizes_of(rows), notes=(note,))


def motions_table(name: str, rows: Rows, named: Mapping[str, Sequence[str]], command: str) -> Row:
    """Return the table of false alarms per minute and of slips warned of, by motion and by kind of sensor."""
    groups = {line: scores for line, scores in groups_of(rows, named).items() if "true dots" not in line}
    at = {
        score: min(int(np.searchsorted(-mean_false(rows, score), -AT_ONE)), len(THRESHOLDS) - 1)
        for scores in groups.values()
        for score in scores
    }
    parts = {motion: {motion: of_motion} for motion, of_motion in rows.items()}
    for kind, is_of in (("sensor evetac", True), ("random sensors", False)):
        parts[kind] = {motion: [row for row in of if (row["sensor"] == EVETAC) == is_of] for motion, of in rows.items()}
    shown = []
    for part, some in parts.items():
        slips = len(clusters_of(slip_rows(some), each_slip=True))
        row: Row = {"part": part, "minutes": sum(one["minutes"] for of in some.values() for one in of), "slips": slips}
        for line, scores in groups.items():
            false = [[false_per_minute(of, score)[at[score]] for of in some.values() if of] for score in scores]
            warned = [_warned(some, score, at[score], WARNED_MS[0]) for score in scores]
            row[f"{line} false"] = float(np.mean(false))
            row[f"{line} warned"] = float(np.mean(warned)) if slips else None
        shown.append(row)
    columns = {"motion or sensor": "{part}", "minutes of contact": "{minutes:.1f}", "slips": "{slips}"}
    columns |= {line: f"{{{line} false:.2f}} / {{{line} warned:.2f}}" for line in groups}
    note = (
        f"False alarms per minute, and share of slips warned of {WARNED_MS[0]} ms ahead, at the lowest threshold with"
        f" at most {AT_ONE:g} false alarm per minute over all motions and sensors. An alarm is false if {MEANS}."
    )
    title = "False alarms and warnings of each motion and kind of sensor"
    return table_of(name, title, columns, shown, command, sizes_of(rows), notes=(note,))


def stated_table(name: str, rows: Rows, models: Mapping[str, Path], command: str) -> Row:
    """Return the table of the false alarms per minute that a model's file states and of those on these trials."""
    shown = []
    for model, path in models.items():
        score = f"{model}, {DOTS[0]} dots"
        for per_minute in PER_MINUTE:
            at = _stated_at(path, per_minute)
            by_motion = {motion: float(false_per_minute(of, score)[at]) for motion, of in rows.items()}
            worst = max(by_motion, key=lambda motion: by_motion[motion])
            row: Row = {"model": model, "stated": per_minute, "threshold": THRESHOLDS[at]}
            row |= {"measured": float(np.mean([*by_motion.values()])), "worst": worst, "of_worst": by_motion[worst]}
            for kind, is_of in (("evetac", True), ("random", False)):
                some = [[one for one in of if (one["sensor"] == EVETAC) == is_of] for of in rows.values()]
                row[kind] = float(np.mean([false_per_minute(of, score)[at] for of in some if of]))
            row["warned"] = float(_warned(rows, score, at, WARNED_MS[0]).mean())
            shown.append(row)
    columns = {
        "training": "{model}",
        "stated per minute": "{stated:g}",
        "threshold": "{threshold:.3f}",
        "measured per minute": "{measured:.2f}",
        "sensor evetac": "{evetac:.2f}",
        "random sensors": "{random:.2f}",
        "worst motion": "{worst}: {of_worst:.1f}",
        f"warned {WARNED_MS[0]} ms ahead": "{warned:.2f}",
    }
    note = (
        "Stated: in the model's file, from the trials that chose its checkpoint and threshold, all motions together."
        f" Measured: mean over motions on other objects and sensors. An alarm is false if {MEANS}."
    )
    title = "Stated and measured false alarms per minute"
    return table_of(name, title, columns, shown, command, sizes_of(rows), notes=(note,))


def _stated_at(path: Path, per_minute: float) -> int:
    """Return the index of the threshold for which a model's file states this many false alarms per minute."""
    with StageFile(path, "model") as file:
        curve = read_curve(file)
    assert curve is not None
    return THRESHOLDS.index(nearest(curve.threshold_for(per_minute)))


def sensors_table(name: str, rows: Rows, models: Mapping[str, Path], command: str) -> Row:
    """Return the table of the false alarms of the first model on each random sensor, at stated rates."""
    model, path = next(iter(models.items()))
    score = f"{model}, {DOTS[0]} dots"
    sensors = sorted({row["sensor"] for of in rows.values() for row in of} - {EVETAC})
    shown = []
    for sensor in sensors:
        some = {motion: [row for row in of if row["sensor"] == sensor] for motion, of in rows.items()}
        every = [row for of in some.values() for row in of]
        row: Row = {"sensor": sensor, "minutes": sum(one["minutes"] for one in every)}
        row["slips"] = len(clusters_of(slip_rows(some), each_slip=True))
        for per_minute in PER_MINUTE:
            at, key = _stated_at(path, per_minute), rate_key(per_minute)
            false = poisson_rate(sum(one["scores"][score]["false"][at] for one in every), row["minutes"])
            row |= {f"at_{key}": false.value, f"low_{key}": false.low, f"high_{key}": false.high}
            row[f"warned_{key}"] = float(_warned(some, score, at, WARNED_MS[0]).mean())
        shown.append(row)
    columns = {"sensor": "{sensor}", "minutes of contact": "{minutes:.1f}", "slips": "{slips}"}
    for per_minute in PER_MINUTE:
        key = rate_key(per_minute)
        columns[f"at {per_minute:g} stated"] = f"{{at_{key}:.2f}} ({{low_{key}:.2f}} to {{high_{key}:.2f}})"
        columns[f"warned {WARNED_MS[0]} ms ahead, at {per_minute:g} stated"] = f"{{warned_{key}:.2f}}"
    note = (
        f"False alarms per minute of contact over all motions, with the 95 % interval of a Poisson count, by {model}."
        f" Motions count by their minutes, so {SLIPS[-1]} counts most. An alarm is false if {MEANS}."
    )
    return table_of(name, "False alarms on each random sensor", columns, shown, command, sizes_of(rows), notes=(note,))


def left_out_table(
    name: str, rows: Rows, models: Mapping[str, Path], left_out: Mapping[str, tuple[str, ...]], command: str
) -> Row:
    """Return the table of false alarms in motions that a model was trained with, and without.

    left_out: the motions that were left out, by model; it is compared with the first of the models.
    """
    usual, shown = next(iter(models)), []
    for model, motions_left in left_out.items():
        for motion in (motion for motion in motions_left if rows.get(motion)):
            some = {motion: rows[motion]}
            row: Row = {"motion": motion, "minutes": sum(one["minutes"] for one in rows[motion])}
            row["slips"] = len(clusters_of(slip_rows(some), each_slip=True))
            for kind, one in (("with", usual), ("without", model)):
                score = f"{one}, {DOTS[0]} dots"
                for per_minute in PER_MINUTE:
                    at, key = _stated_at(models[one], per_minute), rate_key(per_minute)
                    row[f"{kind}_{key}"] = float(false_per_minute(rows[motion], score)[at])
                    warned = _warned(some, score, at, WARNED_MS[0])
                    row[f"{kind}_warned_{key}"] = float(warned.mean()) if len(warned) else None
            shown.append(row)
    mean: Row = {"motion": "mean", "minutes": sum(row["minutes"] for row in shown)}
    mean["slips"] = sum(row["slips"] for row in shown)
    rates = [key for key in shown[0] if key.startswith("with") and "warned" not in key]
    shown.append(mean | {key: float(np.mean([row[key] for row in shown])) for key in rates})
    columns = {"motion": "{motion}", "minutes of contact": "{minutes:.1f}", "slips": "{slips}"}
    for per_minute in PER_MINUTE:
        key = rate_key(per_minute)
        for kind in ("with", "without"):
            columns[f"{per_minute:g} stated, trained {kind} it"] = f"{{{kind}_{key}:.2f}}"
    for kind in ("with", "without"):
        columns[f"warned, {AT_ONE:g} stated, trained {kind} it"] = f"{{{kind}_warned_{AT_ONE:g}:.2f}}"
    groups = "; ".join(", ".join(motions_left) for motions_left in left_out.values())
    note = (
        f"False alarms per minute, and share of slips warned of {WARNED_MS[0]} ms ahead, where this many are stated."
        f" Left out together, in training and in choosing the threshold: {groups}. An alarm is false if {MEANS}."
    )
    title = "Motions that were left out of the training"
    return table_of(name, title, columns, shown, command, sizes_of(rows), notes=(note,))
