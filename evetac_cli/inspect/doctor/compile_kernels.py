"""doctor --compile: have numba compile what the commands need, so that none of them waits for it later.

Why so: the commands themselves are run, on three short trials in a folder that is thrown away. A list of functions and
their types would have to be kept by hand, and be wrong with the next change of a kernel.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Outcome, Progress, silent

# Commands of a step are chains that run side by side; what one step makes, the next ones read. The chain of the
# tracker begins with an import, which compiles nothing, so that it need not wait until the simulator is compiled.
# Three trials: to learn from, to choose a threshold on, to be judged on.
TRIALS = [f"slip-obj03-s0-{number:03d}" for number in range(3)]
RECORDINGS = " ".join(f"{name}.recording.h5" for name in TRIALS)
EVENTS, GRID = "events.txt", "grid.json"
Chain = Sequence[str]
AGAIN_S = 20.0  # after which it is said what still runs: the longest of the commands takes a minute or two
STEPS: tuple[tuple[Chain, ...], ...] = (
    (
        ("record --scene slip --object 3 --count 3 --out .",),
        (
            f"record --from {EVENTS} --frame-size 640x480 --calibration {GRID} --out a.recording.h5",
            "track a.recording.h5",
            "label a.recording.h5",
            "featurize a.recording.h5",
        ),
    ),
    (
        (
            f"track {RECORDINGS}",
            f"label {RECORDINGS}",
            f"featurize {RECORDINGS}",
            f"train {TRIALS[0]}.features.h5 --validate {TRIALS[1]}.features.h5 --epochs 1 --max-steps 1"
            " --out a.model.h5",
            f"evaluate slip {TRIALS[2]}.features.h5 --model a.model.h5 --out a.report.h5",
        ),
        ("grasp --object 11 --lift-s 1 --balance-s 0.1 --out b.recording.h5",),
    ),
)


class Course:
    """Which of the commands have begun and ended, said line by line: a newcomer can tell work from a hang."""

    def __init__(self, commands: int, progress: Progress, say: Callable[[str], None]) -> None:
        self.commands, self.progress, self.say = commands, progress, say
        self.begun = 0
        self.rows: list[dict[str, Any]] = []
        self.running: dict[int, tuple[str, float]] = {}  # a command's number: its name, and when it began
        self._lock = Lock()
        progress(0, commands)
        say(
            f"compiling for this computer, once after installing: {commands} commands, one to two minutes on two quiet"
            " cores, several on a slow or busy computer"
        )

    def run(self, command: str, folder: Path) -> None:
        """Run a command, and say that it begins."""
        name = name_of(command)
        started = time.monotonic()
        with self._lock:
            self.begun += 1
            number = self.begun
            self.running[number] = name, started
            self.say(f"compiling {number} of {self.commands}: {name} ...")
        _run(command, folder)
        with self._lock:
            del self.running[number]
            self.rows.append({"command": name, "time_s": time.monotonic() - started})
            self.progress(len(self.rows), self.commands)

    def say_what_runs(self) -> None:
        """Say which commands are at work, and for how long."""
        with self._lock:
            now = time.monotonic()
            names = (f"{name} for {now - began:.0f} s" for name, began in self.running.values())
            self.say(f"{len(self.rows)} of {self.commands} are compiled; at work: {', '.join(names)}")


def run(
    progress: Progress = silent,
    steps: Sequence[Sequence[Chain]] = STEPS,
    say: Callable[[str], None] = console.say,
    again_s: float = AGAIN_S,
) -> Outcome:
    """Run the commands, a row each; EvetacError with the words of one that fails.

    say: takes a line where a command begins, and every again_s seconds while none ends.
    """
    course = Course(sum(len(chain) for step in steps for chain in step), progress, say)
    with (
        TemporaryDirectory(prefix="evetac-compile-") as folder,
        ThreadPoolExecutor(max_workers=os.cpu_count()) as pool,
    ):
        _write_events(Path(folder))

        def run_chain(chain: Chain) -> None:
            for command in chain:
                course.run(command, Path(folder))

        for step in steps:
            waiting = {pool.submit(run_chain, chain) for chain in step}
            while waiting:
                done, waiting = wait(waiting, timeout=again_s)
                for ended in done:
                    ended.result()
                if not done:
                    course.say_what_runs()
    return Outcome(course.rows, False, {"commands": course.commands})


def name_of(command: str) -> str:
    """What a command line runs, as in `track` and `evaluate slip`."""
    first, second, *_ = command.split()
    return f"{first} {second}" if first == "evaluate" else first


def _write_events(folder: Path) -> None:
    """A second of events at random places, and a dot grid with a window."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 50_000))
    events = np.stack(
        [t, rng.integers(0, 640, len(t)), rng.integers(0, 480, len(t)), rng.integers(0, 2, len(t))], axis=1
    )
    np.savetxt(folder / EVENTS, events, fmt="%d", header="t_us x y p", comments="")
    dots = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
    grid = {"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots.tolist(), "window_px": [540, 0, 640, 480]}
    (folder / GRID).write_text(json.dumps(grid))


def _run(command: str, folder: Path) -> None:
    # The commands of this very package, also where it is not the one that is installed.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    arguments = [sys.executable, "-P", "-m", "evetac_cli", *command.split(), "--quiet"]
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise EvetacError("a command that compiles has failed", where=f"evetac {command}", found=done.stderr.strip())
