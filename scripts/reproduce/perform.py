"""Run an experiment: its commands, evaluations and measurement, and store its tables.

Ctrl-C waits until the running command has removed its unfinished files.
"""

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import interrupts
from evetac_cli.jobs import Row
from scripts.reproduce.experiment import Experiment
from scripts.reproduce.facts import (
    RESULTS,
    ROOT,
    Refusal,
    hours,
    machine,
    model_files,
    model_ids,
    models,
    of_freeze,
    report_header,
    spending,
)
from scripts.reproduce.made_tables import keep, result
from scripts.reproduce.plan import EXPERIMENTS
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.table_text import text
from scripts.reproduce.tables import Evaluation
from scripts.ship.strip_model import unpack_all

MODELS = RESULTS / "models"  # archives of frozen models
IN_PARALLEL = (
    "record",
    "track",
    "label",
    "featurize",
    "train",
    "grasp",
    "examples/cma_lift.py",
    "scripts/studies/slip/recordings.py",
)  # commands given --jobs; fmt: skip
KINDS = ("recording", "labels", "tracks", "features", "model", "report")
INTERRUPTS_TO_KILL = 3  # after this many Ctrl-C, a command that does not end is killed

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


@dataclass(frozen=True)
class Running:
    """How commands are run: files at the same time, and the engine of evetac; tests replace `run` and `header`."""

    jobs: int = 1
    engine: str = "local"
    run: Run = run_command
    header: Callable[[Path], Row] = report_header

    def parallel(self, words: Command) -> Command:
        """Add engine and number of jobs to a command that works on files; a running cluster has its own number."""
        if words[1] not in IN_PARALLEL and words[1:3] != ["evaluate", "slip"]:
            return words
        on_cluster = words[0] == "evetac" and self.engine != "local"
        return [*words, *(["--engine", self.engine] if on_cluster else ["--jobs", str(self.jobs)])]


def evaluate(name: str, words: Command, folder: Path, running: Running) -> Evaluation:
    """Run an evaluation, or read its report if that is up to date; a report of other files is made again."""
    command = [*expand(words, folder), "--out", f"{name}.report.h5", "--json"]
    code, printed = running.run(command, folder)
    if code == 2:  # usually there is a report of fewer or other files; any other error is printed twice
        code, printed = running.run([*command, "--force"], folder)
    if code:
        raise Refusal(f"{' '.join(words)} ended with exit code {code}")
    answer = json.loads(printed)
    return Evaluation(
        answer["rows"], answer["summary"], answer["simulated"], running.header(folder / f"{name}.report.h5")
    )


def is_there(words: Command, folder: Path) -> bool:
    """Whether a program's file of figures exists; it has no recipe to compare, so it is made only once."""
    return words[0] == "python" and "--json" in words and (folder / words[words.index("--json") + 1]).exists()


def own_command(experiment: Experiment, sizes: Sizes) -> str:
    """Return the command that runs an experiment with these sizes."""
    others = (f"--size={name}={as_text(value)}" for name, value in sizes.items() if value != experiment.full[name])
    return shlex.join(["python", "scripts/reproduce/run.py", "--only", experiment.name, *others])


def perform(
    experiment: Experiment,
    sizes: Sizes,
    out: Path,
    results: Path,
    running: Running,
    *,
    replace: bool = False,
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
            code, _ = running.run(running.parallel(expand(step, folder)), folder)
        if code:
            raise Refusal(f"{' '.join(step)} ended with exit code {code}")
    with spending(folder, experiment.name):
        evaluations = experiment.measure(sizes, folder, running.jobs) if experiment.measure else {}
    commands = dict.fromkeys(evaluations, own_command(experiment, sizes))
    for name, words in experiment.evaluations(sizes).items():
        print("+", *words, flush=True)
        with spending(folder, experiment.name):
            evaluations[name] = evaluate(name, running.parallel(words), folder, running)
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
