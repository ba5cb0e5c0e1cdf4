"""Choose, of an experiment's commands, those that a table is made from.

Commands depend on each other by folders: one writes files to `--out`, or next to its inputs, and others name that
folder. A name that might be a folder counts as one, so that a step too many may be chosen, but never one too few.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import PurePosixPath

from scripts.reproduce.plan import EXPERIMENTS, Experiment
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.tables import Table


def _names(words: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """Yield the folder of each file that a command reads, True, and each other word that might be a folder, False."""
    for before, word in zip(words[1:], words[2:], strict=False):
        name = word.partition("=")[2] if word.startswith("--") else word
        if name and before != "--out":
            is_file = "*" in name or name.endswith(".h5")
            yield (str(PurePosixPath(name).parent) if is_file else name), is_file


def named_folders(words: Sequence[str]) -> set[str]:
    """Return the folders of the files that a command reads, and every other word that might be a folder."""
    return {name for name, _ in _names(words)}


def out_folders(words: Sequence[str]) -> set[str]:
    """Return the folder that a command writes to, as a pattern; the folders of its inputs if it has no `--out`."""
    if "--out" in words:
        out = words[words.index("--out") + 1]
        return {str(PurePosixPath(out).parent) if out.endswith(".h5") else out}
    return {name for name, is_file in _names(words) if is_file}


def _serves(made: str, need: str) -> bool:
    return fnmatchcase(made, need) or fnmatchcase(need, made) or made.startswith(f"{need}/")


def needed(steps: Iterable[Command], readers: Iterable[Command]) -> list[Command]:
    """Return the steps, in order, whose files the readers need, directly or through other steps.

    Programs of this folder (`python ...`) are always needed.
    """
    wanted = {folder for words in readers for folder in named_folders(words)}
    chosen: list[Command] = []
    for words in reversed(list(steps)):
        if words[0] == "python" or any(_serves(made, need) for made in out_folders(words) for need in wanted):
            chosen.append(words)
            wanted |= named_folders(words)
    return chosen[::-1]


def experiment_of(name: str) -> tuple[Experiment, Table]:
    """Return the experiment that makes a table, and the table; KeyError if none does."""
    for experiment in EXPERIMENTS:
        for table in experiment.tables:
            if table.name == name:
                return experiment, table
    raise KeyError(name)


def only_for(experiment: Experiment, table: Table) -> Experiment:
    """Return the experiment with nothing but the table, its evaluations and the steps that these need."""

    def evaluations(sizes: Sizes) -> dict[str, Command]:
        every = experiment.evaluations(sizes)
        chosen = {name: words for name, words in every.items() if name in table.evaluations}
        read = (word for words in chosen.values() for word in words if word.endswith(".report.h5"))
        reports = {word.removesuffix(".report.h5") for word in read}
        return {name: words for name, words in every.items() if name in chosen or name in reports}

    def steps(sizes: Sizes) -> Iterator[Command]:
        yield from needed(experiment.steps(sizes), evaluations(sizes).values() if table.evaluations else ())

    if experiment.measure:
        return replace(experiment, tables=(table,))
    return replace(experiment, tables=(table,), steps=steps, evaluations=evaluations)
