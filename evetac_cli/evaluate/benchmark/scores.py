"""The five scores of a benchmark, one number each, by split and in all, with 95 % intervals over sensors and objects.

- onset: share of slips whose first detection is from 50 ms before to 20 ms after gross slip begins (the paper's rule).
- warning: share of slips with a warning at least 10 ms ahead, at the lowest threshold with at most one false alarm per
  minute of contact in the recordings without slip. The rule of alarms is that of kernels/slip/alarms.py; the alarm that
  is on when the object slips must have begun at most 200 ms before.
- force: mean absolute error of the shear force over instants and both axes, in N.
- dots: root mean square of the distance from the true dots, over instants and dots, in px.
- grip: share of lifts whose object is held to the end with a mean grip force of at most 3 times what just holds it.

In force and dots each recording counts the same. `n` slips, recordings or lifts are behind a score; `left_out` are the
recordings without slip, of which onset and warning have no score.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.evaluate.benchmark.data_set import Benchmark, Truth
from evetac_cli.evaluate.benchmark.predictions import Predictions
from evetac_cli.evaluate.common.rows import ends, mean
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels import estimates
from evetac_cli.kernels.estimates import Estimate
from evetac_cli.kernels.slip import alarms, metrics

AHEAD_MS = 10, 200  # of a warning
FALSE_PER_MIN = 1.0
FIRMEST = 3.0  # mean grip force over what just holds the object
ALL = "all"
MS_PER_MIN = 60_000
FINE, COARSER = 200, 1.03  # thresholds that are tried: every one of the highest, then a geometric series of their ranks
UNITS = {"onset": "share", "warning": "share", "force": "N", "dots": "px", "grip": "share"}
TASKS = tuple(UNITS)


class TrialScore(NamedTuple):
    """The contribution of a recording or a slip to a score: `above` over `below`, and figures for further columns."""

    split: str
    sensor: str
    object_name: str
    above: float
    below: float = 1.0
    more: Mapping[str, float] = {}


def all_rows(benchmark: Benchmark, truth: Mapping[str, Truth], made: Predictions, lifts: Rows | None) -> Rows:
    """Return a row for each task with predictions and each split, and for all of them."""
    rows: Rows = []
    if made.onset_ms is not None:
        parts = onset_parts(benchmark, truth, made.onset_ms)
        still = [benchmark.entries[name].split for name in made.onset_ms if truth[name].onset_ms is None]
        rows += task_rows("onset", parts, left_out=still)
    if made.warning is not None:
        threshold, per_min, minutes = threshold_of(benchmark, truth, made.warning)
        parts = warning_parts(benchmark, truth, made.warning, threshold)
        alarms: Row = {"threshold": threshold, "false_per_min": per_min, "quiet_minutes": minutes}
        still = [benchmark.entries[name].split for name in made.warning if not truth[name].slip_begins]
        rows += [row | alarms for row in task_rows("warning", parts, left_out=still)]
    if made.force_n is not None:
        rows += task_rows("force", force_parts(benchmark, truth, made.force_n))
    if made.dot_xy_px is not None:
        rows += task_rows("dots", dots_parts(benchmark, truth, made.dot_xy_px), np.sqrt)
    if lifts is not None:
        rows += grip_rows(lifts)
    return rows


def task_rows(
    task: str,
    parts: Sequence[TrialScore],
    of_ratio: Callable[[float], float] = float,
    left_out: Sequence[str] = (),
) -> Rows:
    """Return the rows of a task.

    of_ratio: converts the ratio of sums to the score. left_out: the split of each recording without slip. Further
    figures that some parts lack have their own number, `<name>_n`.
    """
    rows = []
    names = parts[0].more if parts else ()
    partly_known = [name for name in names if not all(np.isfinite(part.more[name]) for part in parts)]
    for split in (*dict.fromkeys(part.split for part in parts), ALL):
        chosen = [part for part in parts if split in (part.split, ALL)]
        estimate = _estimate(chosen)
        row: Row = {"task": task, "split": split, "unit": UNITS[task], "n": len(chosen)}
        left = sum(split in (one, ALL) for one in left_out)
        row |= {"left_out": left, "left_out_because": "no slip" if left else None}
        row |= dict.fromkeys(("value", "low", "high"))
        if estimate is not None:
            row |= {name: float(of_ratio(value)) for name, value in estimate._asdict().items()}
        row |= {
            "sensors": len({part.sensor for part in chosen}),
            "objects": len({part.object_name for part in chosen}),
            **{name: mean(part.more[name] for part in chosen) for name in names},
            **{f"{name}_n": sum(bool(np.isfinite(part.more[name])) for part in chosen) for name in partly_known},
        }
        rows.append(row)
    return rows


def _estimate(parts: Sequence[TrialScore]) -> Estimate | None:
    if not parts:
        return None
    weights = estimates.cluster_weights([part.sensor for part in parts], [part.object_name for part in parts])
    above, below = (np.array([getattr(part, name) for part in parts]) for name in ("above", "below"))
    return estimates.ratio_of_clusters(above, below, weights)


def _part(benchmark: Benchmark, true: Truth, name: str, above: float, **more: float) -> TrialScore:
    return TrialScore(benchmark.entries[name].split, true.sensor, true.object_name, above, more=more)


def onset_parts(
    benchmark: Benchmark, truth: Mapping[str, Truth], onset_ms: Mapping[str, int | None]
) -> list[TrialScore]:
    """Return a part for each recording of kind slip whose object slips."""
    parts = []
    for name, detected in onset_ms.items():
        onset = truth[name].onset_ms
        if onset is not None:
            timing = metrics.timing(-1 if detected is None else detected, onset)
            more = {kind: float(timing == kind) for kind in ("early", "late")}
            parts.append(_part(benchmark, truth[name], name, float(timing == "correct"), **more))
    return parts


def threshold_of(
    benchmark: Benchmark, truth: Mapping[str, Truth], scores: Mapping[str, NDArray[np.float32]]
) -> tuple[float | None, float | None, float]:
    """Return the lowest threshold with few enough false alarms, their rate, and the minutes of contact without slip.

    None if every threshold has too many, as for a constant score. Thresholds are tried from the highest score down, and
    the last before the first with too many false alarms is taken.
    """
    quiet = [name for name in scores if not truth[name].slip_begins]
    minutes = sum(int(truth[name].held.sum()) for name in quiet) / MS_PER_MIN
    if minutes == 0.0:
        return None, None, 0.0
    levels = [np.where(truth[name].held, alarms.levels(scores[name]), np.nan) for name in quiet]
    found: tuple[float | None, float | None] = (None, None)
    for threshold in _thresholds(np.concatenate(levels)):
        false = sum(len(alarms.onsets(level >= threshold)) for level in levels)
        if false / minutes > FALSE_PER_MIN:
            break
        found = float(threshold), false / minutes
    return *found, minutes


def _thresholds(levels: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the thresholds that are tried, from the highest down: first one above all levels without slip."""
    known = np.unique(levels[~np.isnan(levels)])[::-1]
    if not len(known):
        return known
    ranks = [*range(FINE), *(FINE * COARSER ** np.arange(1, 1000)).astype(int)]
    tried = known[[rank for rank in ranks if rank < len(known)]]
    return np.concatenate([[np.nextafter(known[0], np.float32(np.inf), dtype=np.float32)], tried])


def warning_parts(
    benchmark: Benchmark, truth: Mapping[str, Truth], scores: Mapping[str, NDArray[np.float32]], threshold: float | None
) -> list[TrialScore]:
    """Return a part for each gross slip; without a threshold there is no warning."""
    parts = []
    for name, score in scores.items():
        true = truth[name]
        if not true.slip_begins:
            continue
        warned = [False] * len(true.slip_begins)
        if threshold is not None:
            alarming = alarms.alarming(score, threshold) & true.held
            leads = [alarms.lead_ms(alarming, begin) for begin in true.slip_begins]
            warned = [lead is not None and AHEAD_MS[0] <= lead <= AHEAD_MS[1] for lead in leads]
        parts += [_part(benchmark, true, name, float(one)) for one in warned]
    return parts


def force_parts(benchmark: Benchmark, truth: Mapping[str, Truth], force_n: Mapping[str, NDArray]) -> list[TrialScore]:
    """Return a part for each press."""
    parts = []
    for name, forces in force_n.items():
        true = truth[name]
        error_n = np.abs(forces - true.shear_n).mean(axis=0)
        more = {"error_x_n": float(error_n[0]), "error_y_n": float(error_n[1])}
        more["true_force_n"] = float(np.abs(true.shear_n).mean())
        parts.append(_part(benchmark, true, name, float(error_n.mean()), **more))
    return parts


def dots_parts(benchmark: Benchmark, truth: Mapping[str, Truth], dot_xy_px: Mapping[str, NDArray]) -> list[TrialScore]:
    """Return a part for each recording, with the mean square."""
    parts = []
    for name, places in dot_xy_px.items():
        true = truth[name]
        squares = ((places - true.dot_xy_px) ** 2).sum(axis=2)
        more = {"median_px": float(np.sqrt(np.median(squares))), "worst_px": float(np.sqrt(squares.max()))}
        parts.append(_part(benchmark, true, name, float(squares.mean()), **more))
    return parts


def grip_rows(lifts: Rows) -> Rows:
    """Return the rows of lifts, with intervals also of the share that was held and of the mean force."""
    parts = grip_parts(lifts)
    rows = task_rows("grip", parts)
    for row in rows:
        chosen = [part for part in parts if row["split"] in (part.split, ALL)]
        for name in ("kept", "force_over_holding"):
            known = [part._replace(above=part.more[name]) for part in chosen if np.isfinite(part.more[name])]
            row.update(ends(name, _estimate(known)))
    return rows


def grip_parts(lifts: Rows) -> list[TrialScore]:
    """Return a part for each lift; lifts: rows of `lifts.outcomes`."""
    parts = []
    for row in lifts:
        ratio = row["over_holding_mean"]
        kept = bool(row["balanced"])
        lightly = kept and ratio is not None and ratio <= FIRMEST
        more = {"kept": float(kept), "force_over_holding": float("nan") if ratio is None else float(ratio)}
        parts.append(TrialScore(row["split"], row["sensor"], row["object"], float(lightly), more=more))
    return parts
