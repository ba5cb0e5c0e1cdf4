"""Two different pads that hold one object: closed forms, and what mirrored pads do, where they do not differ."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.sim.gel import contact, gel
from evetac_cli.sim.gel.adaptive import Stepper
from evetac_cli.sim.setup.scene import Solver

NODES = contact.pad_nodes(12, 9, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
EVEN = np.full((9, 12), 1 / 108)
GAP = contact.gap_profile(NODES, "cylinder", 20e-3, 2e-3)
FRICTION = gel.Friction(0.8, 0.64)
MASS_KG = 0.1


def pads(stiffness: float = 1.0, factor: float = 1.0) -> tuple[gel.GelState, gel.GelState]:
    """The first pad with the object, and another of its own stiffness and friction."""
    material = gel.GelMaterial(squeezes=False)
    first = gel.start(NODES, material, MASS_KG, 4e-5, pads=1, body_xy_m=(1e-3, 1e-3))
    stiff = replace(material, shear_modulus_pa=material.shear_modulus_pa * stiffness)
    uneven = np.full(EVEN.shape, factor) if factor != 1.0 else None
    return first, gel.start(NODES, stiff, MASS_KG, 4e-5, pads=1, friction_factor=uneven)


@pytest.mark.parametrize("law", [gel.Friction(0.8, 0.8), FRICTION])
@pytest.mark.slow
def test_equal_pads_are_mirrored_pads(law: gel.Friction) -> None:
    """Assert that two pads that do not differ do what one does that counts twice, through slip and to 1e-9 m."""
    first, second = pads()
    mirrored = gel.start(NODES, gel.GelMaterial(squeezes=False), MASS_KG, 4e-5, pads=2, body_xy_m=(1e-3, 1e-3))
    shares = contact.pressure(3e-4, GAP, 1.0)
    solver = Solver(residual=1e-9)
    two, one = Stepper(solver, second=second), Stepper(solver)
    slipped = 0.0
    for k in range(200):
        load = ((1.2 - 0.002 * k, 1.2 - 0.002 * (k + 1)), (MASS_KG * 9.81, 0.1, 0.0), law)
        done = two.advance(first, shares, *load, second_shares=shares)
        same = one.advance(mirrored, shares, *load)
        slipped = max(slipped, 1.0 - first.stuck[shares > 0].mean())
        np.testing.assert_allclose(done.friction_n, same.friction_n, atol=2e-6)
        np.testing.assert_allclose(done.second_friction_n, done.friction_n, atol=1e-9)
        assert done.friction_heat_j == pytest.approx(same.friction_heat_j, rel=1e-3, abs=1e-9)
        np.testing.assert_allclose(first.pose, mirrored.pose, atol=1e-8)
        assert done.steps == same.steps
    np.testing.assert_allclose(first.displacement_m, mirrored.displacement_m, atol=1e-8)
    np.testing.assert_allclose(second.displacement_m, first.displacement_m, atol=1e-9)
    assert slipped > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [0.5, 3.0])
def test_what_sticks_is_carried_by_stiffness(stiffness: float) -> None:
    """Assert that both carry a weight in proportion to their stiffness, and that the object comes to rest."""
    first, second = pads(stiffness)
    two = Stepper(Solver(), second=second)
    for _ in range(600):
        done = two.advance(first, EVEN, (5.0, 5.0), (MASS_KG * 9.81, 0.0, 0.0), FRICTION, second_shares=EVEN)
    assert first.stuck.all()
    assert second.stuck.all()
    assert done.second_friction_n[0] == pytest.approx(stiffness * done.friction_n[0], rel=1e-3)
    assert done.friction_n[0] + done.second_friction_n[0] == pytest.approx(MASS_KG * 9.81, rel=1e-4)
    assert np.abs(first.twist[:2]).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.3, 1.5])
def test_an_object_slides_past_both(factor: float) -> None:
    """Assert m a = m g - mu_k N (1 + factor) where both slide, and no slide where static friction suffices."""
    weight_n = MASS_KG * 9.81
    for share, slides in ((1.02, False), (0.9, True)):
        first, second = pads(factor=factor)
        normal_n = share * weight_n / (0.8 * (1 + factor))
        two = Stepper(Solver(), second=second)
        falls = []
        for k in range(400):
            pulled_n = weight_n * min(1.0, k / 200)
            two.advance(first, EVEN, (normal_n,) * 2, (pulled_n, 0.0, 0.0), FRICTION, second_shares=EVEN)
            falls.append(first.twist[0])
        assert (falls[-1] > 0.05) == slides
        if slides:
            measured = (falls[-1] - falls[-51]) / 0.05
            assert measured == pytest.approx(9.81 - 0.64 * normal_n * (1 + factor) / MASS_KG, rel=1e-3)


@pytest.mark.slow
def test_a_second_pad_needs_its_shares() -> None:
    """Assert that shares that are not finite are a ValueError."""
    first, second = pads()
    two = Stepper(Solver(), second=second)
    for shares in (np.full(EVEN.shape, np.nan),):
        with pytest.raises(ValueError, match=r"second|nodal_force_n"):
            two.advance(first, EVEN, (5.0, 5.0), (1.0, 0.0, 0.0), FRICTION, second_shares=shares)
    assert not first.displacement_m.any()
