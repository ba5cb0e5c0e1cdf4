"""The page on robot simulators and examples/: code of the page runs, examples come to an end, tables are those made."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "robot-simulators.md"
CODE = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
COMMANDS = re.findall(r"^    python (examples/\w+\.py.*)$", PAGE.read_text(), re.MULTILINE)


def test_the_sensor_of_the_page_runs() -> None:
    """Assert that the code of the sensor, as it is written, feels the shear."""
    names: dict[str, Any] = {}
    exec(compile(CODE[0], "docs/robot-simulators.md", "exec"), names)
    assert names["touch"].shear_n[0] > 0.5
    assert names["touch"].displacement_px[:, 0].mean() > 0.3


@pytest.mark.slow
def test_the_environment_of_the_page_runs() -> None:
    """Assert that the code of the environment runs as it is written."""
    names: dict[str, Any] = {}
    exec(compile(CODE[1], "docs/robot-simulators.md", "exec"), names)
    assert names["info"]["simulated"]


SMALL = {"--trials": "1", "--runs": "1", "--jobs": "1"}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_an_example_of_the_page_runs(command: str, tmp_path: Path) -> None:
    """Assert that a command of the page, with one trial or run, ends well and leaves the file that it names."""
    script, *flags = command.split()
    flags = [SMALL.get(before, flag) for before, flag in zip(["", *flags], flags, strict=False)]
    if "cma" in script:
        flags += ["--generations", "1", "--candidates", "4", "--episodes", "1", "--judged", "1"]
    done = subprocess.run(
        [sys.executable, str(ROOT / script), *flags],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "simulated" in done.stdout
    (made,) = tmp_path.iterdir()
    if made.suffix == ".gif":
        assert made.stat().st_size < 1_000_000
    else:
        assert all(row["simulated"] for row in json.loads(made.read_text()))
