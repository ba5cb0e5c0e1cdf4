"""What reaches a terminal, a pipe or a full disk, and how the program ends then: the real program, in a process."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.resources import PACKAGE
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.patience import PATIENCE_S

NASTY = "\x1b[31mred\x1b]0;title\x07\x9b2J\u202egnp.exe\r[bold]b[/bold]\x00"
RAW = ("\x1b", "\x07", "\x9b", "\u202e", "\r", "\x00")


def evetac(*arguments: str | Path, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run the program; its error output is read, its output goes where `how` says."""
    run = [sys.executable, "-m", "evetac_cli", *map(str, arguments)]
    return subprocess.run(
        run, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent, **how
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report whose texts would change a terminal."""
    path = tmp_path_factory.mktemp("report") / "a.slip.report.h5"
    rows = {"command": NASTY.replace("\x00", ""), "rows": "[]", "summary": json.dumps({NASTY: NASTY, "list": [NASTY]})}
    write_stage(path, Recipe("report", 1, {}), rows)
    return path


OUTPUTS = [
    ["info"],
    ["info", "--json"],
    *(pytest.param(arguments, marks=pytest.mark.slow) for arguments in (["validate"], ["--help"], ["--version"])),
]


def on(arguments: list[str], report: Path) -> list[str | Path]:
    return [*arguments, report] if arguments[0] in ("info", "validate") else list(arguments)


@pytest.mark.parametrize("arguments", OUTPUTS, ids=" ".join)
def test_a_closed_pipe_ends_quietly(report: Path, arguments: list[str]) -> None:
    """Assert that where nobody reads any more (`evetac info x | head -1`) the program ends as others do, silently."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as out:
        done = evetac(*on(arguments, report), stdout=out)
    assert (done.returncode, done.stderr) == (-signal.SIGPIPE, "")


@pytest.mark.parametrize("arguments", OUTPUTS, ids=" ".join)
def test_m4_a_full_disk_behind_the_output_is_said(report: Path, arguments: list[str]) -> None:
    """Assert that a result that could not be written is an error in words."""
    with Path("/dev/full").open("wb") as out:
        done = evetac(*on(arguments, report), stdout=out)
    assert done.returncode == 1
    assert done.stderr == "error: the output: cannot be written: No space left on device\n"


def test_an_ascii_terminal(report: Path) -> None:
    """Assert that a table on a terminal that has ASCII alone is no traceback."""
    done = evetac("validate", report, env={**os.environ, "PYTHONIOENCODING": "ascii"}, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, "")


PATCHED = """
import os, runpy, signal, sys
command, sys.argv = sys.argv[1], ["evetac", *sys.argv[2:]]
exec(command)
runpy.run_module("evetac_cli", run_name="__main__", alter_sys=True)
"""
BROKEN = """
import evetac_cli.inspect.info as info
def run(files, errors):
    raise ZeroDivisionError("division by \\x1b[31mzero")
info.run = run
"""
AT_IMPORT = """
class Stop:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.{signal})
sys.meta_path.insert(0, Stop())
"""
AT_EXIT = """
import atexit
atexit.register(lambda: os.kill(os.getpid(), signal.{signal}))
"""


def patched(patch: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the program after some other code."""
    run = [sys.executable, "-c", PATCHED, patch, *map(str, arguments)]
    return subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=PACKAGE.parent)


def test_m4_a_defect_is_said_as_one(report: Path) -> None:
    """Assert that an error that nobody foresaw is called a defect, its traceback kept in a file, or shown if asked."""
    done = patched(BROKEN, "info", report)
    lines = done.stderr.splitlines()
    assert (done.returncode, done.stdout, lines[0]) == (1, "", "internal error")
    assert "defect of evetac" in done.stderr
    assert "ZeroDivisionError: division by \\x1b[31mzero" in done.stderr
    assert "Traceback" not in done.stderr
    kept = Path(lines[-1].split()[-1])
    assert "Traceback" in kept.read_text() and "ZeroDivisionError" in kept.read_text()
    kept.unlink()
    done = patched(BROKEN, "info", report, "--verbose")
    assert "Traceback" in done.stderr and "\x1b" not in done.stderr


def test_m4_a_defect_is_json_too(report: Path) -> None:
    """Assert that a program that reads JSON gets the defect in it."""
    done = patched(BROKEN, "info", report, "--json", "-v")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["kind"], error["exit_status"]) == (1, "InternalError", 1)
    assert error["message"].startswith("internal error: ZeroDivisionError")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
@pytest.mark.parametrize("module", ["typer", "numpy"])
def test_a_signal_in_each_phase_ends_in_words(report: Path, module: str, name: str) -> None:
    """Assert that a signal while the program starts, or loads a command, ends with 130 and a word, no traceback."""
    done = patched(AT_IMPORT.format(module=module, signal=name), "info", report)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.startswith("interrupted")
    assert "Traceback" not in done.stderr and "xception" not in done.stderr


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_at_the_very_end_is_silent(report: Path, name: str) -> None:
    """Assert that a signal after the result was printed ends the program without any traceback."""
    done = patched(AT_EXIT.format(signal=name), "info", report, "--json")
    assert json.loads(done.stdout)["command"] == "info"
    assert done.stderr == ""


def test_m4_no_escape_of_a_file_reaches_the_terminal(report: Path) -> None:
    """Assert that texts of a file are shown with their control characters spelt out, and brackets as they are."""
    for command in ("info", "validate"):
        shown = CliRunner().invoke(app, [command, str(report)]).output
        assert not any(raw in shown for raw in RAW)
    shown = CliRunner().invoke(app, ["info", str(report)]).output
    assert "\\x1b[31mred\\x1b]0;title\\x07\\x9b2J\\u202egnp.exe\\r[bold]b[/bold]" in shown
    shown = CliRunner().invoke(app, ["info", str(report), "--json"]).output
    assert not any(raw in shown for raw in RAW)


@pytest.mark.parametrize("as_json", [[], ["--json"]])
@pytest.mark.parametrize(
    "arguments",
    [["info", "{}.h5"], ["validate", "{}.h5"], ["label", "--{}"], ["{}"], ["label", "a.h5", "--confirm-ms", "{}"]],
    ids=" ".join,
)
def test_no_escape_of_a_name_reaches_the_terminal(tmp_path: Path, arguments: list[str], as_json: list[str]) -> None:
    """Assert that file names and flags that the user gave are shown spelt out, also where they are no flags at all."""
    name = NASTY.replace("\x00", "").replace("/", "")
    given = [argument.replace("{}", name) for argument in arguments]
    result = CliRunner().invoke(app, given + as_json, env={"TERM": "dumb", "NO_COLOR": "1", "COLUMNS": "400"})
    assert result.exit_code == 2
    assert not any(raw in result.output for raw in RAW)
    assert "\\x1b[31mred" in result.output or as_json or "--confirm-ms" in arguments  # which is not repeated


def test_long_flags_are_not_repeated() -> None:
    """Assert that a flag of 100,000 letters is quoted, not repeated."""
    for arguments in (["label", "--" + "a" * 100_000], ["a" * 100_000], ["label", "a.h5", "--jobs", "9" * 100_000]):
        result = CliRunner().invoke(app, [*arguments, "--json"])
        assert result.exit_code == 2
        assert len(result.output) < 4_000


INTERRUPTED_WHILE_A_CLASS_IS_MADE = """
from evetac_cli.cli import exit_codes

def program():
    exec("raise KeyboardInterrupt")  # as collections.namedtuple, dataclasses and numba make code

exit_codes.run(program)
"""


def test_low_ctrl_c_inside_made_code_exits_130(tmp_path: Path) -> None:
    """Assert that the exit code is 130, too, where Ctrl-C came inside `exec`, which Python remembers until its end."""
    (tmp_path / "interrupted.py").write_text(INTERRUPTED_WHILE_A_CLASS_IS_MADE)
    paths = os.pathsep.join([str(tmp_path), os.getcwd()])
    run = [sys.executable, "-m", "interrupted"]
    assert (
        subprocess.run(run, env={**os.environ, "PYTHONPATH": paths}, timeout=PATIENCE_S, check=False).returncode == 130
    )
