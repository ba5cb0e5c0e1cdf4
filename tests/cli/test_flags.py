"""Flags and help: what most people need fits a screen, and no flag is lost."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evetac_cli.cli.commands import DOCTOR, EVALUATE, EXPORT, PIPELINE, VIEW, Command
from evetac_cli.cli.main import app

COMMANDS = [([command.name], command) for command in (*PIPELINE, VIEW, EXPORT, DOCTOR)]
COMMANDS += [(["evaluate", command.name], command) for command in EVALUATE]
IDS = [" ".join(path) for path, _ in COMMANDS]
SCREEN = {"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}
LINES = 60


def evetac(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), env=SCREEN)


def panels(text: str) -> dict[str, list[str]]:
    """The lines of each panel of a help text by its title; what comes before the first has no title."""
    by_title: dict[str, list[str]] = {"": []}
    title = ""
    for line in text.splitlines():
        if begins := re.match("╭─ (.+?) ─", line):
            title = begins[1]
            by_title[title] = []
        by_title[title].append(line)
    return by_title


@pytest.mark.parametrize("command", ["record", "grasp"])
def test_what_most_people_need_fits_a_screen(command: str) -> None:
    """Assert that examples, the ten flags that matter first, and how to run fit 60 lines of 80 columns."""
    by_title = panels(evetac(command, "--help").stdout)
    first, *others = by_title
    assert [first, *others[:2]] == ["", "Options", "Running"]
    assert len(others) >= 5
    assert sum(len(by_title[title]) for title in ("", "Options", "Running")) <= LINES
    flags = [line for line in by_title["Options"] if line.startswith("│ --")]
    assert len(flags) <= 12, flags


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=IDS)
def test_help_is_without_noise_and_has_examples(path: list[str], command: Command) -> None:
    """Assert that no switch has a type or its `--no-`, no line is too wide, and there are examples of this command."""
    text = evetac(*path, "--help").stdout
    assert "<bool>" not in text
    assert "--no-" not in text.replace("--no-FLAG", "")
    assert max(map(len, text.splitlines())) <= 80
    assert command.examples
    for example in command.examples:
        assert example.startswith(f"evetac {' '.join(path)}")
        assert example in " ".join(text.split())


@pytest.mark.parametrize("arguments", [["--help"], ["evaluate", "--help"], ["info", "--help"], ["repair", "--help"]])
def test_other_help_is_without_noise(arguments: list[str]) -> None:
    """Assert that groups and the commands that look at files show no type of a switch, either."""
    assert "<bool>" not in evetac(*arguments).stdout


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=IDS)
def test_examples_are_understood(path: list[str], command: Command) -> None:
    """Assert that every flag of an example is one of the command."""
    text = evetac(*path, "--help").stdout
    for example in command.examples:
        for flag in re.findall(r"(?<!\S)--?[a-z][\w-]*", example):
            assert re.search(rf"[│ ]{flag} ", text[text.index("╭") :]), (example, flag)


@pytest.mark.parametrize(
    "arguments",
    [
        ["evaluate", "slip", "a.features.h5", "--model", "a.model.h5", "--model", "b.model.h5"],
        ["label", "a.h5", "--threshold-px", "1", "--threshold-px", "2"],
        ["record", "-o", "a", "--out", "b"],
        ["record", "--seed=1", "--seed=1"],
    ],
)
def test_a_flag_given_twice_is_refused(arguments: list[str]) -> None:
    """Assert that no value is lost without a word, with exit code 2; switches may be repeated."""
    result = evetac(*arguments)
    assert result.exit_code == 2
    assert "is given 2 times" in " ".join(result.stderr.replace("│", " ").split())
    assert evetac("record", "--help", "-h").exit_code == 0


def test_two_values_of_model_say_what_to_do() -> None:
    """Assert that who gives --model twice learns how several models are named."""
    result = evetac("evaluate", "slip", "--model", "a", "--model", "b", "c")
    assert "name the others among the files, or all by a glob" in " ".join(result.stderr.replace("│", " ").split())


def test_switches_of_a_command_are_whole_after_its_help() -> None:
    """Assert that help, which leaves `--no-` out, does not take it away."""
    assert evetac("record", "--help").exit_code == 0
    result = evetac("record", "--no-sort", "--from", str(Path("none.txt")))
    assert "No such option" not in result.stderr
    assert "none.txt" in result.stderr
