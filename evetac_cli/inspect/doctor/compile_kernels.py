"""doctor compile: let numba compile the functions that commands need, so that no command has to wait for it later.

The commands themselves are run, on short trials in a temporary folder. A list of functions and their types would have
to be maintained by hand and would be wrong after the next change of a kernel.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.console import print_table
from evetac_cli.errors import EvetacError
from evetac_cli.jobs import LookCall, Outcome, Progress, Rows, silent
from evetac_cli.kernels.slip import features, inputs, load_path, onnx_graphs
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, weight_shapes
from evetac_cli.kernels.slip.detector import Detector, LiveDetector
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.sim.setup.scene_file import changed

EVENTS, GRID, SCENE = "events.txt", "grid.json", "short-slip.toml"
DOTS_PX = np.stack(np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)
SLICES = 200  # more than the history of any network
COMMANDS = (
    f"record --from {EVENTS} --frame-size 640x480 --calibration {GRID} --out a.recording.h5",
    "track a.recording.h5",
    "label a.recording.h5",
    "featurize a.recording.h5",
    f"record --scene {SCENE} --object 3 --out b.recording.h5",
    "grasp --object 11 --lift-s 1 --balance-s 0.1 --out c.recording.h5",
)


def look(call: LookCall) -> Outcome:
    """Compile, and report each command on stderr unless quiet."""
    return run(call.progress, say=(lambda line: None) if call.quiet else console.say)


def run(
    progress: Progress = silent, commands: Sequence[str] = COMMANDS, say: Callable[[str], None] = console.say
) -> Outcome:
    """Compile what commands need, one after the other; raise EvetacError with the message of one that fails.

    say: called with a line when a command begins, and with its own lines on functions that it compiles.
    """
    rows: Rows = []
    started = time.monotonic()
    say(
        f"compiling for this computer, once after installation: {len(commands)} commands, a minute and a half on an"
        " idle computer, several minutes on a slow or busy one"
    )
    _compile_detectors()
    with TemporaryDirectory(prefix="evetac-compile-") as folder:
        _write_events(Path(folder))
        _write_scene(Path(folder))
        for number, line in enumerate(commands):
            progress(number, len(commands))
            part, begin = line.partition(" ")[0], time.monotonic()
            say(f"compiling {number + 1} of {len(commands)}: {part} ...")
            _run(line, folder, say)
            rows.append({"part": part, "time_s": time.monotonic() - begin})
        progress(len(commands), len(commands))
    return Outcome(rows, False, {"time_s": time.monotonic() - started})


def show(result: Outcome, **_: Any) -> None:
    """Print how long each command took."""
    print_table("doctor compile", result.rows, result.summary, simulated=False)


def _run(line: str, folder: str, say: Callable[[str], None]) -> None:
    """Run a command in a folder, and pass on what it says of its compiling."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *line.split()]
    # Import this package, even if another copy of it is installed.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        errors="replace",
    ) as process:  # fmt: skip
        assert process.stderr is not None
        words = []
        for text in process.stderr:
            words.append(text)
            if text.startswith("compiling, "):
                say(text.rstrip())
    if process.returncode:
        found = "".join(words).strip() or f"exit code {process.returncode}"
        raise EvetacError("compiling failed", where=line, found=found)


def _compile_detectors() -> None:
    """Run a network over dots and one with memory, over a file and live, and prepare training data.

    `train` itself needs torch, which may not be installed.
    """
    rows, columns = DOTS_PX.shape[:2]
    dots = rows * columns
    moved_px, counts = np.zeros((SLICES, dots, 2), np.float32), np.zeros((SLICES, dots), np.int32)
    told = np.zeros((SLICES, len(load_path.TOLD)), np.float32)
    path = load_path.over(load_path.start((rows, columns)), moved_px, counts, told)
    series = features.series(moved_px[..., 0], counts)
    for name, seen in (("hist10", series), ("load-path", path)):
        architecture = ARCHITECTURES[name]
        shapes = weight_shapes(architecture, rows, columns)
        weights = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        detector = Detector(onnx_graphs.build(architecture, weights, rows, columns), architecture)
        detector.over(seen)
        LiveDetector(detector, tracker.start(DOTS_PX.reshape(-1, 2), presets.PRESETS["stable"]), None)
    learnt = ARCHITECTURES["hist10"]
    batch = inputs.at(learnt, series, np.array([SLICES - 1]))
    inputs.turn(learnt, batch, rows, columns, np.zeros(1, np.int64), np.ones(1, np.float32))


def _write_events(folder: Path) -> None:
    """Write a second of events at random pixels, and a dot grid with a window."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 50_000))
    events = np.stack(
        [t, rng.integers(0, 640, len(t)), rng.integers(0, 480, len(t)), rng.integers(0, 2, len(t))], axis=1
    )
    np.savetxt(folder / EVENTS, events, fmt="%d", header="t_us x y p", comments="")
    grid = {"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": DOTS_PX.tolist(), "window_px": [540, 0, 640, 480]}
    (folder / GRID).write_text(json.dumps(grid))


def _write_scene(folder: Path) -> None:
    """Write the scene slip with all its parts, as short as possible."""
    time = {"rest_s": 0.05, "load_s": 0.05, "hold_s": 0.05, "after_lost_s": 0.02, "longest_s": 0.3}
    gripper = {"start_factor": [1.05, 1.3], "friction_factor": [0.1, 0.12]}
    (folder / SCENE).write_text(changed("slip", {"time": time, "gripper": gripper}))
