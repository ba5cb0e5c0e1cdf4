"""scripts/reproduce/run.py: tables say what was run, and no run destroys what another has kept."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer

from evetac_cli.cli.main import app
from evetac_cli.jobs import Row
from scripts.reproduce import facts, perform, results, run
from scripts.reproduce.experiment import Experiment
from scripts.reproduce.facts import ROOT, Refusal
from scripts.reproduce.plan import EXPERIMENTS
from scripts.reproduce.steps import evetac
from scripts.reproduce.table_text import text
from scripts.reproduce.tables import Column, Table, summaries
from tests.patience import PATIENCE_S

BY_NAME = {experiment.name: experiment for experiment in EXPERIMENTS}
COMMAND_LINE = typer.main.get_command(app)
EXAMPLE = Experiment(
    "labels", "slip labels against truth", "data/labels", 0.5,
    full={"seed": 0, "objects": "1-20", "each": 5}, small={"objects": "3,11", "each": 1},
    steps=lambda sizes: iter([
        evetac("record", "--object", sizes["objects"], "--count", sizes["each"], "--seed", sizes["seed"], "--out", "."),
        evetac("label", "*.recording.h5"),
    ]),
    evaluations=lambda sizes: {"labels": evetac("evaluate", "labels", "*.labels.h5")},
    tables=(
        Table(
            "labels",
            "Slip labels against true gross slip, {recordings} trajectories of objects {objects}",
            ("labels",),
            summaries,
            (
                Column("onsets that have a label", "{onsets_found} of {trajectories}"),
                Column("median error [ms]", "{onset_error_ms_median:.0f}"),
                Column("worst [ms]", "{onset_error_ms_worst:.0f}"),
                Column("share in -4..+3 ms", "{within_minus4_plus3_ms:.2f}"),
                Column("over 4 ms before gross slip", "{earlier_than_4_ms_before_gross_slip}"),
            ),
        ),
    ),
)  # fmt: skip
SMALLNESS = pytest.mark.parametrize("small", [False, True])


def header(objects: list[int], *, id_: str = "r") -> Row:
    """Of a report on labels of one recording of each object, made with seed 300."""
    history: Row = {}
    for number in objects:
        recording = {
            "kind": "recording", "method": 1, "seed": 300, "parents": [], "parameters": {"object": number},
        }  # fmt: skip
        labels = {
            "kind": "labels", "method": 1, "seed": None, "parents": [f"recording-{number}"], "parameters": {},
        }  # fmt: skip
        history |= {f"recording-{number}": recording, f"labels-{number}": labels}
    return {
        "id": id_, "kind": "report", "method": 1, "seed": None, "parameters": {"command": "evaluate labels"},
        "parents": [f"labels-{number}" for number in objects], "history": history,
    }  # fmt: skip


class FakeEvetac:
    """Stands in for the program: keeps the commands, and answers evaluations with as many labels as it is made for."""

    def __init__(self, objects: list[int]) -> None:
        self.objects, self.commands = objects, []

    def run(self, words: list[str], folder: Path) -> tuple[int, str]:
        self.commands.append(words)
        summary = {"trajectories": len(self.objects), "onsets_found": len(self.objects), "onset_error_ms_median": 1.0,
                   "onset_error_ms_worst": 2.0, "within_minus4_plus3_ms": 0.5,
                   "earlier_than_4_ms_before_gross_slip": 0}  # fmt: skip
        return 0, json.dumps({"rows": [], "summary": summary, "simulated": True})

    def header(self, path: Path) -> Row:
        return header(self.objects)


def run_labels(tmp_path: Path, objects: list[int], *, replace: bool = False) -> FakeEvetac:
    """An experiment whose program labels these objects whatever it is asked."""
    fake = FakeEvetac(objects)
    experiment = EXAMPLE
    perform.perform(
        experiment, dict(experiment.full), tmp_path, tmp_path / "results",
        perform.Running(3, run=fake.run, header=fake.header), replace=replace,
    )  # fmt: skip
    return fake


def test_a_table_says_what_its_reports_say(tmp_path: Path) -> None:
    """Assert that title, sizes and seeds come from the headers, not from the sizes asked for."""
    run_labels(tmp_path, [1, 2, 3, 8])
    table = json.loads((tmp_path / "results" / "labels.json").read_text())
    assert table["title"] == "Slip labels against true gross slip, 4 trajectories of objects 1-3, 8"
    assert table["sizes"]["recordings"] == 4
    assert table["sizes"]["recording_seeds"] == [300]
    assert table["recipe_ids"] == ["r"]
    assert table["commands"] == ["evetac evaluate labels *.labels.h5"]
    assert {"commit", "uncommitted_changes"} <= set(table)
    assert "| 4 of 4 | 1 | 2 | 0.50 | 0 |" in text(table)


def test_jobs_are_handed_on(tmp_path: Path) -> None:
    """Assert that commands which work on several files are given --jobs, and most evaluations are not."""
    record, _, evaluation = run_labels(tmp_path, [1]).commands
    assert record[-2:] == ["--jobs", "3"]
    assert "--jobs" not in evaluation


def test_a_smaller_run_replaces_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a table of more trajectories stays, that the refusal says why, and that --replace overrides it."""
    path = tmp_path / "results" / "labels.json"
    run_labels(tmp_path, [1, 2, 3])
    before = path.read_text()
    with pytest.raises(Refusal, match=r"recordings 1 \(there 3\).*--replace"):
        run_labels(tmp_path, [1])
    assert path.read_text() == before
    assert "1 trajectories of objects 1" in capsys.readouterr().out  # it is printed all the same
    run_labels(tmp_path, [1], replace=True)
    assert json.loads(path.read_text())["sizes"]["recordings"] == 1
    run_labels(tmp_path, [1, 2])  # a larger one needs no flag
    assert json.loads(path.read_text())["sizes"]["recordings"] == 2


def test_a_command_that_fails_ends_the_run(tmp_path: Path) -> None:
    """Assert that the refusal names the command and its exit code, and that no table is written."""
    experiment = EXAMPLE
    with pytest.raises(Refusal, match="evetac record .* exit code 3"):
        perform.perform(
            experiment, dict(experiment.full), tmp_path, tmp_path / "results",
            perform.Running(run=lambda words, folder: (3, ""), header=lambda path: {}),
        )  # fmt: skip
    assert not (tmp_path / "results").exists()


def test_a_report_of_other_files_is_made_anew(tmp_path: Path) -> None:
    """Assert that an evaluation which refuses the report that lies there is run again with --force."""
    commands = []

    def run(words: list[str], folder: Path) -> tuple[int, str]:
        commands.append(words)
        return (0, '{"rows": [], "summary": {}, "simulated": true}') if "--force" in words else (2, "")

    running = perform.Running(run=run, header=lambda path: header([1]))
    perform.evaluate("labels", ["evetac", "evaluate", "labels"], tmp_path, running)
    assert [words[-1] for words in commands] == ["--json", "--force"]


def test_facts_keep_training_apart() -> None:
    """Assert that trajectories judged, detectors, and trajectories trained on are counted each for itself."""
    trained = {"recording": "t", "role": "trained on", "object": 9, "sensor": "evetac"}
    model = {"kind": "model", "seed": None, "parents": ["f"], "parameters": {"seed": 4, "max_steps": 200}}
    grasped = {"kind": "recording", "seed": 7, "parents": ["m"], "parameters": {"object": 11, "sensor": "second"}}
    known = facts.facts([{"parents": ["g"], "history": {"m": {**model, "trajectories": [trained]}, "g": grasped}}])
    assert (known["recordings"], known["objects"], known["sensors"]) == (1, [11], ["second"])
    assert (known["models"], known["training_seeds"], known["training_steps"]) == (1, [4], 200)
    assert (known["training_recordings"], known["training_objects"]) == (1, [9])
    of_grasp = facts.facts([{"parents": ["g"], "history": {"m": model, "g": grasped}}])  # as files of today have it
    assert (of_grasp["models"], of_grasp["training_seeds"], of_grasp["training_recordings"]) == (1, [4], 0)


def test_dry_run_prints_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert that the commands of an experiment and of those before it are printed in order, at the sizes asked for."""
    monkeypatch.setattr("subprocess.run", lambda *a, **k: pytest.fail("something was run"))
    run.main(["--only", "paper-recipe", "--small", "--size", "steps=7", "--dry-run", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert f"cd {tmp_path}/small/data/paper-recipe" in printed
    commands = [line.split()[1] for line in printed.splitlines() if line.startswith("evetac")]
    assert list(dict.fromkeys(commands)) == ["record", "label", "track", "featurize", "train", "evaluate"]
    assert "--max-steps 7" in printed
    assert list(tmp_path.iterdir()) == []


def test_the_recipe_is_the_papers() -> None:
    """Assert tracker, labels and training of the recipe, and that networks that headlines name have five seeds."""
    sizes = perform.sizes_for(BY_NAME["paper-recipe"], small=False, given={})
    commands = [words[1:] for words in BY_NAME["paper-recipe"].steps(sizes)]

    def values(command: str, flag: str) -> list[str]:
        return [words[words.index(flag) + 1] for words in commands if words[0] == command]

    assert set(values("track", "--preset")) == {"paper"} and set(values("label", "--method")) == {"farneback"}
    assert set(values("train", "--preset")) == {"paper"}
    named = zip(*(values("train", flag) for flag in ("--model", "--horizon-ms", "--seed", "--seeds")), strict=True)
    seeds: dict[tuple[str, str], list[int]] = {}
    for model, ahead, first, count in named:
        seeds.setdefault((model, ahead), []).extend(range(int(first), int(first) + int(count)))
    five = [("fast-slow", "0"), ("fast-slow", "10")]
    assert all(found == list(range(9_000, 9_005 if model in five else 9_002)) for model, found in seeds.items())
    assert len(seeds) == 11


@pytest.mark.parametrize("words", [["--only", "no-such"], ["--only", "tracking", "--size", "steps=7"],
                                   ["--only", "tracking", "--size", "edges=many"]])  # fmt: skip
def test_wrong_names_and_sizes_are_refused(words: list[str]) -> None:
    """Assert that an experiment or size that does not exist, and a size of another type, end with an error."""
    with pytest.raises(SystemExit, match="error: "):
        run.main([*words, "--dry-run"])


def test_every_experiment_is_a_make_target() -> None:
    """Assert that make targets and experiments have the same names."""
    makefile = (ROOT / "Makefile").read_text()
    targets = re.findall(r"^([\w-]+):.*\n\t@\$\(REPRODUCE\) --only \$@$", makefile, re.MULTILINE)
    assert sorted(targets) == sorted(BY_NAME)


@SMALLNESS
@pytest.mark.parametrize("name", BY_NAME)
def test_commands_exist(name: str, *, small: bool) -> None:
    """Assert that every command of every experiment parses: commands, flags and values are those of today."""
    experiment = BY_NAME[name]
    sizes = perform.sizes_for(experiment, small=small, given={})
    for program, *words in (*experiment.steps(sizes), *experiment.evaluations(sizes).values()):
        if program == "python":
            assert (ROOT / words[0]).exists()
            continue
        command: Any = COMMAND_LINE
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        command.make_context(name, words)


@pytest.mark.parametrize("name", BY_NAME)
def test_experiments_fit_together(name: str) -> None:
    """Assert that tables are made of evaluations that there are, and that experiments to come first exist."""
    experiment = BY_NAME[name]
    assert set(experiment.after) <= set(BY_NAME)
    assert set(experiment.small) <= set(experiment.full)
    evaluations = set(experiment.evaluations(dict(experiment.full)))
    if experiment.measure:
        evaluations |= {table.name for table in experiment.tables}
    assert {name for table in experiment.tables for name in table.evaluations} <= evaluations


def test_a_table_names_the_methods_that_changed(tmp_path: Path) -> None:
    """Assert that a table made by an older method than today's says by which, and one made by today's says nothing."""
    run_labels(tmp_path, [1])
    table = json.loads((tmp_path / "results" / "labels.json").read_text())
    table["methods"] = {"label": facts.method("label") - 1, "record": facts.method("record")}
    today = facts.method("label")
    assert f"label {today - 1} (now {today})" in text(table)
    table["methods"] = {"record": facts.method("record")}
    assert "older" not in text(table)


def test_a_page_is_filled_between_its_marks(tmp_path: Path) -> None:
    """Assert that a table is replaced and the rest of the page is not, and that a table without a file is an error."""
    run_labels(tmp_path, [1])
    page = "before\n<!-- table labels -->\nwhat was there\n<!-- end of labels -->\nafter\n"
    filled = results.fill_page(page, tmp_path / "results")
    assert "what was there" not in filled
    assert filled.startswith("before\n<!-- table labels -->\n\nSimulated. Slip labels")
    assert filled.endswith("<!-- end of labels -->\nafter\n")
    assert results.fill_page(filled, tmp_path / "results") == filled
    with pytest.raises(FileNotFoundError):
        results.fill_page(page.replace("labels", "lost"), tmp_path / "results")


def test_ctrl_c_leaves_nothing_unfinished(tmp_path: Path) -> None:
    """Assert exit code 130, one sentence and no traceback, and that the command at work takes its files away."""
    words = ["--only", "demo", "--jobs", "2", "--out", str(tmp_path), "--results", str(tmp_path / "results")]
    process = subprocess.Popen(
        [sys.executable, run.__file__, *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        while not any(tmp_path.rglob("*.recording.h5")):
            assert process.poll() is None, process.communicate()[0]
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130 and "Traceback" not in said, said
    assert said.splitlines()[-1].startswith("interrupted: complete files are kept")
    assert [path for pattern in ("*.part*", "*.tmp*") for path in tmp_path.rglob(pattern)] == []
