"""Evaluate how well labels find the onset of slip: `event-flow` against the paper's `farneback`.

`python scripts/studies/labels/judge.py --seeds 50000-50009 --rows FOLDER` simulates 200 slips of all twenty objects on
`evetac`, 100 on the sensors `randomized:SEED`, one each, and 60 on `realistic` (docs/results/labels.json). The slips
are simulated in memory, as `evetac record` would write them (trials.py). Each row (one per trial and method) is
added to the folder at once, and existing rows are not simulated again. --trials changes the numbers of slips.

Errors are those of `evaluate labels`: the true slide of the object between the labels' onset and the true onset, and
the difference in ms. The 95 % intervals resample whole objects, because trials of one object are alike.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.commands.label import Label
from evetac_cli.errors import InputError
from evetac_cli.evaluate.labels.measure import is_near, judged, summary, true_onsets
from evetac_cli.jobs import Row
from evetac_cli.kernels.estimates import Estimate, cluster_weights, ratio_of_clusters
from evetac_cli.stages import label, label_methods
from evetac_cli.store.recordings.onset import LabelledOnset, onset_of_values
from scripts.reproduce.experiment import Check, Figure, ScriptCheck, Study
from scripts.reproduce.facts import RESULTS, ranges
from scripts.reproduce.made_tables import table_of, write
from scripts.reproduce.steps import script
from scripts.studies.labels.trials import PlayedSlip, play_slip
from scripts.studies.rows import add_rows, rows_in, seeds_of

NAME = "labels"
METHODS = ("event-flow", "farneback")
OBJECTS = range(1, 21)
SENSORS = ("evetac", "randomized", "realistic")
TRIALS = (200, 100, 60)  # slips on each


class Slip(NamedTuple):
    """A slip to simulate."""

    sensors: str
    sensor: str
    object: int
    seed: int


def slips(sensors: str, seeds: range, trials: int) -> Iterator[Slip]:
    """Return the slips: all objects for each seed, with a randomised sensor for each."""
    if trials > len(seeds) * len(OBJECTS):
        raise SystemExit(f"{sensors}: {len(seeds)} seeds are too few for {trials} trials")
    for number in range(trials):
        sensor = f"{sensors}:{seeds[0] + number}" if sensors == "randomized" else sensors
        yield Slip(sensors, sensor, OBJECTS[number % len(OBJECTS)], seeds[number // len(OBJECTS)])


def rows_of(slip: Slip) -> list[Row]:
    """Return a row for each method."""
    played = play_slip(slip.object, slip.seed, slip.sensor)
    true = true_onsets(played.as_recording())
    return [{**slip._asdict(), "method": method, **row_of(played, true, method)} for method in METHODS]


def row_of(played: PlayedSlip, true: dict[str, int | None], method: str) -> Row:
    """Compare a method's labels of a slip with the truth; the run time is processor time."""
    began_s = time.process_time()
    try:
        labels = label_methods.compute(played.as_recording(), Label(method=method))
    except InputError as error:
        onset = LabelledOnset(None, None, None, None, str(error).splitlines()[0])
    else:
        onset = onset_of_values(labels.onset, labels.earliest, labels.latest, labels.confidence, labels.doubt)
    took_s = time.process_time() - began_s
    return {**judged(onset, true, played.read("truth/slid_px")), "cpu_s": took_s, "slices": len(played)}


def all_rows(sensors: str, seeds: range, trials: int, folder: Path) -> list[Row]:
    """Return the rows of all slips of some sensors, read from the folder if they exist there."""
    path = folder / f"{sensors}.jsonl"
    known: dict[Slip, list[Row]] = {}
    for row in rows_in(path):
        known.setdefault(Slip(*(row[name] for name in Slip._fields)), []).append(row)
    rows: list[Row] = []
    for slip in slips(sensors, seeds, trials):
        if slip not in known:
            known[slip] = rows_of(slip)
            add_rows(path, known[slip])
        rows += known[slip]
    return rows


def shown(sensors: str, method: str, rows: list[Row]) -> Row:
    """Return a row of the table."""
    near = interval([(row["object"], is_near(row)) for row in rows if _counts(row)])
    figures = summary(rows)
    of_all = summary([row | {"abstained": False} for row in rows])
    figures |= {name: of_all[name] for name in ("onsets_found", "onset_error_px_median", "onset_error_ms_median")}
    return {
        "sensors": sensors,
        "slips": sum(row["t_s_ms"] is not None for row in rows),
        **figures,
        "method": method,
        "abstained_share": figures["abstained_share"] or 0.0,
        "interval": "" if near is None else f"{near.low:.2f} to {near.high:.2f}",
        "rest_worst_early_ms": min((row["onset_error_ms"] or 0 for row in rows if _counts(row)), default=0),
        "cpu_s": float(np.median([row["cpu_s"] for row in rows])),
    }


def _counts(row: Row) -> bool:
    return row["t_s_ms"] is not None and not row["abstained"]


def interval(flags: list[tuple[int, bool]]) -> Estimate | None:
    """Return the share of flags with its interval from resampled objects; None if there are fewer than two objects."""
    objects, marked = [number for number, _ in flags], np.array([flag for _, flag in flags], float)
    if len(set(objects)) < 2:
        return None
    return ratio_of_clusters(marked, np.ones(len(marked)), cluster_weights(objects))


COLUMNS = {
    "sensors": "{sensors}",
    "method": "{method}",
    "slips": "{slips}",
    "abstained": "{abstained_share:.0%}",
    "of the rest within 0.5 px slid": "{rest_within_half_px:.2f} ({interval})",
    "over 10 ms early": "{rest_over_10_ms_early}",
    "in -4..+3 ms": "{rest_within_minus4_plus3_ms:.2f}",
    "interval covers": "{interval_coverage:.2f}",
    "its median width [px]": "{interval_width_px_median:.2f}",
    "[ms]": "{interval_width_ms_median:.0f}",
    "of all within 0.5 px": "{within_half_px:.2f}",
    "median error of all [px]": "{onset_error_px_median:.2f}",
    "[ms], of all": "{onset_error_ms_median:.0f}",
    "run time [s]": "{cpu_s:.2f}",
}
NOTE = (
    "px: true distance that the object slid as one body. Rest: labels that did not abstain. Farneback is the paper's"
    " method, with evetac's constants. Run time: median processor time per trial."
)


STUDY = Study(
    scripts={
        "labels": ScriptCheck(
            (script("studies/labels/judge.py", "--seeds", "50000-50009", "--trials", "20,10,6", "--rows", "rows",
                    "--out", "tables"),),
            3.0,
            Check(("sensors", "method"), (Figure("onsets_found", "trajectories"), Figure("abstained", "trajectories"))),
        ),
    },
)  # fmt: skip


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="FIRST-LAST; a trial of each object per seed")
    parser.add_argument(
        "--trials", default=",".join(map(str, TRIALS)), help="numbers of slips on " + ", ".join(SENSORS)
    )
    parser.add_argument("--rows", type=Path, required=True, help="folder of the rows, one file for each kind of sensor")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the table")
    chosen = parser.parse_args()
    seeds = chosen.seeds
    table: list[Row] = []
    sizes: dict[str, Any] = {"recording_seeds": list(seeds), "objects": list(OBJECTS)}
    for sensors, trials in zip(SENSORS, map(int, chosen.trials.split(",")), strict=True):
        rows = all_rows(sensors, seeds, trials, chosen.rows) if trials else []
        sizes[f"trials_{sensors}"] = trials
        for method in METHODS if rows else ():
            table.append(shown(sensors, method, [row for row in rows if row["method"] == method]))
            sys.stdout.write(json.dumps(table[-1]) + "\n")
    title = "Onsets of slip by labels against true gross slip"
    command = f"python scripts/studies/labels/judge.py --seeds {ranges(seeds)} --trials {chosen.trials} --rows labels"
    made = table_of(NAME, title, COLUMNS, table, command, sizes, notes=(NOTE,))
    write(chosen.out, made | {"methods": {"label": label.METHOD}})


if __name__ == "__main__":
    main()
