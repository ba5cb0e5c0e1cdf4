"""Run the experiments and studies (scripts/experiments.py) and store their tables, one small JSON each.

    python scripts/reproduce.py --list
    python scripts/reproduce.py --only tracking [--small] [--size edges=5] [--jobs 4] [--dry-run]
    python scripts/reproduce.py --table data-rate --out EMPTY   # one table again, compared with docs/results
    python scripts/reproduce.py --check [--only data-rate]      # every table on a tenth of its trials (check_tables.py)

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
import dataclasses
import importlib
import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from experiment_steps import Command, Sizes
from experiment_tables import Column, Evaluation, Table
from experiments import EXPERIMENTS, Experiment
from report_facts import facts, methods, model_ids, report_header, words_for
from results import fill, keys, text
from run_facts import hours, machine, model_files, models, of_freeze, spending

from evetac_cli import interrupts
from evetac_cli.errors import EvetacError
from evetac_cli.evaluate import paper
from evetac_cli.evaluate.source import Source
from evetac_cli.jobs import Row, Rows

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
IN_PARALLEL = (
    "record",
    "track",
    "label",
    "featurize",
    "train",
    "grasp",
    "track-rgb",
    "examples/cma_lift.py",
    "scripts/motion_recordings.py",
    "scripts/train_detectors.py",
)  # commands given --jobs; fmt: skip
KINDS = ("recording", "labels", "tracks", "features", "model", "report")
INTERRUPTS_TO_KILL = 3  # after this many Ctrl-C, a command that does not end is killed
COUNTS = ("recordings", "objects", "models", "training_steps", "trials")  # counts that define the size of a run

# A function that runs a command in a folder and returns its output and exit code.
Run = Callable[[Command, Path], tuple[int, str]]


class Refusal(Exception):
    """A request that cannot be carried out, with a sentence for the user."""


def run_command(words: Command, folder: Path) -> tuple[int, str]:
    """Run evetac or a script of this folder; progress and messages go straight to the terminal."""
    first, *rest = words
    ours = first == "evetac"
    program = ["-P", "-m", "evetac_cli", *rest] if ours else [str(ROOT / rest[0]), *rest[1:]]
    with interrupts.signals_blocked(interrupts.CTRL_C):
        # Ctrl-C is blocked until evetac handles it, because during Python's start it would end in a traceback. A script
        # does not unblock it, so it inherits an unblocked signal. In both cases the handler of this process waits for
        # the command.
        if not ours:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, interrupts.CTRL_C)
        process = subprocess.Popen([sys.executable, *program], cwd=folder, stdout=subprocess.PIPE, text=True)
        printed = wait_for(process)
    return process.returncode, printed


def wait_for(process: "subprocess.Popen[str]") -> str:
    """Return a command's stdout once it has ended. KeyboardInterrupt, also after that, if Ctrl-C was pressed.

    A terminal sends Ctrl-C to the command too, which needs a moment to remove its unfinished files. subprocess.run
    would kill it after a quarter of a second.
    """
    times = 0
    while True:
        try:
            with interrupts.SignalsLetThrough(interrupts.CTRL_C):
                printed, _ = process.communicate()
            break
        except KeyboardInterrupt:
            times += 1
            if times == INTERRUPTS_TO_KILL:
                process.kill()
    if times:
        raise KeyboardInterrupt
    return printed


def expand(words: Command, folder: Path) -> Command:
    """Replace the globs of a command by the matching files, sorted; those in --flag=GLOB stay."""
    expanded: Command = []
    for word in words:
        is_glob = "*" in word and not word.startswith("--")
        expanded += sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if is_glob else [word]
    return expanded


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
    at_once = [] if ours and engine.startswith("dask:") else ["--jobs", str(jobs)]
    return [*words, *at_once, *(["--engine", engine] if ours and engine != "local" else [])]


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


# --- tables -----------------------------------------------------------------------------------------------------------


def commit() -> tuple[str, bool]:
    """Return the commit, and whether the tree differs from it in anything except the tables."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changes = subprocess.run(
        [*git, "status", "--porcelain", "--", ":!docs/results"], capture_output=True, text=True, check=False
    )
    return head.stdout.strip() or "unknown", bool(changes.stdout.strip())


def shown_rows(table: Table, rows: list[Row]) -> list[Row]:
    """Return the figures that the table shows (all for a measured one) and the keys of the paper's figures."""
    columns = [*table.columns, *([table.across] if table.across else [])]
    wanted = {key for column in columns for part in (column.heading, column.cell, column.paper) for key in keys(part)}
    wanted.add("evaluation")
    for key in wanted & paper.SHOWN.keys():
        wanted |= {*paper.SHOWN[key].needs, *paper.SHOWN[key].may_need}
    return [{key: value for key, value in row.items() if table.measured or key in wanted} for row in rows]


def layout(column: Column) -> Row:
    """Return the layout of a column, as JSON."""
    return {"heading": column.heading, "cell": column.cell, **({"paper": column.paper} if column.paper else {})}


def result(table: Table, evaluations: dict[str, Evaluation], commands: Iterable[str]) -> Row:
    """Return a table for storage; its facts come from the reports, or from a measurement without reports."""
    headers = [evaluation.header for evaluation in evaluations.values() if evaluation.header]
    about = {key: value for evaluation in evaluations.values() for key, value in (evaluation.about or {}).items()}
    known = facts(headers) | about.pop("sizes", {})
    head, changed = commit()
    head, changed = about.get("commit", head), about.get("uncommitted_changes", changed)
    rows, columns = table.rows(evaluations), table.columns
    if table.measured:
        columns = tuple(column for column in columns if any(fill(column.cell, row) for row in rows))
        about["summaries"] = {name: evaluation.summary for name, evaluation in evaluations.items()}
    about |= covariates(evaluations)
    return {
        "name": table.name,
        "title": table.title.format(**words_for(known)),
        "simulated": any(evaluation.simulated for evaluation in evaluations.values()),
        "made": f"commit {head}" + (", with uncommitted changes" if changed else ""),
        "commit": head,
        "uncommitted_changes": changed,
        "commands": list(commands),
        "methods": methods(headers),
        "recipe_ids": [header["id"] for header in headers],
        "sizes": known,
        "source": dataclasses.asdict(Source.of(headers)),
        "sources": sources(evaluations, rows),
        "columns": [layout(column) for column in columns],
        "across": layout(table.across) if table.across else None,
        "notes": list(table.notes),
        "rows": shown_rows(table, rows),
    } | about


def sources(evaluations: dict[str, Evaluation], rows: Rows) -> Row:
    """Return the source of each evaluation that rows name as theirs, by which the paper's figures are marked."""
    named = {row["evaluation"] for row in rows if "evaluation" in row}
    headers = {name: evaluation.header for name, evaluation in evaluations.items() if name in named}
    return {name: dataclasses.asdict(Source.of([header])) for name, header in headers.items() if header}


def covariates(evaluations: dict[str, Evaluation]) -> Row:
    """Return the covariates of the slips that a table evaluates; with several evaluations, by evaluation."""
    slips = {name: [row for row in evaluation.rows if "covariate" in row] for name, evaluation in evaluations.items()}
    if not slips or not all(slips.values()):
        return {}
    distinct: dict[str, list[Row]] = {}
    for name, rows in slips.items():
        if rows not in distinct.values():
            distinct[name] = rows
    if len(distinct) == 1:
        return {"covariates": next(iter(distinct.values()))}
    tagged = [
        {**row, "covariate": f"{name.rpartition('-')[2]}: {row['covariate']}"}
        for name, rows in distinct.items()
        for row in rows
    ]
    return {"covariates": tagged}


def extent(value: Any) -> int:
    return len(value) if isinstance(value, list) else int(value)


def smaller(new: Row, old: Row) -> list[str]:
    """Return in which counts a new table is smaller than the existing one, in words."""
    counts = ((name, extent(new["sizes"].get(name, 0)), extent(old["sizes"].get(name, 0))) for name in COUNTS)
    return [f"{name.replace('_', ' ')} {ours} (there {theirs})" for name, ours, theirs in counts if ours < theirs]


def keep(table: Row, folder: Path, *, replace: bool) -> None:
    """Write a table as JSON; Refusal if it would replace a larger run's."""
    path = folder / f"{table['name']}.json"
    if path.exists() and not replace and (less := smaller(table, json.loads(path.read_text()))):
        raise Refusal(f"{path} was not replaced, because this run is smaller: {', '.join(less)}; try --replace")
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".json.part")
    unfinished.write_text(json.dumps(table, indent=1) + "\n")
    unfinished.replace(path)


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
    module, _, function = experiment.measure.partition(".")
    if not module:
        return {}
    evaluations: dict[str, Evaluation] = getattr(importlib.import_module(module), function)(sizes, folder, jobs)
    return evaluations


def own_command(experiment: Experiment, sizes: Sizes) -> str:
    """Return the command that runs an experiment with these sizes."""
    others = (f"--size={name}={as_text(value)}" for name, value in sizes.items() if value != experiment.full[name])
    return shlex.join(["python", "scripts/reproduce.py", "--only", experiment.name, *others])


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
    from check_tables import check, make  # which import this module

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
        "--engine", default="local", help="local, dask, or dask:tls://ADDRESS, as for evetac (docs/cluster.md)"
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
    sys.modules["reproduce"] = sys.modules["__main__"]  # for the modules that import this one
    main()
