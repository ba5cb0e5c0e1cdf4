"""Make one table again, or check all of them on a tenth of their trials: `run.py --table` and `--check`.

A check repeats the first trials of a table's experiment with the sizes of checks.py. Frozen models are taken from
docs/results/models and judged on these trials; one training of one seed is repeated whole, and must give the same
network. The check then says, for each figure, whether it came out equal, or whether the stored figure is in the
interval of the check. Of many figures, one in twenty is outside such an interval by chance.

Of an experiment's commands, only those are run that the table is made from. Commands depend on each other by folders:
one writes files to `--out`, or next to its inputs, and others name that folder. A name that might be a folder counts as
one, so that a step too many may be chosen, but never one too few.

Each finished check is stored in OUT/checks/TABLE.json, with the digest of the table that it checked. Another run
continues with the others, and repeats a check whose table has changed.
"""

import hashlib
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from evetac_cli.jobs import Row
from scripts.reproduce import compare, frozen
from scripts.reproduce.checks import CHECKS, NOT_CHECKED, SCRIPTS, SIZES
from scripts.reproduce.experiment import Check, Experiment, ScriptCheck
from scripts.reproduce.facts import RESULTS, Refusal, commit_facts, hours, made_on, model_files, spending
from scripts.reproduce.perform import MODELS, Running, evaluate, expand, in_order, perform, sizes_for
from scripts.reproduce.plan import EXPERIMENTS
from scripts.reproduce.steps import Command, Sizes
from scripts.reproduce.tables import Evaluation, Table
from scripts.ship.strip_model import digest, unpack

AGAIN = "again"  # folder of the models that a check trains
CORES = 2


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


def archive_of(words: Command) -> Path | None:
    """Return the archive with the frozen models that a training made; None if there is none, or for other commands."""
    if words[1] not in ("train", "train-force") or "--out" not in words:
        return None
    out = Path(words[words.index("--out") + 1])
    path = MODELS / f"{(out.parent if out.suffix == '.h5' else out).name}.tar.xz"
    return path if path.exists() else None


def trained_again(words: Command) -> Command:
    """Return the command that repeats the first of a training's seeds, in another folder."""
    again = list(words)
    if "--seeds" in again:
        again[again.index("--seeds") + 1] = "1"
    again[again.index("--out") + 1] = str(Path(AGAIN) / again[again.index("--out") + 1])
    return again


def contains(words: Sequence[str], part: Sequence[str]) -> bool:
    """Whether a part of a command is in it, in this order and without a gap."""
    return any(list(words[at : at + len(part)]) == list(part) for at in range(len(words)))


@dataclass(frozen=True)
class Plan:
    """What the check of a table runs. archives: those of the frozen models, by the folder that they go to."""

    table: Table
    experiment: Experiment  # reduced to what the check needs
    sizes: Sizes
    check: Check
    archives: dict[str, Path]
    again: Command | None
    hours: float  # estimated, on two cores


def made_from(name: str, evaluations: dict[str, Command]) -> dict[str, Command]:
    """Return the evaluations that the stored table was made from: an experiment may have more, which were not run."""
    path = RESULTS / f"{name}.json"
    commands = json.loads(path.read_text())["commands"] if path.exists() else []
    found = {one: words for one, words in evaluations.items() if " ".join(words) in commands}
    if found and (gone := set(commands) - {" ".join(words) for words in found.values()}):
        raise Refusal(f"{name}: was made by `{min(gone)}`, which is no longer part of its experiment; make it again")
    return found or evaluations


def planned(name: str) -> Plan:
    """Return the check of a table."""
    experiment, table = experiment_of(name)
    sizes = {**experiment.full, **SIZES.get(experiment.name, {})}
    of_table, check = only_for(experiment, table), CHECKS[name]
    every, evaluations = list(of_table.steps(sizes)), made_from(name, of_table.evaluations(sizes))
    archives, kept, frozen_trainings = {}, [], []
    # archives are named by folders of models; another experiment may have folders of the same names
    is_archived = any(CHECKS[one.name].training for one in experiment.tables if one.name in CHECKS)
    for words in every:
        archive = archive_of(words) if is_archived else None
        if archive is None:
            kept.append(words)
            continue
        out = words[words.index("--out") + 1]
        archives[str(Path(out).parent) if out.endswith(".h5") else out] = archive
        frozen_trainings.append(words)
    repeated = [words for words in frozen_trainings if contains(words, check.training)] if check.training else []
    again = trained_again(repeated[0]) if repeated else None
    readers = [*evaluations.values(), *([again] if again else [])]
    steps = [*needed(kept, readers), *([again] if again else [])] if not experiment.measure else kept
    reduced = replace(of_table, steps=lambda _: iter(steps), evaluations=lambda _: evaluations)
    return Plan(table, reduced, sizes, check, archives, again, _estimated(experiment, steps, sizes))


def _estimated(experiment: Experiment, steps: list[Command], sizes: Sizes) -> float:
    """Return the experiment's hours by the share of its commands and of its size that are repeated."""
    shares = [sizes[name] / full for name, full in experiment.full.items() if sizes[name] != full]
    every = len(list(experiment.steps(experiment.full)))
    return experiment.hours * min(shares, default=1.0) * (len(steps) / every if every else 1.0)


def made_by_hand() -> dict[str, str]:
    """Return the stored tables that no experiment makes, with the command that each names."""
    names = {table.name for experiment in EXPERIMENTS for table in experiment.tables}
    stored = {path.stem: json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))}
    return {name: table["commands"][0] for name, table in stored.items() if name not in names}


# --- one table again --------------------------------------------------------------------------------------------------


def make(name: str, out: Path, results: Path, running: Running, given: dict[str, str] | None = None) -> bool:
    """Make a table whole, with what it builds on, and print how it compares with the stored one; True if equal.

    given: sizes that differ from full size, as text, for a smaller table.
    """
    try:
        experiment, table = experiment_of(name)
    except KeyError:
        raise Refusal(f"no experiment makes the table {name}; run.py --list has those that one makes") from None
    for earlier in in_order(experiment.after):
        perform(earlier, dict(earlier.full), out, results, running, replace=True)
    sizes = sizes_for(experiment, small=False, given=given or {})
    perform(only_for(experiment, table), sizes, out, results, running, replace=True)
    path = RESULTS / f"{name}.json"
    if not path.exists():
        print(f"{name}: docs/results has no such table yet")
        return False
    made, kept = json.loads((results / f"{name}.json").read_text()), json.loads(path.read_text())
    check = CHECKS.get(name, Check(tuple(made["rows"][0])[:2]))
    found = compare.differences(made["rows"], kept["rows"], check)
    print(*compared(name, found, check), sep="\n")
    return not found


def compared(name: str, found: list[str], check: Check) -> Iterator[str]:
    """Yield what a comparison found, in words."""
    unpromised = f", except {', '.join(check.unpromised)}, which no run repeats" if check.unpromised else ""
    if found:
        yield f"{name}: differs from docs/results/{name}.json in {len(found)} figures{unpromised}:"
        yield from (f"  {one}" for one in found)
    else:
        yield f"{name}: all rows are equal to docs/results/{name}.json, to the last digit{unpromised}"


# --- the check --------------------------------------------------------------------------------------------------------


def state_path(out: Path, name: str) -> Path:
    return out / "checks" / f"{name}.json"


def table_digest(name: str) -> str:
    return hashlib.sha256((RESULTS / f"{name}.json").read_bytes()).hexdigest()


def finished(out: Path, name: str) -> Row | None:
    """Return the stored result of a check of today's table; None if there is none."""
    path = state_path(out, name)
    stored: Row | None = json.loads(path.read_text()) if path.exists() else None
    return stored if stored is not None and stored["table_sha256"] == table_digest(name) else None


def carried_out(chosen: Plan, out: Path, running: Running) -> Row:
    """Run a check and return its result."""
    name, folder = chosen.table.name, out / chosen.experiment.folder
    began = time.time()
    placed = [path for target, archive in chosen.archives.items() for path in unpack(archive, folder / target)]
    results = out / "checks" / "tables"
    evaluations = perform(chosen.experiment, chosen.sizes, out, results, running, replace=True)
    kept = json.loads((RESULTS / f"{name}.json").read_text())
    made = json.loads((results / f"{name}.json").read_text())
    used = {one: evaluations[one] for one in chosen.table.evaluations if one in evaluations}
    trials = chosen.check.trials(used) if chosen.check.trials else []
    found = compared_with(name, made["rows"], trials, chosen.check, began) | {
        "hours": hours([(folder, chosen.experiment.name)]),
        "whole": chosen.sizes == experiment_of(name)[0].full,
        "models": models_differing(kept.get("models", {}), placed),
    }
    if chosen.again is not None:
        found["training"] = training(chosen, placed, folder, kept["rows"], used, running)
    return found


def compared_with(name: str, made: list[Row], trials: list[Row], check: Check, began: float) -> Row:
    """Return the comparison of a table that was made again with the stored one."""
    kept = json.loads((RESULTS / f"{name}.json").read_text())
    return {
        "table": name,
        "table_sha256": table_digest(name),
        "commit": commit_facts()["commit"],
        "frozen": kept.get("frozen"),
        "took_min": round((time.time() - began) / 60, 1),
        "differences": compare.differences(made, kept["rows"], check),
        "figures": compare.judged(trials, made, kept["rows"], check),
    }


def by_script(name: str, chosen: ScriptCheck, out: Path, running: Running) -> Row:
    """Make a table again by its own script, on fewer trials, and return the comparison."""
    folder, began = out / "scripts" / name, time.time()
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    for words in chosen.commands:
        print("+", *words, flush=True)
        with spending(folder, name):
            code, _ = running.run(words, folder)
        if code:
            raise Refusal(f"{' '.join(words)} ended with exit code {code}")
    made = json.loads((folder / "tables" / f"{name}.json").read_text())["rows"]
    about = {"hours": hours([(folder, name)]), "whole": chosen.whole, "models": []}
    return compared_with(name, made, [], chosen.check, began) | about


def models_differing(named: dict[str, str], placed: list[Path]) -> list[str]:
    """Return the names of the table's models of which no frozen model has the digest that the table names."""
    there = {digest(path) for path in placed}
    return sorted(name for name, sha256 in named.items() if placed and sha256 not in there)


def training(
    chosen: Plan, placed: list[Path], folder: Path, kept: list[Row], used: dict[str, Evaluation], running: Running
) -> Row:
    """Compare the model that was trained again with the frozen ones; judge it where it is another network."""
    assert chosen.again is not None
    target = folder / chosen.again[chosen.again.index("--out") + 1]
    (path,) = [target] if target.suffix == ".h5" else sorted(target.glob("*.h5"))
    about: Row = {"command": " ".join(chosen.again), "model": path.name, "sha256": digest(path)}
    about["equal"] = about["sha256"] in {digest(one) for one in placed}
    if about["equal"]:
        return about
    rows: list[Row] = []
    for name, words in chosen.experiment.evaluations(chosen.sizes).items():
        named = [str(one.relative_to(folder).parent) for one in model_files(expand(words, folder), folder)]
        if name not in used or str(target.relative_to(folder / AGAIN)) not in named:
            continue
        at = words.index("--model") + 1
        end = next((place for place in range(at, len(words)) if words[place].startswith("--")), len(words))
        alone = [*words[:at], str(path.relative_to(folder)), *words[end:]]
        judged = evaluate(f"{AGAIN}-{name}", alone, folder, running)
        evaluations = {name: judged}
        assert chosen.check.trials is not None
        made = chosen.table.rows(evaluations)
        rows += compare.judged(chosen.check.trials(evaluations), made, kept, chosen.check)
    return {**about, "figures": rows}


def summary_lines(found: Row) -> Iterator[str]:
    """Yield the result of a check in words."""
    figures = found["figures"]
    without = [row for row in figures if row["inside"] is None]
    equal, outside = (
        sum(row["equal"] for row in figures),
        [row for row in figures if row["inside"] is False],
    )
    if not figures and found["differences"]:
        yield f"{found['table']}: made again; none of its figures can be judged on a part of the trials"
    elif not found["differences"]:
        yield f"{found['table']}: equal to the last digit ({'whole' if found['whole'] else 'a part of the trials'})"
    else:
        inside = len(figures) - len(outside) - len(without)
        line = f"{found['table']}: {inside} of {len(figures)} figures agree, {equal} of them equal to the last digit"
        yield line + (f"; no interval for {len(without)}" if without else "")
    for row in outside:
        what = f"{row['row']}: {row['figure']} {row['stored']:.3g}"
        yield f"  outside: {what}, in the check {row['again']:.3g} ({row['low']:.3g} to {row['high']:.3g})"
    if found["whole"] and found["differences"]:
        yield from (f"  differs: {one}" for one in found["differences"])
    if found["models"]:
        yield f"  models that differ from those that the table names: {', '.join(found['models'])}"
    if again := found.get("training"):
        if again["equal"]:
            yield f"  training again: {again['model']} is equal to the frozen network, bit for bit"
        else:
            good = sum(row["inside"] is not False for row in again["figures"])
            other = f"{again['model']} is another network"
            yield f"  training again: {other}; {good} of {len(again['figures'])} figures agree"


def check(names: Sequence[str], out: Path, running: Running, *, dry_run: bool = False, as_json: bool = False) -> None:
    """Check tables, all with no names given; Refusal for a table that no check repeats."""
    stored = {path.stem for path in RESULTS.glob("*.json")}
    every = [name for name in (*CHECKS, *SCRIPTS) if name in stored]
    for name in names:
        if name not in every:
            why = NOT_CHECKED.get(name) or (f"its own script makes it: {made_by_hand().get(name, 'none')}")
            raise Refusal(f"{name}: no check repeats it ({why}); choose from {', '.join(every)}")
    plans, gone = {}, {}
    for name in (one for one in names or every if one in CHECKS):
        try:
            plans[name] = planned(name)
        except Refusal as refusal:  # of a table that today's experiment does not make
            if names:
                raise
            gone[name] = str(refusal)
    chosen = [name for name in names or every if name not in gone]
    estimated = {name: plans[name].hours if name in plans else SCRIPTS[name].minutes / 60 for name in chosen}
    if not as_json or dry_run:
        freeze = frozen.read()
        print(frozen.in_words(freeze, frozen.changed(freeze)))
        if line := made_on(json.loads((RESULTS / f"{name}.json").read_text()) for name in estimated):
            print(f"{line} Check them at their commits: figures of `evetac` differ here.")
        for name, needed_h in estimated.items():
            done = " (done)" if finished(out, name) else ""
            whole = name in plans and plans[name].check.training and not plans[name].archives
            why = "; no frozen models are stored, so that every training is repeated" if whole else ""
            print(f"{name}: about {max(1, round(60 * needed_h))} min on {CORES} cores{done}{why}")
        print(f"all: about {sum(estimated.values()):.1f} h")
        if not names:
            print(f"not checked: {', '.join(sorted(NOT_CHECKED.keys() & stored))}")
            print(*(f"not checked, {why}" for why in gone.values()), sep="\n" if gone else "")
            others = sorted(made_by_hand().keys() - SCRIPTS.keys())
            print(f"not checked, made by scripts of their own: {', '.join(others)}")
    if dry_run:
        return
    results = []
    for name in estimated:
        found = finished(out, name)
        if found is None:
            with redirect_stdout(sys.stderr) if as_json else nullcontext():  # the tables that it makes are printed
                if name in plans:
                    found = carried_out(plans[name], out, running)
                else:
                    found = by_script(name, SCRIPTS[name], out, running)
            path = state_path(out, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".json.part")
            unfinished.write_text(json.dumps(found, indent=1) + "\n")
            unfinished.replace(path)
        results.append(found)
    print(
        json.dumps(results, indent=1)
        if as_json
        else "\n".join(line for found in results for line in summary_lines(found))
    )
