"""Contacts in balance that the network of forces learns from: the gel's own, reciprocal, mirrored, and their forces."""

from typing import Any

import numpy as np
import pytest

from evetac_cli.evaluate.cost.gel_reference import dense_layer
from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages.force import static_contacts

HEIGHT_M = static_contacts.HEIGHT_M
NODES = contact.pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
SENSOR = one_sensor("evetac")
RATIO = SENSOR.normal_modulus_pa / SENSOR.shear_modulus_pa


@pytest.fixture(autouse=True)
def sticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """No contact has slipped."""
    monkeypatch.setattr(static_contacts, "SLIPPING_SHARE", 0.0)


def disc(nodes: Any, radius_m: float, x_m: float = 0.0, y_m: float = 0.0) -> Any:
    """Indentation of a flat disc pressed in at a place, in m."""
    return 0.2e-3 * (np.linalg.norm(nodes - (x_m, y_m), axis=2) < radius_m)


def moved(depth_m: Any) -> tuple[Any, Any, Any]:
    return static_contacts._moved(NODES, depth_m, RATIO, np.random.default_rng(0))


def test_contacts_are_those_of_the_gel() -> None:
    """Assert that a gel pressed by a glued disc, and then moved with it, ends where `static_contacts` has it."""
    depth_m = disc(NODES, 5e-3, 2e-3, -1e-3)
    squeezed_m, share, held_m2 = moved(depth_m)
    dry = gel.GelMaterial(viscous_time_s=0.0, maxwell_share=0.0, with_mass=False)
    state = gel.start(NODES, dry, 0.1, 1e-5, pads=1)
    normal_n = SENSOR.normal_modulus_pa / HEIGHT_M * state.cell_area_m2 * depth_m
    to_m = np.array([30e-6, -20e-6])

    def hold(speed_m_s: Any) -> gel.StepInfo:
        twist = (*speed_m_s, 0.0)
        glue = gel.Friction(10, 10)
        return gel.step(state, normal_n, (0, 0, 0), glue, 1.0, theta=1.0, tolerance=1e-12, prescribed_twist=twist)

    pressed = hold((0.0, 0.0))
    most_m = np.abs(squeezed_m).max()
    np.testing.assert_allclose(state.displacement_m, squeezed_m, atol=1e-4 * most_m)
    sheared = hold(to_m)
    np.testing.assert_allclose(state.displacement_m, squeezed_m + share @ to_m, atol=1e-4 * most_m)
    answer_m = share.sum(axis=(0, 1)) * state.cell_area_m2 / HEIGHT_M
    most_n = np.abs(sheared.friction_n[:2]).max()
    np.testing.assert_allclose(pressed.friction_n[:2], dry.shear_modulus_pa * held_m2, atol=1e-4 * most_n)
    np.testing.assert_allclose(
        sheared.friction_n[:2], dry.shear_modulus_pa * (held_m2 + answer_m @ to_m), atol=1e-4 * most_n
    )


def test_forces_are_reciprocal() -> None:
    """Assert that y moved along x is as x moved along y, and along x and y alike where all is as long as wide."""
    for depth_m in (disc(NODES, 5e-3, 2e-3, -1e-3), disc(NODES, 6e-3, 7e-3, 4e-3)):
        answer = moved(depth_m)[1].sum(axis=(0, 1))
        assert answer[0, 1] == pytest.approx(answer[1, 0], abs=1e-9 * answer[0, 0])
    square = contact.pad_nodes(18, 18, (-7.5e-3, 7.5e-3), (-7.5e-3, 7.5e-3))
    share = static_contacts._moved(square, disc(square, 5e-3), RATIO, np.random.default_rng(0))[1]
    answer = share.sum(axis=(0, 1))
    assert answer[0, 0] == pytest.approx(answer[1, 1], rel=1e-9)
    assert answer[0, 1] == pytest.approx(0, abs=1e-9 * answer[0, 0])


def test_a_mirrored_contact_moves_as_its_mirror_image() -> None:
    """Assert that what is pressed on the other side moves the gel there as here, to the other side."""
    depth_m = disc(NODES, 5e-3, 2e-3, -1e-3)
    (squeezed_m, share, _), (other_m, other, _) = moved(depth_m), moved(depth_m[:, ::-1])
    sign = np.array([-1.0, 1.0])
    np.testing.assert_allclose(other_m, squeezed_m[:, ::-1] * sign, atol=1e-9 * np.abs(squeezed_m).max())
    np.testing.assert_allclose(other, share[:, ::-1] * sign[:, None] * sign, atol=1e-9)


def test_what_sticks_stays_and_the_rest_is_squeezed_outwards() -> None:
    """Assert that the loaded part stays under pressure and moves with the object, and that gel beside it gives way."""
    depth_m = disc(NODES, 5e-3)
    squeezed_m, share, _ = moved(depth_m)
    loaded = depth_m > 0
    assert not squeezed_m[loaded].any()
    np.testing.assert_array_equal(share[loaded], np.broadcast_to(np.eye(2), share[loaded].shape))
    outwards = (squeezed_m * NODES).sum(axis=2) / np.linalg.norm(NODES, axis=2)
    beside = ~loaded & (np.linalg.norm(NODES, axis=2) < 7e-3)
    assert (outwards[beside] > 0).all()
    assert np.abs(squeezed_m).max() < 0.5 * depth_m.max()


@pytest.mark.parametrize("radius_m", [3e-3, 6e-3])
def test_a_disc_takes_up_to_a_tenth_less_force_than_on_the_exact_layer(radius_m: float) -> None:
    """Assert that to move a disc on a large pad takes 90 to 97 % of the force that the exact layer asks for.

    The rest is at the disc's border, where waves are shorter than the sheet inside the gel answers.
    """
    nodes = contact.pad_nodes(32, 24, (-20e-3, 20e-3), (-15e-3, 15e-3))
    depth_m = disc(nodes, radius_m, 1e-3, 0.5e-3)
    share = static_contacts._moved(nodes, depth_m, RATIO, np.random.default_rng(0))[1]
    state = gel.start(nodes, gel.GelMaterial(), 0.1, 1e-5)
    answer_m = share.sum(axis=(0, 1)) * state.cell_area_m2 / HEIGHT_M
    stiffness = dense_layer(state, 2).stiffness
    sticks = np.tile((depth_m > 0).ravel(), 2)
    along = np.arange(len(sticks)) < depth_m.size
    exact = np.zeros((len(sticks), 2))
    exact[sticks & along, 0] = exact[sticks & ~along, 1] = 1.0
    exact[~sticks] = np.linalg.solve(stiffness[~sticks][:, ~sticks], -stiffness[~sticks][:, sticks] @ exact[sticks])
    force_m = np.stack([part.sum(axis=0) for part in np.split(stiffness @ exact, 2)]) / state.material.shear_modulus_pa
    assert 0.9 < answer_m.trace() / force_m.trace() < 0.97
