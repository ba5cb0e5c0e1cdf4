"""README and docs: commands, flags, make targets, links and messages exist; figures are those of results.

The slow test runs the commands of README and of the first hour in an empty environment (scripts/first_hour.py).
"""

import ast
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from evetac_cli.cli.main import app
from evetac_cli.evaluate import PAPER
from evetac_cli.evaluate.common.marks import MARKS
from evetac_cli.store.layout import schema
from evetac_cli.trials.record import simulated
from scripts import first_hour
from scripts.docs import figures
from scripts.reproduce import results, table_text
from scripts.reproduce.plan import EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
PAGES = {str(path.relative_to(ROOT)): path.read_text() for path in results.PAGES}
README = PAGES["README.md"]
RESULTS = sorted((ROOT / "docs" / "results").glob("*.json"), key=lambda path: path.stem)


def shown_lines(page: str) -> list[str]:
    """The lines of a page's code, indented or fenced, without comments; a line that goes on is joined to the next."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    code = "\n".join(text for language, text in fenced if language in ("sh", "bash"))
    lines = [*code.splitlines(), *(line[4:] for line in page.splitlines() if line.startswith("    "))]
    return re.sub(r"\\\n\s*", "", "\n".join(re.sub(r"\s#.*", "", line) for line in lines)).splitlines()


def shown_commands(page: str) -> list[str]:
    """The commands of evetac on a page, without what a shell adds."""
    parts = (part.strip() for line in shown_lines(page) for part in re.split(r"[|;]|&&| - <<", line))
    return [part.removesuffix("...").strip(" '") for part in parts if part.startswith("evetac ")]


COMMANDS = sorted({line for page in PAGES.values() for line in shown_commands(page)})
TARGETS = sorted({line.split()[1] for page in PAGES.values() for line in shown_lines(page) if line.startswith("make ")})


def test_readme_is_short_and_the_first_hour_has_the_whole_pipeline() -> None:
    """Assert that README stays short with five commands, and that docs/first-hour.md shows every command."""
    assert len(README.splitlines()) <= 110
    assert len(shown_commands(README)) == 5
    commands = [line.split() for line in shown_commands(PAGES["docs/first-hour.md"])]
    shown = {" ".join(words[1:3]) if words[1] == "evaluate" else words[1] for words in commands}
    assert shown >= {"record", "label", "track", "featurize", "train", "evaluate slip", "grasp"}


def test_commands_parse() -> None:
    """Assert that each command line of README or docs names a command and flags that exist."""
    program = typer.main.get_command(app)
    for line in COMMANDS:
        command, words = program, shlex.split(line)[1:]
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        if words != ["--version"]:
            command.make_context(line, words)


@pytest.mark.parametrize("target", TARGETS)
def test_make_target_exists(target: str) -> None:
    """Assert that a make target of README or docs is in the Makefile, with a line of help."""
    assert re.search(rf"^{target}:.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE)


def anchors(page: str) -> set[str]:
    """What links to the headings of a page end in."""
    headings = re.findall(r"^#+ (.+)$", page, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    """Assert that relative links of a page lead to files or folders, and to headings that are there."""
    text = re.sub(r"(?m)^    .*$", "", PAGES[name])  # without code
    for link in re.findall(r"\]\((?!http|reference/contributing)([^)]+)\)", text):  # a copy that is made with the site
        path, _, anchor = link.partition("#")
        target = (ROOT / name).parent / path if path else ROOT / name
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


def test_messages_are_those_of_the_code() -> None:
    """Assert that every message that the page on troubleshooting explains is one that the code has."""
    code = "\n".join(path.read_text() for path in (ROOT / "evetac_cli").rglob("*.py"))
    page = PAGES["docs/troubleshooting.md"]
    messages = re.findall(r"^### `(.+)`$", page, re.MULTILINE)
    assert len(messages) > 20
    parts = [part.strip() for message in messages for part in message.split("...") if part.strip()]
    assert [part for part in parts if part not in code] == []


def test_every_check_of_doctor_is_explained() -> None:
    """Assert that the table of troubleshooting has a row for each check of doctor that may be wrong."""
    table = PAGES["docs/troubleshooting.md"].split("## What `doctor` says")[1]
    checks = set()
    doctor = ROOT / "evetac_cli" / "inspect" / "doctor"
    parts = [ast.parse((doctor / name).read_text()) for name in ("__init__.py", "cameras.py")]
    for node in (node for part in parts for node in ast.walk(part)):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "check" and len(node.args) > 3:
            name, ok = node.args[1:3]
        elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple) and len(node.value.elts) == 5:
            name, ok = node.value.elts[:2]
        else:
            continue
        if isinstance(name, ast.Constant) and not (isinstance(ok, ast.Constant) and ok.value in (True, None)):
            checks.add(name.value)
    assert {"libusb", "link", "busy", "latency timer"} <= checks
    assert [name for name in sorted(checks - {"torque"}) if f"`{name}`" not in table] == []  # torque is never wrong


def test_tables_say_what_results_say() -> None:
    """Assert that every table is what its file in docs/results/ says: `make results` would change nothing."""
    for page in PAGES.values():
        assert results.fill_page(page, ROOT / "docs" / "results") == page


def test_every_table_has_a_file() -> None:
    """Assert that tables on pages have files, that none stands twice, and that an experiment's kept tables have one."""
    places = re.findall(r"<!-- table ([\w-]+) -->", "".join(PAGES.values()))
    places.remove("paper-ten")  # which README has, too
    assert len(places) == len(set(places))
    made = {results.FREEZE, *results.OF_ROWS}
    assert made <= set(places) <= made | {path.stem for path in RESULTS}
    tables = [table for experiment in EXPERIMENTS for table in experiment.tables]
    assert {table.name for table in tables if table.kept} <= {path.stem for path in RESULTS}
    assert not {table.name for table in tables if not table.kept} & set(places)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_figures_of_the_paper_are_marked(path: Path) -> None:
    """Assert that a file says how it was made, and that the paper's figures stand beside ours with a mark."""
    result = json.loads(path.read_text())
    assert result["name"] == path.stem
    assert result["commands"] and result["commit"] and result["made"]
    files = result["sizes"].get("recordings", 0)  # none: no file of ours was read
    assert result["recipe_ids"] or not files or result["commit"] == "c80c948"  # of which the reports were not kept
    assert unlike_the_paper(result) == []


def unlike_the_paper(result: dict[str, Any]) -> list[str]:
    """The cells of a table whose figures of the paper, or marks, are not those of `PAPER`."""
    found = []
    for row in result["rows"]:
        for column in (*result["columns"], *([result["across"]] if result["across"] else [])):
            names = table_text.keys(column.get("paper", ""))
            if not set(names) <= PAPER.columns.keys() or re.sub(r"{.*?}|sd|[,% ]", "", column.get("paper", "")):
                found.append(f"{column['heading']}: {column['paper']}")
                continue
            stored = table_text.fill(column.get("paper", ""), row)
            shown, mark = table_text.published(column, row, result)
            if shown != stored or (mark not in MARKS if stored else mark != ""):
                found.append(f"{column['heading']}: {stored}, {mark}")
    return found


@pytest.mark.parametrize("name", PAGES)
def test_figures_quoted_in_sentences_are_those_of_results(name: str) -> None:
    """Assert that each figure named above a paragraph is the table's, and that the paragraph has it."""
    assert figures.absent(PAGES[name]) == []


@pytest.mark.parametrize("name", figures.PAGES)
def test_sentences_of_these_pages_name_their_figures(name: str) -> None:
    """Assert that each decimal figure in a sentence comes from a table, or is said to be no result."""
    assert [sentence for sentence in figures.sentences(name, PAGES[name]) if sentence.unmarked] == []


def test_a_changed_digit_of_a_sentence_is_found() -> None:
    """Assert that a page whose sentence has another digit than its table, or a new figure, breaks the two rules."""
    mark = '<!-- figure slip-detectors-timing {"score": "ahead 10 ms"} correct:.3f -->\n<!-- given 0.5 -->\n\n'
    page = f"{mark}It is right in SHARE of slips within 0.5 px.\n"
    assert figures.absent(page.replace("SHARE", "0.824")) == []
    assert [one.unmarked for one in figures.sentences("a", page.replace("SHARE", "0.824"))] == [[]]
    assert figures.absent(page.replace("SHARE", "0.825")) and figures.absent(page.replace("SHARE", "1.824"))
    (added,) = figures.sentences("a", page.replace("SHARE", "0.824 (0.9 before)"))
    assert added.unmarked == ["0.9"]
    assert figures.absent(page.replace("SHARE", "0.824").replace("within 0.5 px", "within 0.6 px"))


def test_what_info_shows_of_a_recording_is_of_today() -> None:
    """Assert that schema version and method number, wherever a page shows what `info` prints, are today's."""
    block = re.compile(
        r"^ +kind +recording\n +schema version +([\d.]+)\n +id .*\n +method version +(\d+)$", re.MULTILINE
    )
    shown = [each for page in PAGES.values() for each in block.findall(page)]
    assert len(shown) == sum(page.count("  schema version  ") for page in PAGES.values()) > 0
    assert set(shown) == {(schema.load("recording").version, str(simulated.METHOD))}


@pytest.mark.parametrize(("name", "figure"), [("docs/first-hour.md", "f1"), ("README.md", "onset_ms")])
def test_pages_to_follow_promise_figures(name: str, figure: str) -> None:
    """Assert that a page to follow has blocks to run, and that they promise a range for its main figure."""
    page = first_hour.blocks(PAGES[name])
    assert len(page) >= 2
    promised = {name: (low, high) for block in page for name, low, high in block.expected}
    low, high = promised[figure]
    assert low < high


@pytest.mark.slow
def test_the_first_hour_comes_out_as_written(tmp_path: Path) -> None:
    """Assert that from an empty environment on every command succeeds, with figures in the stated ranges."""
    script = ROOT / "scripts" / "first_hour.py"
    command = [sys.executable, str(script), "--folder", str(tmp_path), "--minutes", "1000"]  # a test measures no time
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
