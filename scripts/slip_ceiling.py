"""The ceiling of slip detection: how well oracles do that know what no sensor does, on slips and other motion.

`python scripts/slip_ceiling.py choose --seed 4000 --minutes 3 --rows FOLDER` plays each motion with objects that
thresholds are chosen by, and writes the thresholds (slip-thresholds.json). `... judge --seed 51000 --trials 200
--minutes 5 --rows FOLDER` plays others, and writes the tables. Rows, one a trial, are kept in the folder, and what is
there is not simulated again; --motions does some of them, and writes nothing else. No camera is simulated.
"""

import argparse
import itertools
import sys
from pathlib import Path

import motions
import slip_trials
from motions import Planned, Trial
from script_tables import RESULTS, write
from slip_tables import choose_thresholds, timing_table, warning_tables
from slip_trials import Scores, planned_at

NAME = "slip-ceiling"
MOST_TRIALS = 100_000


def played(planned: Planned, seed: int) -> tuple[Trial, Scores]:
    """A trial without a camera, and what the oracles say of it."""
    trial = motions.played(planned, seed)
    return trial, slip_trials.oracle_scores(trial)


def main() -> None:
    """Choose thresholds, or judge by them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("choose", "judge"))
    parser.add_argument("--seed", type=int, required=True, help="of the first trial of a motion")
    parser.add_argument("--minutes", type=float, required=True, help="of contact, for each motion")
    parser.add_argument("--trials", type=int, default=0, help="of slip-speeds, in place of minutes")
    parser.add_argument("--motions", default="", help="some of them, as in pushes,jerks; rows alone are written")
    parser.add_argument("--rows", type=Path, required=True, help="folder of the rows, one file a motion")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    objects = motions.CHOSEN_BY if chosen.what == "choose" else motions.JUDGED
    asked = [name for name in chosen.motions.split(",") if name]
    rows = {}
    for motion in asked or motions.MOTIONS:
        counted = chosen.trials if motion == "slip-speeds" else 0
        plans = (planned_at(motion, objects, chosen.seed, place, chosen.seed) for place in itertools.count())
        path = chosen.rows / f"{motion.replace(' ', '-')}.jsonl"
        limits = (float("inf"), counted) if counted else (chosen.minutes, MOST_TRIALS)
        rows[motion] = slip_trials.rows_of(path, motion, plans, chosen.seed, *limits, played)
        sys.stdout.write(f"{motion}: {len(rows[motion])} trials\n")
    if asked:
        return
    if chosen.what == "choose":
        choose_thresholds(rows, chosen.seed)
        return
    command = f"python scripts/slip_ceiling.py judge --seed {chosen.seed} --minutes {chosen.minutes:g}"
    command += f" --trials {chosen.trials} --rows FOLDER" if chosen.trials else " --rows FOLDER"
    write(chosen.out, timing_table(f"{NAME}-timing", rows, command), *warning_tables(f"{NAME}-warning", rows, command))


if __name__ == "__main__":
    main()
