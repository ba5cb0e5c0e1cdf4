"""Evaluate the estimate of the sticking share, motion by motion, on unseen objects and partly on unseen motions.

`python scripts/studies/sticking/judge.py --seeds 60000-60999 --minutes 20 --rows FOLDER` simulates each motion until
the gel has been touched for that many simulated minutes (docs/results/sticking-share.json). The folder keeps one row
per trial, and existing rows are not simulated again; --motions runs some motions, without writing the table. Dots come
without a camera, with a random tracker error (trials.py); the last rows are with camera and tracker.

- Error: of the slipping share where the truth is between 0.05 and 0.95, mean over looks, every 5 ms.
- In time: the share of gross slips preceded by an alarm 20 ms or more. A slip is possible to detect if the true
  sticking share was 0.8 or less at that time.
- False alarms: alarms that begin, or continue, after the true slipping share has been below 0.05 for AFTER_MS. Alarms
  within NEAR_MS before or after a time above 0.05 count as just before or just after a slip. Alarms within AFTER_MS are
  counted separately.
"""

import argparse
import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.evaluate.slip.warnings import begins
from evetac_cli.jobs import Row
from evetac_cli.kernels.touch.rest import BLOCK_MS
from evetac_cli.kernels.touch.sticking import ALARM, PATIENCE
from evetac_cli.stages.touch.touch_fold import shipped_network
from scripts.reproduce.experiment import Check, Figure, ScriptCheck, Study
from scripts.reproduce.facts import RESULTS, ranges
from scripts.reproduce.made_tables import table_of, write
from scripts.reproduce.steps import script
from scripts.studies import motions
from scripts.studies.motions import Trial
from scripts.studies.rows import add_rows, rows_in, seeds_of
from scripts.studies.slip.seen import Seen
from scripts.studies.sticking import trials
from scripts.studies.sticking.rigid_motion import rigid_slip_share
from scripts.studies.sticking.trials import AFTER_MS, HIGH, LOW, Looks

NAME = "sticking-share"
SLIPS = 0.2
AHEAD_MS, APART_MS, NEAR_MS = 20, 100, 200
BEFORE_MS = 1000  # an alarm up to this long before a slip belongs to it
CONSTANT = 0.14  # median slipping share between LOW and HIGH in the training trials
METHODS = ("network", "rigid", "zero", "constant")
# The later motions are for the slip detector: a light touch has no minutes that count here.
MOTIONS = motions.MOTIONS[: motions.MOTIONS.index("vibration") + 1]
CAMERA, WITH_CAMERA = "slip", "slip with camera"  # the motion that is also simulated with a camera
CAMERA_MINUTES = 0.6  # limit for the motion with camera


def method_shares(trial: Trial, looks: Looks) -> dict[str, Singles]:
    """Return each method's estimate of the slipping share at each look."""
    at_mm = trial.in_mm(trial.rest_px)
    rigid = [rigid_slip_share(held, now, at_mm) for held, now in looks.fields_mm]
    none = np.zeros(len(looks.slices), np.float32)
    return {"network": looks.estimated, "rigid": np.array(rigid, np.float32), "zero": none, "constant": none + CONSTANT}


def alarms_of(share: Singles) -> Flags:
    """Return at which looks the slipping share has been above the alarm level for PATIENCE looks."""
    slipping = share > 1 - ALARM
    alarm = slipping.copy()
    for back in range(1, PATIENCE):
        alarm[back:] &= slipping[:-back]
        alarm[:back] = False
    return alarm


def at_slices(looks: Looks, values: Flags, slices: int) -> Flags:
    """Return the values of looks for every slice, each held until the next look; False without touch."""
    whole = np.zeros(slices, np.bool_)
    for at, value in zip(looks.slices.tolist(), values.tolist(), strict=True):
        whole[at : at + BLOCK_MS] = value
    return whole


def judged(trial: Trial, looks: Looks) -> Row:
    """Return a trial's sums of errors and counts of slips and alarms, by method."""
    truth = trial.slip_share
    at_looks = truth[looks.slices]
    between = (at_looks > LOW) & (at_looks < HIGH)
    slips = begins(trial.slips, 3 * APART_MS)
    recently = trials.recent_largest(truth, AFTER_MS)
    row: Row = {
        "minutes": len(looks.slices) * BLOCK_MS / 60_000,
        "looks_between": int(between.sum()),
        "slips": len(slips),
        "possible": sum(bool((truth[max(on - BEFORE_MS, 0) : max(on - AHEAD_MS, 0)] >= SLIPS).any()) for on in slips),
    }
    for name, share in method_shares(trial, looks).items():
        alarm = at_slices(looks, looks.alarm if name == "network" else alarms_of(share), len(truth))
        if name == "constant":
            alarm[:] = False
        wrong = begins(alarm & (recently < LOW), APART_MS)
        row |= {
            f"{name}_error_sum": float(np.abs(share - at_looks)[between].sum()),
            f"{name}_in_time": sum(bool(alarm[max(on - BEFORE_MS, 0) : max(on - AHEAD_MS, 0)].any()) for on in slips),
            f"{name}_false": len(wrong),
            f"{name}_early": sum(bool((truth[on : on + NEAR_MS] >= LOW).any()) for on in wrong),
            f"{name}_late": sum(bool((truth[max(on - NEAR_MS, 0) : on] >= LOW).any()) for on in wrong),
            f"{name}_after": len(begins(alarm & (truth < LOW), APART_MS)),
        }
    shear = trial.shear_n[looks.slices]
    off = np.angle(np.exp(1j * (looks.direction_rad - np.arctan2(shear[:, 1], shear[:, 0]))))
    known = np.isfinite(off) & (at_looks > SLIPS)
    within = (np.abs(looks.estimated - at_looks) < looks.sd)[between]
    return row | {
        "directions": int(known.sum()),
        "direction_error_sum_rad": float(np.abs(off[known]).sum()),
        "within_sd": int(within.sum()),
    }


def tracked_trial(number: int, seed: int) -> tuple[Trial, Floats]:
    """Return a trial seen by a camera, with dots from the tracker `stable`."""
    eye = Seen(sticks=False)
    trial = motions.played(motions.planned(CAMERA, number, seed), seed, eye.see)
    return trial, eye.dot_px.astype(np.float64)


def rows_of(motion: str, seeds: range, minutes: float, folder: Path) -> list[Row]:
    """Return the rows of a motion until its trials are long enough, read from the folder if they exist there."""
    path = folder / f"{motion.replace(' ', '-').replace(',', '')}.jsonl"
    by_trial = {(row["object"], row["seed"]): row for row in rows_in(path)}
    rows: list[Row] = []
    for seed, number in itertools.product(seeds, motions.JUDGED):
        if sum(row["minutes"] for row in rows) >= minutes:
            return rows
        row = by_trial.get((number, seed))
        if row is None:
            row = {"object": number, "seed": seed, **row_of(motion, number, seed)}
            add_rows(path, [row])
        rows.append(row)
    raise SystemExit(f"{motion}: {len(seeds)} seeds are too few for {minutes:g} minutes")


def row_of(motion: str, number: int, seed: int) -> Row:
    """Simulate and evaluate one trial."""
    rng = np.random.default_rng([seed, number, 1])
    if motion == WITH_CAMERA:
        trial, dot_px = tracked_trial(number, seed)
        return judged(trial, trials.looks_at(trial, dot_px, np.zeros(len(trial.rest_px), np.bool_), shipped_network()))
    trial = motions.played(motions.planned(motion, number, seed), seed)
    return judged(trial, trials.looks_of(trial, rng, shipped_network()))


def summary(motion: str, rows: list[Row]) -> Row:
    """Summarise the rows of one or several motions for the table."""

    def total(name: str) -> float:
        return float(sum(row[name] for row in rows))

    def part(of: str, by: str) -> float | None:
        return total(of) / total(by) if total(by) else None

    shown: Row = {"motion": motion, "trials": len(rows), "minutes": total("minutes"), "slips": int(total("slips"))}
    shown["possible"] = part("possible", "slips")
    for name in METHODS:
        shown[f"{name}_error"] = part(f"{name}_error_sum", "looks_between")
        shown[f"{name}_in_time"] = part(f"{name}_in_time", "slips")
        shown[f"{name}_false_per_min"] = part(f"{name}_false", "minutes")
        shown[f"{name}_early_per_min"] = part(f"{name}_early", "minutes")
        shown[f"{name}_late_per_min"] = part(f"{name}_late", "minutes")
        shown[f"{name}_after_per_min"] = part(f"{name}_after", "minutes")
    off = part("direction_error_sum_rad", "directions")
    shown["direction_off_deg"] = None if off is None else math.degrees(off)
    return shown | {"within_sd": part("within_sd", "looks_between")}


COLUMNS = {
    "motion": "{motion}",
    "minutes": "{minutes:.1f}",
    "error, network": "{network_error:.3f}",
    "model-free": "{rigid_error:.3f}",
    "always 0": "{zero_error:.3f}",
    "constant": "{constant_error:.3f}",
    "within its deviation": "{within_sd:.0%}",
    "direction off [deg]": "{direction_off_deg:.0f}",
    "slips": "{slips}",
    "in time, network": "{network_in_time:.0%}",
    "in time, model-free": "{rigid_in_time:.0%}",
    "possible": "{possible:.0%}",
    "false alarms per minute, network": "{network_false_per_min:.2f}",
    "of these just before, just after a slip": "{network_early_per_min:.2f}, {network_late_per_min:.2f}",
    "false, model-free": "{rigid_false_per_min:.2f}",
    "all alarms below 0.05": "{network_after_per_min:.2f}",
}


NOTE = (
    f"Error, where 0.05 to 0.95 slip. In time: an alarm {AHEAD_MS} ms or more before gross slip; possible: 0.8 or less"
    f" stuck by then. False alarms: where less than 0.05 slipped for {AFTER_MS} ms; just before and"
    f" after a slip: within {NEAR_MS} ms of one. All alarms below 0.05: with those in these {AFTER_MS} ms."
    " *: a motion that was not trained on. Objects " + ranges(motions.JUDGED) + ", of which none was trained on."
)


STUDY = Study(
    scripts={
        "sticking-share": ScriptCheck(
            (script("studies/sticking/judge.py", "--seeds", "60000-60999", "--minutes", 1, "--rows", "rows",
                    "--out", "tables"),),
            4.0,
            Check(("motion",), (Figure("network_in_time", count="slips"), Figure("rigid_in_time", count="slips"))),
        ),
    },
)  # fmt: skip


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="FIRST-LAST; trials of each object per seed")
    parser.add_argument("--minutes", type=float, default=20.0, help="minutes of touch for each motion")
    parser.add_argument("--motions", default="", help="only these, for example pushes,jerks; writes no table")
    parser.add_argument("--rows", type=Path, required=True, help="folder of the rows, one file per motion")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the table")
    chosen = parser.parse_args()
    seeds = chosen.seeds
    asked = [name for name in chosen.motions.split(",") if name]
    shown, every = [], []
    for motion in asked or (*MOTIONS, WITH_CAMERA):
        rows = rows_of(
            motion, seeds, min(chosen.minutes, CAMERA_MINUTES) if motion == WITH_CAMERA else chosen.minutes, chosen.rows
        )
        if motion != WITH_CAMERA:
            every += rows
        name = f"{motion} *" if motion in trials.UNSEEN else motion
        shown.append(summary(name, rows))
        sys.stdout.write(json.dumps(shown[-1]) + "\n")
        if motion == MOTIONS[-1] and not asked:
            shown.append(summary("all", every))
            sys.stdout.write(json.dumps(shown[-1]) + "\n")
    if not asked:
        command = f"python scripts/studies/sticking/judge.py --seeds {ranges(seeds)} --minutes {chosen.minutes:g}"
        sizes = {"objects": list(motions.JUDGED), "minutes_of_each_motion": chosen.minutes}
        title = "The share of a contact that sticks, by motion"
        write(chosen.out, table_of(NAME, title, COLUMNS, shown, f"{command} --rows sticking", sizes, notes=(NOTE,)))


if __name__ == "__main__":
    main()
