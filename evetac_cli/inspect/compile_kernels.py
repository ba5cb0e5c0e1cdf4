"""doctor --compile: have numba compile what the commands need, so that none of them waits for it later.

Why so: the commands themselves are run, on three short trials in a folder that is thrown away. A list of functions and
their types would have to be kept by hand, and be wrong with the next change of a kernel.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Outcome, Progress, silent

# What one step makes, the next ones read; the commands of a step need different functions, and run side by side.
# Three trials: to learn from, to choose a threshold on, to be judged on.
TRIALS = [f"slip-obj03-s0-{number:03d}" for number in range(3)]
RECORDINGS = " ".join(f"{name}.recording.h5" for name in TRIALS)
STEPS: tuple[tuple[str, ...], ...] = (
    ("record --scene slip --object 3 --count 3 --out .",),
    (f"track {RECORDINGS}", f"label {RECORDINGS}"),
    (f"featurize {RECORDINGS}", "grasp --object 11 --lift-s 1 --balance-s 0.1 --out b.recording.h5"),
    (f"train {TRIALS[0]}.features.h5 --validate {TRIALS[1]}.features.h5 --epochs 1 --max-steps 1 --out a.model.h5",),
    (f"evaluate slip {TRIALS[2]}.features.h5 --model a.model.h5 --out a.report.h5",),
)


def run(progress: Progress = silent, steps: Sequence[Sequence[str]] = STEPS) -> Outcome:
    """Run the commands, a row each; EvetacError with the words of one that fails."""
    rows: list[dict[str, Any]] = []
    commands = sum(map(len, steps))
    with (
        TemporaryDirectory(prefix="evetac-compile-") as folder,
        ThreadPoolExecutor(max_workers=os.cpu_count()) as pool,
    ):
        progress(0, commands)
        for step in steps:
            for row in pool.map(lambda command: _run(command, Path(folder)), step):
                rows.append(row)
                progress(len(rows), commands)
    return Outcome(rows, False, {"commands": commands})


def _run(command: str, folder: Path) -> dict[str, Any]:
    started = time.monotonic()
    # The commands of this very package, also where it is not the one that is installed.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    arguments = [sys.executable, "-m", "evetac_cli", *command.split(), "--quiet"]
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise EvetacError("a command that compiles has failed", where=f"evetac {command}", found=done.stderr.strip())
    return {"command": command.partition(" ")[0], "time_s": time.monotonic() - started}
