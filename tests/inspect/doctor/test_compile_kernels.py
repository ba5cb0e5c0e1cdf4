"""doctor compile: afterwards no command compiles anything, and a command that fails is named."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from evetac_cli.errors import EvetacError
from evetac_cli.inspect.doctor import compile_kernels
from evetac_cli.resources import PACKAGE
from scripts.reproduce import steps as experiment_steps

# Runs evetac, and prints on stderr the functions that it compiled.
COUNTED = """
import runpy, sys
from numba.core import event
compiled = []
class Listener(event.Listener):
    def on_start(self, happens):
        function = happens.data["dispatcher"].py_func
        compiled.append(f"{function.__module__}.{function.__qualname__}{happens.data['args']}")
    def on_end(self, happens):
        pass
event.register("numba:compile", Listener())
try:
    runpy.run_module("evetac_cli", run_name="__main__", alter_sys=True)
except SystemExit as end:
    assert not end.code, end.code
print("compiled", len(compiled), *compiled[:3], file=sys.stderr)
"""
SMALLER = {
    r"--count \S+": "--count 1",
    r"--epochs \S+": "--epochs 1",
    r"--(lift|balance)-s \S+": r"--\1-s 1",
    r"--jobs 2": "",
}


def readme_commands() -> list[list[str]]:
    """Commands of README, in one process, where all of it is counted."""
    lines = [line for line in (PACKAGE.parent / "README.md").read_text().splitlines() if line.startswith("evetac ")]
    for long, short in SMALLER.items():
        lines = [re.sub(long, short, line) for line in lines]
    return [line.split() for line in lines]


def demo_commands() -> list[list[str]]:
    """Commands of `make demo`, with fewer trials and epochs."""
    sizes = {"seed": 0, "learn": 1, "unseen": 1, "epochs": 1}
    return [*experiment_steps.demo_steps(sizes), *experiment_steps.demo_evaluations(sizes).values()]


@pytest.mark.slow
def test_after_it_no_command_compiles(tmp_path: Path) -> None:
    """Assert that it leaves nothing to compile for the commands of README and of `make demo`."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(PACKAGE.parent)}

    def compiled(command: list[str], folder: Path) -> list[str]:
        words = [
            name
            for word in command[1:]
            for name in (sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if "*" in word else [word])
        ]
        run = [sys.executable, "-c", COUNTED, *words]
        done = subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stderr.splitlines()[-1].split(maxsplit=2)[1:]

    assert compiled(["evetac", "track", "--help"], tmp_path) == ["0"]
    subprocess.run([sys.executable, "-m", "evetac_cli", "doctor", "compile"], env=environment, check=True)
    for name, commands in (("readme", readme_commands()), ("demo", demo_commands())):
        folder = tmp_path / name
        folder.mkdir()
        assert len(commands) >= 5
        assert [(command, what) for command in commands if (what := compiled(command, folder)) != ["0"]] == []


@pytest.mark.slow
def test_a_command_that_compiles_is_seen(tmp_path: Path) -> None:
    """Assert that the test above would see what is compiled: everything, in an empty folder."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(PACKAGE.parent)}
    run = [sys.executable, "-c", COUNTED, "evaluate", "stability", "track", "--out", str(tmp_path / "s.report.h5")]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert int(done.stderr.splitlines()[-1].split()[1]) > 0


def test_a_command_that_fails_is_named() -> None:
    """Assert that an error names the command and says why it failed."""
    with pytest.raises(EvetacError, match="record --scene nowhere") as error:
        compile_kernels.run(commands=("record --scene nowhere",), say=lambda line: None)
    assert "nowhere" in str(error.value).split("--scene nowhere", 1)[1]


def test_a_process_that_dies_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a process that ends without a word is an error that says so."""
    monkeypatch.setattr(compile_kernels.sys, "executable", "false")
    with pytest.raises(EvetacError, match="track a: .*\n.*exit code 1"):
        compile_kernels.run(commands=("track a",), say=lambda line: None)
