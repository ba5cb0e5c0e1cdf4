"""Gaps over the cells of nodes: points, closed forms of the Winkler foundation over the grid, and slow opening."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.sim.gel.cell_gaps import LEAST, MEAN, MOST, SAMPLES, VARIANCE, CellGaps, cell_samples, gaps_of
from evetac_cli.sim.gel.contact import cell_area, gap_profile, pad_nodes, pressure, surface

LENGTH_M, WIDTH_M = 20e-3, 15e-3
RADIUS_M, TILT = 0.02, 0.03
VOLUMES: dict[str, Callable[[float], float]] = {  # that a surface takes up at an indentation, in m3
    "cylinder": lambda d: LENGTH_M * 4 / 3 * d * math.sqrt(2 * RADIUS_M * d),
    "sphere": lambda d: math.pi * RADIUS_M * d**2,
    "flat": lambda d: WIDTH_M * d**2 / (2 * TILT),
}


def pad(columns: int = 24, rows: int = 18) -> Floats:
    return pad_nodes(columns, rows, (-LENGTH_M / 2, LENGTH_M / 2), (-WIDTH_M / 2, WIDTH_M / 2))


def one_point(nodes: Floats) -> Floats:
    """The middles of the cells alone."""
    return nodes[:, :, None, :]


def off(shape: str, points_of: Callable[[Floats], Floats], finer: int) -> float:
    """Relative error of the volume taken up on a grid so many times finer than 12 x 9, rms over 12 contacts."""
    nodes = pad(12 * finer, 9 * finer)
    errors = []
    for *place_m, deeper_m in np.random.default_rng(1).uniform((-1e-3, -1e-3, 0.0), (1e-3, 1e-3, 5e-5), (12, 3)):
        points, depth_m = points_of(nodes) - np.array(place_m), 170e-6 + deeper_m
        tilt = TILT if shape == "flat" else 0.0
        edge_m = tilt * (-LENGTH_M / 2 - place_m[0])  # where a tilted face touches first
        gaps = gaps_of(surface(points, shape, RADIUS_M, tilt) - edge_m)  # type: ignore[arg-type]
        errors.append(gaps.depth_m(depth_m).sum() * cell_area(nodes) / VOLUMES[shape](depth_m) - 1)
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("shape", sorted(VOLUMES))
def test_volumes_converge_to_closed_forms(shape: str) -> None:
    """Assert second order over the grid, 0.2 % on that of scenes, and an eighth of the error of one point per cell."""
    finer = np.array([1, 2, 4, 8])
    errors = np.array([off(shape, cell_samples, int(times)) for times in finer])
    slope = -np.polyfit(np.log(finer), np.log(errors), 1)[0]
    assert slope > 1.8, errors
    assert errors[1] < 2e-3
    assert errors[1] < off(shape, one_point, 2) / 8


def test_points_fill_each_cell_evenly() -> None:
    """Assert that the points of all cells together are the nodes of a grid SAMPLES times finer, whatever the axes."""
    points = cell_samples(pad(3, 2))
    assert points.shape == (2, 3, SAMPLES**2, 2)
    found = points.reshape(-1, 2)
    fine = pad(3 * SAMPLES, 2 * SAMPLES).reshape(-1, 2)
    np.testing.assert_allclose(found[np.lexsort(found.round(9).T)], fine[np.lexsort(fine.round(9).T)], atol=1e-15)
    turned = cell_samples(np.ascontiguousarray(pad(3, 2)[..., ::-1]))
    np.testing.assert_allclose(turned, points[..., ::-1], atol=1e-15)
    np.testing.assert_allclose(cell_samples(pad(5, 1))[..., 1], 0.0, atol=1e-15)
    np.testing.assert_array_equal(cell_samples(pad(1, 1)), 0.0)


def test_summary_of_each_cell() -> None:
    """Assert least, mean, largest gap and variance of every cell, exactly the gap itself where a cell is even."""
    gaps = gap_profile(pad(7, 6), "sphere", 0.01, 0.05)
    for part, values in (
        (LEAST, gaps.sample_m.min(axis=2)),
        (MEAN, gaps.sample_m.mean(axis=2)),
        (MOST, gaps.sample_m.max(axis=2)),
        (VARIANCE, gaps.sample_m.var(axis=2)),
    ):
        np.testing.assert_allclose(gaps.summary[..., part], values, rtol=1e-9, atol=1e-20)
    even = gaps_of(np.full((1, 1, 16), 0.1))
    assert even.summary.tolist() == [[[0.1, 0.1, 0.1, 0.0]]]


def depths(gaps: CellGaps, indentation_m: float) -> Floats:
    """Mean depth of each cell, from all of its points."""
    mean: Floats = np.maximum(indentation_m - gaps.sample_m, 0.0).mean(axis=2)
    return mean


@pytest.mark.parametrize("indentation_m", [-1e-4, 0.0, 3e-5, 2e-4, 5e-3])
def test_depth_is_the_mean_over_the_points(indentation_m: float) -> None:
    """Assert that short cuts for cells wholly in or out change nothing, also where the surface ends."""
    points = cell_samples(pad())
    height = surface(points, "sphere", RADIUS_M, 0.02)
    for ends_m in (np.inf, 4.1e-3, 0.0):
        gaps = gaps_of(np.where(np.abs(points).max(axis=-1) > ends_m, np.inf, height - height.min()))
        np.testing.assert_allclose(gaps.depth_m(indentation_m), depths(gaps, indentation_m), rtol=1e-9, atol=1e-18)


def test_indentation_is_the_inverse_of_depth() -> None:
    """Assert that the indentation found gives the depths asked for, up to the deepest, and that nothing is no depth."""
    gaps = gap_profile(pad(), "cylinder", RADIUS_M, 0.004)
    for indentation_m in (1e-8, 1e-6, 1e-4, 3.9e-3):
        asked_m = gaps.depth_m(indentation_m).sum()
        assert gaps.indentation_m(asked_m, 4e-3) == pytest.approx(indentation_m, rel=1e-9)
    assert gaps.indentation_m(1e3, 4e-3) == 4e-3
    nothing = gaps_of(np.full((2, 2, 4), np.inf))
    assert nothing.indentation_m(1e-3, 4e-3) == 4e-3
    assert not nothing.depth_m(4e-3).any()


@pytest.mark.parametrize(("shape", "tilt"), [("cylinder", 0.004), ("cylinder", 0.0), ("sphere", 0.0), ("flat", 0.007)])
def test_a_slow_opening_moves_load_evenly(shape: str, tilt: float) -> None:
    """Assert that no share of a node jumps, and that no row of nodes leaves at once, as with one point per cell.

    Opened from 250 to 100 um by 0.2 um per step, about as fast as in a slip scene. The rate of a share is its change
    per step.
    """
    opening_m = np.arange(250e-6, 100e-6, -0.2e-6)
    breaks = []
    for points_of in (cell_samples, one_point):
        points = points_of(pad()) - (0.3e-3, 0.2e-3)
        height = surface(points, shape, RADIUS_M, tilt)  # type: ignore[arg-type]
        gaps = gaps_of(height - height.min())
        rate = np.diff([pressure(depth_m, gaps, 1.0) for depth_m in opening_m], axis=0)
        breaks.append(np.abs(np.diff(rate, axis=0)).max() / np.abs(rate).max())
        fastest = np.abs(rate).max(axis=(1, 2))
        assert fastest.max() < 5 * np.median(fastest)
    assert breaks[0] < 0.3
    assert breaks[1] > 0.6
