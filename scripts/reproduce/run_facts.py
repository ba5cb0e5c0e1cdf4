"""Facts of a run that are stored in its table: the computer, the core hours, the models judged and the freeze.

The processor time of an experiment is summed over its commands, also over those of interrupted runs, in the file
spent.json of its folder.
"""

import json
import os
import platform
import resource
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from evetac_cli.jobs import Row
from evetac_cli.resources import MODEL
from scripts.reproduce import frozen
from scripts.reproduce.seeds import seeds_of

SPENT = "spent.json"
CPU_INFO, MEMORY_INFO = Path("/proc/cpuinfo"), Path("/proc/meminfo")


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
