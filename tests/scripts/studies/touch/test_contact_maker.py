"""The contacts that touch maps are judged by: their layer and their friction against closed forms."""

import math

import numpy as np
import pytest

from evetac_cli.kernels.gel_layer import compliance
from scripts.studies.touch import contact_maker
from scripts.studies.touch.contact_maker import (
    CELL_MM2,
    N_PER_PA,
    SHAPES,
    ContactMaker,
    frictional_shear,
)
from scripts.studies.touch.layer import CELL_MM, ElasticLayer, depth_answer

DOTS = np.stack(np.meshgrid(np.linspace(-8, 8, 5), np.linspace(-6, 6, 4)), -1).reshape(-1, 2)
THICK = ElasticLayer(height_mm=40.0, poisson=0.49)


@pytest.fixture(scope="module")
def maker() -> ContactMaker:
    return ContactMaker(DOTS)


@pytest.fixture(scope="module")
def thick() -> ContactMaker:
    return ContactMaker(DOTS, THICK)


@pytest.mark.parametrize("poisson", [0.3, 0.49])
def test_two_implementations_of_the_layer_agree(poisson: float) -> None:
    """Assert that finite elements give the closed form, at the surface and below, within 0.2 % of that across."""
    waves = np.array([0.05, 0.3, 1.0, 2.0, 6.0])
    for depth_mm in (0.0, 0.5):
        found = depth_answer(ElasticLayer(poisson=poisson), waves, depth_mm)
        exact = compliance(waves * 1e3, 4e-3, 145e3, poisson, depth_mm * 1e-3)
        size = np.abs(exact.across) * 1e3
        for name in found._fields:
            assert (np.abs(getattr(found, name) - getattr(exact, name) * 1e3) < 2e-3 * size).all(), name


def test_a_square_under_even_pressure_sinks_in_as_loves_does(thick: ContactMaker) -> None:
    """Assert Love's depression of a half space under a square: its middle against its side, which no depth adds to.

    At the middle (1 - v) / (pi G) p a 4 asinh(1) for a side of 2 a, at a corner half of it; v = 0.49.
    """
    half = 3.0
    chosen = (np.abs(thick.cell_mm) < half).all(axis=1)
    answer = thick.cell_answer(chosen)[2, 2]
    cells = thick.cell_mm[chosen]
    sunk = answer.sum(axis=1) * 1e4  # of 10 kPa
    middle = sunk[np.hypot(*cells.T) < 0.4].mean()
    corner = sunk[np.abs(cells).min(axis=1) > half - 0.3].mean()

    def love(x: float, y: float) -> float:
        def part(a: float, b: float) -> float:
            return a * math.asinh(b / abs(a)) + b * math.asinh(a / abs(b))

        corners = part(half - x, half - y) + part(half + x, half - y) + part(half - x, half + y)
        return 0.51 / (2 * math.pi * 145e3) * 1e4 * (corners + part(half + x, half + y))

    expected = np.mean([love(0.25, 0.25), love(-0.25, 0.25)]) - love(2.75, 2.75)
    assert middle - corner == pytest.approx(expected, rel=0.02)


def test_a_ball_of_hertz_sinks_in_as_a_paraboloid(thick: ContactMaker) -> None:
    """Assert that Hertz's pressure on a half space makes pi p (1 - v) (2 a^2 - r^2) / (8 a G), up to a constant."""
    radius, cells = 4.0, thick.cell_mm
    r = np.hypot(*cells.T)
    chosen = r < radius
    pressure = 1e4 * np.sqrt(1 - (r[chosen] / radius) ** 2)
    sunk = thick.cell_answer(chosen)[2, 2] @ pressure
    inner = r[chosen] < 3.0
    slope, _ = np.polyfit(r[chosen][inner] ** 2, sunk[inner], 1)
    assert slope == pytest.approx(-math.pi * 1e4 * 0.51 / (8 * radius * 145e3), rel=0.05)


def test_the_answer_of_cells_is_reciprocal_and_costs_work(maker: ContactMaker) -> None:
    """Assert Betti's theorem (pressure works into the layer) and that no traction moves the layer without work."""
    chosen = np.hypot(*maker.cell_mm.T) < 3
    between = maker.cell_answer(chosen)
    whole = between.transpose(0, 2, 1, 3).reshape(3 * chosen.sum(), -1)
    assert whole == pytest.approx(whole.T, abs=1e-9 * np.abs(whole).max())
    assert np.linalg.eigvalsh(whole).min() > 0


def test_friction_slips_from_the_rim_as_mindlin_found(thick: ContactMaker) -> None:
    """Assert that Hertz's contact under a tangential load Q sticks within a (1 - Q / mu P)^(1/3) (Cattaneo, Mindlin).

    On a half space that keeps its volume nearly, where pressure moves nothing aside; the radius within half a cell.
    """
    radius, friction = 4.0, 0.8
    r = np.hypot(*thick.cell_mm.T)
    chosen = r < radius
    pressure = 1e4 * np.sqrt(1 - (r[chosen] / radius) ** 2)
    between = thick.cell_answer(chosen)
    count = len(pressure)
    answer = np.block([[between[0, 0], between[0, 1]], [between[1, 0], between[1, 1]]])
    answer = (answer + answer.T) / 2
    along = np.repeat([1.0, 0.0], count)
    for place_mm in (0.04, 0.07):
        (shear,), converged = frictional_shear(answer, np.zeros(2 * count), pressure, friction, [place_mm * along])
        share = shear[:count].sum() / (friction * pressure.sum())
        assert converged and 0.3 < share < 0.95
        sticks = np.hypot(*shear.reshape(2, count)) < contact_maker.STICKS * friction * pressure
        expected = radius * (1 - share) ** (1 / 3)
        assert math.sqrt(sticks.sum() * CELL_MM2 / math.pi) == pytest.approx(expected, abs=CELL_MM / 2)
        assert sticks[r[chosen] < expected - CELL_MM].all() and not sticks[r[chosen] > expected + CELL_MM].any()


@pytest.mark.parametrize("shape", SHAPES)
def test_contacts_obey_friction_and_what_was_drawn(shape: str, maker: ContactMaker) -> None:
    """Assert net force, friction's cone, slip opposed by shear at its limit, and that a seed makes the same contact."""
    contact = maker.make(shape, 6001)
    assert 1 <= contact.normal_n <= 10
    size = np.hypot(*contact.shear_pa)
    assert (size <= 1.0 * contact.pressure_pa * (1 + 1e-9)).all()
    assert np.hypot(*contact.net_shear_n) <= 1.0 * contact.normal_n
    assert contact.net_shear_n == pytest.approx(contact.shear_pa.sum(axis=1) * N_PER_PA)
    assert 0 < contact.sticks.mean() < 1
    if shape != "twisted":
        assert np.hypot(*contact.net_since_pressed_n) > 0.1 * contact.normal_n
    again = maker.make(shape, 6001)
    assert np.array_equal(again.shear_pa, contact.shear_pa) and np.array_equal(
        again.dot_motion_mm, contact.dot_motion_mm
    )
    assert not np.array_equal(maker.make(shape, 6002).dot_motion_mm, contact.dot_motion_mm)
