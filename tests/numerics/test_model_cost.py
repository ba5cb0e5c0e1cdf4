"""evaluate cost model: the Pareto front, what is timed, figures as in evaluate slip, the command."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli import main
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.numerics import cost, model_cost
from evetac_cli.params import EvaluateCost, EvaluateSlip
from evetac_cli.stages.evaluate import slip
from evetac_cli.store.files import StageFile
from tests.stages.evaluate.test_slip import features_file, trained


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Features to be judged on, two seeds of one model, and another that predicts every 5th slice."""
    folder = tmp_path_factory.mktemp("cost")
    learn = [features_file(folder, number, object_=1) for number in range(2)]
    return {
        "features": [features_file(folder, 100 + number, object_=1 + number) for number in range(2)],
        "seeds": trained(learn, folder / "seeds", seeds=2),
        "down5": trained(learn, folder / "down5", model="down5"),
    }


def judged(world: dict[str, list[Path]], models: list[Path], out: Path) -> Path:
    """The report of evaluate slip on these models."""
    params = EvaluateSlip()
    (job,) = slip.jobs([*world["features"], *models], params, out)
    slip.run(job, params)
    return out


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time a few repeats."""
    whole = model_cost.timed
    monkeypatch.setattr(model_cost, "timed", lambda act: whole(act, repeats=5, longest_s=0.0))


def make(files: list[Path], out: Path, **values: Any) -> Any:
    params = EvaluateCost(part="model", **values)
    (job,) = cost.jobs(files, params, out)
    return cost.run(job, params)


def rows_of(*points: tuple[float | None, float]) -> list[dict[str, Any]]:
    return [{"error_share_f1": error, "time_us_median": time_us} for error, time_us in points]


def test_front_by_hand() -> None:
    """Assert the front of a handmade case: equals both count, what is unknown does not, and neither do the beaten."""
    rows = rows_of((0.5, 1.0), (0.5, 1.0), (0.2, 2.0), (0.2, 3.0), (0.4, 2.0), (None, 0.1), (0.1, 9.0))
    assert model_cost.front(rows, "error_share_f1") == [True, True, True, False, False, False, True]


def test_front_holds_the_best_of_both() -> None:
    """Assert that least error and least time are on the front, and that nothing on it is beaten in both."""
    rng = np.random.default_rng(0)
    rows = rows_of(*((float(error), float(time_us)) for error, time_us in rng.random((50, 2))))
    on = [row for row, best in zip(rows, model_cost.front(rows, "error_share_f1"), strict=True) if best]
    for figure in ("error_share_f1", "time_us_median"):
        assert min(row[figure] for row in rows) == min(row[figure] for row in on)
    on.sort(key=lambda row: row["time_us_median"])
    errors = [row["error_share_f1"] for row in on]
    assert errors == sorted(errors, reverse=True)


def test_timed_repeats() -> None:
    """Assert that fewer repeats are timed where the time is over, but never fewer than the fewest."""
    calls = []
    assert len(model_cost.timed(lambda: calls.append(0), repeats=70, longest_s=60.0)) == 70
    assert len(calls) == 70 + model_cost.WARM
    assert len(model_cost.timed(lambda: None, repeats=1000, longest_s=0.0)) == model_cost.FEWEST


@pytest.fixture(scope="module")
def untrained() -> list[model_cost.Candidate]:
    return model_cost._untrained()


def test_every_architecture_is_a_candidate(untrained: list[model_cost.Candidate]) -> None:
    """Assert that without models all architectures are there, with the paper's numbers of parameters."""
    assert [candidate.setting for candidate in untrained] == list(ARCHITECTURES)
    found = {candidate.setting: candidate.parameters for candidate in untrained}
    expected = {"no-hist": 14_895, "hist10": 15_125, "hist20": 16_385, "fast-slow": 15_990}
    assert {name: found[name] for name in expected} == expected


@pytest.mark.parametrize("name", ["fast-slow", "down5", "disp-xy", "hist10-img-6x6"])
def test_a_step_is_a_whole_one(
    untrained: list[model_cost.Candidate], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Assert that a timed step runs the tracker on 500 events, and the network as often as it predicts."""
    (candidate,) = (one for one in untrained if one.setting == name)
    seen: list[int] = []
    judged: list[Any] = []
    inner, outer = Detector.probability, model_cost.tracker.step

    def judge(self: Detector, batch: Any) -> Any:
        judged.append(batch)
        return inner(self, batch)

    def track(state: Any, x: Any, *rest: Any) -> None:
        seen.append(len(x))
        outer(state, x, *rest)

    step: Callable[[], Any] = model_cost._one_step(candidate, np.random.default_rng(0))
    monkeypatch.setattr(Detector, "probability", judge)
    monkeypatch.setattr(model_cost.tracker, "step", track)
    for _ in range(10):
        step()
    assert seen == [500] * 10
    assert len(judged) == 10 / candidate.detector.architecture.every


def test_figures_are_those_of_evaluate_slip(world: dict[str, list[Path]], quick: None, tmp_path: Path) -> None:
    """Assert that seeds share a row, whose figures are those of evaluate slip, and one timing for equal networks."""
    models = [*world["seeds"], *world["down5"]]
    report = judged(world, models, tmp_path / "b.report.h5")
    outcome = make([report, *models], tmp_path / "a.report.h5")
    with StageFile(report, "report") as file:
        wanted = [row for row in json.loads(file.read("rows")) if "seeds" in row]
    for row, other in zip(outcome.rows, wanted, strict=True):
        assert {key: row[key] for key in ("setting", "seeds", "slip_correct", "f1")} == {
            key: other[key] for key in ("setting", "seeds", "slip_correct", "f1")
        }
        assert row["error_share_f1"] == 1 - row["f1"]
        assert 0 < row["time_us_median"] <= row["time_us_p99"]
        assert 0 < row["step_us_median"] <= row["step_us_p99"]
    assert any(row["pareto_f1"] for row in outcome.rows)
    assert [row["faults"] for row in validate.run([tmp_path / "a.report.h5"]).rows] == [None]
    with StageFile(world["seeds"][0], "model") as model:
        weights = {name: shape for name, (_, shape) in model.contents().items() if name.startswith("weights/")}
    trained_numbers = sum(int(np.prod(shape)) for name, shape in weights.items() if "input_" not in name)
    assert outcome.rows[0]["parameters"] == trained_numbers == 14_895


def test_where_reports_go(world: dict[str, list[Path]], tmp_path: Path) -> None:
    """Assert that the report lies beside that of evaluate slip, or without files in the present folder."""
    report = judged(world, world["seeds"], tmp_path / "unseen.slip.report.h5")
    (job,) = cost.jobs([report, *world["seeds"]], EvaluateCost(part="model"), None)
    assert job.output == tmp_path / "unseen.slip.cost.report.h5"
    (job,) = cost.jobs([], EvaluateCost(part="model"), None)
    assert (job.inputs, str(job.output)) == ((), "model.cost.report.h5")


def test_what_is_refused(world: dict[str, list[Path]], tmp_path: Path) -> None:
    """Assert that files for another part, models without their report, and reports on others are errors."""
    with pytest.raises(InputError, match="only the part model"):
        cost.jobs(world["features"], EvaluateCost(part="sim"), tmp_path)
    with pytest.raises(InputError, match="no model file"):
        cost.jobs(world["features"], EvaluateCost(part="model"), tmp_path)
    for others in ([], world["features"]):
        with pytest.raises(InputError, match="one report of `evaluate slip`"):
            cost.jobs(others, EvaluateCost(part="model", model=world["seeds"][0]), tmp_path)
    with pytest.raises(InputError, match="wrong kind of file"):
        make([world["features"][0], *world["seeds"]], tmp_path / "c.report.h5")
    report = judged(world, world["seeds"], tmp_path / "b.report.h5")
    for models, shared in ((world["down5"], 0), (world["seeds"][:1], 1), ([*world["seeds"], *world["down5"]], 2)):
        with pytest.raises(InputError, match=f"on 2 models, {shared} of these"):
            make([report, *models], tmp_path / "c.report.h5")
    make([], tmp_path / "d.report.h5")
    with pytest.raises(InputError, match="evaluate cost, on 0 models"):
        make([tmp_path / "d.report.h5", *world["seeds"]], tmp_path / "c.report.h5")


def test_the_command(world: dict[str, list[Path]], quick: None, tmp_path: Path) -> None:
    """Assert that `evaluate cost model REPORT --model MODELS` takes the part first, and leaves report and picture."""
    report = judged(world, world["seeds"], tmp_path / "b.report.h5")
    files = [str(report), "--model", *map(str, world["seeds"])]
    out = tmp_path / "c.report.h5"
    shown = CliRunner().invoke(main.app, ["evaluate", "cost", "model", *files, "-o", str(out), "--json", "--quiet"])
    answer = json.loads(shown.stdout)
    assert answer["simulated"]
    assert [row["seeds"] for row in answer["rows"]] == [2]
    pytest.importorskip("matplotlib")
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
