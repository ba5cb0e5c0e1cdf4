"""A process that compiles for `doctor --compile`: it runs the commands that it receives, one after the other.

One process runs many commands, because a separate process for each would import numba, and compile numba's own
functions, again.

    python -P -m evetac_cli.inspect.doctor.compile_worker < lines

Each line is a command with its flags, or the name of a part in FIRST, which is compiled before the command that needs
it. Answers are lines of JSON on stdout: `{"functions": 12}` during the work, `{"failed": "", "functions": 30}` at the
end; `failed` is the message of a command that failed.
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

SLICES = 200  # more than the history of any network
SAY_S = 0.5  # between two lines that report progress


def _camera() -> None:
    """Run the camera's first slice of a slip scene, without the gel, which another process compiles."""
    plan = first_plan("slip", "3")
    sensor, texture = sensor_with_gel(plan.scene, plan.sensor), np.zeros(TEXTURE_PX, np.float32)
    rng = np.random.default_rng(0)
    camera = GelCamera(sensor, scene=plan.scene, texture=texture, rng=rng)
    camera.render(np.zeros_like(camera.rest_m), OUT_OF_SIGHT_M, 0.0, 0, None, cut_m=camera.cut_rest_m, still=False)


def _detector() -> None:
    """Run the detector of a grasp for some slices, and the preparation of training data from read-only slices."""
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
    """Counts the compiled functions and reports the number every SAY_S; compilation runs without garbage collection."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        self.functions = self._inside = 0
        self._tell, self._told_s = tell, time.monotonic()

    def on_start(self, happens: Any) -> None:
        """The compilation of a function begins, possibly within that of another."""
        if self._inside == 0:
            gc.disable()
        self._inside += 1

    def on_end(self, happens: Any) -> None:
        """The compilation of a function has ended."""
        self._inside -= 1
        self.functions += 1
        if self._inside == 0:
            gc.enable()
        if time.monotonic() - self._told_s > SAY_S:
            self._told_s = time.monotonic()
            self._tell(self.functions)


def _failure(line: str) -> str:
    """Run a command or a part; return the text on stderr of a command that fails, empty otherwise."""
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
        except Exception:  # a part of FIRST has no command line that turns exceptions into messages
            return traceback.format_exc()
    return ""


@contextmanager
def _stderr_into(file: IO[bytes]) -> Iterator[None]:
    """Redirect the descriptor of stderr, because a command opens its own streams on it."""
    before = os.dup(2)
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def work(lines: IO[str], answers: IO[str]) -> None:
    """Run the command or part of each line, and answer, until there are no more lines."""

    def answer(**what: Any) -> None:
        answers.write(f"{json.dumps(what)}\n")
        answers.flush()

    counter = Counter(lambda functions: answer(functions=functions))
    with event.install_listener("numba:compile", counter):
        for line in lines:
            failed = _failure(line.strip())
            answer(failed=failed, functions=counter.functions)


if __name__ == "__main__":
    # Redirect stdout, so that output of commands does not mix with answers.
    with os.fdopen(os.dup(1), "w") as answers, open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)
        work(sys.stdin, answers)
