"""The sheet inside the gel that couples its surface nodes (see kernels/gel_layer), in one time step.

Its balance is SPRING q + stretch(q) = SPRING v. v are the velocities of the nodes, q those of the sheet below them, and
stretch is a stencil of a node's eight neighbours. The sheet has no mass and bears no load, and its losses are those of
the whole layer. So its balance does not depend on the time step, and a `rule` is computed once per pad.

A sweep updates x and y, and each of them in the two colours of a chess board, because nodes of one colour do not depend
on each other. Written without branches, each update is one flat loop, which numba vectorises. Free edges are handled by
a border of mirrored values, some with the opposite sign, and by the rule's weights of edge nodes. Code that changes the
nodes of a sheet must update its border (`mirror`). Sums and multiples of sheets already have valid borders.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import ACROSS, ALONG, SPRING

Links = tuple[float, float, float]  # of one component along x and along y, and of the other component over the corners


class SheetStencil(NamedTuple):
    """The sheet's stencil: links along and across a wave for each direction of the grid, and to the corners."""

    along_x: float
    along_y: float
    across_x: float
    across_y: float
    corner: float


def sheet_stencil(height_m: float, pitch_x_m: float, pitch_y_m: float) -> SheetStencil:
    """Return the stencil of a grid with these pitches."""
    over_x, over_y = (height_m / pitch_x_m) ** 2, (height_m / pitch_y_m) ** 2
    corner = (ALONG - ACROSS) * height_m**2 / (4 * pitch_x_m * pitch_y_m)
    return SheetStencil(ALONG * over_x, ALONG * over_y, ACROSS * over_x, ACROSS * over_y, corner)


def rule_of(stretch: SheetStencil, rows: int, columns: int) -> Floats:
    """Return the update rule for x and y: for each colour the share of a node's velocity kept, and ease; and weight.

    (2, 5, nodes): keep, ease, keep, ease, weight. The nodes are those of all rows, one row after the other; each row is
    two entries longer, as in a bordered array.
    """
    rule = np.zeros((2, 5, rows, columns + 2))
    rule[:, [0, 2]] = 1.0
    row, column = np.arange(rows)[:, None], np.arange(columns)[None, :]
    lacks_x = (column == 0).astype(int) + (column == columns - 1)
    lacks_y = (row == 0).astype(int) + (row == rows - 1)
    links = ((stretch.along_x, stretch.across_y), (stretch.across_x, stretch.along_y))
    for axis, (link_x, link_y) in enumerate(links):
        diagonal = SPRING + link_x * (2 - lacks_x) + link_y * (2 - lacks_y)
        # best over-relaxation factor if the nodes stick, as most do, and pull the sheet along
        smoothness = 1.0 - SPRING / float(diagonal.max())
        factor = 2.0 / (1.0 + math.sqrt(1.0 - smoothness * smoothness))
        # the border beyond an edge is the node itself or its negative (see `mirror`): the link's part is removed
        mirrored = link_x * lacks_x - link_y * lacks_y
        weight = diagonal + (mirrored if axis == 0 else -mirrored)
        ease = factor / diagonal
        for colour in range(2):
            is_of_colour = (row + column) % 2 == colour
            rule[axis, 2 * colour, :, :columns] = np.where(is_of_colour, 1.0 - ease * weight, 1.0)
            rule[axis, 2 * colour + 1, :, :columns] = np.where(is_of_colour, ease, 0.0)
        rule[axis, 4, :, :columns] = weight
    return rule.reshape(2, 5, rows * (columns + 2))


@njit(cache=True, _nrt=False)
def mirror(plane: Floats, odd_rows: bool) -> None:
    """Set the border of one component (rows + 2, columns + 2): mirrored, with opposite sign at rows or at columns.

    So the corner terms of the stencil add up to those of the energy of the cells within the pad at its free edges.
    """
    rows, columns = plane.shape
    sign_y = -1.0 if odd_rows else 1.0
    for row in range(1, rows - 1):
        plane[row, 0] = -sign_y * plane[row, 1]
        plane[row, columns - 1] = -sign_y * plane[row, columns - 2]
    for column in range(columns):
        plane[0, column] = sign_y * plane[1, column]
        plane[rows - 1, column] = sign_y * plane[rows - 2, column]


@njit(cache=True, _nrt=False, error_model="numpy")
def _update(
    own: Floats,
    other: Floats,
    stride: int,
    links: Links,
    source: Floats,
    keep: Floats,
    ease: Floats,
    after: Floats,
) -> None:
    """Fill the plane `after` with one component after the update of one colour; `other` is the other component."""
    link_x, link_y, corner = links
    here, above, below = own[stride:], own[1:], own[2 * stride + 1 :]
    under = other[2 * stride :]
    moved = after[stride + 1 :]
    for k in range(len(keep) - 2):
        total = source[k] + link_x * (here[k] + here[k + 2]) + link_y * (above[k] + below[k])
        total += corner * ((under[k + 2] - other[k + 2]) - (under[k] - other[k]))
        moved[k] = keep[k] * here[k + 1] + ease[k] * total


@njit(cache=True, _nrt=False, error_model="numpy")
def _lacking(
    own: Floats, other: Floats, stride: int, links: Links, source: Floats, weight: Floats, left: Floats
) -> None:
    """Fill `left` with the residual of the balance of one component."""
    link_x, link_y, corner = links
    here, above, below = own[stride:], own[1:], own[2 * stride + 1 :]
    under = other[2 * stride :]
    for k in range(len(weight) - 2):
        total = source[k] + link_x * (here[k] + here[k + 2]) + link_y * (above[k] + below[k])
        total += corner * ((under[k + 2] - other[k + 2]) - (under[k] - other[k]))
        left[k] = total - weight[k] * here[k + 1]


@njit(cache=True, _nrt=False)
def pull_sheet(nodes: Floats, source: Floats) -> None:
    """Fill `source`, (2, rows * (columns + 2)), with the pull of the nodes (rows, columns, 2) on their sheet.

    The two entries after each row are 0 and are not changed.
    """
    rows, columns, _ = nodes.shape
    for row in range(rows):
        first = row * (columns + 2)
        for column in range(columns):
            source[0, first + column] = SPRING * nodes[row, column, 0]
            source[1, first + column] = SPRING * nodes[row, column, 1]


@njit(cache=True, _nrt=False)
def largest(values: Floats) -> float:
    """Return the largest magnitude in an array; four at once, because a single maximum would wait for the previous."""
    a = b = c = d = 0.0
    whole = len(values) // 4 * 4
    for k in range(0, whole, 4):
        a, b = max(a, abs(values[k])), max(b, abs(values[k + 1]))
        c, d = max(c, abs(values[k + 2])), max(d, abs(values[k + 3]))
    for k in range(whole, len(values)):
        a = max(a, abs(values[k]))
    return max(a, b, c, d)


@njit(cache=True, _nrt=False)
def scalar_product(one: Floats, other: Floats) -> float:
    """Return the scalar product of two arrays; four sums at once, for the reason in `largest`."""
    a = b = c = d = 0.0
    whole = len(other) // 4 * 4
    for k in range(0, whole, 4):
        a, b = a + one[k] * other[k], b + one[k + 1] * other[k + 1]
        c, d = c + one[k + 2] * other[k + 2], d + one[k + 3] * other[k + 3]
    for k in range(whole, len(other)):
        a += one[k] * other[k]
    return (a + b) + (c + d)


@njit(cache=True, _nrt=False)
def over_nodes(planes: Floats, values: Floats) -> float:
    """Return the product of a sheet (2, rows + 2, columns + 2) with values (2, rows * (columns + 2)), 0 after a row."""
    stride = planes.shape[2]
    total = 0.0
    for axis in range(2):
        total += scalar_product(planes[axis].reshape(-1)[stride + 1 :], values[axis])
    return total


@njit(cache=True, _nrt=False)
def relax_sheet(planes: Floats, source: Floats, stretch: SheetStencil, rule: Floats, after: Floats) -> None:
    """Make one sweep of over-relaxation over the sheet's velocities, (2, rows + 2, columns + 2).

    source: (2, rows * (columns + 2)), the pull of the nodes; after: memory for one component, with its border.
    """
    stride = planes.shape[2]
    half = after.reshape(planes.shape[1], stride)
    for axis in range(2):
        own, other, links = planes[axis].reshape(-1), planes[1 - axis].reshape(-1), _links(stretch, axis)
        _update(own, other, stride, links, source[axis], rule[axis, 0], rule[axis, 1], after)
        mirror(half, axis == 0)
        _update(after, other, stride, links, source[axis], rule[axis, 2], rule[axis, 3], own)
        mirror(planes[axis], axis == 0)


@njit(cache=True, _nrt=False)
def _links(stretch: SheetStencil, axis: int) -> Links:
    if axis == 0:
        return stretch.along_x, stretch.across_y, stretch.corner
    return stretch.across_x, stretch.along_y, stretch.corner


@njit(cache=True, _nrt=False)
def sheet_imbalance(planes: Floats, source: Floats, stretch: SheetStencil, rule: Floats, left: Floats) -> None:
    """Fill `left`, (2, rows * (columns + 2)), with the residual of the sheet's balance, and 0 after each row."""
    stride = planes.shape[2]
    for axis in range(2):
        own, other = planes[axis].reshape(-1), planes[1 - axis].reshape(-1)
        _lacking(own, other, stride, _links(stretch, axis), source[axis], rule[axis, 4], left[axis])
        for end in range(stride, left.shape[1] + 1, stride):
            left[axis, end - 2] = left[axis, end - 1] = 0.0
