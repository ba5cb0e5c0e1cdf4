"""Evaluate how early slip is detected, and with how many false alarms, by oracles with true values and by detectors.

`python scripts/studies/slip/judge.py see FOLDER --seed 73000 --minutes 3 --trials 300` simulates each motion, one file
per trial (seen.py), which takes hours; existing files are not made again. `--objects choose` takes the objects for
choosing thresholds. `... choose FOLDER` writes the oracles' thresholds for timing (thresholds.json). `... judge FOLDER
--model NAME=FILE ...` writes tables; models of one name are trainings of one detector. Networks over dots are given to
`see` instead. `... left-out FOLDER --model NAME=FILE MOTION,MOTION=FILE ...` compares the first model with others that
were trained without the motions of their names.
"""

import argparse
import functools
import itertools
import json
import lzma
import multiprocessing
import sys
from collections.abc import Sequence
from pathlib import Path

from evetac_cli.evaluate.slip.models import Model
from evetac_cli.jobs import Row
from evetac_cli.resources import MODEL
from scripts.reproduce.experiment import Check, Figure, ScriptCheck, Study
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import models_in_words, write
from scripts.reproduce.steps import script
from scripts.studies import motions
from scripts.studies.slip import tables as slip_tables
from scripts.studies.slip import trials as slip_trials
from scripts.studies.slip.seen import SeenTrial, trials_in
from scripts.studies.slip.tables import Rows
from scripts.studies.slip.trials import planned_at

OBJECTS = {"judge": motions.JUDGED, "choose": motions.CHOSEN_BY}

STUDY = Study(
    scripts={
        "slip-detectors-timing": ScriptCheck(
            (script("studies/slip/judge.py", "see", "seen", "--seed", 73000, "--minutes", 0.3, "--trials", 30),
             script("studies/slip/judge.py", "judge", "seen", "--model", f"load-path 1={MODEL}", "--out", "tables")),
            4.0,
            Check(("score",), tuple(Figure(name, count="slips") for name in ("correct", "early", "late"))),
        ),
    },
)  # fmt: skip


read_model = functools.cache(Model.read)  # once in each process


def judged(one: SeenTrial, models: dict[str, Path]) -> Row:
    """Return the row of a trial with the results of every score."""
    assert one.trial is not None
    read = {name: read_model(path) for name, path in models.items() if name not in one.scores}
    scores = slip_trials.scores_of(one, read)
    return one.row | slip_trials.judged(one.motion, one.trial, scores)


def rows_of(folder: Path, models: dict[str, Path], jobs: int) -> Rows:
    """Return the rows of all trials of a folder by motion; SystemExit if there are none."""
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        judge = functools.partial(judged, models=models)
        rows = {motion: [*pool.imap(judge, trials_in(folder, motion), 8)] for motion in motions.MOTIONS}
    if not any(rows.values()):
        raise SystemExit(f"{folder}: expected trials, found none; run `judge.py see` first")
    return {motion: of_motion for motion, of_motion in rows.items() if of_motion}


def see(chosen: argparse.Namespace, names: Sequence[str]) -> None:
    """Simulate the trials of each motion."""
    models = {name: Model.read(Path(path)) for name, _, path in (given.partition("=") for given in chosen.model)}
    for motion in names:
        counted = chosen.trials if motion == "slip-speeds" else 0
        limits = (float("inf"), counted) if counted else (chosen.minutes,)
        plans = (planned_at(motion, OBJECTS[chosen.objects], chosen.seed, at, chosen.seed) for at in itertools.count())
        count = slip_trials.see(chosen.folder, motion, plans, chosen.seed, models, *limits)
        sys.stdout.write(f"{motion}: {count} trials\n")
        sys.stdout.flush()


def judge(chosen: argparse.Namespace) -> None:
    """Write the tables and their rows."""
    named: dict[str, list[str]] = {}
    models = {}
    given = [one.partition("=")[::2] for one in chosen.model]
    for name, path in given:
        several = [other for other, _ in given].count(name) > 1
        named.setdefault(name, []).append(f"{name} {len(named.get(name, ())) + 1}" if several else name)
        models[named[name][-1]] = Path(path)
    rows = rows_of(chosen.folder, models, chosen.jobs)
    words = f" --model {models_in_words(chosen.model)}" if models else ""
    command = f"python scripts/studies/slip/judge.py judge FOLDER{words} --name {chosen.name}"
    at = slip_tables.thresholds() | slip_tables.thresholds_of(models)
    tables = [
        slip_tables.timing_table(f"{chosen.name}-timing", rows, at, command),
        slip_tables.warning_table(f"{chosen.name}-warned", rows, named, command),
        slip_tables.motions_table(f"{chosen.name}-motions", rows, named, command),
    ]
    if models:
        tables.append(slip_tables.stated_table(f"{chosen.name}-stated", rows, models, command))
        tables.append(slip_tables.paired_table(f"{chosen.name}-paired", rows, at, models, command))
        tables.append(slip_tables.sensors_table(f"{chosen.name}-sensors", rows, models, command))
    write(chosen.out, *tables)
    kept = chosen.out / "rows" / f"{chosen.name}.jsonl.xz"
    kept.parent.mkdir(exist_ok=True)
    with lzma.open(kept, "wt") as file:
        file.writelines(json.dumps({"motion": name} | row) + "\n" for name, of in rows.items() for row in of)


def left_out(chosen: argparse.Namespace) -> None:
    """Write the table of models that were trained without some motions, each named by these motions."""
    models = {name: Path(path) for name, _, path in (given.partition("=") for given in chosen.model)}
    motions_of = {name: tuple(name.split(",")) for name in list(models)[1:]}
    command = f"python scripts/studies/slip/judge.py left-out FOLDER --model {models_in_words(chosen.model)}"
    rows = rows_of(chosen.folder, models, chosen.jobs)
    write(chosen.out, slip_tables.left_out_table(f"{chosen.name}-left-out", rows, models, motions_of, command))


def main() -> None:
    """Simulate trials, choose thresholds, or evaluate with them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("see", "choose", "judge", "left-out"))
    parser.add_argument("folder", type=Path, help="folder of the trials, one folder per motion")
    parser.add_argument("--seed", type=int, default=0, help="see: seed of the first trial of a motion")
    parser.add_argument("--minutes", type=float, default=3.0, help="see: minutes of contact for each motion")
    parser.add_argument("--trials", type=int, default=0, help="see: number of slip-speeds trials, instead of minutes")
    parser.add_argument("--motions", default="", help="see: only these, for example pushes,jerks")
    parser.add_argument("--objects", choices=tuple(OBJECTS), default="judge", help="see: which objects")
    parser.add_argument(
        "--model", nargs="*", default=[], metavar="NAME=FILE", help="see: networks over dots; judge: load-path"
    )
    parser.add_argument("--name", default="slip-detectors", help="judge: name of the tables")
    parser.add_argument("--out", type=Path, default=RESULTS, help="judge: folder of the tables")
    parser.add_argument("--jobs", type=int, default=1, help="choose, judge: trials evaluated at the same time")
    chosen = parser.parse_args()
    asked = [name for name in chosen.motions.split(",") if name]
    if unknown := set(asked) - set(motions.MOTIONS):
        parser.error(f"--motions: expected some of {', '.join(motions.MOTIONS)}, found {', '.join(sorted(unknown))}")
    if chosen.what == "see":
        see(chosen, asked or motions.MOTIONS)
    elif chosen.what == "choose":
        slip_tables.choose_thresholds(rows_of(chosen.folder, {}, chosen.jobs))
    elif chosen.what == "judge":
        judge(chosen)
    else:
        left_out(chosen)


if __name__ == "__main__":
    main()
