"""The part `model`: the Pareto front, what is timed, figures as in evaluate slip, the command."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.common import rows
from evetac_cli.evaluate.cost import EvaluateCost, models
from evetac_cli.evaluate.cost import command as cost
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.inspect import validate
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.detector import LiveDetector
from evetac_cli.store.files import StageFile
from tests.evaluate.slip.test_measure import features_file, trained
from tests.make import run_stage


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Features to evaluate on, two seeds of one model, and another that predicts every 5th slice."""
    folder = tmp_path_factory.mktemp("cost")
    learn = [features_file(folder, number, object_=1) for number in range(2)]
    return {
        "features": [features_file(folder, 100 + number, object_=1 + number) for number in range(2)],
        "seeds": trained(learn, folder / "seeds", seeds=2),
        "down5": trained(learn, folder / "down5", model="down5"),
    }


def evaluated(files: dict[str, list[Path]], models: list[Path], out: Path) -> Path:
    """The report of evaluate slip on these models."""
    params = EvaluateSlip()
    run_stage(slip, [*files["features"], *models], params, out)
    return out


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time a few repeats."""
    monkeypatch.setattr(models, "REPEATS", 5)


def make(inputs: list[Path], out: Path, **values: Any) -> Any:
    params = EvaluateCost(part="model", **values)
    return run_stage(cost, inputs, params, out)[1]


def points(*values: tuple[float | None, float], horizon_ms: int = 0) -> list[dict[str, Any]]:
    task = {"horizon_ms": horizon_ms}
    return [{**task, "error_share_f1": error, "time_us_median": time_us} for error, time_us in values]


def test_front_by_hand() -> None:
    """Assert the front of a handmade case: equals both count, what is unknown does not, and neither do the beaten."""
    rows = points((0.5, 1.0), (0.5, 1.0), (0.2, 2.0), (0.2, 3.0), (0.4, 2.0), (None, 0.1), (0.1, 9.0))
    assert models.front(rows, "error_share_f1") == [True, True, True, False, False, False, True]


def test_tasks_have_fronts_of_their_own() -> None:
    """Assert that a detector of slip now is not beaten by one that warns ahead, and the other way round."""
    tasks = points((0.1, 1.0), (0.5, 2.0)) + points((0.3, 5.0), (0.4, 6.0), horizon_ms=10)
    assert models.front(tasks, "error_share_f1") == [True, False, True, False]


def test_timed_repeats() -> None:
    """Assert that fewer repeats are timed where the time is over, but never fewer than the fewest."""
    calls = []
    assert len(rows.timed_us(lambda: calls.append(0), repeats=70, longest_s=60.0)) == 70
    assert len(calls) == 70 + rows.WARM_UP
    assert len(rows.timed_us(lambda: None, repeats=1000, longest_s=0.0)) == rows.FEWEST


@pytest.fixture(scope="module")
def untrained() -> list[models.Candidate]:
    """With weights that are the same each time: with some, a network says the same of all slices (2 of 25 down5)."""
    import torch

    with torch.random.fork_rng():
        torch.manual_seed(0)
        return models._untrained()


def test_every_architecture_is_a_candidate(untrained: list[models.Candidate]) -> None:
    """Assert that without models all architectures are there, with the paper's numbers of parameters."""
    assert [candidate.setting for candidate in untrained] == list(ARCHITECTURES)
    parameters = {candidate.setting: candidate.parameters for candidate in untrained}
    expected = {"no-hist": 14_895, "hist10": 15_125, "hist20": 16_385, "fast-slow": 15_990}
    assert {name: parameters[name] for name in expected} == expected


@pytest.mark.parametrize("name", ["fast-slow", "down5", "load-path", "hist10-img-6x6"])
def test_a_step_is_a_whole_one(untrained: list[models.Candidate], monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Assert that a timed step tracks 500 events, and predicts as often as the network does."""
    (candidate,) = (one for one in untrained if one.setting == name)
    seen: list[int] = []
    said: list[float] = []
    tracked: list[int] = []
    inner = LiveDetector.step

    def step_live(self: LiveDetector, x: Any, y: Any, p: Any) -> float:
        seen.append(len(x))
        said.append(inner(self, x, y, p))
        tracked.append(int(self.tracking.record["slices"][0]))
        return said[-1]

    step: Callable[[], Any] = models._grasp_step(candidate, np.random.default_rng(0))
    monkeypatch.setattr(LiveDetector, "step", step_live)
    for _ in range(11):
        step()
    assert seen == [500] * 11
    assert np.diff(tracked).tolist() == [1] * 10
    assert np.count_nonzero(np.diff(np.nan_to_num(said))) == 10 / candidate.detector.architecture.every


def test_figures_are_those_of_evaluate_slip(files: dict[str, list[Path]], quick: None, tmp_path: Path) -> None:
    """Assert that seeds share a row, whose figures are those of evaluate slip, and one timing for equal networks."""
    models = [*files["seeds"], *files["down5"]]
    report = evaluated(files, models, tmp_path / "b.report.h5")
    outcome = make([report, *models], tmp_path / "a.report.h5")
    with StageFile(report, "report") as file:
        expected = [row for row in json.loads(file.read("rows")) if "seeds" in row]
    for row, other in zip(outcome.rows, expected, strict=True):
        assert {key: row[key] for key in ("setting", "seeds", "slip_correct", "f1")} == {
            key: other[key] for key in ("setting", "seeds", "slip_correct", "f1")
        }
        assert row["error_share_f1"] == 1 - row["f1"]
        assert 0 < row["time_us_median"] <= row["time_us_p99"]
        assert 0 < row["step_us_median"] <= row["step_us_p99"]
    assert any(row["pareto_f1"] for row in outcome.rows)
    assert {name for name in outcome.rows[0] if name.startswith("error_")} == set(cost.PARTS["model"].errors)
    assert [row["faults"] for row in validate.run([tmp_path / "a.report.h5"]).rows] == [None]
    with StageFile(files["seeds"][0], "model") as model:
        weights = {name: shape for name, (_, shape) in model.contents().items() if name.startswith("weights/")}
    trained_numbers = sum(int(np.prod(shape)) for name, shape in weights.items() if "input_" not in name)
    assert outcome.rows[0]["parameters"] == trained_numbers == 14_895
