"""Facts that are stored in a table: what was evaluated, method versions, commit, computer, core hours, models, freeze.

The processor time of an experiment is summed over its commands, also over those of interrupted runs, in the file
spent.json of its folder.
"""

import importlib
import json
import os
import platform
import resource
import subprocess
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from evetac_cli.cli.config import with_config
from evetac_cli.jobs import Row
from evetac_cli.resources import MODEL
from evetac_cli.store.layout.ancestry import EARLIER, row_digest
from scripts.reproduce import frozen
from scripts.reproduce.seeds import seeds_of

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
SPENT = "spent.json"
CPU_INFO, MEMORY_INFO = Path("/proc/cpuinfo"), Path("/proc/meminfo")
# The module that defines METHOD, the method version, of each command.
MODULES = {name: command.module for name, command in with_config().items()}
MODULES |= {"train-force --method touch": "stages.force.adapt_touch", "track --rgb": "stages.track_rgb"}
COMMANDS = {
    "recording": "record", "labels": "label", "features": "featurize", "model": "train", "force-model": "train-force",
}  # fmt: skip


class Refusal(Exception):
    """A request that cannot be carried out, with a sentence for the user."""


def _commit() -> tuple[str, bool]:
    """Return the commit, and whether the tree differs from it in anything except the tables."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    changes = subprocess.run(
        [*git, "status", "--porcelain", "--", ":!docs/results"], capture_output=True, text=True, check=False
    )
    return head.stdout.strip() or "unknown", bool(changes.stdout.strip())


def commit_facts() -> Row:
    """Return the commit of a table, in words too, and whether the tree differs from it."""
    head, changed = _commit()
    words = f"{head}, with uncommitted changes" if changed else head
    return {
        "made": f"commit {words}",
        "commit": head,
        "uncommitted_changes": changed,
        "default_sensor": default_sensor(),
    }


@cache
def default_sensor() -> str:
    """Return a digest of the values of `evetac`, by which a table says on which of its versions it was made."""
    from evetac_cli.sim.setup.plan import one_sensor
    from evetac_cli.sim.setup.tables import as_table

    return row_digest(as_table(one_sensor("evetac")))


def made_on(tables: Iterable[Mapping[str, Any]]) -> str:
    """Return a line on the tables that were made before `evetac` had its dots of 15 px; empty if none was."""
    older = [table for table in tables if table.get("default_sensor") != default_sensor()]
    at = ", ".join(sorted({str(table["commit"]) for table in older if "commit" in table}))
    return f"Made{f' at {at}' * bool(at)} on `small-dots`, then the values of `evetac`." if older else ""


def commit_in_words() -> str:
    """Return the commit, with a remark if files other than the tables have uncommitted changes."""
    return str(commit_facts()["made"]).removeprefix("commit ")


def method(command: str) -> int:
    """Return the current method version of a command."""
    return int(importlib.import_module(f"evetac_cli.{MODULES[command]}").METHOD)


def ranges(values: Iterable[int]) -> str:
    """Return numbers as ranges, such as `1-3, 8`, or the ends if there are more than six."""
    parts: list[list[int]] = []
    for value in sorted(set(values)):
        if parts and value == parts[-1][-1] + 1:
            parts[-1].append(value)
        else:
            parts.append([value])
    if len(parts) > 6:
        return f"from {parts[0][0]} to {parts[-1][-1]}"
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)


def report_header(path: Path) -> Row:
    """Return the header of a report, with its history."""
    from evetac_cli.store.files import StageFile

    with StageFile(path, "report") as file:
        header: Row = file.header
        return header


def ancestors(header: Row, history: Row) -> Iterator[Row]:
    """Return a header's ancestors of kinds recording and model, through the files in between.

    The training data of a grasp's model is not included, because the grasp does not contain it.
    """
    for parent in (history[parent_id] for parent_id in header["parents"] if parent_id in history):
        if parent["kind"] in ("recording", "model", "force-model"):
            yield parent
            if parent["kind"] == "recording":  # for a grasp: the detector's model
                yield from (model for model in ancestors(parent, history) if model["kind"] != "recording")
        else:
            yield from ancestors(parent, history)


def _history(header: Row) -> Row:
    return {id_: {**entry, "id": id_} for id_, entry in header["history"].items()}


def model_ids(headers: Iterable[Row]) -> set[str]:
    """Return the recipe ids of the models that the reports judge."""
    nodes = (node for header in headers for node in ancestors(header, _history(header)))
    return {node["id"] for node in nodes if node["kind"] != "recording"}


def facts(headers: Iterable[Row]) -> Row:
    """Return what was evaluated and what was trained on, from the headers of a table's reports."""
    judged: dict[str, Row] = {}
    models: dict[str, Row] = {}
    training: dict[str, Row] = {}
    for header in headers:
        history = _history(header)
        for node in ancestors(header, history):
            (judged if node["kind"] == "recording" else models)[node["id"]] = node
        for model in list(models.values()):
            rows = (row for row in model.get("trajectories", ()) if row["role"] != EARLIER)
            training |= {row["recording"]: {"parameters": row} for row in rows if row["recording"] is not None}

    def parameters(nodes: dict[str, Row], name: str) -> list[Any]:
        values = {json.dumps(node["parameters"].get(name)) for node in nodes.values()} - {"null"}
        return sorted(map(json.loads, values))

    tones = {node["parameters"].get("scene", {}).get("time", {}).get("tone_s", 0.0) for node in judged.values()}
    return {
        "recordings": len(judged),
        "objects": parameters(judged, "object"),
        "sensors": parameters(judged, "sensor"),
        "recording_seeds": sorted({node["seed"] for node in judged.values() if node["seed"] is not None}),
        "models": len(models),
        "training_seeds": sorted(set(parameters(models, "seed"))),
        "training_steps": max(parameters(models, "max_steps"), default=0),
        "training_recordings": len(training),
        "training_objects": parameters(training, "object"),
        "training_sensors": parameters(training, "sensor"),
        "tone_s": max(tones, default=0.0),
    }


def methods(headers: Iterable[Row]) -> dict[str, int]:
    """Return the method version of each command behind a table's reports; the oldest if there are several."""
    numbers: dict[str, int] = {}
    for header in headers:
        nodes = (header, *header["history"].values())
        in_frames = any(node["kind"] == "tracks" and node["seed"] is not None for node in nodes)
        for node in nodes:
            command = node["parameters"].get("command", COMMANDS.get(node["kind"], ""))
            if node["kind"] == "force-model" and node["parameters"].get("method") == "touch":
                command = "train-force --method touch"
            if node["kind"] == "tracks":
                command = "track" if node["seed"] is None else "track --rgb"
            if node["kind"] == "recording" and "controller" in node["parameters"]:
                command = "grasp"
            if command in MODULES:
                numbers[command] = min(node["method"], numbers.get(command, node["method"]))
            for kind, method in node.get("methods", {}).items():  # of the files that a model was trained on
                command = COMMANDS.get(kind, "track --rgb" if in_frames else "track")
                numbers[command] = min(method, numbers.get(command, method))
    return {command: numbers[command] for command in MODULES if command in numbers}


def words_for(known: Row) -> Row:
    """Return the facts in words for a title."""
    shown = {name: value for name, value in known.items() if not isinstance(value, list)}
    for name, value in known.items():
        if isinstance(value, list):
            whole = all(isinstance(entry, int) for entry in value)
            shown[name] = ranges(value) if whole else ", ".join(map(str, value))
    return shown


def machine() -> Row:
    """Return the number of cores that a process may use, the processor's name and the memory in GB; no host name."""
    names = [line.partition(":")[2].strip() for line in _lines(CPU_INFO) if line.startswith("model name")]
    kilobytes = [int(line.split()[1]) for line in _lines(MEMORY_INFO) if line.startswith("MemTotal")]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory_gb = round(kilobytes[0] / 1e6) if kilobytes else None
    return {"cores": cores, "processor": names[0] if names else platform.machine(), "memory_gb": memory_gb}


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def _processor_s() -> float:
    """Return the processor time of this process and of all its commands that have ended."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def _spent(folder: Path) -> dict[str, float]:
    path = folder / SPENT
    stored: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}
    return stored


@contextmanager
def spending(folder: Path, experiment: str) -> Iterator[None]:
    """Add the processor time of the block to the experiment's, also if it fails or is interrupted."""
    began = _processor_s()
    try:
        yield
    finally:
        spent = _spent(folder)
        spent[experiment] = spent.get(experiment, 0.0) + _processor_s() - began
        unfinished = folder / f"{SPENT}.part"
        unfinished.write_text(json.dumps(spent, indent=1) + "\n")
        unfinished.replace(folder / SPENT)


def hours(experiments: Iterable[tuple[Path, str]]) -> float:
    """Return the core hours spent on experiments, each given by its folder and name; three digits."""
    return float(f"{sum(_spent(folder).get(name, 0.0) for folder, name in experiments) / 3600:.3g}")


def model_files(words: Sequence[str], folder: Path) -> list[Path]:
    """Return the files that `--model` of a command names, with its globs expanded, in the experiment's folder."""
    first = words.index("--model") + 1 if "--model" in words else len(words)
    end = next((at for at in range(first, len(words)) if words[at].startswith("--")), len(words))
    named = [folder / word for word in words[first:end]]
    return [path for one in named for path in (sorted(one.rglob("*.h5")) if one.is_dir() else [one]) if path.is_file()]


def models(judged: Collection[str], candidates: Iterable[Path], folder: Path) -> dict[str, str]:
    """Return name -> SHA-256 of the models that a table judges.

    judged: the recipe ids of these models; candidates: files that may be among them; the shipped detector may be, too.
    The name is that of the file and of its folder, such as `nothing/hist10-s9000`; the digest is `strip_model.digest`.
    """
    from evetac_cli.store.files import header_of
    from scripts.ship.strip_model import digest, short_name

    found: dict[str, str] = {}
    for path in (*candidates, MODEL) if judged else ():
        if header_of(path)["id"] in judged:
            inside = path.is_relative_to(folder)
            place = path.relative_to(folder) if inside else Path(*path.parts[-2:])
            found[short_name(str(place).removeprefix("models/"))] = digest(path)
    return dict(sorted(found.items()))


def of_freeze(table: Mapping[str, Any]) -> Row:
    """Return the frozen commit for a table whose trials all have judging seeds; empty for any other.

    `changed_since`: the frozen files that differed from that commit when the table was made.
    """
    seeds = seeds_of(table)
    if not seeds or not all(seed in frozen.SEEDS for seed in seeds):
        return {}
    freeze = frozen.read()
    return {"frozen": freeze.commit[:8], "changed_since": frozen.changed(freeze)}


def in_words(result: Mapping[str, Any]) -> str:
    """Return core hours, computer and freeze of a table in words; empty for a table without these facts."""
    words = [] if result.get("hours") is None else [f"{result['hours']:.3g} core hours"]
    if made_on := result.get("machine"):
        memory = f", {made_on['memory_gb']} GB" if made_on.get("memory_gb") else ""
        words.append(f"{made_on['cores']} cores of {made_on['processor']}{memory}")
    if commit := result.get("frozen"):
        changed = len(result.get("changed_since", []))
        since = f", {changed} frozen file{'s' * (changed != 1)} changed" if changed else ""
        words.append(f"methods frozen at {commit}{since}")
    return "; ".join(words)
