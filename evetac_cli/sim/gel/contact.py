"""Pressure of a gripped object on the gel: gaps, pressure distribution, and force against closing.

The pad is thin and bonded to a stiff back, so each point is treated as a separate spring: a Winkler foundation of
stiffness E/H per area. Each node's cell has several points (cell_gaps). The force then follows from the object's shape
in closed form. The closing of the gripper is the sum of both gels' indentation and the bending of the fingers, which
are softer than the gel. Not simulated: a layer of constant volume resists pressure more the wider the contact is, so E
is an effective modulus.

Axes are those of the image in a grasp from the top: x points down (along gravity), y to the side, in metres from the
centre of the view.
"""

import math
from dataclasses import dataclass

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import check_range
from evetac_cli.kernels.compiled import njit
from evetac_cli.sim.gel.cell_gaps import CellGaps, cell_samples, gaps_of, mean_depth
from evetac_cli.sim.setup.object_file import Shape


def pad_nodes(columns: int, rows: int, x_range_m: tuple[float, float], y_range_m: tuple[float, float]) -> Floats:
    """Return the cell centres of an evenly divided pad: (rows, columns, 2), x along columns, y along rows."""
    assert columns >= 1 and rows >= 1 and x_range_m[0] < x_range_m[1] and y_range_m[0] < y_range_m[1]
    x = x_range_m[0] + (np.arange(columns) + 0.5) * (x_range_m[1] - x_range_m[0]) / columns
    y = y_range_m[0] + (np.arange(rows) + 0.5) * (y_range_m[1] - y_range_m[0]) / rows
    return np.stack(np.meshgrid(x, y), axis=-1)


def cell_area(node_xy_m: Floats) -> float:
    """Return the area in m2 of a cell of a regular grid (rows, columns, 2) with at least two rows and two columns."""
    assert node_xy_m.ndim == 3 and node_xy_m.shape[2] == 2 and min(node_xy_m.shape[:2]) >= 2
    return float((node_xy_m[0, 1, 0] - node_xy_m[0, 0, 0]) * (node_xy_m[1, 0, 1] - node_xy_m[0, 0, 1]))


def gap_profile(node_xy_m: Floats, shape: Shape, radius_m: float = 0.0, tilt_rad: float = 0.0) -> CellGaps:
    """Return the gaps between a rigid surface and the undeformed gel at first touch, over the cells; the least is 0.

    A cylinder is upright (its axis along x), so it curves away in y; radius_m has no effect for a flat surface. Curved
    surfaces are parabolas, which is accurate for contacts narrow compared with the radius. A tilt about y opens the gap
    by tilt * x: it is the misalignment of the fingers, and makes slip begin at one end.
    """
    height = surface(cell_samples(node_xy_m), shape, radius_m, tilt_rad)
    return gaps_of(height - height.min())


def surface(
    xy_m: Floats,
    shape: Shape,
    radius_m: float = 0.0,
    tilt_rad: float = 0.0,
    *,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    round_ends: bool = False,
) -> Floats:
    """Return the height of a rigid surface over points (..., 2), as (...) in m, from its middle if it were not tilted.

    Shapes as in `gap_profile`. place: x and y of its middle in m, and its rotation from x to y. round_ends: beyond
    their radius, a cylinder and a sphere are infinitely far away.
    """
    assert np.isfinite(tilt_rad)
    assert shape in ("flat", "cylinder", "sphere")
    if shape != "flat":
        check_range("radius_m", radius_m, above=True)
    points = np.ascontiguousarray(xy_m, dtype=np.float64).reshape(-1, 2)
    curves = (shape == "sphere", shape != "flat")
    x_m, y_m, turn = place
    at = (float(x_m), float(y_m), math.cos(turn), math.sin(turn))
    height: Floats = _heights(points, curves, float(radius_m), float(tilt_rad), at, round_ends)
    return height.reshape(xy_m.shape[:-1])


@njit(cache=True)
def _heights(
    points: Floats,
    curves: tuple[bool, bool],
    radius: float,
    tilt: float,
    at: tuple[float, float, float, float],
    round_ends: bool,
) -> Floats:
    """Compute `surface`. curves: whether it curves along x and along y. at: position, cosine and sine of rotation."""
    x_m, y_m, cosine, sine = at
    height = np.empty(len(points))
    for k in range(len(points)):
        from_x = points[k, 0] - x_m
        from_y = points[k, 1] - y_m
        x = cosine * from_x + sine * from_y
        y = cosine * from_y - sine * from_x
        square = (x * x if curves[0] else 0.0) + (y * y if curves[1] else 0.0)
        height[k] = tilt * x
        if square > 0.0:
            height[k] += square / (2.0 * radius)
            if round_ends and square > radius * radius:
                height[k] = np.inf
    return height


@dataclass(frozen=True)
class ForceCurve:
    """Normal force of one finger and indentation of one gel, tabulated over closing past first touch in even steps.

    The table starts at 0 and ends at `reach_ticks`; `lookup` returns the last value beyond. second_indentation_m: of
    the second finger's gel, if its stiffness differs.
    """

    step_ticks: float
    metres_per_tick: float
    force_n: Floats
    indentation_m: Floats
    second_indentation_m: Floats | None = None

    @property
    def reach_ticks(self) -> float:
        """Return the closing of the last entry, in ticks past first touch."""
        return self.step_ticks * (len(self.force_n) - 1)


def force_curve(
    gaps: CellGaps,
    node_stiffness_n_m: float,
    gel_height_m: float,
    finger_stiffness_n_m: float,
    metres_per_tick: float,
    *,
    reach_ticks: float = 120.0,
    step_ticks: float = 0.01,
    second_stiffness: float | None = None,
) -> ForceCurve:
    """Return the table of N and indentation d over the closing c: c * metres_per_tick = 2 d + N / stiffness.

    node_stiffness_n_m is E/H * area of a point; N(d) = node_stiffness_n_m * sum of (d - gap) over pressed points. It is
    linear between the gaps of two points, so the table is exact at its entries. metres_per_tick is the change of the
    gap between the fingers, and finger_stiffness_n_m the stiffness of fingers, links and mounts for that gap. The table
    ends at reach_ticks (120 ticks are about 20 mm, 30 N with the fingers' 1.8 N/mm), or earlier if the gel would be
    pressed flat (d = gel height).

    second_stiffness: of the second finger's gel relative to the first's, if they differ.
    """
    assert np.isfinite(gaps.sample_m).all() and gaps.least_m == 0.0
    force, corner = _indentation_curve(gaps, node_stiffness_n_m, gel_height_m)
    second = corner
    if second_stiffness is not None:  # a corner at each point of either gel that comes into contact
        pushes = np.unique(np.concatenate([force, second_stiffness * force]))
        pushes = pushes[pushes <= min(1.0, second_stiffness) * force[-1]]
        second = np.interp(pushes / second_stiffness, force, corner)
        force, corner = pushes, np.interp(pushes, force, corner)
    closing = (corner + second + force / finger_stiffness_n_m) / metres_per_tick
    entries = int(min(reach_ticks, closing[-1]) / step_ticks * (1 + 1e-12)) + 1
    if entries < 2:
        raise ValueError(
            f"the gel is pressed flat {closing[-1]:.3g} ticks after touch, less than step_ticks {step_ticks}"
        )
    ticks = step_ticks * np.arange(entries)
    first_m, force_n = np.interp(ticks, closing, corner), np.interp(ticks, closing, force)
    second_m = None if second_stiffness is None else np.interp(ticks, closing, second)
    return ForceCurve(step_ticks, metres_per_tick, force_n, first_m, second_m)


def _indentation_curve(gaps: CellGaps, node_stiffness_n_m: float, gel_height_m: float) -> tuple[Floats, Floats]:
    """Return the normal force in N and the indentation in m of one gel, (corners,) each, rising, linear in between.

    The indentation is 0 where a gap is 0. There is a corner at each point of a cell that comes into contact; the last
    corner is where the first point is pressed flat.
    """
    flat_m = gaps.least_m + gel_height_m
    gap = np.sort(gaps.sample_m, axis=None)
    corner = np.unique(np.append(gap[gap < flat_m], flat_m))
    pressed = np.searchsorted(gap, corner, side="right")
    gap_sum = np.concatenate([[0.0], np.cumsum(gap[: pressed[-1]])])[pressed]
    return node_stiffness_n_m / gaps.sample_m.shape[2] * (pressed * corner - gap_sum), corner


def closing_at(curve: ForceCurve, force_n: float) -> float:
    """Return the closing in ticks past first touch at which a finger presses with force_n, within the curve's range."""
    check_range("force_n", force_n, 0.0, float(curve.force_n[-1]))
    return float(curve.step_ticks * np.interp(force_n, curve.force_n, np.arange(len(curve.force_n))))


@njit(cache=True, _nrt=False)
def lookup(table: Floats, step_ticks: float, closing_ticks: float) -> float:
    """Return a ForceCurve table's value at a closing: linear between entries, 0 before touch, the last entry beyond."""
    if closing_ticks <= 0.0:
        return 0.0
    place = closing_ticks / step_ticks
    if place >= table.shape[0] - 1:
        return float(table[-1])
    entry = int(place)
    return float(table[entry] + (place - entry) * (table[entry + 1] - table[entry]))


def pressure(indentation_m: float, gaps: CellGaps, total_force_n: float) -> Floats:
    """Return the normal force of each node, (rows, columns) in N: proportional to its cell's depth, with a given total.

    Without indentation there is no contact, and every node carries 0 for any total. ValueError if a value is not finite
    or the total is negative.
    """
    force: Floats = _pressure(indentation_m, gaps.sample_m, gaps.summary, total_force_n)
    return force


@njit(cache=True)
def _pressure(indentation_m: float, sample_m: Floats, summary: Floats, total_force_n: float) -> Floats:
    if not (np.isfinite(indentation_m) and np.isfinite(total_force_n) and total_force_n >= 0.0):
        raise ValueError("indentation_m must be finite, total_force_n finite and >= 0")
    force: Floats = mean_depth(indentation_m, sample_m, summary)
    pressed_m = force.sum()
    if pressed_m > 0.0:
        force *= total_force_n / pressed_m
    return force


def turning_arm(node_xy_m: Floats, nodal: Floats) -> float:
    """Return the largest moment, in N m per N of friction, with which a contact resists turning on the spot.

    nodal: normal force of each node, in any unit. The result is the mean distance of the force from its middle; 0
    without contact.
    """
    force = nodal.sum()
    if force <= 0.0:
        return 0.0
    middle_m = (nodal[..., None] * node_xy_m).sum((0, 1)) / force
    return float((nodal * np.linalg.norm(node_xy_m - middle_m, axis=-1)).sum() / force)
