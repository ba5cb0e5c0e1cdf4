"""doctor --compile: let numba compile the functions that commands need, so that no command has to wait for it later.

The commands themselves are run, on short trials in a temporary folder. A list of functions and their types would have
to be maintained by hand and would be wrong after the next change of a kernel. Two processes share the work
(compile_worker.py): one compiles camera and detector, which commands use last, while the other compiles the tracker and
the gel.
"""

import json
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Outcome, Progress, silent
from evetac_cli.sim.setup.scene_file import changed

EVENTS, GRID, SCENE = "events.txt", "grid.json", "short-slip.toml"
Chain = Sequence[str]
AGAIN_S = 15.0  # period of messages on what is still running: the longest part takes half a minute or more

# The chains of a step run in parallel, each in a process; later steps use the files and functions of earlier ones. The
# tracker's chain begins with an import, which compiles nothing, so that it need not wait for the simulator.
STEPS: tuple[tuple[Chain, ...], ...] = (
    (
        (
            f"record --from {EVENTS} --frame-size 640x480 --calibration {GRID} --out a.recording.h5",
            "track a.recording.h5",
            "label a.recording.h5",
            "featurize a.recording.h5",
            f"record --scene {SCENE} --object 3 --out b.recording.h5",
        ),
        ("camera", "detector"),
    ),
    (("grasp --object 11 --lift-s 1 --balance-s 0.1 --out c.recording.h5",),),
)


class Course:
    """The parts that have begun and ended, printed line by line, so that a new user sees that the program works."""

    def __init__(self, parts: int, progress: Progress, say: Callable[[str], None]) -> None:
        self.parts, self.progress, self.say = parts, progress, say
        self.begun = self.functions = 0
        self.rows: list[dict[str, Any]] = []
        self.running: dict[int, tuple[str, float]] = {}  # a part's number: its name, and when it began
        self._lock = Lock()
        progress(0, parts)
        say(
            f"compiling for this computer, once after installation: {parts} parts, half a minute on two idle"
            " cores, several minutes on a slow or busy computer"
        )

    def run(self, line: str, worker: "Worker") -> None:
        """Let a worker run a part, and print its begin."""
        name = name_of(line)
        started = time.monotonic()
        with self._lock:
            self.begun += 1
            number = self.begun
            self.running[number] = name, started
            self.say(f"compiling {number} of {self.parts}: {name} ...")
        functions = 0
        for more in worker.run(line):
            with self._lock:
                functions += more
                self.functions += more
        with self._lock:
            del self.running[number]
            self.rows.append({"part": name, "functions": functions, "time_s": time.monotonic() - started})
            self.progress(len(self.rows), self.parts)

    def say_what_runs(self) -> None:
        """Print the parts that are running, and for how long."""
        with self._lock:
            now = time.monotonic()
            names = ", ".join(f"{name} for {now - began:.0f} s" for name, began in self.running.values())
            self.say(
                f"{len(self.rows)} of {self.parts} parts are compiled, {self.functions} functions; running: {names}"
            )


class Worker:
    """A process of compile_worker.py in a folder."""

    def __init__(self, folder: Path) -> None:
        # Import this package, even if another copy of it is installed.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        arguments = [sys.executable, "-P", "-m", "evetac_cli.inspect.doctor.compile_worker"]
        self._process = subprocess.Popen(
            arguments,
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,  # messages of the process itself; those of a command are in its answer
            text=True,
        )
        self._functions = 0

    def run(self, line: str) -> Iterator[int]:
        """Run a part and yield the numbers of newly compiled functions; raise EvetacError if the part fails."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with suppress(BrokenPipeError):  # the process has ended, which is reported below
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()
        for answer in map(json.loads, self._process.stdout):
            if answer.get("failed"):
                raise _failed(line, answer["failed"])
            yield answer["functions"] - self._functions
            self._functions = answer["functions"]
            if "failed" in answer:
                return
        assert self._process.stderr is not None
        words = self._process.stderr.read()
        raise _failed(line, words or f"the process ended with exit code {self._process.wait()}")

    def stop(self) -> None:
        """Kill the process; the reader of its answers then sees that it has ended."""
        self._process.kill()

    def end(self) -> None:
        """Stop the process and release its resources."""
        self.stop()
        with suppress(BrokenPipeError), self._process:  # there may be a line that it has not read
            pass


def _failed(line: str, words: str) -> EvetacError:
    return EvetacError("compiling failed", where=line, found=words.strip())


def run(
    progress: Progress = silent,
    steps: Sequence[Sequence[Chain]] = STEPS,
    say: Callable[[str], None] = console.say,
    again_s: float = AGAIN_S,
) -> Outcome:
    """Compile all parts and return a row for each; raise EvetacError with the message of one that fails.

    say: called with a line when a part begins, and every again_s seconds while none ends.
    """
    course = Course(sum(len(chain) for step in steps for chain in step), progress, say)
    with TemporaryDirectory(prefix="evetac-compile-") as folder:
        _write_events(Path(folder))
        _write_scene(Path(folder))
        workers = [Worker(Path(folder)) for _ in range(min(os.cpu_count() or 1, max(map(len, steps))))]
        try:
            _run_steps(steps, workers, course, again_s)
        finally:
            for worker in workers:
                worker.end()
    return Outcome(course.rows, False, {"functions": course.functions})


def _run_steps(steps: Sequence[Sequence[Chain]], workers: Sequence[Worker], course: Course, again_s: float) -> None:
    """Run the chains of each step in parallel; after a failure or Ctrl-C, do not wait for the others."""
    idle = deque(workers)

    def run_chain(chain: Chain) -> None:
        worker = idle.popleft()
        for line in chain:
            course.run(line, worker)
        idle.append(worker)

    with ThreadPoolExecutor(max_workers=len(workers)) as pool:
        try:
            for step in steps:
                waiting = {pool.submit(run_chain, chain) for chain in step}
                while waiting:
                    done, waiting = wait(waiting, timeout=again_s)
                    for ended in done:
                        ended.result()
                    if not done:
                        course.say_what_runs()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.stop()
            raise


def name_of(line: str) -> str:
    """Return the name of a part, for example `track`, `evaluate slip` or `camera`."""
    first, *more = line.split()
    return f"{first} {more[0]}" if first == "evaluate" else first


def _write_events(folder: Path) -> None:
    """Write a second of events at random pixels, and a dot grid with a window."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 50_000))
    events = np.stack(
        [t, rng.integers(0, 640, len(t)), rng.integers(0, 480, len(t)), rng.integers(0, 2, len(t))], axis=1
    )
    np.savetxt(folder / EVENTS, events, fmt="%d", header="t_us x y p", comments="")
    dots = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
    grid = {"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots.tolist(), "window_px": [540, 0, 640, 480]}
    (folder / GRID).write_text(json.dumps(grid))


def _write_scene(folder: Path) -> None:
    """Write the scene slip with all its parts, as short as possible."""
    time = {"rest_s": 0.05, "load_s": 0.05, "hold_s": 0.05, "after_lost_s": 0.02, "longest_s": 0.3}
    gripper = {"start_factor": [1.05, 1.3], "friction_factor": [0.1, 0.12]}
    (folder / SCENE).write_text(changed("slip", {"time": time, "gripper": gripper}))
