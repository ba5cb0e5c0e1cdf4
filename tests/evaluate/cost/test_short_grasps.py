"""Short grasps in memory, and the detectors that stand between the network and the controller in them."""

import numpy as np
import pytest

from evetac_cli.evaluate.cost.short_grasps import (
    FixedDetector,
    GraspResult,
    ShortGrasp,
    run_short_grasp,
)
from evetac_cli.kernels.grip.control import SlipSignal
from tests.evaluate.conftest import CountingDetector


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
