"""A pad in balance under a disc that sticks to it: what its force is on the exact layer, and what pressure does."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.gel_layer import Squeeze, moved_by
from evetac_cli.sim.gel import contact, gel
from tests.sim.gel.dense_layer import dense_layer

HEIGHT_M = gel.GelMaterial().height_m


def under(nodes: Any, radius_m: float, x_m: float = 0.0, y_m: float = 0.0) -> Any:
    """Which nodes a disc is on."""
    return np.linalg.norm(nodes - (x_m, y_m), axis=2) < radius_m


def test_what_sticks_stays_and_the_rest_is_squeezed_outwards() -> None:
    """Assert that the loaded part stays under pressure and moves with the object, and that gel beside it gives way."""
    nodes = contact.pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    sticks, depth_m = under(nodes, 5e-3), 0.2e-3
    squeezed_m2 = Squeeze(nodes, HEIGHT_M).of(7.0 * contact.cell_area(nodes) / HEIGHT_M * depth_m * sticks)
    moved = moved_by(nodes, HEIGHT_M, sticks, squeezed_m2)
    squeezed_m, share = moved[..., 0], moved[..., 1:]
    assert not squeezed_m[sticks].any()
    np.testing.assert_array_equal(share[sticks], np.broadcast_to(np.eye(2), share[sticks].shape))
    outwards = (squeezed_m * nodes).sum(axis=2) / np.linalg.norm(nodes, axis=2)
    assert (outwards[~sticks & under(nodes, 7e-3)] > 0).all()
    assert np.abs(squeezed_m).max() < 0.5 * depth_m


@pytest.mark.parametrize("radius_m", [3e-3, 6e-3])
def test_a_disc_takes_up_to_a_tenth_less_force_than_on_the_exact_layer(radius_m: float) -> None:
    """Assert that to move a disc on a large pad takes 90 to 97 % of the force that the exact layer asks for.

    The rest is at the disc's border, where waves are shorter than the sheet inside the gel answers.
    """
    nodes = contact.pad_nodes(32, 24, (-20e-3, 20e-3), (-15e-3, 15e-3))
    disc = under(nodes, radius_m, 1e-3, 0.5e-3)
    share = moved_by(nodes, HEIGHT_M, disc, np.zeros_like(nodes))[..., 1:]
    state = gel.start(nodes, gel.GelMaterial(), 0.1, 1e-5)
    answer_m = share.sum(axis=(0, 1)) * state.cell_area_m2 / HEIGHT_M
    stiffness = dense_layer(state, 2).stiffness
    sticks = np.tile(disc.ravel(), 2)
    along = np.arange(len(sticks)) < disc.size
    exact = np.zeros((len(sticks), 2))
    exact[sticks & along, 0] = exact[sticks & ~along, 1] = 1.0
    exact[~sticks] = np.linalg.solve(stiffness[~sticks][:, ~sticks], -stiffness[~sticks][:, sticks] @ exact[sticks])
    force_m = np.stack([part.sum(axis=0) for part in np.split(stiffness @ exact, 2)]) / state.material.shear_modulus_pa
    assert 0.9 < answer_m.trace() / force_m.trace() < 0.97
