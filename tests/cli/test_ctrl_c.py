"""Ctrl-C in commands that work on files: how long until the program has ended, and what is left then.

Those of recording from devices are in tests/trials/record/test_ctrl_c.py. The bound is generous, for busy machines; the
times are printed (pytest -s). A command that had ended by itself before Ctrl-C came says nothing, and is skipped.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.resources import PACKAGE
from tests.conftest import Made
from tests.make import event_arrays, write_recording
from tests.patience import PATIENCE_S

BOUND_S = 20.0  # on a machine that is not busy it is 1 s
MOMENTS_S = (0.8, 3.0)  # after the start of the program: while it loads modules, and at work
SLICES, EVENTS_A_SLICE = 200_000, 10
FRAME_PX = (640, 480)
GRID_PX = np.stack(np.meshgrid(60.0 * np.arange(1, 9), 60.0 * np.arange(1, 8)), axis=-1)
SENSOR: dict[str, Any] = {
    "sensor/name": "evetac",
    "sensor/dot_xy_px": GRID_PX,
    "sensor/dot_radius_px": np.float64(12.0),
    "sensor/window_px": np.array([540, 0, 640, 480], np.int32),
}


@pytest.fixture(scope="module")
def file_of(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Files to work on by their names, a or b and a kind: features of the session, and recordings of some minutes."""
    folder = tmp_path_factory.mktemp("inputs")

    @cache
    def find(name: str) -> Path:
        seed = "ab".index(name[0])
        if "recording" not in name:
            return made.beside(made.recordings[seed], "features")
        rng, count = np.random.default_rng(seed), SLICES * EVENTS_A_SLICE
        t = np.arange(count, dtype=np.int64) * (1000 // EVENTS_A_SLICE)
        x, y = (rng.integers(0, most, count).astype(np.uint16) for most in FRAME_PX)
        events = Events(t, x, y, rng.integers(0, 2, count).astype(np.uint8))
        return write_recording(folder / name, event_arrays(events, SLICES) | SENSOR, simulated=True)

    return find


# What is in braces is a file to work on; the output goes into an empty folder.
COMMANDS = {
    "validate": "validate {a.recording.h5}",
    "label": "label {a.recording.h5} -o OUT",
    "track two": "track {a.recording.h5} {b.recording.h5} --jobs 2 -o OUT",
    "train": "train {a.features.h5} {b.features.h5} --epochs 100000 --max-steps 10000000 -o OUT",
    "simulate two": "record --count 4 --jobs 2 -o OUT",
    "grasp again": "grasp --camera replay:{a.recording.h5} -o OUT",
}


@pytest.mark.slow
@pytest.mark.parametrize("moment_s", MOMENTS_S)
@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_ends_the_program(command: str, moment_s: float, file_of: Callable[[str], Path], tmp_path: Path) -> None:
    """Assert that Ctrl-C ends it with exit code 130 and a word, and that nothing half done is left."""
    words = [_filled(word, file_of, tmp_path) for word in COMMANDS[command].split()]
    run = subprocess.Popen(
        [sys.executable, "-m", "evetac_cli", *words],
        cwd=PACKAGE.parent,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        time.sleep(moment_s)
        ended = run.poll()
        pressed_s = time.monotonic()
        if ended is None:
            os.kill(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
        passed_s = time.monotonic() - pressed_s
    finally:
        run.kill()
    complete = any(path.suffix == ".h5" and path.name[0] != "." for path in tmp_path.iterdir())
    if ended == 0 or (complete and "interrupted" not in said and run.returncode in (0, -signal.SIGINT)):
        pytest.skip("had ended by itself")
    print(f"{command} after {moment_s:g} s: {passed_s:.2f} s: {said.strip().splitlines()[-1:]}")
    assert run.returncode == 130, said
    assert "interrupted" in said
    assert "Traceback" not in said
    assert passed_s < BOUND_S
    assert [path for path in tmp_path.rglob("*") if path.suffix in (".tmp", ".part")] == []


def _filled(word: str, file_of: Callable[[str], Path], out: Path) -> str:
    start, brace, rest = word.partition("{")
    name, _, end = rest.partition("}")
    return f"{start}{file_of(name)}{end}" if brace else str(out) if word == "OUT" else word
