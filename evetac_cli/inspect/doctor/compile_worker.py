"""A process that compiles for `doctor --compile`: it runs what it is told, one thing after the other.

Why one process for many commands: each of its own would load numba, and compile what numba brings along, once more.

    python -P -m evetac_cli.inspect.doctor.compile_worker < lines

Each line names a command with its flags, or, in FIRST, a part that is compiled ahead of the command that needs it.
Answers are lines of JSON on stdout: `{"functions": 12}` while it works, `{"failed": "", "functions": 30}` at the end,
where `failed` holds the words of a command that failed.
"""

import gc
import json
import os
import runpy
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numba.core import event

from evetac_cli.events import Events
from evetac_cli.kernels.slip import inputs
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, CHANNELS
from evetac_cli.kernels.tracking import presets
from evetac_cli.resources import MODEL
from evetac_cli.sim.camera.gel_camera import GelCamera
from evetac_cli.sim.scenes.gripped import OUT_OF_SIGHT_M, TEXTURE_PX
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.sampling import sensor_with_gel
from evetac_cli.store.files import StageFile
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector

SLICES = 200  # more than any network looks back on
SAY_S = 0.5  # between two lines that say how far it is


def _camera() -> None:
    """What the camera of a slip scene runs in its first slice, without the gel, which another process compiles."""
    plan = first_plan("slip", "3")
    sensor, texture = sensor_with_gel(plan.scene, plan.sensor), np.zeros(TEXTURE_PX, np.float32)
    rng = np.random.default_rng(0)
    camera = GelCamera(sensor, scene=plan.scene, texture=texture, rng=rng, readout=plan.readout)
    camera.render(np.zeros_like(camera.rest_m), OUT_OF_SIGHT_M, 0.0, 0, None, cut_m=camera.cut_rest_m, still=False)


def _detector() -> None:
    """What the detector of a grasp runs in a slice, and training on slices that nobody may change."""
    with StageFile(MODEL) as model:
        rows, columns = (int(size) for size in model.read("dot_shape"))
        dots_px = np.stack(np.meshgrid(60.0 * np.arange(columns) + 60.0, 60.0 * np.arange(rows) + 50.0), axis=-1)
        detector = OnlineSlipDetector.start(model, dots_px, (540, 0, 640, 480), presets.PRESETS["stable"])
    x, y = np.full(200, 100, np.uint16), np.full(200, 110, np.uint16)
    for number in range(SLICES):
        detector.step(Events(np.full(200, 1000 * number), x, y, np.ones(200, np.uint8)))
    learnt = ARCHITECTURES["disp-xy"]
    series = np.zeros((SLICES, rows * columns, len(CHANNELS)), np.float32)
    series.setflags(write=False)
    batch = inputs.at(learnt, series, np.array([SLICES - 1]))
    inputs.turn(learnt, batch, rows, columns, np.zeros(1, np.int64), np.ones(1, np.float32))


FIRST: dict[str, Callable[[], None]] = {"camera": _camera, "detector": _detector}


class Counter(event.Listener):  # type: ignore[misc]
    """Counts the functions that are compiled, and tells now and then; meanwhile no garbage is looked for."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        self.functions = self._inside = 0
        self._tell, self._told_s = tell, time.monotonic()

    def on_start(self, happens: Any) -> None:
        """A function begins to be compiled, maybe within another."""
        if self._inside == 0:
            gc.disable()
        self._inside += 1

    def on_end(self, happens: Any) -> None:
        """A function is compiled."""
        self._inside -= 1
        self.functions += 1
        if self._inside == 0:
            gc.enable()
        if time.monotonic() - self._told_s > SAY_S:
            self._told_s = time.monotonic()
            self._tell(self.functions)


def _failure(line: str) -> str:
    """Run a command or a part; the words on stderr of a command that fails, empty otherwise."""
    with TemporaryFile() as words, _stderr_into(words):
        try:
            if line in FIRST:
                FIRST[line]()
            else:
                sys.argv = ["evetac", *line.split(), "--quiet"]
                runpy.run_module("evetac_cli", run_name="__main__", alter_sys=True)
        except SystemExit as end:
            if not end.code:
                return ""
            sys.stderr.flush()
            words.seek(0)
            return words.read().decode(errors="replace") or f"exit status {end.code}"
        except Exception:  # a part has no command line that turns it into words
            return traceback.format_exc()
    return ""


@contextmanager
def _stderr_into(file: IO[bytes]) -> Iterator[None]:
    """By its number, because a command opens streams of its own on it."""
    before = os.dup(2)
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def work(lines: IO[str], answers: IO[str]) -> None:
    """Run what each line names, and answer, until there are no more lines."""

    def answer(**what: Any) -> None:
        answers.write(f"{json.dumps(what)}\n")
        answers.flush()

    counter = Counter(lambda functions: answer(functions=functions))
    with event.install_listener("numba:compile", counter):
        for line in lines:
            failed = _failure(line.strip())
            answer(failed=failed, functions=counter.functions)


if __name__ == "__main__":
    # What a command prints by whatever way is no answer.
    with os.fdopen(os.dup(1), "w") as answers, open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)
        work(sys.stdin, answers)
