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

from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from tests.patience import PATIENCE_S

BOUND_S = 20.0  # on a machine that is not busy it is 1 s
MOMENTS_S = (0.8, 3.0)  # after the start of the program: while it loads modules, and at work
SLICES, EVENTS_A_SLICE = 200_000, 10
ROWS, COLUMNS = 7, 8
FRAME_PX = (640, 480)
GRID_PX = np.stack(np.meshgrid(60.0 * np.arange(1, COLUMNS + 1), 60.0 * np.arange(1, ROWS + 1)), axis=-1)
SENSOR: dict[str, Any] = {
    "sensor/frame_px": np.array(FRAME_PX, np.int32),
    "sensor/name": "evetac",
    "sensor/dot_xy_px": GRID_PX,
    "sensor/dot_radius_px": np.float64(12.0),
    "sensor/window_px": np.array([540, 0, 640, 480], np.int32),
}
TRAINED_SLICES, ONSET = 2000, 1500


def recording(path: Path, seed: int) -> Header:
    """Random events all over the frame, as many in every slice, for some minutes."""
    rng = np.random.default_rng(seed)
    count = SLICES * EVENTS_A_SLICE
    arrays = {
        "events/t": np.arange(count, dtype=np.int64) * (1000 // EVENTS_A_SLICE),
        "events/x": rng.integers(0, FRAME_PX[0], count).astype(np.uint16),
        "events/y": rng.integers(0, FRAME_PX[1], count).astype(np.uint16),
        "events/p": rng.integers(0, 2, count).astype(np.uint8),
        "ms_to_idx": np.arange(SLICES + 1, dtype=np.int64) * EVENTS_A_SLICE,
        "t_offset": np.int64(0),
        **SENSOR,
    }
    return write_stage(path, Recipe("recording", 1, {}, seed=seed, simulated_source=True), arrays)


def features(path: Path, seed: int) -> None:
    """What a detector can be trained on for hours."""
    shape = (TRAINED_SLICES, ROWS * COLUMNS)
    moved = np.random.default_rng(seed).random((*shape, 2), np.float32)
    arrays = {
        "displacement_px": np.linalg.norm(moved, axis=2),
        "displacement_xy_px": moved,
        "events_per_dot": np.ones(shape, np.int32),
        "events_total": np.full(TRAINED_SLICES, 40, np.int32),
        "events_outside": np.full(TRAINED_SLICES, 30, np.int32),
        "label": (np.arange(TRAINED_SLICES) >= ONSET).astype(np.int8),
        "onset_slice": np.int64(ONSET),
        "dot_shape": np.array([ROWS, COLUMNS], np.int32),
    }
    parent = Recipe("recording", 1, {}, seed=seed, simulated_source=True).header()
    write_stage(path, Recipe("features", 1, {}, parents=(parent,)), arrays)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Files to work on by their names, each made when it is first asked for."""
    folder = tmp_path_factory.mktemp("inputs")

    @cache
    def make(name: str) -> Path:
        path = folder / name
        kind, seed = name.split(".")[-2], int(name.startswith("b."))
        if kind == "recording":
            recording(path, seed)
        elif kind == "features":
            features(path, seed)
        return path

    return make


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
def test_ctrl_c_ends_the_program(command: str, moment_s: float, made: Callable[[str], Path], tmp_path: Path) -> None:
    """Assert that Ctrl-C ends it with exit code 130 and a word, and that nothing half done is left."""
    words = [_filled(word, made, tmp_path) for word in COMMANDS[command].split()]
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


def _filled(word: str, made: Callable[[str], Path], out: Path) -> str:
    start, brace, rest = word.partition("{")
    name, _, end = rest.partition("}")
    return f"{start}{made(name)}{end}" if brace else str(out) if word == "OUT" else word
