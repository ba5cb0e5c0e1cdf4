"""The stages evaluate cost and evaluate stability: reports without inputs, the picture, the commands."""

import importlib.util
import json
import math
import sys
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from evetac_cli import params
from evetac_cli.cli import main
from evetac_cli.console import plain
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.numerics import cost, stability
from evetac_cli.numerics.simulator import gel_cost, gel_stability
from evetac_cli.store.files import StageFile

needs_matplotlib = pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="needs matplotlib")
DRAW = cost._draw
SMALL = gel_cost.Extent((10_000, 5_000), (1_000, 100), 500.0, ((6, 4),), (10, 8))
CAMERA = [
    {"part": "camera", "setting": f"ideal, tone, {n} sub-steps", "error_us_median": late, "error_count_share": 0.0,
     "time_us_median": 100.0 * n, "time_us_p99": 200.0 * n}
    for n, late in ((1, 5.0), (2, math.inf), (4, 0.3))
]  # fmt: skip
STAGES = [("cost", cost, params.EvaluateCost), ("stability", stability, params.EvaluateStability)]
each = pytest.mark.parametrize(("name", "stage", "cls"), STAGES, ids=[stage[0] for stage in STAGES])


@pytest.fixture(autouse=True)
def small(monkeypatch, tmp_path):
    """In a folder of its own, the least that the commands can measure, and no pictures: those take longer."""
    whole, trial = gel_stability.suite, gel_cost.draw_trial
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cost, "_draw", lambda rows, path: True)
    monkeypatch.setattr(gel_cost, "USUAL", SMALL)
    monkeypatch.setattr(gel_cost, "draw_trial", lambda seed: replace(trial(seed), columns=8, rows=6, seconds=0.05))
    monkeypatch.setattr(cost.camera_cost, "camera_cost", lambda seed: [dict(row) for row in CAMERA])
    monkeypatch.setattr(gel_stability, "suite", lambda seed, full: whole(seed, full=full, steps=2)[::9])


@pytest.fixture
def pictures(small, monkeypatch):
    """With pictures after all."""
    monkeypatch.setattr(cost, "_draw", DRAW)


def make(stage, chosen, out=None, **how):
    (job,) = stage.jobs([], chosen, out)
    return job.output, stage.run(job, chosen, **how)


def evetac(*arguments):
    wide = {"COLUMNS": "400", "TERM": "dumb", "NO_COLOR": "1"}
    return CliRunner().invoke(main.app, ["evaluate", *map(str, arguments)], env=wide)


@each
def test_where_the_report_goes(name, stage, cls, tmp_path):
    """Assert that a report goes to the present folder, to the folder given, or is the file given."""
    (job,) = stage.jobs([], cls(), None)
    assert str(job.output) == f"sim.{name}.report.h5"
    assert job.inputs == ()
    assert stage.jobs([], cls(), tmp_path / "a")[0].output == tmp_path / "a" / f"sim.{name}.report.h5"
    assert stage.jobs([], cls(), tmp_path / "b.h5")[0].output == tmp_path / "b.h5"


@each
def test_the_report_is_valid_and_says_simulated(name, stage, cls):
    """Assert that the report holds the rows shown, is valid, has no parents, and says simulated and its parameters."""
    output, outcome = make(stage, cls(seed=3))
    assert outcome.made
    assert outcome.simulated
    assert outcome.summary["report"] == str(output)
    assert [row["faults"] for row in validate.run([output]).rows] == [None]
    with StageFile(output, "report") as file:
        assert file.header["simulated"] is True
        assert file.header["parents"] == []
        expected = {"command": f"evaluate {name}", "part": "sim", "seed": 3, "full": False}
        assert file.header["parameters"] == expected
        assert json.loads(file.read("rows")) == plain(outcome.rows)
        assert json.loads(file.read("summary")).items() <= plain(outcome.summary).items()


@each
def test_a_report_is_kept(name, stage, cls):
    """Assert that the same recipe measures nothing again, and another one is refused until forced."""
    output, first = make(stage, cls())
    before = output.read_bytes()
    _, again = make(stage, cls(), progress=lambda *_: pytest.fail("measured again"))
    assert not again.made
    assert again.simulated
    assert again.rows == plain(first.rows)
    with pytest.raises(InputError, match="another recipe"):
        make(stage, cls(seed=1))
    assert output.read_bytes() == before
    assert make(stage, cls(seed=1), force=True)[1].made


@each
def test_progress_ends_at_its_total(name, stage, cls):
    """Assert that progress rises to the total announced from the start."""
    told = []
    make(stage, cls(), progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))
    assert len({total for _, total in told}) == 1


@each
def test_interruption_leaves_nothing(name, stage, cls, tmp_path):
    """Assert that Ctrl-C while measuring leaves no file."""

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(stage, cls(), progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_cost_rows_are_those_of_mechanics_and_camera():
    """Assert that the rows of both parts are there, in this order, with the figures of the summary."""
    _, outcome = make(cost, params.EvaluateCost())
    assert [row["part"] for row in outcome.rows] == ["mechanics"] * SMALL.rows + ["camera"] * 3
    assert outcome.summary["rows"] == len(outcome.rows)
    assert outcome.summary["explicit_blows_up_at"] == "1 ms, 0.1 ms"
    assert outcome.summary["reference_um_object_at_most"] == outcome.rows[0]["error_um_object_rms"]


def test_what_the_implicit_step_saves():
    """Assert that it is the best explicit run time over the least implicit one of no greater error."""

    def row(setting, error, time_us):
        outcome = "finished" if error else "blew up after 1 ms"
        errors = {"error_um_object_rms": error, "error_um_gel_rms": error}
        return {"part": "mechanics", "setting": setting, **errors, "time_us_median": time_us, "outcome": outcome}

    rows = [
        row("reference: theta 0.51, dt 5 us", 0.01, 1e4),
        row("theta 1, dt 1 ms", 20.0, 10.0),
        row("theta 0.55, dt 1 ms", 9.0, 40.0),
        row("theta 0.55, dt 0.5 ms", 3.0, 80.0),
        row("explicit, dt 10 us", None, 100.0),
        row("explicit, dt 5 us", 100.0, 1000.0),
        row("explicit, dt 1 us", 10.0, 8000.0),
    ]
    summary = cost._summary(rows)
    assert summary["implicit_saves_times"] == 200.0
    assert summary["explicit_blows_up_at"] == "10 us"
    assert cost._summary([rows[0], rows[4]])["implicit_saves_times"] is None
    assert cost._summary([rows[0], rows[1], rows[6]])["implicit_saves_times"] is None


@needs_matplotlib
def test_the_picture_lies_beside_the_report(pictures, tmp_path):
    """Assert that the picture has the report's name, is drawn again only where it is missing, and leaves no trace."""
    output, outcome = make(cost, params.EvaluateCost(), tmp_path / "here.h5")
    picture = tmp_path / "here.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert outcome.summary["plot"] == str(picture)
    written = picture.stat().st_mtime_ns
    assert "plot" not in make(cost, params.EvaluateCost(), output)[1].summary
    assert picture.stat().st_mtime_ns == written
    picture.unlink()
    make(cost, params.EvaluateCost(), output)
    assert picture.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here.h5", "here.png"]


@needs_matplotlib
def test_a_picture_that_cannot_be_written(tmp_path):
    """Assert that this is an error in words, and leaves nothing behind."""
    (tmp_path / "sim.cost.report.png").mkdir()
    (tmp_path / "sim.cost.report.png" / "x").touch()
    with pytest.raises(InputError, match="sim.cost.report.png: cannot be written"):
        DRAW(CAMERA, tmp_path / "sim.cost.report.png")
    assert [path.name for path in tmp_path.iterdir()] == ["sim.cost.report.png"]


@needs_matplotlib
def test_lines_of_the_picture():
    """Assert a panel for each error, a line for each integrator, and no points for a blow-up, 0, or infinity."""
    from matplotlib.figure import Figure

    _, outcome = make(cost, params.EvaluateCost())
    axes = Figure().subplots()
    cost._draw_panel(axes, outcome.rows[: SMALL.rows], "error_um_object_rms")
    labels = axes.get_legend_handles_labels()[1]
    assert labels[:2] == ["bound of the reference's own error", "theta 1, dt 10 to 5 ms"]
    assert not [label for label in labels if "nodes" in label or "layer" in label or "explicit" in label]
    axes = Figure().subplots()
    cost._draw_panel(axes, CAMERA, "error_us_median")
    assert axes.lines[0].get_xydata().tolist() == [[100.0, 5.0], [400.0, 0.3]]
    assert axes.lines[0].get_label() == "ideal, tone, 1 to 4 sub-steps"
    assert axes.get_ylabel() == "error [us]"
    axes = Figure().subplots()
    cost._draw_panel(axes, CAMERA, "error_count_share")
    assert axes.get_legend_handles_labels()[1] == ["real time"]


def test_without_matplotlib(pictures, monkeypatch, tmp_path):
    """Assert that without matplotlib the report is made all the same, and it is said how to get the picture."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    output, outcome = make(cost, params.EvaluateCost())
    assert "evetac[plot]" in outcome.summary["plot"]
    assert [path.name for path in tmp_path.iterdir()] == [output.name]


def test_stability_counts_what_is_ok(monkeypatch):
    """Assert that the summary counts cases, refusals, and names what is not ok."""
    good = {"sweeps_mean": 1.0, "sweeps_most": 1, "residual_most": 1e-9, "energy_gained_j": -1.0}
    rows = [
        {"case": "a", "ok": True, "outcome": "finite", **good},
        {"case": "b", "ok": False, "outcome": "not finite", **good, "residual_most": 1e-3},
        {"case": "c", "ok": True, "outcome": "refused: no", **dict.fromkeys(good)},
    ]
    monkeypatch.setattr(gel_stability, "suite", lambda seed, full: [lambda row=row: row for row in rows])
    summary = make(stability, params.EvaluateStability())[1].summary
    assert summary.items() >= {"cases": 3, "ok": 2, "refused": 1, "not_ok": "b", "residual_most": 1e-3}.items()


@pytest.mark.parametrize("name", ["cost", "stability"])
def test_commands(name):
    """Assert that `evaluate cost sim` prints one JSON object, and that the part may be left out."""
    result = evetac(name, "sim", "--json")
    assert result.exit_code == 0, result.output
    shown = json.loads(result.stdout, parse_constant=pytest.fail)
    assert (shown["command"], shown["simulated"]) == (f"evaluate {name}", True)
    assert len(shown["rows"]) > 10
    result = evetac(name)
    assert result.exit_code == 0
    assert f"evaluate {name} (simulated)" in result.stdout
    assert "up to date" in result.stderr


@pytest.mark.parametrize("name", ["cost", "stability"])
@pytest.mark.parametrize("given", [["simm"], ["sim", "sim"], ["sim", "--seed", "-1"], ["--part", "sim"]])
def test_wrong_arguments(name, given, tmp_path):
    """Assert that another part, two parts, and a part as a flag are refused before any work."""
    result = evetac(name, *given)
    assert result.exit_code == 2
    assert (result.stdout, list(tmp_path.iterdir())) == ("", [])
    if given == ["simm"]:
        assert "PART: unknown value" in result.stderr
        assert "did you mean sim?" in result.stderr


def test_help_names_the_part():
    """Assert that the help lists PART as an argument, which is not a flag."""
    text = evetac("cost", "--help").output
    assert "[PART]" in text
    assert "--part" not in text


def test_config_file(tmp_path):
    """Assert that part, seed and full come from a config file too, and a flag goes before it."""
    config = tmp_path / "c.toml"
    config.write_text('[evaluate.stability]\npart = "sim"\nseed = 5\n')
    assert evetac("stability", "--config", config).exit_code == 0
    with StageFile(tmp_path / "sim.stability.report.h5") as file:
        assert file.header["parameters"]["seed"] == 5
    assert evetac("stability", "--config", config, "--seed", 6, "--force").exit_code == 0
    with StageFile(tmp_path / "sim.stability.report.h5") as file:
        assert file.header["parameters"]["seed"] == 6
