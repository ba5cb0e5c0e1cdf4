"""The dot grid: any order in, rows, columns and neighbours out; what is no grid is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.kernels.calibration.grid import arrange, lattice, neighbours, one_row, pitch

Grid = NDArray[np.float64]


def regular(rows: int, columns: int, pitch_px: float = 60.0) -> Grid:
    """(rows, columns, 2) centres on a square grid."""
    return np.stack(np.meshgrid(50 + pitch_px * np.arange(columns), 40 + pitch_px * np.arange(rows)), axis=-1)


def tilted(grid: Grid, angle: float) -> Grid:
    """The grid turned about its first dot by an angle in radians."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return (grid - grid[0, 0]) @ turn.T + grid[0, 0]


shapes = st.tuples(st.integers(1, 7), st.integers(1, 9))


@given(shapes, st.randoms(use_true_random=False), st.floats(5.0, 100.0))
@settings(deadline=None)
def test_any_order_gives_the_grid(shape: tuple[int, int], random: object, pitch_px: float) -> None:
    """Assert that shuffled dots come back in their rows and columns, bit for bit."""
    grid = regular(*shape, pitch_px)
    flat = list(grid.reshape(-1, 2))
    random.shuffle(flat)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(arrange(np.array(flat)), grid)


@given(shapes, st.integers(0, 2**32 - 1), st.floats(-0.45, 0.45))
@settings(deadline=None)
def test_tilt_and_jitter(shape: tuple[int, int], seed: int, rise: float) -> None:
    """Assert that a grid that rises by less than half a pitch over its width, with unsteady dots, is still found."""
    rng = np.random.default_rng(seed)
    rows, columns = shape
    angle = np.arctan(rise / max(columns - 1, 1))
    sine, cosine = abs(np.sin(angle)), np.cos(angle)
    # What is left, in pitches, of the gap between rows, and of the way to the next column, beyond half a pitch.
    spare = min(cosine - (columns - 1) * sine, 1 - sine) - 0.5
    assume(spare > 0.02)
    grid = tilted(regular(rows, columns), angle)
    grid += rng.uniform(-1, 1, grid.shape) * 60.0 * spare / 8
    np.testing.assert_array_equal(arrange(rng.permutation(grid.reshape(-1, 2))), grid)


THREE, FLAT = regular(3, 4), regular(3, 4).reshape(-1, 2)
NO_GRID: list[tuple[Grid, str]] = [
    *((tilted(regular(7, 9), np.arctan(rise / 8)).reshape(-1, 2), "expected") for rise in (0.6, 0.9, -0.75)),
    *((np.zeros(shape), "shape") for shape in ((0,), (4,), (0, 2), (4, 3), (2, 0, 2), (2, 2, 3), (1, 2, 2, 2))),
    *((np.where(FLAT[5] == FLAT, value, FLAT), "finite") for value in (np.nan, np.inf)),
    (np.where(THREE[1, 1] == THREE, -np.inf, THREE), "finite"),
    *((turned, "from top to bottom") for turned in (THREE[::-1], THREE[:, ::-1], THREE.transpose(1, 0, 2))),
    (np.repeat(FLAT, 2, axis=0), "listed twice"),
    (np.concatenate([FLAT, FLAT[::4] + 1.0]), "listed twice"),
    (FLAT[1:], r"found \[3, 4, 4\] dots per row"),
    (np.concatenate([FLAT, FLAT[-1:] + 3.0]), r"found \[4, 4, 5\] dots per row"),
    (
        np.concatenate([np.delete(row, at, axis=0) for row, at in zip(THREE, (0, 2, 3), strict=True)]),
        "below each other",
    ),
]


@pytest.mark.parametrize(("dots", "words"), NO_GRID)
def test_dots_that_are_no_grid(dots: Grid, words: str) -> None:
    """Assert that rows that run into each other or lack dots, and places that are none, are refused."""
    with pytest.raises(ValueError, match=words):
        arrange(dots)


def test_sorted_grids_are_taken_as_they_are() -> None:
    """Assert that (rows, columns, 2) is returned unchanged, with NaN where dots are missing, also a whole row."""
    grid = regular(4, 5)
    np.testing.assert_array_equal(arrange(grid), grid)
    grid[1, 2] = np.nan
    grid[3] = np.nan
    np.testing.assert_array_equal(arrange(grid), grid)


def test_pitch() -> None:
    """Assert that the pitch is the distance to the nearest dot, whatever the order, missing dots and outliers."""
    grid = regular(5, 6, 31.5)
    assert pitch(grid) == 31.5
    assert pitch(grid.reshape(-1, 2)[::-1]) == 31.5
    assert pitch(tilted(grid, 0.3)) == pytest.approx(31.5, rel=1e-12)
    grid[0, 0] = np.nan
    grid[2, 2] += 4.0
    assert pitch(grid) == pytest.approx(31.5, rel=1e-12)
    assert pitch(grid[1:2, 1:2]) == np.inf


@given(shapes, st.integers(0, 2**32 - 1), st.floats(-0.25, 0.25))
@settings(deadline=None)
def test_lattice_of_a_tilted_grid(shape: tuple[int, int], seed: int, angle: float) -> None:
    """Assert that unsteady dots in any order, tilted by up to 14 degrees, come back in rows and columns."""
    assume(min(shape) > 1)
    rng = np.random.default_rng(seed)
    # Through two or three rows the surface on which the grid grows is less certain: with 4 px, as for the grids of
    # gels, one of a hundred grids of 2 x 6 dots loses its last column.
    unsteady_px = 4 if min(shape) > 3 else 2
    grid = tilted(regular(*shape), angle) + rng.uniform(-unsteady_px, unsteady_px, (*shape, 2))
    np.testing.assert_array_equal(lattice(rng.permutation(grid.reshape(-1, 2))), grid)


@given(shapes, st.integers(0, 2**32 - 1), st.floats(-0.15, 0.15), st.floats(0.4, 2.5))
@settings(deadline=None)
def test_rows_and_columns_of_another_pitch(shape: tuple[int, int], seed: int, angle: float, stretched: float) -> None:
    """Assert that rows may be closer together than columns, or farther apart, whole and with dots missing."""
    assume(min(shape) > 2)
    rng = np.random.default_rng(seed)
    grid = tilted(regular(*shape) * (1, stretched), angle)
    grid += rng.uniform(-0.05, 0.05, grid.shape) * 60 * min(stretched, 1)
    np.testing.assert_array_equal(lattice(rng.permutation(grid.reshape(-1, 2))), grid)
    if min(shape) > 4:
        grid[2, 2] = grid[1, 3] = np.nan
        places = grid.reshape(-1, 2)
        np.testing.assert_array_equal(lattice(rng.permutation(places[np.isfinite(places[:, 0])])), grid)


def test_lattice_with_holes_and_strangers() -> None:
    """Assert that missing dots become NaN in their places, and that places off the lattice are left out."""
    grid = tilted(regular(7, 9), 0.05)
    holes = [(0, 0), (2, 3), (2, 4), (6, 8), (3, 0)]
    for hole in holes:
        grid[hole] = np.nan
    dots = grid.reshape(-1, 2)
    strangers = np.array([[83.0, 70.0], [900.0, 20.0], [300.0, -55.0]])
    result = lattice(np.random.default_rng(0).permutation(np.concatenate([dots[np.isfinite(dots[:, 0])], strangers])))
    np.testing.assert_array_equal(result, grid)


@pytest.mark.parametrize("bend", [-0.3, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("shape", [(7, 9), (8, 14), (4, 5)])
def test_lattice_through_a_lens(shape: tuple[int, int], bend: float) -> None:
    """Assert that no dot is lost if a lens moves those at the corners by up to 30 % of their distance to the middle."""
    rng = np.random.default_rng(3)
    for angle in (0.0, 0.2):
        flat = tilted(regular(*shape), angle)
        flat -= flat.mean(axis=(0, 1))
        off = np.linalg.norm(flat, axis=2, keepdims=True)
        grid = flat * (1 - bend * (off / off.max()) ** 2) + 600.0
        grid[1, 2] = grid[2, -1] = np.nan
        places = grid.reshape(-1, 2)
        np.testing.assert_array_equal(lattice(rng.permutation(places[np.isfinite(places[:, 0])])), grid)


@pytest.mark.parametrize("seed", [1, 2, 10])
def test_lattice_where_a_lens_folds_the_border(seed: int) -> None:
    """Assert that all dots are kept, also if what is expected beyond the border falls onto dots of the grid."""
    rng = np.random.default_rng(seed)
    flat = np.stack(np.meshgrid(np.linspace(-272, 272, 9), np.linspace(-204, 204, 7)), axis=-1)
    grid = flat * (1 - 0.3 * (flat**2).sum(axis=2, keepdims=True) / 320**2) + (320, 240)
    grid += rng.normal(0, 1.0, grid.shape)
    np.testing.assert_array_equal(lattice(rng.permutation(grid.reshape(-1, 2)), (7, 9)), grid)


def test_lattice_without_weak_borders() -> None:
    """Assert that a row of few dots at the border is no row."""
    grid = regular(5, 6)
    weak = grid[0, 1:3] - (0, 60)
    np.testing.assert_array_equal(lattice(np.concatenate([grid.reshape(-1, 2), weak])), grid)


@pytest.mark.parametrize(
    "places",
    [
        np.empty((0, 2)),
        regular(1, 3)[0],
        regular(1, 9)[0],
        regular(9, 1)[:, 0],
        np.tile([[5.0, 5.0]], (9, 1)),
        np.array([[0.0, 0.0], [1.0, 0.0], [500.0, 3.0], [3.0, 700.0]]),
    ],
    ids=["none", "three", "a row", "a column", "one place", "scattered"],
)
def test_no_lattice(places: Grid) -> None:
    """Assert that too few dots, one row, one column, and places anywhere are refused."""
    with pytest.raises(ValueError, match="at least two rows and two columns"):
        lattice(places)


def neighbour_counts(dots_px: Grid) -> list[int]:
    """How many dots have 3, 5 and 8 neighbours; fails if the neighbours are not mutual or of another number."""
    result = neighbours(dots_px)
    pairs = {(i, int(j)) for i, row in enumerate(result) for j in row if j >= 0}
    assert all((j, i) in pairs for i, j in pairs)
    counts = (result >= 0).sum(axis=1)
    assert set(counts.tolist()) <= {3, 5, 8}
    return [int((counts == wanted).sum()) for wanted in (3, 5, 8)]


def test_neighbours_of_the_real_grid(outside_file: Callable[[str], Path]) -> None:
    """Assert that on the real 9 x 7 grid, dots in no order, corners have 3 neighbours, edges 5 and all others 8."""
    dots = np.array(json.loads(outside_file("evetac_base_calibration.json").read_text())["dot_xy_px"])
    assert neighbour_counts(dots) == [4, 24, 35]
    corner = int(np.argmin(dots.sum(axis=1)))
    assert (neighbours(dots)[corner] >= 0).sum() == 3


def staggered(rows: int = 7, columns: int = 8, pitch_px: float = 60.0) -> Grid:
    """Places (n, 2) with six neighbours each: every other row half a pitch to the right."""
    y, x = np.mgrid[:rows, :columns]
    return pitch_px * np.stack([1 + x + 0.5 * (y % 2), 1 + y * np.sqrt(0.75)], axis=-1).reshape(-1, 2)


def test_staggered_rows_are_no_grid() -> None:
    """Assert that they are refused whether whole or with dots missing, and are one row from the top and the left."""
    rng = np.random.default_rng(0)
    whole = staggered()
    for places in (whole, np.delete(whole, 20, axis=0), whole + rng.normal(0, 1.0, whole.shape)):
        with pytest.raises(ValueError, match="expected"):
            lattice(rng.permutation(places))
    np.testing.assert_array_equal(one_row(rng.permutation(whole)), whole[None])
    np.testing.assert_array_equal(arrange(whole[None, ::-1]), whole[None, ::-1])
