"""The cut edge of a gel as its camera places it."""

import numpy as np
import pytest

from evetac_cli.sim.camera.gel_camera import CUT_NODES, _moved_cut


@pytest.mark.parametrize("seed", range(3))
def test_cut_edge_moves_as_between_its_nodes(seed: int) -> None:
    """Assert that every row of a cut edge moves as numpy.interp has it between the nodes around it, to the bit."""
    rng = np.random.default_rng(seed)
    mm_per_px = rng.uniform(0.03, 0.06)
    rest_px = np.linspace(*(540.0 + rng.normal(0.0, 1.0, 2)), 480)
    rows = np.linspace(0.0, 479.0, CUT_NODES)
    cut_m = rng.normal(0.0, 1e-4, (CUT_NODES, 2))
    expected = rest_px + np.interp(np.arange(480.0), rows, cut_m[:, 0] * 1e3 / mm_per_px)
    np.testing.assert_array_equal(_moved_cut(rest_px, rows, cut_m, mm_per_px), expected)
