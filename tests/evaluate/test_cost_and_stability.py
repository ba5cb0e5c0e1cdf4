"""The commands evaluate cost and evaluate stability: every part measured for real in small, reports, the picture."""

import importlib.util
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli import main
from evetac_cli.console import plain
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common import picture
from evetac_cli.evaluate.common.rows import Extent, draw_panel
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.cost import camera as camera_cost
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.evaluate.cost import simulator as simulator_cost
from evetac_cli.evaluate.stability import EvaluateStability
from evetac_cli.evaluate.stability import cases as stability_cases
from evetac_cli.evaluate.stability import command as stability
from evetac_cli.evaluate.stability import gel as gel_stability
from evetac_cli.evaluate.stability import simulator as simulator_stability
from evetac_cli.inspect import validate
from evetac_cli.jobs import Outcome
from evetac_cli.sim.camera.scanning.camera import CameraModel
from evetac_cli.sim.gel import gel
from evetac_cli.store.files import StageFile
from tests.make import run_stage

needs_matplotlib = pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="needs matplotlib")
BESIDE = picture.beside
SETTINGS = len(camera_cost.SETTINGS)
MECHANICS_ROWS = 3  # of each of 2 ways of unloading and 3 frictions
CAMERA = [
    {"part": "camera", "setting": f"tone, {n} scans", "error_us_median": late, "error_share_count": 0.0,
     "time_us_median": 100.0 * n, "time_us_p99": 200.0 * n}
    for n, late in ((1, 5.0), (2, math.inf), (4, 0.3))
]  # fmt: skip
STAGES = [("cost", cost, EvaluateCost), ("stability", stability, EvaluateStability)]
SLOW = {"cost": pytest.mark.slow}  # takes seconds each time
each = pytest.mark.parametrize(
    ("name", "stage", "cls"),
    [pytest.param(*stage, id=stage[0], marks=SLOW.get(stage[0], ())) for stage in STAGES],
)


def tiny_workloads():
    """Two dots for 5 ms on a circle, before a small camera without noise."""
    dots = np.array([[20.3, 22.6], [60.8, 23.1]])

    def circle(times_ms):
        turn = 2.0 * np.pi * times_ms / 8.0
        return 5.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)

    model = CameraModel(frame_px=(84, 48), noise_rate_hz=0.0, hot_pixels=0)
    return [camera_cost.Workload("circle", model, dots, circle, 5)]


@pytest.fixture(autouse=True)
def small(monkeypatch, tmp_path):
    """In a folder of its own, the least that the part sim can measure, and no pictures: those take longer."""
    trial, cases = simulator_cost.draw_trial, stability.PARTS["sim"].cases
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(picture, "beside", lambda outcome, *_: outcome)
    tiny = {"columns": 8, "rows": 6, "seconds": 0.05}
    monkeypatch.setattr(simulator_cost, "draw_trial", lambda seed: replace(trial(seed), **tiny))
    for name, amount in {
        "STEPS_MS": (1.0, 0.5), "REFERENCE_STEP_MS": 0.25, "REFERENCE_PITCH_MM": 2.5, "PITCHES_MM": (5.0,),
        "TRIALS": 1, "TOLERANCES_UM": (),
    }.items():  # fmt: skip
        monkeypatch.setattr(simulator_cost, name, Extent(amount, amount))
    monkeypatch.setattr(camera_cost, "workloads", tiny_workloads)
    monkeypatch.setattr(simulator_stability, "GEL_STEPS", Extent(2, 2))
    monkeypatch.setattr(gel_stability, "onset_error", lambda *given: ([(stability_cases.ONSET, 0.0)], "not tried"))
    few = stability.PARTS["sim"]._replace(cases=lambda seed, full: cases(seed, full)[::9])
    monkeypatch.setitem(stability.PARTS, "sim", few)


def evaluate(*arguments):
    wide = {"COLUMNS": "400", "TERM": "dumb", "NO_COLOR": "1"}
    return CliRunner().invoke(main.app, ["evaluate", *map(str, arguments)], env=wide)


@each
def test_the_report_is_valid_and_says_simulated(name, stage, cls):
    """Assert that the report holds the rows shown, is valid, has no parents, and says simulated and its parameters."""
    output, outcome = run_stage(stage, [], cls(seed=3))
    assert outcome.made
    assert outcome.simulated
    assert outcome.summary["report"] == str(output)
    assert [row["faults"] for row in validate.run([output]).rows] == [None]
    with StageFile(output, "report") as file:
        assert file.header["simulated"] is True
        assert file.header["parents"] == []
        expected = {"command": f"evaluate {name}", "part": "sim", "seed": 3, "full": False}
        expected |= {"trials": None} if name == "cost" else {}
        assert file.header["parameters"] == expected
        assert json.loads(file.read("rows")) == plain(outcome.rows)
        assert json.loads(file.read("summary")).items() <= plain(outcome.summary).items()


@pytest.mark.slow
def test_cost_of_the_simulator():
    """Assert real rows of mechanics and camera, in this order, with errors that fall the finer a setting is."""
    _, outcome = run_stage(cost, [], EvaluateCost())
    parts = [row["part"] for row in outcome.rows]
    assert parts[-SETTINGS:] == ["camera"] * SETTINGS
    unloaded = parts[:-SETTINGS]
    assert [unloaded.count(part) for part in dict.fromkeys(unloaded)] == [MECHANICS_ROWS] * 6
    for row in outcome.rows:
        assert 0 < row["time_us_median"] <= row["time_us_p99"]
        assert {name for name in row if name.startswith("error_")} < {*cost.PARTS["sim"].errors}
    rows = {row["setting"]: row for row in outcome.rows}
    late_us = [rows[f"circle, 16 sub-steps, {n} scans"]["error_us_median"] for n in (5, 20, 100)]
    assert late_us == sorted(late_us, reverse=True)
    assert late_us[-1] < 20.0
    assert outcome.summary["rows"] == len(outcome.rows)


@needs_matplotlib
def test_a_picture_that_cannot_be_written(tmp_path):
    """Assert that this is an error in words, and leaves nothing behind."""
    (tmp_path / "sim.cost.report.png").mkdir()
    (tmp_path / "sim.cost.report.png" / "x").touch()
    with pytest.raises(InputError, match="sim.cost.report.png: cannot be written"):
        BESIDE(Outcome(CAMERA, True), tmp_path / "sim.cost.report.h5", lambda figure: None, (1.0, 1.0))
    assert [path.name for path in tmp_path.iterdir()] == ["sim.cost.report.png"]


@needs_matplotlib
def test_lines_of_the_picture():
    """Assert a line per setting, and no points for an error of 0 or infinity."""
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    draw_panel(axes, CAMERA, "error_us_median")
    assert axes.lines[0].get_xydata().tolist() == [[100.0, 5.0], [400.0, 0.3]]
    assert axes.lines[0].get_label() == "tone, 1 scans to 4 scans"
    assert axes.get_ylabel() == "error [us]"
    axes = Figure().subplots()
    draw_panel(axes, CAMERA, "error_share_count")
    assert axes.get_legend_handles_labels()[1] == ["real time"]


def rows_by_hand():
    """Three cases of the gel: one within its bounds, one that misses one of two, and one that is refused."""
    residual, energy = (bound._replace(most=1.0) for bound in (stability_cases.BALANCE, stability_cases.ENERGY))

    def refuse():
        raise ValueError("no")

    return [
        lambda: stability_cases.case_rows("a", "10 sweeps", [(residual, 0.5), (energy, 0.1)], part="gel"),
        lambda: stability_cases.case_rows("b", "400 sweeps", [(residual, 2.0), (energy, 0.1)], part="gripper"),
        lambda: stability_cases.run_case("c", refuse, part="gel"),
    ]


@pytest.fixture
def by_hand(monkeypatch):
    """The part `sim` with cases by hand."""
    part = stability.PARTS["sim"]._replace(cases=lambda seed, full: rows_by_hand())
    monkeypatch.setitem(stability.PARTS, "sim", part)


def test_stability_counts_what_is_ok(by_hand):
    """Assert that the summary counts cases, refusals and what is not ok, and that rows that are not ok come first."""
    outcome = run_stage(stability, [], EvaluateStability())[1]
    counts = {"cases": 3, "refused": 1, "measured": 2, "cases_not_ok": 1}
    counts |= {"not_ok_by_part": "gel 0 of 1 (1 refused), gripper 1 of 1"}
    assert outcome.summary.items() >= {**counts, "not_ok": "gripper: b"}.items()
    assert [(row["case"], row["ok"]) for row in outcome.rows] == [
        ("b", False), ("a", True), ("a", True), ("b", True), ("c", True)
    ]  # fmt: skip
    columns = ("part", "case", "ok", "quantity", "value", "bound", "unit", "outcome", "reason")
    assert {tuple(row) for row in outcome.rows} == {columns}


def test_strict(by_hand, tmp_path):
    """Assert that a case that is not ok is printed with exit 0, and with --strict with 1, also from an old report."""
    assert evaluate("stability").exit_code == 0
    for _ in range(2):
        result = evaluate("stability", "--strict")
        assert result.exit_code == 1
        assert "outside their bounds" in result.stderr
        assert "1 of 2 not ok" in result.stderr
        assert "force left unbalanced" in result.stdout
        (tmp_path / "sim.stability.report.h5").unlink(missing_ok=True)
    shown = json.loads(evaluate("stability", "--strict", "--json").stdout)
    assert shown["error"]["exit_status"] == 1
    assert [row["case"] for row in shown["rows"] if not row["ok"]] == ["b"]


def test_a_fault_in_the_gel_is_reported(monkeypatch):
    """Assert that all real cases are ok, and that a step which gives the object energy turns some to not ok."""
    assert run_stage(stability, [], EvaluateStability())[1].summary["not_ok"] is None
    real = gel.step

    def step(state, *given, **changes):
        info = real(state, *given, **changes)
        state.twist += 1.0
        return info

    monkeypatch.setattr(gel, "step", step)
    faulty = run_stage(stability, [], EvaluateStability(seed=1), force=True)[1]
    assert stability_cases.ENERGY.quantity in [row["quantity"] for row in faulty.rows if not row["ok"]]
    assert faulty.summary["cases_not_ok"] > 0
