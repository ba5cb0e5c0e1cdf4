"""The sheet inside the gel through which its surface nodes pull each other (see kernels/gel_layer), in one time step.

Its balance is SPRING q + stretch(q) = SPRING v: v are the velocities of the nodes, q those of the sheet below them,
stretch a stencil of a node's eight neighbours. It has no mass and bears no load, its losses are those of the
whole layer, and so its balance does not depend on the time step: a `rule` is made once for a pad.

A sweep goes over x and y and, of each, over the two colours of a chess board, as those of one colour do not wait for
each other. Why so: written without branches it is one flat loop for each, which numba makes vector code of. Free edges
are met by a border of mirrored values, some of the other sign, and by what the rule keeps of a node there.
"""

import math
from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.gel_layer import ACROSS, ALONG, SPRING


class SheetStencil(NamedTuple):
    """The sheet's stencil: its links along and across a wave for each direction of the grid, and to the corners."""

    along_x: float
    along_y: float
    across_x: float
    across_y: float
    corner: float


def sheet_stencil(height_m: float, pitch_x_m: float, pitch_y_m: float) -> SheetStencil:
    """The stencil of a grid of such pitches."""
    over_x, over_y = (height_m / pitch_x_m) ** 2, (height_m / pitch_y_m) ** 2
    corner = (ALONG - ACROSS) * height_m**2 / (4 * pitch_x_m * pitch_y_m)
    return SheetStencil(ALONG * over_x, ALONG * over_y, ACROSS * over_x, ACROSS * over_y, corner)


def rule_of(stretch: SheetStencil, rows: int, columns: int) -> Floats:
    """What a node keeps of its velocity in a sweep, and its ease: (x and y, colours, keep and ease, nodes).

    Nodes are those of the rows one after the other, two entries longer than a row, as in a bordered array.
    """
    rule = np.zeros((2, 2, 2, rows, columns + 2))
    rule[:, :, 0] = 1.0
    row, column = np.arange(rows)[:, None], np.arange(columns)[None, :]
    lacks_x = (column == 0).astype(int) + (column == columns - 1)
    lacks_y = (row == 0).astype(int) + (row == rows - 1)
    links = ((stretch.along_x, stretch.across_y), (stretch.across_x, stretch.along_y))
    for axis, (link_x, link_y) in enumerate(links):
        diagonal = SPRING + link_x * (2 - lacks_x) + link_y * (2 - lacks_y)
        # the factor of over-relaxation that is best where the nodes stick, as most do, and pull the sheet along
        smoothness = 1.0 - SPRING / float(diagonal.max())
        factor = 2.0 / (1.0 + math.sqrt(1.0 - smoothness * smoothness))
        ease = factor / diagonal
        # the border beyond an edge is the node itself, or less it (see `mirror`): what its link adds is taken off
        mirrored = link_x * lacks_x - link_y * lacks_y
        keep = 1.0 - factor - ease * (mirrored if axis == 0 else -mirrored)
        for colour in range(2):
            chosen = (row + column) % 2 == colour
            rule[axis, colour, 0, :, :columns] = np.where(chosen, keep, 1.0)
            rule[axis, colour, 1, :, :columns] = np.where(chosen, ease, 0.0)
    return rule.reshape(2, 2, 2, rows * (columns + 2))


@njit(cache=True, _nrt=False)
def mirror(plane: Floats, odd_rows: bool) -> None:
    """Set the border of one component (rows + 2, columns + 2): mirrored, of the other sign over rows or over columns.

    So the corners of the stencil sum up to what the energy of the cells within the pad asks for at its free edges.
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
def _after(
    own: Floats,
    other: Floats,
    stride: int,
    links: tuple[float, float, float],
    source: Floats,
    rule: Floats,
    after: Floats,
) -> None:
    """Velocities of one component after the update of one colour; `other` is the other component."""
    link_x, link_y, corner = links
    here, below = own[stride:], own[2 * stride + 1 :]
    above = own[1:]
    under = other[2 * stride :]
    keep, ease = rule[0], rule[1]
    for k in range(len(after)):
        total = source[k] + link_x * (here[k] + here[k + 2]) + link_y * (above[k] + below[k])
        total += corner * ((under[k + 2] - other[k + 2]) - (under[k] - other[k]))
        after[k] = keep[k] * here[k + 1] + ease[k] * total


@njit(cache=True, _nrt=False)
def pull_sheet(nodes: Floats, source: Floats) -> float:
    """Fill `source` with what the nodes (rows, columns, 2) pull their sheet with; returns the largest."""
    rows, columns, _ = nodes.shape
    most = 0.0
    for axis in range(2):
        for row in range(rows):
            first = row * (columns + 2)
            for column in range(columns):
                pull = SPRING * nodes[row, column, axis]
                source[axis, first + column] = pull
                most = max(most, abs(pull))
    return most


@njit(cache=True, _nrt=False)
def relax_sheet(planes: Floats, source: Floats, stretch: SheetStencil, rule: Floats, after: Floats) -> None:
    """One sweep of over-relaxation over the sheet's velocities, (2, rows + 2, columns + 2).

    source: (2, rows * (columns + 2)), what the nodes pull it with; after: memory for one component.
    """
    stride = planes.shape[2]
    count = source.shape[1] - 2
    for axis in range(2):
        mirror(planes[1 - axis], axis == 1)
        own, other = planes[axis].reshape(-1), planes[1 - axis].reshape(-1)
        links = _links(stretch, axis)
        for colour in range(2):
            mirror(planes[axis], axis == 0)
            _after(own, other, stride, links, source[axis], rule[axis, colour], after[:count])
            moved = own[stride + 1 :]
            for k in range(count):
                moved[k] = after[k]


@njit(cache=True, _nrt=False)
def _links(stretch: SheetStencil, axis: int) -> tuple[float, float, float]:
    if axis == 0:
        return stretch.along_x, stretch.across_y, stretch.corner
    return stretch.across_x, stretch.along_y, stretch.corner


@njit(cache=True, _nrt=False, error_model="numpy")
def sheet_imbalance(planes: Floats, source: Floats, stretch: SheetStencil, left: Floats) -> float:
    """Fill `left`, (2, rows * (columns + 2)), with what the balance of the sheet lacks; returns the largest."""
    rows, columns = planes.shape[1] - 2, planes.shape[2] - 2
    stride = columns + 2
    worst = 0.0
    for axis in range(2):
        mirror(planes[axis], axis == 0)
    for axis in range(2):
        own, other = planes[axis], planes[1 - axis]
        link_x, link_y, corner = _links(stretch, axis)
        # a border that is mirrored with its sign has a link to an edge that is not there
        for row in range(rows):
            for column in range(columns):
                here = own[row + 1, column + 1]
                total = source[axis, row * stride + column] - SPRING * here
                if column > 0:
                    total += link_x * (own[row + 1, column] - here)
                if column < columns - 1:
                    total += link_x * (own[row + 1, column + 2] - here)
                if row > 0:
                    total += link_y * (own[row, column + 1] - here)
                if row < rows - 1:
                    total += link_y * (own[row + 2, column + 1] - here)
                below = other[row + 2, column + 2] - other[row + 2, column]
                above = other[row, column + 2] - other[row, column]
                total += corner * (below - above)
                left[axis, row * stride + column] = total
                worst = max(worst, abs(total))
    return worst
