"""The README: commands, flags, make targets and files that it shows exist; its figures are those of docs/results/."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from evetac_cli.cli.main import app

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import results
from experiments import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
PAGES = {path: path.read_text() for path in sorted((ROOT / "docs").glob("*.md"))}
INDENTED = [line[4:].split("   #")[0].strip() for line in README.splitlines() if line.startswith("    ")]
OF_SCRIPTS = ("blind-identification",)  # results of scripts, which docs quote: no tables of experiments
RESULTS = sorted(
    (path for path in (ROOT / "docs" / "results").glob("*.json") if path.stem not in OF_SCRIPTS),
    key=lambda path: path.stem,
)
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


def test_tables_say_what_results_say() -> None:
    """Assert that every table is what its file in docs/results/ says: `make results` would change nothing."""
    for page in (README, *PAGES.values()):
        assert results.fill_page(page, ROOT / "docs" / "results") == page


def test_every_table_has_a_file_and_a_place() -> None:
    """Assert that experiments and README name the same tables, and that each file has a place there or in the docs."""
    names = sorted(table.name for experiment in EXPERIMENTS for table in experiment.tables)
    places, elsewhere = (re.findall(r"<!-- table ([\w-]+) -->", page) for page in (README, "".join(PAGES.values())))
    assert sorted(places) == names
    assert [path.stem for path in RESULTS] == sorted([*names, *elsewhere])


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_figures_of_the_paper_are_marked(path: Path) -> None:
    """Assert that a file says how it was made, and that beside each figure of the paper stands how it compares."""
    result = json.loads(path.read_text())
    assert result["name"] == path.stem
    assert result["commands"] and result["commit"] and result["made"]
    assert result["recipe_ids"] or result["made"].startswith("first edition, c80c948")
    for row in result["rows"]:
        for column in (*result["columns"], *([result["across"]] if result["across"] else [])):
            if "paper" in column and results.fill(column["paper"], row):
                assert row["marks"][column["heading"]] in results.MARKS


# What sentences of the README say, filled from a row of a table: the table, what names the row, the words.
QUOTES: tuple[tuple[str, dict[str, Any], str], ...] = (
    ("grasps", {"setting": "paper"}, "the detector never saw in {success:.0%} of trials"),
    ("grasps", {"setting": "paper"}, "that {success:.2f} stands beside the paper's {paper_success:.2f}"),
    ("grasps-by-object", {"setting": "paper", "object": 12}, "object 12 (38 g) is held with {force_end_n:.1f} N"),
    ("grasps-by-object", {"setting": "paper", "object": 18}, "the filled bottle (18) with {force_end_n:.1f} N"),
    (
        "grasps-by-object",
        {"setting": "load-proportional", "object": 18},
        "objects 18 to 20 with more (object 18 with {force_end_n:.1f} N)",
    ),
    ("grasp-robustness", {"setting": "load-proportional, second, closed gel"}, "gel it keeps {success:.2f}"),
    ("grasp-robustness", {"setting": "load-proportional, drop-100g"}, "slides by {moved_mm_median:.1f} mm"),
)


@pytest.mark.parametrize(("table", "names", "words"), QUOTES)
def test_sentences_say_what_results_say(table: str, names: dict[str, Any], words: str) -> None:
    """Assert that a figure quoted in a sentence is that of the table."""
    rows = json.loads((ROOT / "docs" / "results" / f"{table}.json").read_text())["rows"]
    (row,) = [row for row in rows if names.items() <= row.items()]
    assert words.format(**row) in " ".join(README.replace(" %", "%").split())
