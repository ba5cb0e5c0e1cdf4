"""Run every command that reads files on mutated files: no traceback, no crash, no hang, no half-written output.

    python scripts/attack/fuzz/run.py OUT.jsonl --count 20000 --seed 17   # started again, it continues
    python scripts/attack/fuzz/run.py OUT.jsonl --count 2000 --kinds npz "AEDAT 2"   # damaged files of these kinds only
    python scripts/attack/fuzz/run.py OUT.jsonl --only 4711 --seed 17 --keep DIR   # one case, its files in DIR

A case is one damaged file and up to three of the commands that read its kind. Each command runs in a process of its
own, forked from a process that has loaded all modules, so a case takes a fraction of a second. These are problems:

    traceback   an exception without an error message of evetac, or `internal error`
    crash       a signal, or an exit code other than 0, 1, 2, 3 and 130
    hang        more than 20 s of processor time, or ten minutes of waiting
    memory      more than 2 GB resident
    output      an output that `validate` refuses
    left        a file left behind after exit code 2
    json        output of --json that is not a JSON object
    escape      a control character on stdout or stderr
"""

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # threads do not survive the fork

import numpy as np  # noqa: E402

from evetac_cli.cli import main as command_line  # noqa: E402
from scripts.attack.fuzz import corpus, mutations, wire  # noqa: E402

HANG_S = 20  # of processor time, in s, so that a busy computer makes no difference
WAITS_S = 600.0  # of waiting, in s
MEMORY_MB = 2048
ADDRESS_SPACE = 16 << 30  # so that a runaway process ends before memory runs out
CODES = (0, 1, 2, 3, 130)
COMMANDS_OF_A_CASE = 3
WARM = ("recording", "features", "tracks", "DSEC", "grasp recording", "scene")  # their commands load all slow modules
SHOWN = 400  # characters of a command's output that are kept with a problem


def call(arguments: list[str], folder: Path, streams: Path) -> dict[str, Any]:
    """Run one command in a child process; return exit code, seconds and MB. Its output is written to `streams`."""
    started, limit_s = time.monotonic(), WAITS_S
    child = os.fork()
    if child == 0:
        _child(arguments, folder, streams)
    status, usage = None, None
    while status is None:
        pid, code, used = os.wait4(child, os.WNOHANG)
        if pid:
            status, usage = code, used
        elif time.monotonic() > started + limit_s:
            os.killpg(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
        else:
            time.sleep(0.002)
    exit_ = os.waitstatus_to_exitcode(status)
    ended: int | str = "hang" if exit_ in (-signal.SIGKILL, -signal.SIGXCPU) else exit_
    return {"exit": ended, "seconds": round(usage.ru_utime + usage.ru_stime, 3), "memory_mb": usage.ru_maxrss >> 10}


def _child(arguments: list[str], folder: Path, streams: Path) -> None:
    code = 70
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (HANG_S, HANG_S + 1))
        for number, name in ((1, "stdout"), (2, "stderr")):
            file = os.open(streams.with_suffix(f".{name}"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        sys.stdin = open(os.devnull)  # noqa: SIM115 - until the child ends
        sys.argv = ["evetac", *arguments]
        try:
            if arguments[0] == "wire":
                wire.CALLS[arguments[1]](Path(arguments[2]))
            else:
                command_line.main()
            code = 0
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def problems(result: dict[str, Any], streams: Path, folder: Path, before: set[str], as_json: bool) -> list[str]:
    """Return the problems of a command, each as `name: details`."""
    out, err = (streams.with_suffix(f".{name}").read_bytes() for name in ("stdout", "stderr"))
    words = (out + err).decode(errors="replace")
    lines = []
    if "Traceback (most recent call last)" in words or "internal error" in words:
        last = [line for line in words.splitlines() if line.strip()][-1:]
        places = [line.strip() for line in words.splitlines() if line.strip().startswith('File "') and "evetac" in line]
        lines.append(f"traceback: {' '.join(last)[:SHOWN]} {' '.join(places[-1:])}")
    if result["exit"] == "hang":
        lines.append("hang")
    elif result["exit"] not in CODES:
        lines.append(f"crash: exit {result['exit']}: {words[-SHOWN:]}")
    if result["memory_mb"] > MEMORY_MB:
        lines.append(f"memory: {result['memory_mb']} MB")
    if as_json and result["exit"] in CODES:
        try:
            json.loads(out)
        except ValueError:
            lines.append(f"json: {out[:SHOWN]!r}")
    if any(ord(letter) < 32 and letter not in "\n\t\r" for letter in words):
        lines.append(f"escape: {words[:SHOWN]!r}")
    if result["exit"] == 2 and (left := sorted(_files(folder) - before)):
        lines.append(f"left: {', '.join(left)[:SHOWN]}")
    return lines


def _mutate(path: Path, family: str, rng: np.random.Generator, report: Path) -> list[str]:
    """Damage a file in a child process, because HDF5 may crash on a file that is damaged twice."""
    child = os.fork()
    if child == 0:
        try:
            report.write_text(json.dumps(mutations.mutate(path, family, rng)))
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    done: list[str] = json.loads(report.read_text()) if report.exists() else ["not known: HDF5 broke on it"]
    return done


def _files(folder: Path) -> set[str]:
    """Return the names of all files."""
    every = (path for path in folder.rglob("*") if not path.is_dir())
    return {str(path.relative_to(folder)) for path in every}


def case(number: int, seed: int, files: Path, folder: Path, kinds: Sequence[corpus.Kind]) -> dict[str, Any]:
    """Make one damaged file and run its commands; return the damage and the problems."""
    damage_rng, rng = np.random.default_rng([seed, number]), np.random.default_rng([seed, number, 1])
    kind = kinds[number % len(kinds)]
    damaged = corpus.copy(kind, files, folder)
    done = _mutate(damaged, kind.mutation, damage_rng, folder.parent / "damage")
    chosen = rng.permutation(len(kind.commands))[:COMMANDS_OF_A_CASE]
    row: dict[str, Any] = {"case": number, "seed": seed, "kind": kind.name, "damage": done, "runs": [], "problems": []}
    for place in sorted(chosen):
        command = kind.commands[place]
        outputs = folder / "out"
        shutil.rmtree(outputs, ignore_errors=True)
        outputs.mkdir()
        as_json = bool(rng.random() < 0.5) and not command.startswith("wire")
        words = command.format(f=damaged, o=outputs, d=folder).split() + (["--json"] if as_json else [])
        streams = folder.parent / "output"
        before = _files(folder)
        result = call(words, folder, streams)
        wrong = problems(result, streams, folder, before, as_json)
        if result["exit"] == 0:
            for made in sorted(outputs.rglob("*.h5")):
                if "." in made.stem and not made.is_symlink():  # a stage file: NAME.KIND.h5
                    checked = call(["validate", str(made)], folder, streams)
                    if checked["exit"] != 0:
                        text = streams.with_suffix(".stdout").read_text(errors="replace")
                        text += streams.with_suffix(".stderr").read_text(errors="replace")
                        wrong.append(f"output: {made.name}: {' '.join(text.split())[-SHOWN:]}")
        row["runs"].append({"command": command, **result})
        row["problems"] += [f"{command}: {line}" for line in wrong]
        for path in _files(folder) - before:
            if not path.startswith("out/"):
                (folder / path).unlink(missing_ok=True)
    return row


def warm_up(files: Path, kinds: Sequence[corpus.Kind]) -> None:
    """Load all modules and compiled kernels in this process, so that its children do not have to."""
    with tempfile.TemporaryDirectory() as folder:
        output, saved = os.open(os.devnull, os.O_WRONLY), [os.dup(1), os.dup(2)]
        os.dup2(output, 1)
        os.dup2(output, 2)
        try:
            for kind in [kind for kind in kinds if kind.name in WARM] or kinds:
                for command in kind.commands:
                    if not command.startswith("record --camera"):
                        _in_this_process(command.format(f=files / kind.file, o=folder, d=folder).split(), files)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, kept in enumerate(saved, start=1):
                os.dup2(kept, number)


def _in_this_process(arguments: list[str], folder: Path) -> None:
    place = os.getcwd()
    os.chdir(folder)
    sys.argv = ["evetac", *arguments]
    try:
        command_line.main()
    except SystemExit:
        pass
    finally:
        os.chdir(place)


def known(path: Path, seed: int) -> set[int]:
    """Return the cases that an earlier run has finished."""
    if not path.exists():
        return set()
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {row["case"] for row in rows if row["seed"] == seed}


def summary(path: Path) -> int:
    """Print the outcome of all cases; return the number of cases with a problem."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    exits = Counter(run["exit"] for row in rows for run in row["runs"])
    kinds = Counter(problem.split(": ", 2)[1] for row in rows for problem in row["problems"])
    runs = [run for row in rows for run in row["runs"]]
    print(f"{len(rows):,} damaged files, {len(runs):,} commands; seeds {sorted({row['seed'] for row in rows})}")
    print("exit codes: " + ", ".join(f"{code}: {count:,}" for code, count in sorted(exits.items(), key=str)))
    print(
        f"longest {max(run['seconds'] for run in runs):.1f} s, most memory {max(run['memory_mb'] for run in runs)} MB"
    )
    print("problems: " + (", ".join(f"{name} {count}" for name, count in kinds.most_common()) or "none"))
    for problem, count in Counter(p for row in rows for p in row["problems"]).most_common(60):
        first = next(row["case"] for row in rows if problem in row["problems"])
        print(f"  {count} x, first in case {first}: {problem[:300]}")
    return sum(bool(row["problems"]) for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="JSON lines, one per case; cases in this file are not run again")
    parser.add_argument("--count", type=int, default=1000, help="total number of cases [1000]")
    parser.add_argument("--first", type=int, default=0, help="number of the first case [0]")
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument("--only", type=int, help="run only this case, and print it")
    parser.add_argument("--keep", type=Path, help="with --only: an empty folder in which to keep its files")
    parser.add_argument("--corpus", type=Path, help="folder of the corpus, made if missing [fuzz-corpus next to OUT]")
    names = [kind.name for kind in corpus.KINDS]
    parser.add_argument("--kinds", nargs="+", choices=names, default=names, metavar="KIND", help=", ".join(names))
    chosen = parser.parse_args()
    kinds = [kind for kind in corpus.KINDS if kind.name in chosen.kinds]
    # Not in /tmp, where another user may have created a folder of this name.
    chosen.corpus = (chosen.corpus or chosen.out.with_name("fuzz-corpus")).absolute()
    corpus.make(chosen.corpus)
    warm_up(chosen.corpus, kinds)
    if chosen.only is not None:
        folder = chosen.keep or Path(tempfile.mkdtemp(prefix="evetac-fuzz-"))
        (folder / "case").mkdir(parents=True)
        print(json.dumps(case(chosen.only, chosen.seed, chosen.corpus, folder / "case", kinds), indent=1))
        return
    finished = known(chosen.out, chosen.seed)
    with chosen.out.open("a") as out:
        for number in range(chosen.first, chosen.first + chosen.count):
            if number in finished:
                continue
            with tempfile.TemporaryDirectory(prefix="evetac-fuzz-") as folder:
                files = Path(folder) / "case"
                files.mkdir()
                out.write(json.dumps(case(number, chosen.seed, chosen.corpus, files, kinds)) + "\n")
                out.flush()
    raise SystemExit(1 if summary(chosen.out) else 0)


if __name__ == "__main__":
    main()
