"""Flags and help: what most people need fits a screen, and no flag is lost."""

import json
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evetac_cli.cli.main import app
from evetac_cli.commands import every
from evetac_cli.commands.parameter import EXPERTS, Command
from evetac_cli.evaluate import SUBJECTS
from tests.conftest import Made

COMMANDS = [(name.split(), command) for name, command in every().items()]
COMMANDS += [(["evaluate", command.name], command) for command in SUBJECTS]
IDS = [" ".join(path) for path, _ in COMMANDS]
SCREEN = {"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}
LINES = 45


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


def test_what_most_people_need_fits_a_screen() -> None:
    """Assert that help on the flags of record fits 45 lines of 80 columns, and that --help-all has the others."""
    by_title = panels(evetac("record", "--help").stdout)
    assert list(by_title)[:3] == ["", "Options", "Running"] and EXPERTS not in by_title
    assert sum(line.startswith("│") for lines in by_title.values() for line in lines) <= LINES
    more = panels(evetac("record", "--help-all").stdout)
    assert list(more) == [*by_title, EXPERTS]
    assert {"--tolerance", "--step-ms", "--engine"} <= set(re.findall(r"--[a-z-]+", " ".join(more[EXPERTS])))


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=IDS)
def test_help_is_without_noise_and_has_examples(path: list[str], command: Command, tmp_path: Path) -> None:
    """Assert that no switch has a type or its `--no-`, no line is too wide, and examples have flags of this command.

    It speaks of the files in a folder where these are taken, and only there.
    """
    text = evetac(*path, "--help").stdout
    assert "<bool>" not in text
    assert "--no-" not in text.replace("--no-FLAG", "")
    assert max(map(len, text.splitlines())) <= 80
    assert command.examples
    for example in command.examples:
        assert example.startswith(f"evetac {' '.join(path)}")
        assert example in " ".join(text.split())
        for flag in re.findall(r"(?<!\S)--?[a-z][\w-]*", example):
            assert re.search(rf"[│ ]{flag} ", text[text.index("╭") :]), (example, flag)
    text = " ".join(text.replace("│", " ").split())
    sentence = f"For a folder, all {command.kind} files in it are used."
    assert (sentence in text) == bool(command.files and command.kind)
    if sentence in text:
        place = ["model"] if path == ["evaluate", "cost"] else []  # what comes before the files
        refused = evetac(*path, *place, str(tmp_path))
        assert f"*.{command.kind}.h5" in refused.stderr


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


@pytest.mark.parametrize("words", [["info"], ["validate"], ["validate", "--repair"]])
def test_quiet_commands_print_nothing(words: list[str], made: Made, tmp_path: Path) -> None:
    """Assert that -q leaves the exit code and errors alone, and prints nothing else; --json prints all the same."""
    shutil.copy(made.recordings[0], tmp_path / "a.recording.h5")
    of_file = [str(tmp_path)] if "--repair" in words else [str(tmp_path / "a.recording.h5")]
    for files in ([str(tmp_path)], of_file):
        run = evetac(*words, "-q", *files)
        assert (run.exit_code, run.stdout, run.stderr) == (0, "", "")
        assert json.loads(evetac(*words, "-q", "--json", *files).stdout)["command"] == words[0]
    missing = evetac(*words, "-q", str(tmp_path / "none.recording.h5"))
    assert missing.exit_code == 2
    assert missing.stdout == ""
    assert missing.stderr.startswith("error: ") or words == ["validate"]


@pytest.mark.parametrize("words", IDS)
def test_every_command_explains_its_columns(words: str) -> None:
    """Assert that `--legend` needs no files, and says the meaning of each column in a sentence."""
    shown = evetac(*words.split(), "--legend", "--json")
    assert shown.exit_code == 0, shown.output
    rows = json.loads(shown.stdout)["rows"]
    assert rows and len({row["column"] for row in rows}) == len(rows)
    assert [row for row in rows if not re.fullmatch(r"[A-Z1].*\.", row["meaning"])] == []
    assert evetac(*words.split(), "--legend").stdout.startswith(f"{words} --legend")
