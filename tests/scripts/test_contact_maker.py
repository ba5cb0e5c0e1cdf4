"""The contacts that touch maps are judged by: their layer and their friction against closed forms."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.kernels.gel_layer import compliance

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import contact_maker
import touch_layer
from contact_maker import (
    CELL_MM2,
    COUNT,
    FIRST_MM,
    N_PER_PA,
    SHAPES,
    ContactMaker,
    frictional_shear,
    on_coarse_cells,
    pressure_profile,
)
from touch_layer import CELL_MM, ElasticLayer, SurfaceAnswer, depth_answer

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


def test_finer_elements_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the error falls with the fourth power of the elements' size, nearly."""
    waves = np.array([1.5])
    exact = compliance(waves * 1e3, 4e-3, 145e3, 0.49).along[0] * 1e3
    monkeypatch.setattr(touch_layer, "GROWTH", 1.0)
    errors = []
    for elements in (6, 12, 24):
        monkeypatch.setattr(touch_layer, "ELEMENTS", elements)
        errors.append(abs(depth_answer(ElasticLayer(), waves).along[0] / exact - 1))
    assert errors[0] > 8 * errors[1] > 64 * errors[2]


def test_an_even_load_thins_and_shears_the_layer() -> None:
    """Assert the answer to a wave without end: H/G, and for pressure H over the modulus of a confined layer."""
    found = depth_answer(ElasticLayer(poisson=0.4), np.zeros(1))
    assert (found.across[0], found.along[0]) == pytest.approx((4 / 145e3, 4 / 145e3), rel=1e-9)
    assert found.aside[0] == pytest.approx(0.0, abs=1e-12)
    assert found.down[0] == pytest.approx(4 * (1 - 0.8) / (2 * 145e3 * 0.6), rel=1e-9)


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


def test_dots_see_what_cells_do() -> None:
    """Assert that points on cells' middles move as the cells do, by two ways through the transform."""
    answer = SurfaceAnswer(ElasticLayer())
    between = answer.between_cells(COUNT)
    point = np.array([[FIRST_MM + 20 * CELL_MM, FIRST_MM + 30 * CELL_MM]])
    seen = answer.at(point, FIRST_MM, COUNT)[0]
    rows, columns = 30 - np.arange(COUNT) + COUNT - 1, 20 - np.arange(COUNT) + COUNT - 1
    assert seen == pytest.approx(between[:, :, rows[:, None], columns], abs=1e-9 * np.abs(between).max())


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


def test_all_that_sticks_moves_with_the_object(maker: ContactMaker) -> None:
    """Assert that without slip every cell is where the object is, that all slip ends at friction times the load."""
    chosen = np.hypot(*maker.cell_mm.T) < 3
    count = int(chosen.sum())
    between = maker.cell_answer(chosen)
    answer = np.block([[between[0, 0], between[0, 1]], [between[1, 0], between[1, 1]]])
    answer = (answer + answer.T) / 2
    along, pressure = np.repeat([0.6, 0.8], count), np.full(count, 1e4)
    (sticks,), _ = frictional_shear(answer, np.zeros(2 * count), pressure, 1e3, [0.01 * along])
    assert answer @ sticks == pytest.approx(0.01 * along, abs=1e-4)
    (first, slides), converged = frictional_shear(answer, np.zeros(2 * count), pressure, 0.5, [2 * along, 4 * along])
    assert converged
    for slid in (first, slides):
        assert np.hypot(*slid.reshape(2, count)) == pytest.approx(0.5 * pressure, rel=1e-6)
    net = slides.reshape(2, count).sum(axis=1)
    assert net / np.hypot(*net) == pytest.approx([0.6, 0.8], abs=1e-3)


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


def test_a_twist_is_a_torque(maker: ContactMaker) -> None:
    """Assert that torque about two points differs by the net force times the way, and that a twist has much of it."""
    contact = maker.make("twisted", 6003)
    fx, fy = contact.net_shear_n
    moved = contact.torsion_n_mm(contact.centre_mm + [2.0, -1.0]) - contact.torsion_n_mm(contact.centre_mm)
    assert moved == pytest.approx(-(2.0 * fy + 1.0 * fx))
    assert abs(contact.torsion_n_mm(contact.centre_mm)) > 0.2 * contact.normal_n


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_lie_on_the_lattice(shape: str) -> None:
    """Assert that pressure is nowhere negative and, but for the one off centre, 0 at the lattice's border."""
    line = FIRST_MM + CELL_MM * np.arange(COUNT)
    cells = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    for seed in range(5):
        profile = pressure_profile(shape, cells, np.random.default_rng(seed))
        assert (profile >= 0).all() and profile.max() > 0.5
        assert not profile[np.abs(cells).max(axis=1) > -FIRST_MM - 0.1].any()


def test_coarse_cells_keep_the_forces(maker: ContactMaker) -> None:
    """Assert that cells of 1 mm have the contact's forces, and that what lies beyond them is left out."""
    contact = maker.make("ball", 6004)
    line = np.arange(-14.0, 15.0)
    coarse = on_coarse_cells(contact, line, line)
    assert coarse[:2].sum(axis=(1, 2)) * 1e-6 == pytest.approx(contact.net_shear_n)
    assert coarse[2].sum() * 1e-6 == pytest.approx(contact.normal_n)
    assert on_coarse_cells(contact, line + 100, line).any() == np.False_


def test_friction_that_does_not_converge_is_said(maker: ContactMaker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a contact that was not solved for is refused."""
    monkeypatch.setattr(contact_maker, "MOST_ITERATIONS", 2)
    with pytest.raises(RuntimeError, match="flat, seed 6000"):
        maker.make("flat", 6000)
