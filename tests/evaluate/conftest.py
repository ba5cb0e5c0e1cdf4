"""A short grasp and a detector, shared by the tests of grasps."""

import pytest

from evetac_cli.evaluate.cost.grasp import GraspResult, ShortGrasp, run_short_grasp
from evetac_cli.events import Events
from evetac_cli.kernels.grip.control import SlipSignal


class CountingDetector:
    """A detector that counts the slices it is given."""

    def __init__(self) -> None:
        self.slices, self.signal = 0, SlipSignal(mean_displacement_x_px=1.5)

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        self.told = position_ticks, goal_ticks

    def step(self, events: Events | None) -> float:
        self.slices += 1
        return 0.25


@pytest.fixture(scope="package")
def short() -> GraspResult:
    """A short grasp with the package's detector."""
    return run_short_grasp(ShortGrasp(11, "load-proportional", lift_s=1.0, balance_s=0.1), 3)
