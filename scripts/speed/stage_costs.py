"""Measure the cost of each stage: processor time, memory and bytes per trial, with start-up separated from work.

    python scripts/speed/stage_costs.py                          # `make profile`: six trials of the scene slip
    python scripts/speed/stage_costs.py --trials 8 -o costs.json # more trials, and the figures as JSON too
    python scripts/speed/stage_costs.py --only track,label       # these, and (without figures) the stages they need
    python scripts/speed/stage_costs.py --inside track           # ... and the functions in which a stage spends time

Every command runs on two trials, on all trials, and on all again, when there is nothing left to do. The difference
between all and two trials is the work, per trial. The rest of the time for two trials is start-up: loading modules and
kernels, reading flags, looking at files.

Processor time includes all processes that a command starts. The least of several rounds counts, because other programs
only add time. Memory is the largest resident set on all trials. Bytes are those of the stage's outputs. Run `evetac
doctor compile` first, otherwise the first round compiles. Simulated, one process (`--jobs 1`).
"""

import argparse
import json
import os
import pstats
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from evetac_cli.console import print_table, say
from evetac_cli.jobs import Row
from evetac_cli.resources import MODEL
from scripts.reproduce.facts import commit_facts

LOOP = ("--controller", "paper", "--model", "shipped", "--node-pitch-mm", "1.45")
FEW = 2  # trials of the first run: the least that train needs to train and to choose a threshold
SEED = 10_000  # object of the first trial, which the pretrained detector was not trained on
MOST_FUNCTIONS = 20  # functions that --inside shows
AS_SHOWN = ("stage", "cpu_s_per_trial", "share", "start_cpu_s", "again_cpu_s", "memory_mb", "kilobytes_per_trial")


@dataclass(frozen=True)
class Step:
    """A command to measure."""

    words: tuple[str, ...]  # arguments before the input files
    reads: str = ""  # kind of the input files; empty: it makes a given number of trials
    writes: str = ""  # file name suffix of its outputs; empty: none
    after: tuple[str, ...] = ("record",)  # steps whose files it needs


def cpu_of(*words: str, cwd: Path) -> tuple[float, float]:
    """Return a command's processor time in s and its largest resident set in MB; SystemExit if it fails."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *words]
    process = subprocess.Popen(command, cwd=cwd, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3


def steps(scene: str, grasp_s: float) -> dict[str, Step]:
    """Return all commands to measure, in an order in which each finds its inputs.

    grasp_s: how long a grasp lifts; it balances for a third of that.
    """
    lasts = ("--lift-s", str(grasp_s), "--balance-s", str(grasp_s / 3.0))
    learn = ("train", "--model", "fast-slow", "--preset", "adam", "--epochs", "1", "-o", "a.model.h5")
    judge = ("evaluate", "slip", "--model", str(MODEL), "-o", "slip.report.h5")
    features = ("record", "track", "label", "featurize")
    return {
        "record": Step(("record", "--scene", scene, "--object", "3", "-o", "."), "", ".recording.h5", ()),
        "track": Step(("track",), "recording", ".tracks.h5"),
        "label": Step(("label",), "recording", ".labels.h5"),
        "featurize": Step(("featurize", "--sticking-share"), "recording", ".features.h5", features[:-1]),
        "train 1 epoch": Step(learn, "features", ".model.h5", features),
        "evaluate slip": Step(judge, "features", "slip.report.h5", features),
        "evaluate labels": Step(
            ("evaluate", "labels", "-o", "labels.report.h5"), "labels", "labels.report.h5", ("record", "label")
        ),
        "evaluate tracking": Step(
            ("evaluate", "tracking", "-o", "tracks.report.h5"), "tracks", "tracks.report.h5", ("record", "track")
        ),
        "validate": Step(("validate",), "recording"),
        "info": Step(("info",), "recording"),
        "grasp": Step(("grasp", "--object", "11", *LOOP, *lasts, "-o", "grasps"), "", "grasps/*.recording.h5", ()),
    }


def command(step: Step, folder: Path, trials: int) -> list[str]:
    """Return the arguments of a step for the trials of a folder, or for making a number of them."""
    if not step.reads:
        return [*step.words, "--quiet", "--count", str(trials), "--seed", str(SEED)]
    return [*step.words, "--quiet", *(path.name for path in sorted(folder.glob(f"*.{step.reads}.h5")))]


def needed(chosen: Sequence[str], known: dict[str, Step]) -> list[str]:
    """Return the chosen steps and all steps that make files for them, in order."""
    before = {earlier for name in chosen for earlier in known[name].after}
    return [name for name in known if name in chosen or name in before]


def measured_round(known: dict[str, Step], chosen: Sequence[str], trials: int, scene: Path | None) -> dict[str, Row]:
    """Measure each chosen step on two trials, on all and on all again, and the bytes it writes.

    Steps that are not chosen run without figures. scene: a file that is put next to the trials.
    """
    rows: dict[str, Row] = {}
    with tempfile.TemporaryDirectory(prefix="evetac-profile-") as place:
        for name, count in (("few", FEW), ("all", trials)):
            folder = Path(place, name)
            folder.mkdir()
            if scene is not None:
                shutil.copy(scene, folder)
            for what in needed(chosen, known):
                words = command(known[what], folder, count)
                cpu_s, memory_mb = cpu_of(*words, cwd=folder)
                if what not in chosen:
                    continue
                row = rows.setdefault(what, {})
                row[f"{name}_s"], row["memory_mb"] = cpu_s, memory_mb
                if name == "all" and known[what].writes:
                    row["again_s"], _ = cpu_of(*words, cwd=folder)
                    row["bytes"] = sum(path.stat().st_size for path in folder.glob(f"*{known[what].writes}"))
    return rows


def table(rounds: Sequence[dict[str, Row]], trials: int) -> list[Row]:
    """Return a row for each step (least of several rounds) and one for all: work per trial, its share, and start-up."""
    rows: list[Row] = []
    for stage in rounds[0]:
        least = {key: min(taken[stage][key] for taken in rounds) for key in rounds[0][stage] if key.endswith("_s")}
        work_s = max(least["all_s"] - least["few_s"], 0.0) / (trials - FEW)
        row = {"stage": stage, "cpu_s_per_trial": work_s, "start_cpu_s": max(least["few_s"] - FEW * work_s, 0.0)}
        row["again_cpu_s"] = least.get("again_s")
        row["memory_mb"] = max(taken[stage]["memory_mb"] for taken in rounds)
        row["kilobytes_per_trial"] = rounds[0][stage]["bytes"] / trials / 1e3 if "bytes" in rounds[0][stage] else None
        rows.append(row)
    whole_s = sum(row["cpu_s_per_trial"] for row in rows)
    for row in rows:
        row["share"] = row["cpu_s_per_trial"] / whole_s if whole_s else None
    return [{key: row[key] for key in AS_SHOWN} for row in rows]


def summary(rows: Sequence[Row]) -> Row:
    """Summarise all stages: work per trial, start-up, and the share of start-up if there is a single trial."""
    work_s, start_s = (sum(row[key] for row in rows) for key in ("cpu_s_per_trial", "start_cpu_s"))
    return {
        "cpu_s_per_trial": work_s,
        "start_cpu_s": start_s,
        "start_share_of_one_trial": start_s / (work_s + start_s) if work_s + start_s else None,
        "load": " ".join(f"{load:.1f}" for load in os.getloadavg()),
        "cores": os.cpu_count(),
    }


def inside(known: dict[str, Step], stage: str, trials: int, scene: Path | None) -> list[Row]:
    """Return the functions in which a stage spends most time: own time, time with callees, and number of calls."""
    with tempfile.TemporaryDirectory(prefix="evetac-profile-") as place:
        folder = Path(place)
        if scene is not None:
            shutil.copy(scene, folder)
        for what in needed([stage], known):
            words = command(known[what], folder, trials)
            if what != stage:
                cpu_of(*words, cwd=folder)
        seen = folder / "seen.prof"
        profiled = [sys.executable, "-P", "-m", "cProfile", "-o", str(seen), "-m", "evetac_cli", *words]
        subprocess.run(profiled, cwd=folder, stdout=subprocess.DEVNULL, check=True)
        functions = pstats.Stats(str(seen)).stats  # type: ignore[attr-defined]
    longest = sorted(functions.items(), key=lambda entry: -entry[1][2])[:MOST_FUNCTIONS]
    return [
        {"function": place_of(*where), "own_s": own_s, "with_called_s": whole_s, "calls": calls}
        for where, (_, calls, own_s, whole_s, _) in longest
    ]


def place_of(file: str, line: int, name: str) -> str:
    """Return the location of a function: file with its last three folders, line and name."""
    return f"{'/'.join(Path(file).parts[-3:])}:{line} {name}" if line else name


def main() -> None:
    """Measure and print a table."""
    about = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    about.add_argument("--trials", type=int, default=6, help="number of trials, at least 3")
    about.add_argument("--rounds", type=int, default=2, help="rounds; the least time counts")
    about.add_argument("--scene", default="slip", help="name of a scene, or a TOML file")
    about.add_argument("--grasp-s", type=float, default=3.0, help="how long a grasp lifts")
    about.add_argument("--only", default="", help="stages, separated by commas")
    about.add_argument("--inside", default="", help="a stage: show its longest functions instead")
    about.add_argument("-o", "--out", type=Path, help="write the figures as JSON too")
    given = about.parse_args()
    scene = Path(given.scene).resolve() if given.scene.endswith(".toml") else None
    known = steps(scene.name if scene else given.scene, given.grasp_s)
    chosen = [given.inside] if given.inside else given.only.split(",") if given.only else list(known)
    unknown = [name for name in chosen if name not in known]
    if unknown or given.trials <= FEW or given.rounds < 1:
        about.error(f"expected more than {FEW} trials, 1 round, and stages among {', '.join(known)}; found {unknown}")
    if given.inside:
        rows, more = inside(known, given.inside, given.trials, scene), {}
    else:
        rounds = []
        for number in range(given.rounds):
            say(f"round {number + 1} of {given.rounds}: {len(chosen)} stages")
            rounds.append(measured_round(known, chosen, given.trials, scene))
        rows = table(rounds, given.trials)
        more = summary(rows) | {"trials": given.trials, "rounds": given.rounds, "commit": commit_facts()["commit"]}
    print_table(f"inside {given.inside}" if given.inside else "stage costs", rows, more, simulated=True)
    if given.out:
        given.out.write_text(json.dumps({"simulated": True, "rows": rows, "summary": more}, indent=1) + "\n")


if __name__ == "__main__":
    main()
