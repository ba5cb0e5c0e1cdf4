"""Contact: gaps, force curves against closed forms of the Winkler foundation, pressure."""

import numpy as np
import pytest

from evetac_cli.sim.gel.cell_gaps import LEAST, cell_samples, gaps_of
from evetac_cli.sim.gel.contact import (
    cell_area,
    closing_at,
    force_curve,
    gap_profile,
    lookup,
    pad_nodes,
    pressure,
    surface,
    turning_arm,
)

MODULUS_PA, HEIGHT_M, FINGER_N_M, TICK_M = 1.0e6, 4e-3, 1.8e3, 0.165e-3
LENGTH_M, WIDTH_M = 20e-3, 15e-3


def pad(columns=24, rows=18):
    return pad_nodes(columns, rows, (-LENGTH_M / 2, LENGTH_M / 2), (-WIDTH_M / 2, WIDTH_M / 2))


def curve_of(gap, area, **changes):
    return force_curve(gap, MODULUS_PA / HEIGHT_M * area, HEIGHT_M, FINGER_N_M, TICK_M, **changes)


def test_pad_nodes_are_cell_centres():
    """Assert that nodes are the centres of even cells, x along columns and y along rows, which cover the pad."""
    nodes = pad_nodes(4, 2, (0.0, 8.0), (-1.0, 1.0))
    assert nodes.shape == (2, 4, 2)
    np.testing.assert_allclose(nodes[0, :, 0], [1, 3, 5, 7])
    np.testing.assert_allclose(nodes[:, 0, 1], [-0.5, 0.5])
    assert cell_area(nodes) * 8 == pytest.approx(16.0, rel=1e-15)


def test_gap_shapes():
    """Assert that a cylinder curves in y only, a sphere in both, a tilt opens along x, and the least gap is 0."""
    nodes = pad(5, 5)
    x, y = np.moveaxis(cell_samples(nodes), -1, 0)
    for shape, tilt, height in (
        ("cylinder", 0.0, y**2 / 0.06),
        ("sphere", 0.0, (x**2 + y**2) / 0.06),
        ("flat", -0.01, -0.01 * x),
    ):
        gaps = gap_profile(nodes, shape, 0.03, tilt)
        np.testing.assert_allclose(gaps.sample_m, height - height.min(), atol=1e-18)
    for shape in ("flat", "cylinder", "sphere"):
        assert gap_profile(nodes, shape, 0.01, 0.02).least_m == 0.0


def test_a_surface_at_a_place_is_that_seen_from_there():
    """Assert that moving and turning a surface is moving and turning the points, and that round ones end."""
    points = pad(9, 7)
    from_middle = points - (1.2e-3, -0.7e-3)
    turned = from_middle @ np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    for shape in ("flat", "cylinder", "sphere"):
        wanted = surface(turned, shape, 6e-3, 0.02)
        found = surface(points, shape, 6e-3, 0.02, place=(1.2e-3, -0.7e-3, 0.4), round_ends=True)
        across = {"flat": 0 * turned[..., 0], "cylinder": turned[..., 1], "sphere": np.linalg.norm(turned, axis=-1)}
        ended = np.abs(across[shape]) > 6e-3
        assert ended.any() == (shape != "flat")
        np.testing.assert_allclose(found, np.where(ended, np.inf, wanted), rtol=1e-12, atol=1e-18)


def test_flat_punch_is_exact():
    """Assert that a flat punch follows N = E/H A d, and its closing 2 d + N / stiffness, at every entry."""
    nodes = pad()
    curve = curve_of(gap_profile(nodes, "flat"), cell_area(nodes))
    np.testing.assert_allclose(
        curve.force_n, MODULUS_PA / HEIGHT_M * LENGTH_M * WIDTH_M * curve.indentation_m, rtol=1e-12
    )
    closing_m = 2 * curve.indentation_m + curve.force_n / FINGER_N_M
    np.testing.assert_allclose(closing_m, TICK_M * curve.step_ticks * np.arange(len(closing_m)), rtol=1e-12)


@pytest.mark.parametrize(
    ("shape", "closed_form"),
    [
        ("cylinder", lambda d, r: LENGTH_M * 4 / 3 * d * np.sqrt(2 * r * d)),
        ("sphere", lambda d, r: np.pi * r * d**2),
    ],
)
def test_round_shapes_converge_to_closed_form(shape, closed_form):
    """Assert that the force of round shapes converges to the integral of the Winkler pressure over the patch."""
    radius_m, depth_m, errors = 0.02, 200e-6, []
    for nodes_each in (15, 45, 135):
        nodes = pad(nodes_each, nodes_each)
        curve = curve_of(gap_profile(nodes, shape, radius_m), cell_area(nodes), step_ticks=0.002)
        force_n = np.interp(depth_m, curve.indentation_m, curve.force_n)
        errors.append(abs(force_n / (MODULUS_PA / HEIGHT_M * closed_form(depth_m, radius_m)) - 1))
    assert errors[-1] < 5e-4
    assert errors[-1] < errors[0] / 10


def test_table_entries_are_the_sum_over_points():
    """Assert that every entry is what a sum over all points gives, for a tilted sphere that loads them one by one."""
    nodes = pad(7, 6)
    gaps = gap_profile(nodes, "sphere", 0.01, 0.05)
    curve = curve_of(gaps, cell_area(nodes), reach_ticks=60.0, step_ticks=0.5)
    depth = np.maximum(curve.indentation_m[:, None, None, None] - gaps.sample_m, 0)
    force = MODULUS_PA / HEIGHT_M * cell_area(nodes) * depth.mean(axis=3).sum(axis=(1, 2))
    np.testing.assert_allclose(curve.force_n, force, rtol=1e-12, atol=1e-15)
    closing = (2 * curve.indentation_m + force / FINGER_N_M) / TICK_M
    np.testing.assert_allclose(closing, 0.5 * np.arange(len(closing)), rtol=1e-12, atol=1e-12)


def test_curve_ends_where_asked_or_with_the_gel():
    """Assert that a curve reaches as far as asked, or to the closing at which the gel is pressed flat."""
    nodes = pad()
    gap, area = gap_profile(nodes, "flat"), cell_area(nodes)
    assert curve_of(gap, area, reach_ticks=25.0, step_ticks=0.1).reach_ticks == pytest.approx(25.0)
    flat = curve_of(gap, area, reach_ticks=1e5, step_ticks=1.0)
    assert 0.99 * HEIGHT_M < flat.indentation_m[-1] <= HEIGHT_M
    assert (np.diff(flat.force_n) > 0).all()


CONSTANTS = (MODULUS_PA / HEIGHT_M * 1e-6, HEIGHT_M, FINGER_N_M, TICK_M)
REFUSED = [
    *(({"radius_m": value}, "found") for value in (0.0, np.nan)),
    ({"constants": CONSTANTS, "step_ticks": 1e4, "reach_ticks": 1e5}, "step_ticks"),
    *(({"pressed": values}, "finite") for values in ((np.nan, 1.0), (1e-4, np.nan), (1e-4, -1.0), (np.inf, 1.0))),
]


@pytest.mark.parametrize(("given", "named"), REFUSED)
def test_refusals(given, named):
    """Assert that radii, forces and tables of a single entry that make no sense are refused."""
    even, given = gaps_of(np.zeros((2, 2, 1))), dict(given)
    with pytest.raises(ValueError, match=named):
        if "radius_m" in given:
            gap_profile(pad(), "sphere", given["radius_m"])
        elif "pressed" in given:
            pressure(given["pressed"][0], even, given["pressed"][1])
        else:
            force_curve(even, *given.pop("constants"), **given)


def test_lookup_is_linear_and_clamped():
    """Assert that lookup is 0 up to touch, exact at entries, linear between them, and the last entry beyond."""
    table = np.array([0.0, 1.0, 4.0])
    expected = {-1e9: 0.0, 0.0: 0.0, 0.25: 0.5, 0.5: 1.0, 0.75: 2.5, 1.0: 4.0, 1e9: 4.0, np.inf: 4.0}
    for closing, value in expected.items():
        assert lookup(table, 0.5, closing) == value


def test_closing_at_is_the_inverse_of_lookup():
    """Assert that the closing found for a force gives that force, and that forces outside the curve are refused."""
    nodes = pad()
    curve = curve_of(gap_profile(nodes, "cylinder", 0.024, 0.003), cell_area(nodes))
    for force_n in (0.0, 1e-3, 0.3, 5.0, curve.force_n[-1]):
        assert lookup(curve.force_n, curve.step_ticks, closing_at(curve, force_n)) == pytest.approx(force_n, abs=1e-12)
    for force_n in (-1e-3, 1.01 * curve.force_n[-1], np.nan):
        with pytest.raises(ValueError, match="force_n"):
            closing_at(curve, force_n)


def test_pressure_sums_to_the_force():
    """Assert that nodal forces add up to the total, in proportion to indentation, and only where the gel is pressed."""
    gaps = gap_profile(pad(), "sphere", 0.02, 0.004)
    force = pressure(150e-6, gaps, 2.5)
    assert force.sum() == pytest.approx(2.5, rel=1e-13)
    assert ((force > 0) == (gaps.summary[..., LEAST] < 150e-6)).all()
    depth = gaps.depth_m(150e-6)
    np.testing.assert_allclose(force, depth * (2.5 / depth.sum()), rtol=1e-12)


def test_pressure_without_indentation_is_zero():
    """Assert that without indentation nothing is loaded, whatever the total."""
    gap = gap_profile(pad(), "flat")
    assert not pressure(0.0, gap, 1.0).any()
    assert not pressure(-1e-3, gap, 1.0).any()
    assert not pressure(1e-4, gap, 0.0).any()


def test_turning_arm_of_a_disc_and_of_one_node():
    """Assert 2/3 of the radius for an even disc, wherever it lies, and 0 for one node, and without contact."""
    nodes = pad_nodes(120, 90, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    disc = (np.linalg.norm(nodes - (1e-3, 2e-3), axis=-1) < 5e-3).astype(float)
    assert turning_arm(nodes, disc) == pytest.approx(2 / 3 * 5e-3, rel=0.01)
    assert turning_arm(nodes, 7.0 * disc) == pytest.approx(turning_arm(nodes, disc), rel=1e-12)
    one = np.zeros(nodes.shape[:2])
    assert turning_arm(nodes, one) == 0.0
    one[3, 5] = 2.0
    assert turning_arm(nodes, one) == pytest.approx(0.0, abs=1e-15)
