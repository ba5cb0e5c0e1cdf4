"""The cut edge of a gel as its camera places it, and a sensor with all that a row can name of a camera."""

import numpy as np
import pytest

from evetac_cli.events import concatenate
from evetac_cli.sim.camera.gel_camera import CUT_NODES, _moved_cut
from evetac_cli.sim.setup.plan import one_sensor
from tests.sim.camera.gel_cameras import gel_camera


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


def test_realistic_sensor_sees_the_gel_move() -> None:
    """Assert that dots of the sensor `realistic` make ON and OFF events at their rims, the same when made again."""
    sensor = one_sensor("realistic")
    made = []
    for _ in range(2):
        realistic = gel_camera(sensor, cut=True)
        shift_m, cut_m = np.zeros_like(realistic.rest_m), np.zeros_like(realistic.cut_rest_m)
        slices = []
        for k in range(40):
            shift_m, cut_m = shift_m + [2e-6, 0.0], cut_m + [2e-6, 0.0]
            slices.append(realistic.render(shift_m, np.zeros(2), 0.0, 1000 * k, cut_m=cut_m))
        made.append(concatenate(slices))
        assert np.abs(realistic.dot_xy_px - realistic.grid_xy_px.reshape(-1, 2)).max() > 2.0
    assert all((one == other).all() for one, other in zip(*made, strict=True))
    at_px = np.stack([made[0].x, made[0].y], axis=1).astype(float)
    near = np.linalg.norm(at_px[:, None] - realistic.dot_xy_px, axis=2).min(axis=1)
    at_rims = (near > sensor.dot_radius_px - 6.0) & (near < sensor.dot_radius_px + 8.0)
    assert at_rims.mean() > 0.7
    assert 0.25 < made[0].p[at_rims].mean() < 0.75
