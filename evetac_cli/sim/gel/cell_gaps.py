"""The gap of a rigid surface over each node's cell of the gel, and the depth to which the gel is pressed there.

A node represents its cell: SAMPLES x SAMPLES points of the cell are separate springs, and the node bears their total
force. A cell that is fully pressed does not need the points: its mean depth is the indentation minus its mean gap.

With only the gap at its centre, a node would be pressed fully or not at all. Rows of nodes would enter and leave the
contact at once, and the contact's edge would be resolved only to half a cell.
"""

from typing import NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.kernels.compiled import njit

SAMPLES = 4  # points along each side of a cell; forces are then within 0.04 % of closed forms on the scenes' grid
LEAST, MEAN, MOST, VARIANCE = range(4)  # columns of `CellGaps.summary`
MOST_STEPS = 200  # limit of a search that needs 25 steps at most


class CellGaps(NamedTuple):
    """Gaps in m between a surface and the undeformed gel, over the cells of a grid of nodes; infinite off the surface.

    sample_m: (rows, columns, samples), at the points of each cell.

    summary: (rows, columns, 4), least, mean and largest gap of each cell in m and their variance in m2.

    least_m: the gap at the point of first touch.
    """

    sample_m: Floats
    summary: Floats
    least_m: float

    def depth_m(self, indentation_m: float) -> Floats:
        """Return the mean depth to which each node's cell is pressed, (rows, columns) in m."""
        depth: Floats = mean_depth(indentation_m, self.sample_m, self.summary)
        return depth

    def indentation_m(self, depth_sum_m: float, deepest_m: float) -> float:
        """Return the indentation, at most deepest_m, at which the depths of all cells sum to depth_sum_m, > 0."""
        return float(_indentation(depth_sum_m, deepest_m, self.sample_m, self.summary))


def cell_samples(node_xy_m: Floats) -> Floats:
    """Return the points of each cell of a regular grid of nodes (rows, columns, 2): (rows, columns, samples, 2).

    The cells of a single row or column have zero width across it, because the pitch is unknown.
    """
    assert node_xy_m.ndim == 3 and node_xy_m.shape[2] == 2 and node_xy_m.size and np.isfinite(node_xy_m).all()
    rows, columns, _ = node_xy_m.shape
    along_row = node_xy_m[0, 1] - node_xy_m[0, 0] if columns > 1 else np.zeros(2)
    along_column = node_xy_m[1, 0] - node_xy_m[0, 0] if rows > 1 else np.zeros(2)
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    from_node = (places[:, None, None] * along_column + places[:, None] * along_row).reshape(-1, 2)
    return np.ascontiguousarray(node_xy_m[:, :, None, :] + from_node)


def gaps_of(sample_m: Floats) -> CellGaps:
    """Return the gaps of a surface from its gaps at the sampled points, (rows, columns, samples) in m."""
    assert sample_m.ndim == 3 and sample_m.size and not np.isnan(sample_m).any()
    sample_m = np.ascontiguousarray(sample_m)
    summary = _summary(sample_m)
    return CellGaps(sample_m, summary, float(summary[..., LEAST].min()))


@njit(cache=True)
def _summary(sample: Floats) -> Floats:
    rows, columns, count = sample.shape
    summary = np.empty((rows, columns, 4))
    for row in range(rows):
        for column in range(columns):
            least = most = sample[row, column, 0]
            total = 0.0
            for k in range(count):
                gap = sample[row, column, k]
                least = min(least, gap)
                most = max(most, gap)
                total += gap
            mean = total / count
            squares = 0.0
            for k in range(count):
                squares += (sample[row, column, k] - mean) ** 2
            if least == most:  # the mean of equal numbers is not always that number
                mean, squares = least, 0.0
            summary[row, column, LEAST] = least
            summary[row, column, MEAN] = mean
            summary[row, column, MOST] = most
            summary[row, column, VARIANCE] = squares / count
    return summary


@njit(cache=True)
def mean_depth(indentation_m: float, sample_m: Floats, summary: Floats) -> Floats:
    """Return the mean depth to which each cell is pressed, (rows, columns) in m; 0 for cells without contact."""
    rows, columns, count = sample_m.shape
    depth = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            if indentation_m <= summary[row, column, LEAST]:
                continue
            if indentation_m >= summary[row, column, MOST]:
                depth[row, column] = indentation_m - summary[row, column, MEAN]
                continue
            total = 0.0
            for k in range(count):
                total += max(indentation_m - sample_m[row, column, k], 0.0)
            depth[row, column] = total / count
    return depth


@njit(cache=True, _nrt=False)
def _indentation(depth_sum_m: float, deepest_m: float, sample_m: Floats, summary: Floats) -> float:
    """Compute `CellGaps.indentation_m` by Newton's method from above: the sum is convex and piecewise linear."""
    rows, columns, count = sample_m.shape
    at_m = deepest_m
    for _ in range(MOST_STEPS):
        depth = cells = 0.0
        for row in range(rows):
            for column in range(columns):
                if at_m <= summary[row, column, LEAST]:
                    continue
                if at_m >= summary[row, column, MOST]:
                    depth += at_m - summary[row, column, MEAN]
                    cells += 1.0
                    continue
                for k in range(count):
                    gap = sample_m[row, column, k]
                    if gap < at_m:
                        depth += (at_m - gap) / count
                        cells += 1.0 / count
        if cells == 0.0:
            break
        nearer_m = at_m - (depth - depth_sum_m) / cells
        if not nearer_m < at_m:
            break
        at_m = nearer_m
    return at_m
