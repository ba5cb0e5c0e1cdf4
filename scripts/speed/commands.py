"""Measure the CPU time of whole commands on one trial of 4 s: user and system time of the process.

Two checkouts take turns, and the cheapest round of each counts, because other programs can only add to the time.
"""

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

RECORD = "record --scene slip --object 3 --seed 20011 -o a.recording.h5"
STAGES = ("track", "label", "featurize")
# Run in a folder with a trial and all files made from it; the output named by NEW is removed before each round.
NEW = "new"
COMMANDS = {
    "--version": "--version",
    "--help": "--help",
    **{f"{stage}, nothing to do": f"{stage} a.recording.h5" for stage in STAGES},
    "predict-touch, nothing to do": "predict-touch a.tracks.h5",
    "record, nothing to do": RECORD,
    "validate": "validate a.recording.h5",
    "info": "info a.recording.h5",
    "info of a folder": "info .",
    "track": f"track a.recording.h5 -o {NEW}.tracks.h5",
    "label": f"label a.recording.h5 -o {NEW}.labels.h5",
    "featurize": f"featurize a.recording.h5 -o {NEW}.features.h5",
    "predict-touch": f"predict-touch a.tracks.h5 -o {NEW}.touch.h5",
    "export parquet": f"export a.recording.h5 --format parquet -o {NEW}.parquet",
    "export raw": f"export a.recording.h5 --format raw -o {NEW}.raw",
    "report": f"report . -o {NEW}.html",
}


def cpu_s(code: Path, words: str, folder: Path) -> float:
    """Return the CPU seconds of `evetac WORDS` in a folder, with a checkout's package; CalledProcessError."""
    for old in folder.glob(f"{NEW}.*"):
        old.unlink()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = [sys.executable, "-P", "-m", "evetac_cli", *words.split()]
    subprocess.run(run, cwd=folder, env=os.environ | {"PYTHONPATH": str(code)}, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def cheapest(codes: Sequence[Path], rounds: int, commands: dict[str, str] = COMMANDS) -> dict[str, list[float]]:
    """Return the CPU seconds of each command with the package of each checkout; the first run loads caches, uncounted.

    Each checkout has a trial of its own, because one may not be able to read the other's files. Recipe and seed are the
    same; the trials differ only if the simulator does.
    """
    with tempfile.TemporaryDirectory(prefix="evetac-bench-") as name:
        folders = [Path(name) / str(number) for number in range(len(codes))]
        for code, folder in zip(codes, folders, strict=True):
            folder.mkdir()
            made = [f"{stage} a.recording.h5" for stage in STAGES]
            for words in (RECORD, *made, "predict-touch a.tracks.h5", "info ."):
                cpu_s(code, words, folder)
        at_work = list(zip(codes, folders, strict=True))
        found = {}
        for what, words in commands.items():
            spent = [[cpu_s(code, words, folder) for code, folder in at_work] for _ in range(rounds + 1)][1:]
            found[what] = [min(column) for column in zip(*spent, strict=True)]
        return found


def rows(code: Path, rounds: int = 3) -> list[dict[str, object]]:
    """Return a row for each command, with the package of this checkout."""
    return [{"what": what, "cpu_s": spent} for what, (spent,) in cheapest([code], rounds).items()]


def against(code: Path, base: Path, rounds: int) -> list[dict[str, object]]:
    """Return a row for each command, with the package of this checkout, of another, and their ratio."""
    return [
        {"what": what, "cpu_s": ours, "cpu_s_base": theirs, "ratio": ours / theirs}
        for what, (ours, theirs) in cheapest([code, base], rounds).items()
    ]
