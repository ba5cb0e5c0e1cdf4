"""The table of slip detectors by sensor: timing and F1 of each detector, and the gain from adapting it to a sensor.

The rows of evaluated trials come from studies/slip/trials.py, as a dict by the sensor's name. Each trial has a
different object.
"""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import Counts
from scripts.studies.slip import tables
from scripts.studies.slip.trials import THRESHOLDS
from scripts.studies.tables import table_of

NAME = "slip-detectors-sensors"
ADAPTED = "adapted"  # name of the score of a model adapted to the sensor
RANDOMISED = "randomized:"  # prefix of the name of a randomised sensor


def key_of(score: str) -> str:
    """Return the prefix of a score's keys in a row."""
    return re.sub(r"\W+", "_", score)


def score_columns(score: str, right: NDArray[np.float64], clusters: Sequence[object], f1: float) -> Row:
    """Return a score's share of correct timing with its confidence interval, and F1, as values of a row.

    right: 1 for each slip with correct timing, else 0, (slips,); clusters: the cluster of each slip, (slips,).
    """
    correct, key = tables.mean_of(right, list(map(str, clusters))), key_of(score)
    return {f"{key}_correct": correct.value, f"{key}_low": correct.low, f"{key}_high": correct.high, f"{key}_f1": f1}


def sensor_rows(rows: dict[str, list[Row]], at: dict[str, dict[str, float]], before: str | None) -> list[Row]:
    """Return the rows of the table from the rows of trials.

    at: for each sensor, the threshold of each score; before: the name of the model that was adapted, or None.
    """
    slips = {sensor: [row for row in of if "unloading_n_s" in row] for sensor, of in rows.items()}

    def right(score: str, sensors: Sequence[str]) -> NDArray[np.float64]:
        every = [tables.timings(slips[one], score, THRESHOLDS.index(at[one][score])) for one in sensors]
        return (np.concatenate(every) == "correct").astype(float)

    def f1(score: str, sensors: Sequence[str]) -> float:
        places = [(row, THRESHOLDS.index(at[one][score])) for one in sensors for row in slips[one]]
        return Counts(*np.sum([row["scores"][score]["counts"][place] for row, place in places], axis=0).tolist()).f1

    groups = [(sensor, [sensor]) for sensor in rows]
    randomised = [sensor for sensor in rows if sensor.startswith(RANDOMISED)]
    adapted = [sensor for sensor in rows if before and ADAPTED in at[sensor]]
    for name, several in (("randomised", randomised), (ADAPTED, adapted)):
        groups += [(f"{len(several)} {name} together", several)] * (len(several) > 1)
    shown = []
    for name, several in groups:
        clusters = [row["seed" if len(several) == 1 else "sensor"] for one in several for row in slips[one]]
        row: Row = {"sensor": name, "slips": len(clusters)}
        for score in at[several[0]]:
            if all(score in at[one] for one in several):
                row |= score_columns(score, right(score, several), clusters, f1(score, several))
        shown.append(row)
    if before and len(adapted) > 1:  # `clusters` is still that of the adapted sensors, the last group
        gain, more = right(ADAPTED, adapted) - right(before, adapted), f1(ADAPTED, adapted) - f1(before, adapted)
        less: Row = {"sensor": f"adapted less {before}, paired", "slips": len(gain)}
        shown.append(less | score_columns(ADAPTED, gain, clusters, more))
    return shown


def table(shown: list[Row], scores: Sequence[str], sensors: int, command: str, sizes: Row) -> Row:
    """Return the table of all sensors, with the worst sensor of each score in a note.

    shown: rows of `sensor_rows`; the first `sensors` of them are those of single sensors.
    """
    columns, worst = {"sensor": "{sensor}", "slips": "{slips}"}, []
    for score in scores:
        key = key_of(score)
        timing = f"{{{key}_correct:.2f}} ({{{key}_low:.2f}} to {{{key}_high:.2f}})"
        columns[f"{score}: timing correct; F1"] = f"{timing}; {{{key}_f1:.2f}}"
        lowest = min((row for row in shown[:sensors] if f"{key}_correct" in row), key=lambda row: row[f"{key}_correct"])
        worst.append(f"{score} on {lowest['sensor']} ({lowest[f'{key}_correct']:.2f})")
    notes = [
        "Each trial has another object. Intervals of 95 % by object, for several sensors by sensor; thresholds are"
        f" those of the model files. Worst by timing: {', '.join(worst)}."
    ]
    if ADAPTED in scores:
        columns |= {"onsets told to adapt by": "{labelled}", "adapted in [s]": "{took_s:.0f}"}
        notes.append(
            "Adapted: with `evetac train --adapt` on one minute of contact in other slips of the same sensor, labelled"
            " from events; only if at least 8 onsets have a label. Time: of one processor core, from `label` to"
            " `train`."
        )
    return table_of(NAME, "Slip detectors from sensor to sensor", columns, shown, command, sizes, notes=notes)
