"""The sheet inside the gel: its sweeps and its balance against the sparse matrix of the same layer."""

import math

import numpy as np
import pytest
from scipy.sparse.linalg import splu

from evetac_cli.kernels.gel_layer import SPRING, Squeeze, sheet_stiffness
from evetac_cli.sim.gel.contact import pad_nodes
from evetac_cli.sim.gel.gel import Friction, GelMaterial, start, step
from evetac_cli.sim.gel.sheet import largest, pull_sheet, relax_sheet, rule_of, sheet_imbalance, sheet_stencil

HEIGHT_M = 4e-3
GRIDS = [(24, 18), (1, 1), (1, 7), (7, 1), (2, 5)]


def balanced(columns: int, rows: int, sweeps: int) -> tuple[np.ndarray, float]:
    """How far the sheet is from what the matrix says after so many sweeps, over its largest value; its imbalance."""
    nodes = pad_nodes(columns, rows, (-0.4e-3 * columns, 0.4e-3 * columns), (-0.5e-3 * rows, 0.5e-3 * rows))
    moved = np.random.default_rng(columns).normal(size=(rows, columns, 2))
    stretch = sheet_stencil(HEIGHT_M, 0.8e-3, 1e-3)
    rule = rule_of(stretch, rows, columns)
    planes, source = np.zeros((2, rows + 2, columns + 2)), np.zeros((2, rows * (columns + 2)))
    pull_sheet(moved, source)
    for _ in range(sweeps):
        relax_sheet(planes, source, stretch, rule, np.zeros(planes[0].size))
    lacks = np.zeros_like(source)
    sheet_imbalance(planes, source, stretch, rule, lacks)
    left = largest(lacks.ravel())
    if min(rows, columns) == 1:
        return planes[:, 1:-1, 1:-1], left
    count = rows * columns
    matrix = sheet_stiffness(nodes, HEIGHT_M).tocsc() / (0.8e-6 / HEIGHT_M)
    exact = splu(matrix[2 * count :, 2 * count :]).solve(SPRING * np.moveaxis(moved, 2, 0).ravel())
    return planes[:, 1:-1, 1:-1].ravel() - exact, left


@pytest.mark.parametrize(("columns", "rows"), GRIDS)
def test_sweeps_find_the_balance(columns: int, rows: int) -> None:
    """Assert that sweeps lead to the balance of the sparse matrix, free edges included, and that imbalance tells."""
    off, left = balanced(columns, rows, 150)
    assert left < 1e-9
    if min(rows, columns) > 1:
        assert np.abs(off).max() < 1e-9
    _, early = balanced(columns, rows, 2)
    assert early > 1e-3 or (columns, rows) == (1, 1)  # one node alone is in balance at once


@pytest.mark.parametrize("way", [0, 1])
def test_a_held_gel_is_that_of_the_matrix(way: int) -> None:
    """Assert that a gel of which a part is moved and pressed lies as the matrix of the layer has it in balance."""
    nodes = pad_nodes(24, 18, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    material = GelMaterial()
    state = start(nodes, material, 1.0, 1.0, pads=1)
    loaded = (np.hypot(nodes[..., 0] - 2e-3, nodes[..., 1]) < 4e-3).astype(float)
    nodal_n = 5.0 * loaded / loaded.sum()
    twist = np.zeros(3)
    twist[way] = 2e-7
    for _ in range(3):  # in some thousand seconds all has come to rest
        info = step(
            state,
            nodal_n,
            (0, 0, 0),
            Friction(9, 9),
            1e3,
            theta=1.0,
            tolerance=1e-10,
            prescribed_twist=twist,
            max_sweeps=5000,
        )
        assert info.converged
    count = loaded.size
    matrix = sheet_stiffness(nodes, HEIGHT_M).tocsc() * material.shear_modulus_pa
    held = np.concatenate([np.tile(loaded.ravel() > 0, 2), np.zeros(2 * count, np.bool_)])
    pushed = np.zeros(4 * count)
    pushed[: 2 * count] = np.moveaxis(Squeeze(nodes, HEIGHT_M).of(nodal_n), 2, 0).ravel()
    moved = np.zeros(4 * count)
    moved[held] = np.repeat([(way == 0) * 6e-4, (way == 1) * 6e-4], int(loaded.sum()))
    moved[~held] = splu(matrix[~held][:, ~held]).solve(pushed[~held] - matrix[~held][:, held] @ moved[held])
    found = np.moveaxis(state.displacement_m, 2, 0).ravel()
    assert np.abs(found - moved[: 2 * count]).max() < 1e-5 * 6e-4
    inner = np.hypot(nodes[..., 0] - 2e-3, nodes[..., 1]) > 4e-3
    assert not math.isclose(np.abs(state.displacement_m[inner, 1 - way]).max(), 0.0)
