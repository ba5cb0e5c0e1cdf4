"""reproduce.py --table and --check: what is run, what is compared, and what an interrupted check keeps."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.jobs import Row
from tests.conftest import Made

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import check_tables
import compare_tables
import reproduce
import run_facts
from experiment_steps import evetac
from experiment_tables import DETECTORS, Column, Evaluation, Table
from experiments import EXPERIMENTS, Experiment
from made_tables import Refusal
from needed_steps import experiment_of, needed, only_for
from ship import strip_model
from table_checks import CHECKS, NOT_CHECKED, SCRIPTS, SIZES, Check, Figure, ScriptCheck, grasp_trials, slip_trials

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
    """Assert that the paper's recipe leaves out the changes, and that recordings that a training reads are made."""
    experiment, table = experiment_of("paper-recipe")
    reduced = only_for(experiment, table)
    chosen, every = list(reduced.steps(experiment.full)), list(experiment.steps(experiment.full))
    assert set(reduced.evaluations(experiment.full)) == set(table.evaluations)
    out = {words[words.index("--out") + 1] for words in chosen}
    assert {"recordings/learn", "nothing/choose", "models/nothing"} <= out
    assert not any(name.startswith(("quiet", "tracker", "models/tracker")) for name in out)
    following = iter(every)
    assert all(words in following for words in chosen)  # in order
    edge = only_for(*experiment_of("tracking-edge"))
    assert {words[1] for words in edge.steps(dict(edge.full))} == {"record", "track"}
    assert all("edge-cut" in " ".join(words) for words in edge.steps(dict(edge.full)))


def test_files_beside_their_inputs_are_found() -> None:
    """Assert that a command without --out serves those who read its inputs' folder, and no others."""
    steps = [
        evetac("record", "--out", "a"),
        evetac("record", "--out", "b"),
        evetac("track", "a/*.recording.h5"),
        evetac("track", "b/*.recording.h5"),
        evetac("train", "a/*.features.h5", "--validate", "b", "--out", "models/x.model.h5"),
    ]
    assert needed(steps, [evetac("evaluate", "tracking", "a/*.tracks.h5")]) == [steps[0], steps[2]]
    assert needed(steps, [evetac("evaluate", "slip", "--model", "models/*.model.h5")]) == steps


def test_differences_name_row_column_and_amount() -> None:
    """Assert that a changed digit and a missing row are found, and that run times are exempt."""
    kept = [{"preset": "a", "consistent": 5, "error_px": 0.25, "time_us": 1.0}, {"preset": "b", "error_px": None}]
    assert compare_tables.differences([{**kept[0], "time_us": 7.0}, kept[1]], kept, EDGE) == []
    found = compare_tables.differences([{**kept[0], "error_px": 0.251}, {"preset": "c"}], kept, EDGE)
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
    found = compare_tables.interval(trials([True] * 17, models=5), right)
    assert found is not None
    assert (found.value, found.low) == (1.0, share(17, 17).low)
    assert compare_tables.interval(trials([True, False]), right) is None
    several = compare_tables.interval(trials([True, False] * 10), right)
    assert several is not None and several.low < 0.35 and several.high > 0.65
    mean = compare_tables.interval(trials([1.0, 2.0, 3.0]), Figure("error_px"))
    assert mean is not None and mean.low == pytest.approx(2 - 4.303 / 3**0.5, abs=1e-3)  # Student's, of 2 degrees
    root = compare_tables.interval(trials([3.0, 3.0, 3.0]), Figure("error_px", squared=True))
    assert root is not None and root == pytest.approx((3.0, 3.0, 3.0))


@pytest.mark.parametrize(("stored", "equal", "inside"), [(0.5, True, True), (0.45, False, True), (0.99, False, False)])
def test_a_stored_figure_is_judged(stored: float, *, equal: bool, inside: bool) -> None:
    """Assert that a figure is equal, in the interval of the check, or outside."""
    check = Check(("preset",), (Figure("right"),), trials=lambda evaluations: [])
    made = [{"preset": "a", "right": 0.5}]
    (row,) = compare_tables.judged(trials([True, False] * 10), made, [{"preset": "a", "right": stored}], check)
    assert (row["equal"], row["inside"]) == (equal, inside)
    (few,) = compare_tables.judged(trials([True]), made, [{"preset": "a", "right": 0.4}], check)
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
    tables=(FAKE_TABLE,), in_plan=False,
)  # fmt: skip


def fake_trials(evaluations: dict[str, Evaluation]) -> list[Row]:
    return [{**row, "unit": row["file"]} for row in evaluations["errors"].rows if "file" in row]


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stored table of ten trajectories, and its check on three; returns the folder of the stored tables."""
    results = tmp_path / "results"
    monkeypatch.setattr("experiments.EXPERIMENTS", (FAKE,))
    monkeypatch.setattr("needed_steps.EXPERIMENTS", (FAKE,))
    monkeypatch.setattr(check_tables, "EXPERIMENTS", (FAKE,))
    monkeypatch.setattr(check_tables, "RESULTS", results)
    monkeypatch.setattr(check_tables, "MODELS", results / "models")
    check = Check(("preset",), (Figure("error_px"),), fake_trials)
    monkeypatch.setattr(check_tables, "CHECKS", {"fake": check})
    monkeypatch.setattr(check_tables, "SIZES", {"fake": {"count": 3}})
    monkeypatch.setattr(check_tables, "SCRIPTS", {})
    reproduce.perform(FAKE, FAKE.full, tmp_path / "whole", results, jobs=1, replace=True, run=FakeRun(10),
                      header=lambda path: HEADER)  # fmt: skip
    return results


def test_a_check_is_resumed(fake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a finished check is not run again before its table changes, and that an interrupted one is."""
    out = tmp_path / "check"
    how: dict[str, Any] = {"jobs": 1, "header": lambda path: HEADER}

    def interrupted(words: list[str], folder: Path) -> tuple[int, str]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        check_tables.check([], out, run=interrupted, **how)
    assert not list((out / "checks").rglob("fake.json"))
    run = FakeRun(3)
    check_tables.check([], out, run=run, **how)
    assert run.commands[0] == ["evetac", "record", "--count", "3", "--out", "trials", "--jobs", "1"]
    capsys.readouterr()
    check_tables.check(["fake"], out, run=interrupted, as_json=True, **how)
    (found,) = json.loads(capsys.readouterr().out)
    (figure,) = found["figures"]
    assert (figure["stored"], figure["again"], figure["inside"]) == (pytest.approx(0.45), pytest.approx(0.1), False)
    assert found["whole"] is False and found["differences"]
    path = fake / "fake.json"
    path.write_text(path.read_text().replace("0.45", "0.1"))
    check_tables.check(["fake"], out, run=run, **how)
    assert "fake: 1 of 1 figures agree" in capsys.readouterr().out


def test_a_table_made_again_is_compared(fake: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that equal rows are said to be equal, and that a digit that was changed in the stored table is named."""
    how: dict[str, Any] = {"jobs": 1, "replace": True, "header": lambda path: HEADER, "run": FakeRun(10)}
    assert check_tables.make("fake", tmp_path / "a", tmp_path / "a" / "tables", **how)
    assert "all rows are equal" in capsys.readouterr().out
    path = fake / "fake.json"
    stored = json.loads(path.read_text())
    stored["rows"][0]["error_px"] += 0.01
    path.write_text(json.dumps(stored))
    assert not check_tables.make("fake", tmp_path / "b", tmp_path / "b" / "tables", **how)
    assert "a: error_px" in capsys.readouterr().out
    with pytest.raises(Refusal, match="no experiment makes the table"):
        check_tables.make("lost", tmp_path / "b", tmp_path / "b", **how)


def test_a_table_without_a_check_is_refused(fake: Path, tmp_path: Path) -> None:
    """Assert that the refusal says why, and that a dry run runs nothing."""
    (fake / "other.json").write_text(json.dumps({"name": "other", "commands": ["python scripts/other.py"]}))
    with pytest.raises(Refusal, match=r"other: no check repeats it .*scripts/other.py"):
        check_tables.check(["other"], tmp_path)
    check_tables.check([], tmp_path / "dry", dry_run=True)
    assert not (tmp_path / "dry").exists()


def test_a_table_of_its_own_script_is_checked(fake: Path, tmp_path: Path) -> None:
    """Assert that its shares are judged by the numbers of trials, and that a command that fails is an error."""
    own = ScriptCheck(
        (["python", "scripts/judge_labels.py"],), 1.0,
        Check(("what",), (Figure("right", count="slips"), Figure("found", "slips"))),
    )  # fmt: skip
    stored = [{"what": "a", "right": 0.9, "slips": 100, "found": 40}]
    (fake / "own.json").write_text(json.dumps({"name": "own", "rows": stored}))

    def run(words: list[str], folder: Path) -> tuple[int, str]:
        again = [{"what": "a", "right": 0.8, "slips": 10, "found": 10}]
        (folder / "tables" / "own.json").write_text(json.dumps({"name": "own", "rows": again}))
        return 0, ""

    found = check_tables.by_script("own", own, tmp_path, run)
    assert [row["inside"] for row in found["figures"]] == [True, False]
    with pytest.raises(Refusal, match="exit code 3"):
        check_tables.by_script("own", own, tmp_path, lambda words, folder: (3, ""))


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_take_the_words_of_their_checks(name: str) -> None:
    """Assert that the script is there, has each flag, and that the table is stored and made by it."""
    for _, path, *words in SCRIPTS[name].commands:
        text = (reproduce.ROOT / path).read_text()
        assert all(f'"{word}"' in text for word in words if word.startswith("--"))
        stored = json.loads((reproduce.RESULTS / f"{name}.json").read_text())
        assert path in stored["commands"][0]
        assert {key for figure in SCRIPTS[name].check.figures for key in (figure.above, figure.count)} - {""} <= {
            key for row in stored["rows"] for key in row
        }


def test_only_what_a_table_was_made_from_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that evaluations that the stored table lacks are left out, and that all are there without a table."""
    monkeypatch.setattr(check_tables, "RESULTS", tmp_path)
    evaluations = {"a": evetac("evaluate", "slip", "a"), "b": evetac("evaluate", "slip", "b")}
    assert check_tables.made_from("mine", evaluations) == evaluations
    (tmp_path / "mine.json").write_text(json.dumps({"commands": ["evetac evaluate slip b"]}))
    assert check_tables.made_from("mine", evaluations) == {"b": evaluations["b"]}


def test_frozen_models_take_the_place_of_trainings(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that with an archive only the training to be repeated is left, with one seed and what it learns from."""
    monkeypatch.setattr(check_tables, "MODELS", tmp_path)
    strip_model.pack([made.model], tmp_path / "nothing.tar.xz")
    chosen = check_tables.planned("paper-recipe")
    commands = list(chosen.experiment.steps(chosen.sizes))
    trainings = [words for words in commands if words[1] == "train"]
    assert trainings == [chosen.again] and chosen.archives == {"models/nothing": tmp_path / "nothing.tar.xz"}
    assert chosen.again is not None
    assert check_tables.contains(chosen.again, ["--seeds", "1", "--out", "again/models/nothing"])
    assert check_tables.contains(chosen.again, ["--model", "fast-slow", "--horizon-ms", "10"])
    assert any(check_tables.contains(words, ["--out", "nothing/learn"]) for words in commands)
    assert chosen.hours < check_tables.planned("paper-recipe-changes").hours  # of which no archive is there
    strip_model.pack([made.model], tmp_path / "labels.tar.xz")
    assert not check_tables.planned("true-slip-share").archives  # its models/labels are other networks


@pytest.mark.parametrize("same", [True, False])
def test_a_training_again_is_compared(made: Made, tmp_path: Path, *, same: bool) -> None:
    """Assert that an equal network is found by its digest, and that another one is judged on the check's trials."""
    folder = tmp_path
    placed = folder / "models" / "nothing" / "fast-slow-s0.model.h5"
    again = folder / "again" / "models" / "nothing" / "fast-slow.model.h5"
    for path in (placed, again):
        path.parent.mkdir(parents=True)
        shutil.copyfile(made.model, path)
    if not same:
        import h5py

        with h5py.File(again, "r+") as file:
            file["validation/slip_share"][...] = 0.123  # another training
    chosen = check_tables.planned("paper-recipe")
    words = evetac("train", "x.features.h5", "--seeds", 1, "--out", "again/models/nothing")
    chosen = check_tables.replace(chosen, again=words)
    setting = {"setting": "s", "model": "fast-slow", "horizon_ms": 10}
    slips = [{"setting": "s", "timing": "correct", "f1": 1.0, "file": f"{n}", "object": str(n)} for n in range(8)]
    rows = [{**setting, "seeds": 1, "slip_correct": 1.0, "trajectories": 8}, *slips]
    asked: list[list[str]] = []

    def run(command: list[str], where: Path) -> tuple[int, str]:
        asked.append(command)
        return 0, json.dumps({"rows": rows, "summary": {}, "simulated": True})

    evaluations = {name: Evaluation(rows, {}, True) for name in chosen.table.evaluations}
    kept = [{"objects_words": "unseen", "model": "fast-slow", "horizon_ms": 10, "slip_correct": 0.9}]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce, "report_header", lambda path: HEADER)
        found = check_tables.training(chosen, [placed], folder, kept, evaluations, run)
    assert found["equal"] == same and bool(asked) != same
    if not same:
        assert {words[words.index("--model") + 1] for words in asked} == {str(again.relative_to(folder))}
        assert {row["inside"] for row in found["figures"]} == {True}


def not_packed(tables: dict[str, Row], names: set[str]) -> list[str]:
    """The models of frozen tables that are neither packed nor the shipped detector."""
    judged = {name for table in tables.values() if table.get("frozen") for name in table.get("models", {})}
    return sorted(judged - names - {"slip-10ms"})


def test_models_of_frozen_tables_are_packed() -> None:
    """Assert that each model that a frozen table names is in an archive, and that a missing one is found."""
    names = strip_model.names_in(reproduce.MODELS)
    tables = {path.stem: json.loads(path.read_text()) for path in reproduce.RESULTS.glob("*.json")}
    experiments = {name: table for name, table in tables.items() if name in CHECKS and CHECKS[name].training}
    assert not_packed(experiments, names) == []
    doctored = {"a": {"frozen": "f9c755f9", "models": {"nothing/lost-s1": "0"}}}
    assert not_packed(doctored, names) == ["nothing/lost-s1"]


def test_trials_of_slip_are_those_of_their_setting() -> None:
    """Assert that a trajectory has the model, the horizon and the change of its evaluation, and object as unit."""
    rows = [
        {"setting": "s", "model": "hist20", "horizon_ms": 20, "seeds": 5, "slip_correct": 0.5},
        {"setting": "s", "timing": "early", "f1": 0.5, "file": "a", "object": "12"},
        {"setting": "s", "timing": None, "f1": None, "file": "b", "object": "13"},
    ]
    (row,) = slip_trials({"recipe-tracker-unseen": Evaluation(rows, {}, True)})
    assert (row["change_words"], row["objects_words"], row["model"], row["horizon_ms"], row["unit"]) == (
        "tracker `stable`", "unseen", "hist20", 20, "12",
    )  # fmt: skip
    assert (row["slip_correct"], row["slip_early"], row["slip_late"]) == (False, True, False)


def test_trials_of_grasps_are_those_of_their_row() -> None:
    """Assert that grasps with and without gain belong to one row, and that only kept objects have a grip and a way."""
    whole = {"setting": "paper", "columns": 2, "success": 0.5}
    grasp = {"object": "14", "balanced": True, "moved_mm": 2.0, "force_end_n": 1.5}
    trials = [
        {**grasp, "setting": "paper", "file": "a"},
        {**grasp, "setting": "paper, gain 2", "file": "b", "balanced": False},
    ]
    rows = grasp_trials({"grasps-paper": Evaluation([whole, *trials], {}, True)})
    assert {(row["setting"], row["detector"]) for row in rows} == {("paper", DETECTORS["paper"])}
    assert [(row["success"], row["force_end_n"], row["moved_mm_mean"]) for row in rows] == [
        (True, 1.5, 2.0), (False, None, None),
    ]  # fmt: skip


def test_hours_are_summed_over_interrupted_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a run that fails counts too, that experiments are kept apart, and that their hours are added."""
    clock = iter([0.0, 1800.0, 5000.0, 6800.0, 0.0, 36.0])
    monkeypatch.setattr(run_facts, "_processor_s", lambda: next(clock))
    with run_facts.spending(tmp_path, "a"):
        pass
    with pytest.raises(KeyboardInterrupt), run_facts.spending(tmp_path, "a"):
        raise KeyboardInterrupt
    with run_facts.spending(tmp_path, "b"):
        pass
    assert run_facts.hours([(tmp_path, "a")]) == 1.0
    assert run_facts.hours([(tmp_path, "a"), (tmp_path, "b"), (tmp_path / "lost", "c")]) == 1.01


def test_a_table_says_on_what_and_with_what_it_was_made(made: Made, tmp_path: Path) -> None:
    """Assert cores and processor without a host name, models by digest, and the freeze of judging seeds alone."""
    import platform

    on = run_facts.machine()
    assert on["cores"] >= 1 and on["processor"] and platform.node() not in json.dumps(on)
    folder = tmp_path / "models" / "x"
    folder.mkdir(parents=True)
    shutil.copyfile(made.model, folder / "a.model.h5")
    words = evetac("evaluate", "slip", "f.features.h5", "--model", "models", "--recordings", "x")
    files = run_facts.model_files(words, tmp_path)
    assert files == [folder / "a.model.h5"]
    from evetac_cli.store.files import header_of

    id_ = header_of(made.model)["id"]
    assert run_facts.models({id_}, files, tmp_path) == {"x/a": strip_model.digest(made.model)}
    assert run_facts.models({"another"}, files, tmp_path) == {}
    elsewhere = run_facts.models({id_}, files, tmp_path / "y")
    assert list(elsewhere) == ["x/a"]
    judged = run_facts.of_freeze({"sizes": {"recording_seeds": [92_000]}})
    assert judged["frozen"] and isinstance(judged["changed_since"], list)
    assert run_facts.of_freeze({"sizes": {"recording_seeds": [92_000, 5]}}) == {}
    said = run_facts.in_words({"machine": {"cores": 2, "processor": "X", "memory_gb": 8}, "hours": 1.234, **judged})
    assert said.startswith("1.23 core hours; 2 cores of X, 8 GB; methods frozen at f9c755f9")
