"""What grasps lose by delays and other detectors: figures by hand, and a report of real short grasps."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli import resources
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.cost import EvaluateCost, command
from evetac_cli.evaluate.cost import grasp as cost
from evetac_cli.evaluate.cost.grasp import (
    FixedDetector,
    GraspResult,
    ShortGrasp,
    run_short_grasp,
)
from evetac_cli.inspect import validate
from evetac_cli.kernels.grip.control import SlipSignal
from tests.evaluate.conftest import CountingDetector


def test_cost_of_a_late_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert a row for every setting and controller, with errors over the trials that held their object."""

    def late_is_lost(short: ShortGrasp, *_: object, **__: object) -> GraspResult:
        figures = {"balanced": short.latency_ms <= 10, "moved_mm": 0.1 * short.latency_ms, "force_end_n": 1.0}
        return GraspResult(figures, {}, np.full(100, 90.0))

    monkeypatch.setattr(cost, "run_short_grasp", late_is_lost)
    reports: list[tuple[int, int]] = []
    measured = cost.measure(EvaluateCost(part="grasp"), (), lambda done, total: reports.append((done, total)))
    rows = {row["setting"]: row for row in measured}
    assert len(rows) == 2 * (1 + 4 + 3 + 1)
    assert reports[-1] == (len(rows), len(rows))
    assert rows["paper, latency 5 ms"]["error_mm_moved"] == pytest.approx(0.5)
    assert rows["load-proportional, latency 50 ms"]["error_share_lost"] == 1.0
    assert rows["load-proportional, latency 50 ms"]["error_mm_moved"] is None
    assert rows["load-proportional, detector truth"]["time_us_median"] == 90.0


@pytest.mark.slow
def test_a_real_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the report and picture of two settings, of which the object that no controller holds is lost."""
    for name, amount in {
        "OBJECTS": (11,), "CONTROLLERS": ("none", "load-proportional"), "LATENCIES_MS": (), "RATES_HZ": (),
    }.items():  # fmt: skip
        monkeypatch.setattr(cost, name, Extent(amount, amount))
    monkeypatch.setattr(cost, "BALANCE_S", 0.1)
    chosen = EvaluateCost(part="grasp")
    (job,) = command.jobs([], chosen, tmp_path)
    assert job.output.name == "grasp.cost.report.h5"
    outcome = command.run(job, chosen)
    rows = {row["setting"]: row for row in outcome.rows}
    assert list(rows) == [
        f"{controller}, {setting}"
        for controller in ("none", "load-proportional")
        for setting in ("500 Hz, no latency", "detector truth")
    ]
    assert rows["none, 500 Hz, no latency"]["error_share_lost"] == 1.0
    assert rows["load-proportional, 500 Hz, no latency"]["error_share_lost"] == 0.0
    assert 0 < rows["load-proportional, detector truth"]["error_mm_moved"] < cost.LOST_MM
    assert all(0 < row["time_us_median"] <= row["time_us_p99"] for row in outcome.rows)
    assert outcome.summary.items() >= {"settings": 4, "trials": 4}.items()
    assert [row["faults"] for row in validate.run([job.output]).rows] == [None]
    assert outcome.simulated
    assert {name for name in outcome.rows[0] if name.startswith("error_")} == set(command.PARTS["grasp"].errors)


def test_detectors_to_compare_with(tmp_path: Path) -> None:
    """Assert that --model names a file, all of a folder, or a glob, beside the package's model; files are refused."""
    models = [tmp_path / f"{name}.model.h5" for name in "ab"]
    for path in models:
        path.touch()
    assert cost.inputs([], None) == (resources.MODEL,)
    assert cost.inputs([], tmp_path) == cost.inputs([], tmp_path / "*.model.h5") == (resources.MODEL, *models)
    assert cost.inputs([], models[1]) == (resources.MODEL, models[1])
    assert [setting.name for setting in cost.settings(False, models)][-2:] == ["detector a", "detector b"]
    with pytest.raises(InputError):
        cost.inputs([tmp_path / "x.features.h5"], None)


def test_a_short_grasp(short: GraspResult) -> None:
    """Assert that it lifts, that the rows are those of a recording, and that every slice was timed."""
    assert short.rows["truth/table_gap_mm"][-1] > 5.0
    assert len(short.detector_us) == len(short.rows["truth/table_gap_mm"]) == 1500 + 1000 + 100
    assert (short.detector_us > 0).all()
    assert "events/t" not in short.rows


def test_a_lost_object_ends_it() -> None:
    """Assert that a grasp ends soon after the hand has left its object behind."""
    result = run_short_grasp(ShortGrasp(11, "none", balance_s=30.0), 3)
    moved_mm = np.hypot(*result.rows["truth/object_xy_px"].T) * 0.0329
    assert 20.0 < moved_mm[-1] < 30.0
    assert len(moved_mm) < 5000
    assert not result.figures["lifted"]


@pytest.mark.parametrize("slip", [True, False])
def test_a_fixed_detector(slip: bool) -> None:
    """Assert that its decision is the one given, and its displacements are the detector's own."""
    detector = FixedDetector(CountingDetector(), lambda: slip)
    assert [detector.step(None) for _ in range(3)] == [float(slip)] * 3
    assert detector.signal == SlipSignal(3 * slip, mean_displacement_x_px=1.5)
