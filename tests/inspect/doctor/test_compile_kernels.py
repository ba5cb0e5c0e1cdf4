"""doctor --compile: afterwards no command compiles anything, and a command that fails is named."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from evetac_cli.errors import EvetacError
from evetac_cli.inspect.doctor import compile_kernels, compile_worker
from evetac_cli.resources import PACKAGE
from scripts import experiment_steps

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
    subprocess.run([sys.executable, "-m", "evetac_cli", "doctor", "--compile"], env=environment, check=True)
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
        compile_kernels.run(steps=((("record --scene nowhere",),),), say=lambda line: None)
    assert "nowhere" in str(error.value).split("--scene nowhere", 1)[1]


def test_a_process_that_dies_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a process that ends before it answers is an error that says so."""
    monkeypatch.setattr(compile_kernels.sys, "executable", "false")
    with pytest.raises(EvetacError, match="camera: .*\n.*the process ended with exit code 1"):
        compile_kernels.run(steps=((("camera",),),), say=lambda line: None)


def test_each_command_is_said_as_it_begins() -> None:
    """Assert a line for each command with its number, the number of all, and how far it is where one takes long."""
    said: list[str] = []
    importing = "record --from events.txt --frame-size 640x480 --calibration grid.json --out {}.recording.h5"
    steps = (((importing.format("a"), importing.format("b")),), ((importing.format("c"),), (importing.format("d"),)))
    done: list[tuple[float, float]] = []
    outcome = compile_kernels.run(lambda *how: done.append(how[:2]), steps, said.append, again_s=0.01)
    assert "once after installation: 4 parts" in said[0]
    begun = [line for line in said if line.startswith("compiling ") and line.endswith("...")]
    assert begun == [f"compiling {number} of 4: record ..." for number in (1, 2, 3, 4)]
    waiting = [line for line in said[1:] if line not in begun]
    assert waiting and all(" of 4 parts are compiled, 0 functions; running: record for " in line for line in waiting)
    assert [(row["part"], row["functions"]) for row in outcome.rows] == [("record", 0)] * 4
    assert done == [(number, 4) for number in range(5)]


def test_an_error_is_not_waited_for_in_words() -> None:
    """Assert that a command that fails ends the others' telling too, and that its error is the one that is raised."""
    said: list[str] = []
    with pytest.raises(EvetacError, match="trim nothing"):
        compile_kernels.run(steps=((("trim nothing",), ("camera",)), (("detector",),)), say=said.append)
    assert sorted(said[1:]) in (
        ["compiling 1 of 3: trim ...", "compiling 2 of 3: camera ..."],
        ["compiling 1 of 3: camera ...", "compiling 2 of 3: trim ..."],
        ["compiling 1 of 3: trim ..."],
    )


def test_parts_of_their_own_are_there() -> None:
    """Assert that what is compiled ahead of a command, and not by one, is known to the process that compiles."""
    lines = [line for step in compile_kernels.STEPS for chain in step for line in chain]
    assert {line for line in lines if " " not in line} == set(compile_worker.FIRST)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("record --scene slip", "record"),
        ("evaluate slip a.features.h5 --model m", "evaluate slip"),
        ("track a.h5", "track"),
        ("camera", "camera"),
    ],
)
def test_commands_are_called_as_on_the_command_line(command: str, name: str) -> None:
    """Assert that an evaluation is named with its subject."""
    assert compile_kernels.name_of(command) == name
