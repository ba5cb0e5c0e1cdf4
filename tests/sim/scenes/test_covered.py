"""Shares of cells under a face, wherever it lies, and even motion."""

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel.contact import pad_nodes
from evetac_cli.sim.scenes.covered import NO_HOLE, covered

NODES = pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
FACES: dict[str, tuple[tuple[float, float], bool, Floats]] = {  # half sides, round, hole
    "rectangle": ((5.3e-3, 3.1e-3), False, NO_HOLE),
    "disc": ((4.7e-3, 4.7e-3), True, NO_HOLE),
    "ellipse": ((6.1e-3, 3.9e-3), True, NO_HOLE),
    "ring": ((6.1e-3, 4.5e-3), True, np.array([4.8e-3, 3.2e-3])),
}


@pytest.mark.parametrize("name", FACES)
def test_each_cell_is_that_of_its_points(name: str) -> None:
    """Assert that no cell is off by more than 4 % of it from the share of 32 x 32 points inside the face."""
    half_m, is_round, hole_m = FACES[name]
    fine = (np.arange(32) + 0.5) / 32 - 0.5
    pitch_m = NODES[1, 1] - NODES[0, 0]
    points = NODES[:, :, None, None, :] + np.stack(np.meshgrid(fine, fine), axis=-1) * pitch_m

    def inside(half: Floats, from_middle: Floats) -> Floats:
        scaled = np.abs(from_middle) / half
        result: Floats = (np.hypot(*np.moveaxis(scaled, -1, 0)) if is_round else scaled.max(axis=-1)) < 1.0
        return result

    for place_m in np.random.default_rng(1).uniform(-2e-3, 2e-3, (5, 2)):
        wanted = inside(np.array(half_m), points - place_m)
        if len(hole_m):
            wanted &= ~inside(hole_m, points - place_m)
        shares = covered(NODES, place_m, np.array(half_m), is_round=is_round, hole_m=hole_m)
        np.testing.assert_allclose(shares, wanted.mean(axis=(2, 3)), atol=0.04)


def test_a_face_that_moves_takes_up_cells_evenly() -> None:
    """Assert that a disc which moves by a tenth of a cell a step changes no cell by more than a fifth of it."""
    pitch_m = float(NODES[0, 1, 0] - NODES[0, 0, 0])
    places = [np.array([share * pitch_m, 0.3e-3]) for share in np.linspace(-2.0, 2.0, 41)]
    shares = np.array([covered(NODES, place, np.full(2, 4.7e-3), is_round=True) for place in places])
    assert 0.05 < np.abs(np.diff(shares, axis=0)).max() < 0.2
    assert not covered(NODES, np.array([1.0, 0.0]), np.full(2, 4.7e-3), is_round=True).any()
