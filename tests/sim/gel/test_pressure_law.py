"""Friction that grows less than in proportion to pressure: what each node holds, and what all hold together."""

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel.cell_gaps import SAMPLES, CellGaps, gaps_of
from evetac_cli.sim.gel.contact import gap_profile, pad_nodes, pressure
from evetac_cli.sim.gel.friction import PressureLaw

EXPONENTS = (0.1, 0.33, 0.67, 1.0)
SHAPES = [("cylinder", 0.004), ("cylinder", 0.0), ("sphere", 0.01), ("flat", 0.007), ("flat", 0.0)]


def pad() -> Floats:
    return pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))


def held(indentation_m: float, gaps: CellGaps, exponent: float) -> Floats:
    """Share of each node in what all hold."""
    shares = pressure(indentation_m, gaps, 1.0)
    return shares * PressureLaw(exponent).factor(indentation_m, gaps, shares)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize(("shape", "tilt"), SHAPES)
def test_a_node_holds_what_its_points_do(shape: str, tilt: float, exponent: float) -> None:
    """Assert the mean of p^(1 - m) over each cell, within 0.5 % of the strongest node, and mu N for all together.

    Where pressure does not count at all, within one point: in a thousandth of the depth it comes to hold all it can.
    """
    gaps = gap_profile(pad(), shape, 0.02, tilt)  # type: ignore[arg-type]
    for indentation_m in (5e-6, 60e-6, 250e-6):
        depth = np.maximum(indentation_m - gaps.sample_m, 0.0)
        wanted = np.where(depth > 0, np.where(depth > 0, depth, 1.0) ** (1 - exponent), 0.0).mean(axis=2)
        found = held(indentation_m, gaps, exponent)
        assert found.sum() == pytest.approx(1.0, rel=1e-12)
        off = 1 / SAMPLES**2 if exponent == 1.0 else 5e-3
        np.testing.assert_allclose(found, wanted / wanted.sum(), atol=off * found.max(), rtol=0)
        assert not found[wanted == 0.0].any()


def test_a_finer_grid_holds_the_same() -> None:
    """Assert that what a quarter of a contact holds is that of a grid four times finer, within 1 % of the whole."""
    fine = pad_nodes(96, 72, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    for exponent in EXPONENTS:
        quarters = []
        for nodes in (pad(), fine):
            rows, columns, _ = nodes.shape
            gaps = gap_profile(nodes - (1e-3, 0.7e-3), "cylinder", 0.02, 0.004)
            quarters.append(held(150e-6, gaps, exponent)[: rows // 2, : columns // 2].sum())
        assert quarters[0] == pytest.approx(quarters[1], abs=0.01)


def test_a_law_near_coulombs_is_his() -> None:
    """Assert that an exponent next to 0 leaves every factor at 1, and that under an even face every one does."""
    gaps = gap_profile(pad(), "sphere", 0.02, 0.01)
    shares = pressure(2e-4, gaps, 1.0)
    np.testing.assert_allclose(PressureLaw(1e-9).factor(2e-4, gaps, shares), 1.0, rtol=1e-5)
    even = gap_profile(pad(), "flat")
    shares = pressure(1e-4, even, 1.0)
    for exponent in EXPONENTS:
        np.testing.assert_allclose(PressureLaw(exponent).factor(1e-4, even, shares), 1.0, rtol=1e-12)


def test_nothing_is_held_without_contact() -> None:
    """Assert a factor of 1 where nothing presses, and on a surface that ends, over gaps that begin anywhere."""
    gaps = gap_profile(pad(), "sphere", 0.02)
    law = PressureLaw(0.67)
    for indentation_m in (0.0, -1e-3):
        np.testing.assert_array_equal(law.factor(indentation_m, gaps, pressure(indentation_m, gaps, 1.0)), 1.0)
    beyond = gaps_of(np.where(gaps.sample_m > 1e-4, np.inf, gaps.sample_m - 3e-3))
    shares = pressure(-2.95e-3, beyond, 1.0)
    factor = law.factor(-2.95e-3, beyond, shares)
    assert np.isfinite(factor).all()
    assert (shares * factor).sum() == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_array_equal(factor[shares == 0.0], 1.0)
