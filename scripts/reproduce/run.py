"""Run the experiments and studies (scripts/reproduce/plan.py) and store their tables, one small JSON each.

    python scripts/reproduce/run.py --list
    python scripts/reproduce/run.py --only tracking [--small] [--size edges=5] [--jobs 4] [--dry-run]
    python scripts/reproduce/run.py --table data-rate --out EMPTY  # one table again, compared with docs/results
    python scripts/reproduce/run.py --check [--only data-rate]  # every table on a tenth of its trials

Each command skips files that are up to date, so an experiment continues where it was stopped. Its files are in a folder
of their own (demo/, data/slip/, ...), those of `--small` in small/.

Tables go to docs/results/NAME.json, those of small runs to small/results/. They contain rows, layout, commands, recipe
ids of the reports, seeds, sizes, and the commit, all from the headers of the reports, so a table always documents its
own run. They also contain the computer, the core hours of all runs, and the digest of each model (run_facts.py). A
table of more trajectories, objects or models is not replaced by a smaller one unless --replace is given. Other
experiments' tables are not changed.

Ctrl-C ends the running command, which removes its unfinished files, and then this program, with exit code 130.
"""

import argparse
import importlib
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Row
from scripts.reproduce.made_tables import Refusal, keep, result
from scripts.reproduce.plan import EXPERIMENTS, Experiment
from scripts.reproduce.report_facts import model_ids, report_header
from scripts.reproduce.results import text
from scripts.reproduce.run_command import expand, run_command
from scripts.reproduce.run_facts import hours, machine, model_files, models, of_freeze, spending
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.tables import Evaluation
from scripts.ship.strip_model import unpack_all

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
MODELS = RESULTS / "models"  # archives of frozen models
IN_PARALLEL = (
    "record",
    "track",
    "label",
    "featurize",
    "train",
    "grasp",
    "track-rgb",
    "examples/cma_lift.py",
    "scripts/studies/slip/recordings.py",
    "scripts/studies/slip/train.py",
)  # commands given --jobs; fmt: skip
KINDS = ("recording", "labels", "tracks", "features", "model", "report")

# A function that runs a command in a folder and returns its output and exit code.
Run = Callable[[Command, Path], tuple[int, str]]


def as_text(size: Any) -> str:
    """Return a size in the format of --size."""
    return ",".join(size) if isinstance(size, tuple) else str(size)


def sizes_for(experiment: Experiment, *, small: bool, given: dict[str, str]) -> Sizes:
    """Return an experiment's sizes; values given as text replace the defaults."""
    sizes = {**experiment.full, **(experiment.small if small else {})}
    for name, value in given.items():
        if name not in sizes:
            continue
        usual = sizes[name]
        try:
            sizes[name] = tuple(filter(None, value.split(","))) if isinstance(usual, tuple) else type(usual)(value)
        except ValueError as error:
            raise Refusal(f"--size {name}={value}: expected {type(usual).__name__}, for example {usual}") from error
    return sizes


def with_engine(words: Command, jobs: int, engine: str) -> Command:
    """Add engine and number of jobs to a command that works on files; a running cluster has its own number."""
    if words[1] not in IN_PARALLEL and words[1:3] != ["evaluate", "slip"]:
        return words
    ours = words[0] == "evetac"
    return [*words, *(["--engine", engine] if ours and engine != "local" else ["--jobs", str(jobs)])]


def in_order(names: Iterable[str]) -> list[Experiment]:
    """Return the named experiments, each after those that it builds on."""
    by_name = {experiment.name: experiment for experiment in EXPERIMENTS}
    ordered: dict[str, Experiment] = {}

    def add(name: str) -> None:
        if name not in by_name:
            raise Refusal(f"there is no experiment {name}; choose from {', '.join(by_name)}")
        for earlier in by_name[name].after:
            add(earlier)
        ordered[name] = by_name[name]

    for name in names:
        add(name)
    return list(ordered.values())


# --- running ----------------------------------------------------------------------------------------------------------


def evaluate(name: str, words: Command, folder: Path, run: Run, header: Callable[[Path], Row]) -> Evaluation:
    """Run an evaluation, or read its report if that is up to date; a report of other files is made again."""
    command = [*expand(words, folder), "--out", f"{name}.report.h5", "--json"]
    code, printed = run(command, folder)
    if code == 2:  # usually there is a report of fewer or other files; any other error is printed twice
        code, printed = run([*command, "--force"], folder)
    if code:
        raise Refusal(f"{' '.join(words)} ended with exit code {code}")
    answer = json.loads(printed)
    return Evaluation(answer["rows"], answer["summary"], answer["simulated"], header(folder / f"{name}.report.h5"))


def is_there(words: Command, folder: Path) -> bool:
    """Whether a program's file of figures exists; it has no recipe to compare, so it is made only once."""
    return words[0] == "python" and "--json" in words and (folder / words[words.index("--json") + 1]).exists()


def measured(experiment: Experiment, sizes: Sizes, folder: Path, jobs: int) -> dict[str, Evaluation]:
    """Return the result of the experiment's own measurement; empty if it has none."""
    module, _, function = experiment.measure.rpartition(".")
    if not module:
        return {}
    evaluations: dict[str, Evaluation] = getattr(importlib.import_module(module), function)(sizes, folder, jobs)
    return evaluations


def own_command(experiment: Experiment, sizes: Sizes) -> str:
    """Return the command that runs an experiment with these sizes."""
    others = (f"--size={name}={as_text(value)}" for name, value in sizes.items() if value != experiment.full[name])
    return shlex.join(["python", "scripts/reproduce/run.py", "--only", experiment.name, *others])


def perform(
    experiment: Experiment,
    sizes: Sizes,
    out: Path,
    results: Path,
    *,
    jobs: int,
    replace: bool,
    engine: str = "local",
    run: Run = run_command,
    header: Callable[[Path], Row] = report_header,
) -> dict[str, Evaluation]:
    """Run an experiment's commands, evaluations and measurement; print and store its tables; return the evaluations."""
    folder, started = out / experiment.folder, time.time()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{experiment.name}: {experiment.shows}; files in {folder}", flush=True)
    if any(str(MODELS) in word for step in experiment.steps(sizes) for word in step):
        unpack_all(MODELS)
    for step in experiment.steps(sizes):
        print("+", *step, flush=True)
        if is_there(step, folder):
            continue
        with spending(folder, experiment.name):
            code, _ = run(with_engine(expand(step, folder), jobs, engine), folder)
        if code:
            raise Refusal(f"{' '.join(step)} ended with exit code {code}")
    with spending(folder, experiment.name):
        evaluations = measured(experiment, sizes, folder, jobs)
    commands = dict.fromkeys(evaluations, own_command(experiment, sizes))
    for name, words in experiment.evaluations(sizes).items():
        print("+", *words, flush=True)
        with spending(folder, experiment.name):
            evaluations[name] = evaluate(name, with_engine(words, jobs, engine), folder, run, header)
        commands[name] = " ".join(words)
    said = (*experiment.steps(sizes), *experiment.evaluations(sizes).values())
    judged = {path for words in said for path in model_files(expand(words, folder), folder)}
    spent = hours([(out / one.folder, one.name) for one in (*in_order(experiment.after), experiment)])
    refusals = []
    for table in experiment.tables:
        chosen = {name: evaluations[name] for name in table.evaluations if name in evaluations}
        if not chosen:  # --size left out everything that the table is made of
            continue
        made = result(table, chosen, dict.fromkeys(commands[name] for name in chosen))
        ids = model_ids(one.header for one in chosen.values() if one.header)
        made |= {"machine": machine(), "hours": spent, "models": models(ids, sorted(judged), folder)} | of_freeze(made)
        print(f"\n{text(made)}")
        try:
            keep(made, results, replace=replace)
        except Refusal as refusal:  # the experiment's other tables are still stored
            refusals.append(str(refusal))
    files = {kind: len(list(folder.rglob(f"*.{kind}.h5"))) for kind in KINDS}
    new = sum(path.stat().st_mtime >= started for path in folder.rglob("*.h5"))
    print(f"{experiment.folder}/ holds " + ", ".join(f"{count} {kind}" for kind, count in files.items()), end="; ")
    print(f"{new} made in {time.time() - started:.0f} s" if new else "all up to date, nothing to do")
    if refusals:
        raise Refusal("\n".join(refusals))
    return evaluations


def print_list() -> None:
    for experiment in EXPERIMENTS:
        names = ", ".join(table.name for table in experiment.tables)
        print(
            f"{experiment.name:12} {experiment.shows}; estimated {experiment.hours:g} h at full size"
            + (f"; {names}" * bool(names))
        )
        print(f"{'':12} " + " ".join(f"{name}={as_text(value)}" for name, value in experiment.full.items()))


def print_commands(experiment: Experiment, sizes: Sizes, out: Path, jobs: int, engine: str) -> None:
    print(f"mkdir -p {out / experiment.folder}; cd {out / experiment.folder}")
    for step in experiment.steps(sizes):
        print(*with_engine(step, jobs, engine))
    for name, words in experiment.evaluations(sizes).items():
        print(*with_engine(words, jobs, engine), "--out", f"{name}.report.h5", "--json")
    if experiment.measure:
        print(f"# {experiment.measure} of scripts/ measures the rest")


def make_or_check(chosen: argparse.Namespace, given: dict[str, str]) -> None:
    """Carry out --table, with the given sizes, or --check; Refusal for a table that neither knows.

    Without --out, files go to data/again/.
    """
    from scripts.reproduce.check_tables import check, make  # which import this module

    out = ROOT / "data" / "again" / ("check" if chosen.check else "whole") if chosen.out == ROOT else chosen.out
    how = {"jobs": chosen.jobs, "engine": chosen.engine}
    if chosen.table:
        make(chosen.table, out, chosen.results or out / "tables", given, replace=True, **how)
    else:
        check(chosen.only, out, dry_run=chosen.dry_run, as_json=chosen.json, **how)


def main(arguments: list[str] | None = None) -> None:
    """Read the flags and run the experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="this experiment and those that it builds on"
    )
    parser.add_argument("--small", action="store_true", help="sizes that take minutes, in separate folders")
    parser.add_argument(
        "--size", action="append", default=[], metavar="NAME=VALUE", help="change a size; lists are comma-separated"
    )
    parser.add_argument("--jobs", type=int, default=1, help="files worked on at the same time")
    parser.add_argument(
        "--engine", default="local", help="local, or dask:tls://ADDRESS, as for evetac (docs/cluster.md)"
    )
    parser.add_argument("--out", type=Path, default=ROOT, help="folder of the experiments' folders")
    parser.add_argument("--results", type=Path, default=None, help="folder of the tables")
    parser.add_argument("--replace", action="store_true", help="replace tables of larger runs too")
    parser.add_argument("--list", action="store_true", help="print the experiments with their sizes")
    parser.add_argument("--dry-run", action="store_true", help="print the commands without running them")
    parser.add_argument("--table", metavar="NAME", help="make one table whole, and compare it with docs/results")
    parser.add_argument(
        "--check", action="store_true", help="check all tables, or those of --only, on a tenth of their trials"
    )
    parser.add_argument("--json", action="store_true", help="with --check: print the results as JSON")
    chosen = parser.parse_args(arguments)
    if chosen.list:
        print_list()
        return
    try:
        given = dict(entry.split("=", 1) for entry in chosen.size)
    except ValueError:
        parser.error("--size takes NAME=VALUE, for example --size each=2")
    try:
        if chosen.table or chosen.check:
            make_or_check(chosen, given)
            return
        experiments = in_order(chosen.only or [experiment.name for experiment in EXPERIMENTS])
        unknown = [name for name in given if not any(name in experiment.full for experiment in experiments)]
        if unknown:
            raise Refusal(f"no chosen experiment has the size {', '.join(unknown)}; --list prints all sizes")
        out = chosen.out / "small" if chosen.small else chosen.out
        results = out / "results" if chosen.small else RESULTS
        for experiment in experiments:
            sizes = sizes_for(experiment, small=chosen.small, given=given)
            if chosen.dry_run:
                print_commands(experiment, sizes, out, chosen.jobs, chosen.engine)
            else:
                usual = results if experiment.published else out / experiment.folder
                table_folder = chosen.results or usual
                how = {"jobs": chosen.jobs, "replace": chosen.replace, "engine": chosen.engine}
                perform(experiment, sizes, out, table_folder, **how)
    except (Refusal, EvetacError) as refusal:
        raise SystemExit(f"error: {refusal}") from None
    except KeyboardInterrupt:
        print("interrupted: complete files are kept; run the same command to continue", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
