"""Evaluate how early slip is detected, and with how many false alarms, by oracles with true values and by detectors.

`python scripts/studies/slip/judge.py choose --seed 4000 --minutes 3 --rows FOLDER` simulates each motion with the
objects for choosing thresholds, and writes the thresholds (thresholds.json). `... judge --seed 51000 --trials 200
--minutes 3 --rows FOLDER` simulates others, and writes tables. The folder keeps one row per trial, and existing rows
are not simulated again. --motions runs some motions, and writes only rows.

Without --model no camera is simulated. With `--model NAME=FILE ...`, detectors also see the trials through a camera.
Thresholds are chosen only for oracles; a model's thresholds are in its file.
"""

import argparse
import itertools
import sys
from pathlib import Path

from evetac_cli.evaluate.slip.models import Model
from evetac_cli.evaluate.slip.warnings import RULES
from evetac_cli.resources import MODEL
from scripts.reproduce.experiment import Check, Figure, ScriptCheck, Study
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import models_in_words, write
from scripts.reproduce.steps import script
from scripts.studies import motions
from scripts.studies.motions import Planned, Trial
from scripts.studies.slip import tables as slip_tables
from scripts.studies.slip import trials as slip_trials
from scripts.studies.slip.seen import seen
from scripts.studies.slip.trials import Scores, planned_at

MOST_TRIALS = 100_000


STUDY = Study(
    scripts={
        "slip-detectors-timing": ScriptCheck(
            (script("studies/slip/judge.py", "judge", "--seed", 52000, "--minutes", 0.3, "--trials", 30, "--model",
                    f"ours 10 ms={MODEL}", "--rows", "rows", "--out", "tables"),),
            4.0,
            Check(("score",), tuple(Figure(name, count="slips") for name in ("correct", "early", "late"))),
        ),
    },
)  # fmt: skip


def main() -> None:
    """Choose thresholds, or evaluate with them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("choose", "judge"))
    parser.add_argument("--seed", type=int, required=True, help="seed of the first trial of a motion")
    parser.add_argument("--minutes", type=float, required=True, help="minutes of contact for each motion")
    parser.add_argument("--trials", type=int, default=0, help="number of slip-speeds trials, instead of minutes")
    parser.add_argument("--motions", default="", help="only these, for example pushes,jerks; writes only rows")
    parser.add_argument("--rows", type=Path, required=True, help="folder of the rows, one file per motion")
    parser.add_argument("--model", nargs="*", default=[], metavar="NAME=FILE", help="trained slip detectors")
    parser.add_argument("--name", default="slip-detectors", help="name of the tables")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the tables")
    chosen = parser.parse_args()
    models = {name: Model.read(Path(path)) for name, _, path in (given.partition("=") for given in chosen.model)}
    objects = motions.CHOSEN_BY if chosen.what == "choose" else motions.JUDGED
    asked = [name for name in chosen.motions.split(",") if name]
    if unknown := set(asked) - set(motions.MOTIONS):
        parser.error(f"--motions: expected some of {', '.join(motions.MOTIONS)}, found {', '.join(sorted(unknown))}")

    def play(planned: Planned, seed: int) -> tuple[Trial, Scores]:
        trial, scores = seen(planned, seed, models) if models else (motions.played(planned, seed), {})
        return trial, {**slip_trials.oracle_scores(trial), **scores}

    rows = {}
    for motion in asked or motions.MOTIONS:
        counted = chosen.trials if motion == "slip-speeds" else 0
        plans = (planned_at(motion, objects, chosen.seed, place, chosen.seed) for place in itertools.count())
        path = chosen.rows / f"{motion.replace(' ', '-')}.jsonl"
        limits = (float("inf"), counted) if counted else (chosen.minutes, MOST_TRIALS)
        rows[motion] = slip_trials.rows_of(path, motion, plans, chosen.seed, *limits, play)
        for row in rows[motion]:
            if missing := models.keys() - row["scores"].keys():
                raise SystemExit(f"{path}: rows lack results of {', '.join(missing)}; name another folder with --rows")
        sys.stdout.write(f"{motion}: {len(rows[motion])} trials\n")
    if asked:
        return
    if chosen.what == "choose":
        slip_tables.choose_thresholds(rows, chosen.seed)
        return
    words = ["python scripts/studies/slip/judge.py judge", f"--seed {chosen.seed}", f"--minutes {chosen.minutes:g}"]
    words += [f"--trials {chosen.trials}"] * bool(chosen.trials)
    words += [f"--model {models_in_words(chosen.model)}"] * bool(models)
    command = " ".join([*words, f"--rows FOLDER --name {chosen.name}"])
    at = slip_tables.thresholds() | {name: slip_tables.thresholds_of(model.path) for name, model in models.items()}
    given = (rows, at)
    tables = [slip_tables.timing_table(f"{chosen.name}-timing", *given, command)]
    tables += [slip_tables.warning_table(f"{chosen.name}-{rule}", *given, rule, command) for rule in RULES]
    shown = ["ahead 10 ms", *models]
    tables += [slip_tables.motions_table(f"{chosen.name}-motions", *given, shown, command)]
    tables += [slip_tables.paired_table(f"{chosen.name}-paired", *given, list(models), command)] * bool(models)
    write(chosen.out, *tables)


if __name__ == "__main__":
    main()
