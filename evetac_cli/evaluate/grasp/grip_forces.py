"""How firmly controllers grip: the grip force over the least force that holds the object, by class of mass.

Also whether the force follows the weight. Rows are grasps as in `evaluate grasp` and the scripts: their `setting` or
controller, the outcome from sim/grasp_outcome.py, and `carried_g`, the mass that the gripper carried at the end. Forces
count only for objects that were held to the end.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.rows import mean, quantile
from evetac_cli.jobs import Row, Rows
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2

CLASSES_G = ((30.0, 100.0), (100.0, 250.0), (250.0, 600.0))
STAYED_MM = 3.0  # an object that moved less counts as not moved


def firmness(trials: Rows) -> Row:
    """Return how many grasps of one controller kept their object, and with how much excess force; None where unknown.

    Excess force is relative to the least force that holds the object, in the `over_holding_counted` grasps that kept
    it and of which this force is known.
    """
    held_trials = [row for row in trials if row["balanced"]]
    with_excess = [row for row in held_trials if row.get("over_holding_end") is not None]
    row: Row = {
        "grasps": len(trials),
        "kept": len(held_trials) / len(trials),
        "lost": ", ".join(
            f"{count} {how}" for how, count in Counter(row["failure"] for row in trials if row["failure"]).most_common()
        ),
    }
    row["over_holding_counted"] = len(with_excess)
    for name in ("end", "mean", "peak"):
        values = [one[f"over_holding_{name}"] for one in with_excess]
        row |= {
            f"over_holding_{name}_median": quantile(values, 0.5),
            f"over_holding_{name}_p95": quantile(values, 0.95),
        }
    for low, high in CLASSES_G:
        values = [one["over_holding_end"] for one in with_excess if low <= one["carried_g"] < high]
        row[f"over_holding_counted_{low:g}_{high:g}_g"] = len(values)
        row[f"over_holding_end_p95_{low:g}_{high:g}_g"] = quantile(values, 0.95)
    row["force_follows_weight"] = rank_correlation(
        [one["carried_g"] for one in with_excess], [one["force_end_n"] for one in with_excess]
    )
    row["stayed_share"] = mean(one["moved_mm"] < STAYED_MM for one in held_trials)
    row["motor_work_j_median"] = quantile([one["motor_work_j"] for one in held_trials], 0.5)
    reactions, false = (sum(one[name] for one in trials) for name in ("slip_events", "false_slip_events"))
    return {**row, "reactions_mean": reactions / len(trials), "false_share": false / reactions if reactions else None}


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation of two columns, ties sharing their rank; None where it is undefined."""
    if len(first) < 3 or any(np.ptp(values) == 0.0 for values in (first, second)):
        return None
    from scipy import stats  # takes half a second to load

    return float(stats.spearmanr(first, second).statistic)


def draw(figure: Any, settings: Sequence[tuple[int, str, Rows]]) -> None:
    """Plot grip force at the end against weight, with the least force that holds each object.

    settings: number of the series, setting, held trials. Both axes are logarithmic, so proportionality is a slope of 1.
    """
    axes = figure.subplots()
    weights_n, holding_n = [], []
    for number, name, trials in settings:
        x_n = [row["carried_g"] * 1e-3 * GRAVITY_M_S2 for row in trials]
        weights_n += x_n
        holding_n += [row["holding_end_n"] for row in trials]
        style = {**picture.series(number), "linestyle": "none"}
        axes.plot(x_n, [row["force_end_n"] for row in trials], label=f"controller {name}", **style)
    axes.plot(weights_n, holding_n, "_", color="0.35", markersize=10, label="least force that holds the object")
    middle = float(np.median(np.array(holding_n) / np.array(weights_n)))
    ends = np.array([min(weights_n), max(weights_n)])
    axes.plot(ends, middle * ends, color="0.35", linewidth=1, label="... at the median friction")
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        picture.log_axis(axis)
    axes.set_xlabel("weight carried at the end [N]")
    axes.set_ylabel("grip force at the end [N]")
    picture.legend(figure, [axes])
