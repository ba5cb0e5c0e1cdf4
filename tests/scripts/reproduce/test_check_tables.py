"""run.py --table and --check: what is run, what is compared, and what an interrupted check keeps."""

import json
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.jobs import Row
from scripts.reproduce import check_tables, compare, perform
from scripts.reproduce.check_tables import experiment_of, only_for
from scripts.reproduce.checks import CHECKS, NOT_CHECKED, SCRIPTS, SIZES
from scripts.reproduce.experiment import Check, Experiment, Figure
from scripts.reproduce.facts import RESULTS, ROOT, Refusal
from scripts.reproduce.plan import EXPERIMENTS
from scripts.reproduce.steps import evetac
from scripts.reproduce.tables import Column, Evaluation, Table
from scripts.ship import strip_model
from tests.conftest import Made

TABLES = {table.name: experiment for experiment in EXPERIMENTS for table in experiment.tables if experiment.published}
EDGE = Check(("preset",), (Figure("consistent", "trajectories"), Figure("error_px")), unpromised=("time_us",))


def test_every_table_says_how_it_is_checked() -> None:
    """Assert that each table of the experiments has a check or a reason, and that sizes are those of experiments."""
    assert sorted(TABLES) == sorted([*CHECKS, *NOT_CHECKED])
    by_name = {experiment.name: experiment for experiment in EXPERIMENTS}
    for name, sizes in SIZES.items():
        assert sizes.keys() <= by_name[name].full.keys()
    for name, check in CHECKS.items():
        experiment = TABLES[name]
        trainings = [words for words in experiment.steps(experiment.full) if words[1] == "train"]
        assert not check.training or any(check_tables.contains(words, check.training) for words in trainings)


def test_only_steps_that_a_table_needs_are_run() -> None:
    """Assert that a table of known objects leaves out the unseen ones, and keeps the recordings that are learned."""
    experiment, table = experiment_of("slip-over-time")
    reduced = only_for(experiment, table)
    chosen, every = list(reduced.steps(experiment.full)), list(experiment.steps(experiment.full))
    assert set(reduced.evaluations(experiment.full)) == set(table.evaluations)
    out = {words[words.index("--out") + 1] for words in chosen}
    assert {"recordings/learn", "features/choose", "models/recipe"} <= out
    assert not any("unseen" in name for name in out)
    following = iter(every)
    assert all(words in following for words in chosen)  # in order
    edge = only_for(*experiment_of("tracking-edge"))
    assert {words[1] for words in edge.steps(dict(edge.full))} == {"record", "track"}
    assert all("edge-cut" in " ".join(words) for words in edge.steps(dict(edge.full)))


def test_differences_name_row_column_and_amount() -> None:
    """Assert that a changed digit and a missing row are found, and that run times are exempt."""
    kept = [{"preset": "a", "consistent": 5, "error_px": 0.25, "time_us": 1.0}, {"preset": "b", "error_px": None}]
    assert compare.differences([{**kept[0], "time_us": 7.0}, kept[1]], kept, EDGE) == []
    found = compare.differences([{**kept[0], "error_px": 0.251}, {"preset": "c"}], kept, EDGE)
    assert found == [
        "b: only in the stored table",
        "c: only in the table made again",
        "a: error_px 0.251 instead of 0.25, by 0.001",
    ]


def trials(values: list[Any], *, models: int = 1) -> list[Row]:
    """Trials of objects 0, 1, ..., each judged by several models."""
    return [
        {"preset": "a", "right": value, "error_px": value, "unit": number, "file": f"{number}.h5"}
        for number, value in enumerate(values)
        for _ in range(models)
    ]


def test_an_interval_is_as_wide_as_its_trials_are_few() -> None:
    """Assert Wilson's width for shares, by different trials and not by models, and none for two units."""
    from evetac_cli.kernels.estimates import share

    right = Figure("right")
    found = compare.interval(trials([True] * 17, models=5), right)
    assert found is not None
    assert (found.value, found.low) == (1.0, share(17, 17).low)
    assert compare.interval(trials([True, False]), right) is None
    several = compare.interval(trials([True, False] * 10), right)
    assert several is not None and several.low < 0.35 and several.high > 0.65
    mean = compare.interval(trials([1.0, 2.0, 3.0]), Figure("error_px"))
    assert mean is not None and mean.low == pytest.approx(2 - 4.303 / 3**0.5, abs=1e-3)  # Student's, of 2 degrees
    root = compare.interval(trials([3.0, 3.0, 3.0]), Figure("error_px", squared=True))
    assert root is not None and root == pytest.approx((3.0, 3.0, 3.0))


@pytest.mark.parametrize(("stored", "equal", "inside"), [(0.5, True, True), (0.45, False, True), (0.99, False, False)])
def test_a_stored_figure_is_judged(stored: float, *, equal: bool, inside: bool) -> None:
    """Assert that a figure is equal, in the interval of the check, or outside."""
    check = Check(("preset",), (Figure("right"),), trials=lambda evaluations: [])
    made = [{"preset": "a", "right": 0.5}]
    (row,) = compare.judged(trials([True, False] * 10), made, [{"preset": "a", "right": stored}], check)
    assert (row["equal"], row["inside"]) == (equal, inside)
    (few,) = compare.judged(trials([True]), made, [{"preset": "a", "right": 0.4}], check)
    assert few["inside"] is None


class FakeRun:
    """Stands in for the program: each trajectory's error is 0.1 px times its number, for `count` trajectories."""

    def __init__(self, count: int) -> None:
        self.count, self.commands = count, []

    def __call__(self, words: list[str], folder: Path) -> tuple[int, str]:
        self.commands.append(words)
        rows = [{"preset": "a", "file": f"{n}.h5", "error_px": 0.1 * n} for n in range(self.count)]
        mean = {"preset": "a", "error_px": sum(row["error_px"] for row in rows) / len(rows)}
        return 0, json.dumps({"rows": [mean, *rows], "summary": {}, "simulated": True})


HEADER: Row = {"id": "r", "kind": "report", "method": 1, "seed": None, "parameters": {}, "parents": [], "history": {}}
FAKE_TABLE = Table(
    "fake", "Errors", ("errors",), lambda evaluations: [row for row in evaluations["errors"].rows if "file" not in row],
    (Column("preset", "{preset}"), Column("error", "{error_px:.3f}")),
)  # fmt: skip
FAKE = Experiment(
    "fake", "errors", "fake", 0.1, full={"count": 10}, small={},
    steps=lambda sizes: iter([evetac("record", "--count", sizes["count"], "--out", "trials")]),
    evaluations=lambda sizes: {"errors": evetac("evaluate", "tracking", "trials/*.tracks.h5")},
    tables=(FAKE_TABLE,),
)  # fmt: skip


def fake_trials(evaluations: dict[str, Evaluation]) -> list[Row]:
    return [{**row, "unit": row["file"]} for row in evaluations["errors"].rows if "file" in row]


def running(run: perform.Run) -> perform.Running:
    return perform.Running(run=run, header=lambda path: HEADER)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stored table of ten trajectories, and its check on three; returns the folder of the stored tables."""
    results = tmp_path / "results"
    monkeypatch.setattr(perform, "EXPERIMENTS", (FAKE,))
    monkeypatch.setattr(check_tables, "EXPERIMENTS", (FAKE,))
    monkeypatch.setattr(check_tables, "RESULTS", results)
    monkeypatch.setattr(check_tables, "MODELS", results / "models")
    check = Check(("preset",), (Figure("error_px"),), fake_trials)
    monkeypatch.setattr(check_tables, "CHECKS", {"fake": check})
    monkeypatch.setattr(check_tables, "SIZES", {"fake": {"count": 3}})
    monkeypatch.setattr(check_tables, "SCRIPTS", {})
    monkeypatch.setattr(check_tables.frozen, "changed", lambda freeze: [])  # reads all that is frozen, in seconds
    perform.perform(FAKE, FAKE.full, tmp_path / "whole", results, running(FakeRun(10)))
    return results


def test_a_check_is_resumed(fake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a finished check is not run again before its table changes, and that an interrupted one is."""
    out = tmp_path / "check"

    def interrupted(words: list[str], folder: Path) -> tuple[int, str]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        check_tables.check([], out, running(interrupted))
    assert not list((out / "checks").rglob("fake.json"))
    run = FakeRun(3)
    check_tables.check([], out, running(run))
    assert run.commands[0] == ["evetac", "record", "--count", "3", "--out", "trials", "--jobs", "1"]
    capsys.readouterr()
    check_tables.check(["fake"], out, running(interrupted), as_json=True)
    (found,) = json.loads(capsys.readouterr().out)
    (figure,) = found["figures"]
    assert (figure["stored"], figure["again"], figure["inside"]) == (pytest.approx(0.45), pytest.approx(0.1), False)
    assert found["whole"] is False and found["differences"]
    path = fake / "fake.json"
    path.write_text(path.read_text().replace("0.45", "0.1"))
    check_tables.check(["fake"], out, running(run))
    assert "fake: 1 of 1 figures agree" in capsys.readouterr().out


def test_a_table_made_again_is_compared(fake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that equal rows are said to be equal, and that a digit that was changed in the stored table is named."""
    run = running(FakeRun(10))
    assert check_tables.make("fake", tmp_path / "a", tmp_path / "a" / "tables", run)
    assert "all rows are equal" in capsys.readouterr().out
    path = fake / "fake.json"
    stored = json.loads(path.read_text())
    stored["rows"][0]["error_px"] += 0.01
    path.write_text(json.dumps(stored))
    assert not check_tables.make("fake", tmp_path / "b", tmp_path / "b" / "tables", run)
    assert "a: error_px" in capsys.readouterr().out
    with pytest.raises(Refusal, match="no experiment makes the table"):
        check_tables.make("lost", tmp_path / "b", tmp_path / "b", run)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_take_the_words_of_their_checks(name: str) -> None:
    """Assert that the script is there, has each flag, and that the table is stored and made by it."""
    for _, path, *words in SCRIPTS[name].commands:
        text = (ROOT / path).read_text()
        assert all(f'"{word}"' in text for word in words if word.startswith("--"))
        stored = json.loads((RESULTS / f"{name}.json").read_text())
        assert path in stored["commands"][0]
        assert {key for figure in SCRIPTS[name].check.figures for key in (figure.above, figure.count)} - {""} <= {
            key for row in stored["rows"] for key in row
        }


def test_frozen_models_take_the_place_of_trainings(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that with an archive only the training to be repeated is left, with one seed and what it learns from."""
    monkeypatch.setattr(check_tables, "MODELS", tmp_path)
    strip_model.pack([made.model], tmp_path / "recipe.tar.xz")
    chosen = check_tables.planned("paper-recipe")
    commands = list(chosen.experiment.steps(chosen.sizes))
    trainings = [words for words in commands if words[1] == "train"]
    assert trainings == [chosen.again] and chosen.archives == {"models/recipe": tmp_path / "recipe.tar.xz"}
    assert chosen.again is not None
    assert check_tables.contains(chosen.again, ["--seeds", "1", "--out", "again/models/recipe"])
    assert check_tables.contains(chosen.again, ["--model", "fast-slow", "--horizon-ms", "10"])
    assert any(check_tables.contains(words, ["--out", "features/learn"]) for words in commands)


def not_packed(tables: dict[str, Row], names: set[str]) -> list[str]:
    """The models of frozen tables that are neither packed nor the shipped detector."""
    judged = {name for table in tables.values() if table.get("frozen") for name in table.get("models", {})}
    return sorted(judged - names - {"slip-10ms"})


def test_models_of_frozen_tables_are_packed() -> None:
    """Assert that each model that a frozen table names is in an archive, and that a missing one is found."""
    names = strip_model.names_in(perform.MODELS)
    tables = {path.stem: json.loads(path.read_text()) for path in RESULTS.glob("*.json")}
    experiments = {name: table for name, table in tables.items() if name in CHECKS and CHECKS[name].training}
    assert not_packed(experiments, names) == []
    doctored = {"a": {"frozen": "ccbcd6aa", "models": {"recipe/lost-s1": "0"}}}
    assert not_packed(doctored, names) == ["recipe/lost-s1"]
