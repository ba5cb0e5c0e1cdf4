"""What the README shows exists: commands with their flags, make targets, files, the Python interface."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from evetac_cli.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
INDENTED = [line[4:].split("   #")[0].strip() for line in README.splitlines() if line.startswith("    ")]
COMMANDS = [line for line in INDENTED if line.startswith("evetac ")]


def test_readme_tells_both_stories() -> None:
    """Assert that every command of the pipeline is shown."""
    shown = {" ".join(line.split()[1:3]) if " evaluate " in line else line.split()[1] for line in COMMANDS}
    assert shown >= {"record", "label", "track", "featurize", "train", "evaluate slip", "grasp", "info", "validate"}


@pytest.mark.parametrize("line", COMMANDS)
def test_command_parses(line: str) -> None:
    """Assert that a command line of the README names a command and flags that exist."""
    command = typer.main.get_command(app)
    words = shlex.split(line)[1:]
    while hasattr(command, "commands"):
        command = command.commands[words.pop(0)]
    command.make_context(line, words)


@pytest.mark.parametrize("target", [line.split()[1] for line in INDENTED if line.startswith("make ")])
def test_make_target_exists(target: str) -> None:
    """Assert that a make target of the README is in the Makefile, with a line of help."""
    assert re.search(rf"^{target}:.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE)


@pytest.mark.parametrize("link", re.findall(r"\]\((?!http)([^)]+)\)", README))
def test_link_leads_somewhere(link: str) -> None:
    """Assert that a relative link of the README leads to a file or folder."""
    assert (ROOT / link).exists()


def test_python_interface_is_there() -> None:
    """Assert that the names that the README imports can be imported."""
    for module, names in re.findall(r"from (evetac_cli\S*) import (.+)", README):
        loaded = __import__(module, fromlist=["_"])
        assert all(hasattr(loaded, name.strip()) for name in names.split(","))
