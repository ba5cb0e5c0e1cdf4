"""README begins with two commands that set up what they need: they are those of CI and of the Makefile.

What make sets up, in which extras, is said in docs/; a test compares these with pyproject.toml.
"""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from evetac_cli.errors import EXTRAS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TWO = ["make demo", "make test"]


def code_lines(page: str) -> list[str]:
    """The lines of code of a page, fenced or indented, in their order."""
    lines, fenced = [], False
    for line in page.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            lines.append(line.strip())
    return lines


def extras_of(variable: str) -> set[str]:
    """Extras of a variable of the Makefile: USED is what `make setup` installs, EVERY what `make setup-all` does."""
    (named,) = re.findall(rf"^{variable} := (.+)$", MAKEFILE, re.MULTILINE)
    return set(named.split(","))


def planned(target: str, *more: str) -> str:
    """What make would run for a target on a machine where nothing was done so far."""
    run = ["make", "--dry-run", "--no-print-directory", target, "VENV=nothing-here", "PYTHON=python-here", *more]
    return subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_readme_begins_with_them() -> None:
    """Assert that the first lines of code of README are the two commands, right after what it is."""
    assert code_lines(README)[:2] == TWO
    assert README.splitlines().index(TWO[0]) < 25
    assert README.split("\n## ")[1].startswith("Two commands")


def test_ci_runs_readmes_test_command() -> None:
    """Assert that CI runs the command that README gives for the tests, and that each of its targets exists."""
    commands = [line for line in (ROOT / ".ci" / "run").read_text().splitlines() if line.startswith("make ")]
    assert TWO[1] in commands
    for target in re.findall(r" ([a-z][a-z-]*)", "\n".join((*commands, *TWO))):
        assert re.search(rf"^{target}:.*## ", MAKEFILE, re.MULTILINE), target
    assert "what CI runs" in next(
        line for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines() if "test check" in line
    )


@pytest.mark.parametrize("target", ["demo", "test", "docs", "tracking", "setup", "setup-all"])
def test_a_target_sets_up_what_it_needs(target: str) -> None:
    """Assert that on a fresh machine an environment is made, filled and compiled before anything else is run.

    The documentation needs no kernels.
    """
    lines = planned(target).splitlines()
    steps = ("-m venv", "pip install") if target == "docs" else ("-m venv", "pip install", "doctor compile")
    places = [next(at for at, line in enumerate(lines) if what in line) for what in steps]
    assert places == sorted(places) and places[0] == 0
    installs = [line for line in lines if "pip install" in line]
    named = [set(re.findall(r"'\.\[(.+?)\]'", line)[0].split(",")) for line in installs]
    assert named[0] == extras_of("USED")
    needs_every = target in ("test", "docs", "setup-all")
    assert named[1:] == ([extras_of("EVERY")] if needs_every else [])
    if target not in ("setup", "setup-all"):
        assert len(lines) > places[-1] + 1  # and then its own work


def test_setup_all_brings_every_extra() -> None:
    """Assert that setup-all installs all that is there, and setup not more than pictures, pages and formats need."""
    assert extras_of("EVERY") == set(PROJECT["optional-dependencies"]) == {*EXTRAS, "dev", "docs"}
    assert extras_of("USED") == {"plot", "convert"}
