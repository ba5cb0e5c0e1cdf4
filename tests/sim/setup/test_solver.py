"""Settings of the simulation: what is refused, which takes the place of which, and what they come to."""

import pytest

from evetac_cli.sim.setup.solver import Solver, with_given
from evetac_cli.sim.setup.tables import as_table


def test_a_step_takes_the_place_of_a_tolerance_and_the_other_way() -> None:
    """Assert that of a tolerance and a fixed step the one that is given holds, whatever the scene names."""
    fixed = with_given(Solver(tolerance_um=0.05), {"step_ms": 0.5}, "here")
    assert fixed.step_ms == 0.5
    assert "tolerance_um" not in as_table(fixed)
    adaptive = with_given(Solver(step_ms=0.5, theta=0.6), {"tolerance_um": 0.05}, "here")
    assert (adaptive.tolerance_um, adaptive.theta) == (0.05, 0.6)
    assert "step_ms" not in as_table(adaptive)


@pytest.mark.parametrize(("tolerance_um", "halvings"), [(0.2, 3), (0.1, 4), (0.05, 5), (1e-9, 7), (0.4, 2), (1e3, 0)])
def test_a_smaller_tolerance_may_halve_more_often(tolerance_um: float, halvings: int) -> None:
    """Assert how often a slice may be halved at a tolerance."""
    assert Solver(tolerance_um=tolerance_um).halvings == halvings


@pytest.mark.parametrize(
    ("pitch_mm", "nodes"), [(0.833, (24, 18)), (1.45, (14, 10)), (0.67, (30, 22)), (1.667, (12, 9)), (5.0, (4, 3))]
)
def test_nodes_of_a_pitch(pitch_mm: float, nodes: tuple[int, int]) -> None:
    """Assert how many nodes a pad of 20 x 15 mm has at a pitch."""
    assert Solver(node_pitch_mm=pitch_mm).nodes((20e-3, 15e-3)) == nodes
