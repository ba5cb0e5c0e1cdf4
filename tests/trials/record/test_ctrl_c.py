"""Ctrl-C in every state of `record`: how long until the program has ended, and what is left then.

The bound is generous, for busy machines; the times are printed (pytest -s).
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from evetac_cli.inspect import repair, validate
from evetac_cli.resources import PACKAGE
from tests.patience import PATIENCE_S

BOUND_S = 20.0  # on a machine that is not busy it is 1 s
# What the camera does, and when Ctrl-C comes: so many s after the start, or once segments are written.
STATES = {
    "loading the command": ("virtual:prepared", 0.2, 0),
    "loading the stage": ("virtual:prepared", 0.6, 0),
    "opening the camera": ("virtual:prepared", 1.0, 0),
    "the first slices": ("virtual:prepared", 0.0, 1),
    "recording": ("virtual:prepared", 0.0, 8),
    "a silent camera": ("virtual:prepared+silence@0:600", 0.0, 4),
    "random words": ("virtual:prepared+random@0:600", 0.0, 4),
    "torn words": ("virtual:prepared+torn@0.1:600", 0.0, 4),
    "a slow clock": ("virtual:prepared+slow@0", 0.0, 4),
}


@pytest.mark.slow
@pytest.mark.parametrize("state", STATES)
def test_ctrl_c_ends_the_program(state: str, tmp_path: Path) -> None:
    """Assert that the first Ctrl-C ends it with exit code 130, and that what was recorded is valid or repairable."""
    camera, after_s, segments = STATES[state]
    output = tmp_path / "a.recording.h5"
    words = ["record", "--camera", camera, "--gripper", "none", "--expected-event-rate", "1e5", "-o", str(output)]
    run = subprocess.Popen(
        [sys.executable, "-m", "evetac_cli", *words], cwd=PACKAGE.parent, stderr=subprocess.PIPE, text=True
    )
    try:
        time.sleep(after_s)
        while segments and not (output.with_suffix(".part") / f"{segments - 1:06d}.h5").exists():
            assert run.poll() is None, run.stderr and run.stderr.read()
            time.sleep(0.01)
        pressed_s = time.monotonic()
        os.kill(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
        passed_s = time.monotonic() - pressed_s
    finally:
        run.kill()
    print(f"{state}: {passed_s:.2f} s: {said.strip().splitlines()[-1:]}")
    assert run.returncode == 130, said
    assert "interrupted" in said
    assert passed_s < BOUND_S
    if output.with_suffix(".part").exists():
        assert "evetac repair" in said
        assert repair.run([tmp_path]).rows[0]["fault"] is None
    if segments:
        assert validate.run([output]).rows[0]["faults"] is None
