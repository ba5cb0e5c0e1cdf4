"""The gel's layer as one matrix over all nodes, of any order, and the motion of a trial on it found by another search.

Independent springs, the sheet of `gel` eliminated, or the exact layer. The balance is found by alternating directions,
which shares no code with `gel`.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.common.gel_case import GelCase
from evetac_cli.kernels.gel_layer import Squeeze, compliance, sheet_stiffness
from evetac_cli.sim.gel import gel

BEYOND = 3.0  # gel heights by which the sheet extends beyond its pad
BOX = 4  # period of the exact layer, in pads: the nearest copy of the pad is three pads away
FINER = 3  # wave numbers of the exact layer: up to this many times the grid's on either side
SAMPLE_S = 0.01


class Motion(NamedTuple):
    """The object's pose (samples, 3) and the displacement of the nodes (samples, nodes, 2), every 10 ms."""

    pose: Floats
    gel_m: Floats

    def errors_um(self, reference: "Motion") -> tuple[float, float]:
        """Root mean square distances of the object's position and of the gel from a reference."""
        square = ((self.pose - reference.pose)[:, :2] ** 2).sum(-1).mean()
        gel_square = ((self.gel_m - reference.gel_m) ** 2).sum(-1).mean()
        return 1e6 * math.sqrt(square), 1e6 * math.sqrt(gel_square)


def simulate(trial: GelCase, dt_s: float, theta: float, *, tolerance: float = 1e-6) -> Motion:
    """Simulate a trial with `gel.step`; dt_s divides 10 ms."""
    state, shares = trial.start()
    samples = []
    for k in range(round(trial.seconds / dt_s)):
        at_s = (k + theta) * dt_s
        nodal_n = trial.load(at_s) * shares
        gel.step(state, nodal_n, trial.force_at(at_s), trial.friction, dt_s, theta=theta, tolerance=tolerance)
        if (k + 1) % round(SAMPLE_S / dt_s) == 0:
            samples.append((state.pose.copy(), state.displacement_m.reshape(-1, 2).copy()))
    return Motion(*(np.array(column) for column in zip(*samples, strict=True)))


class LayerMatrix(NamedTuple):
    """A pad of n nodes: stiffness in N/m (2 n, 2 n), with displacements along x, then along y; and its squeeze.

    squeeze: (2 n, n), the surface force with which normal forces on the nodes push the gel aside, in their unit.
    """

    stiffness: Floats
    squeeze: Floats


def dense_layer(state: gel.GelState, order: int, *, goes_on: bool = False) -> LayerMatrix:
    """Return the layer of an order; goes_on: it extends beyond its pad, where nothing touches it.

    order 0: a G/H on the diagonal, no squeeze; 1: that of `gel`, its sheet eliminated; 2: exact stiffness and squeeze,
    always extending beyond the pad.
    """
    count = state.stuck.size
    if order == 0:
        return LayerMatrix(state.constant("shear") * np.eye(2 * count), np.zeros((2 * count, count)))
    shear, pressure = _exact_answers(state) if order == 2 else _sheet_answers(state, goes_on)
    stiffness = np.asarray(np.linalg.inv(shear), dtype=np.float64)
    return LayerMatrix(stiffness, stiffness @ pressure)


def _sheet_answers(state: gel.GelState, goes_on: bool) -> tuple[Floats, Floats]:
    """Return the same as `_exact_answers` for the sheet inside the gel.

    If it goes on, by BEYOND heights on all sides.
    """
    height_m = state.material.height_m
    rows, columns = state.stuck.shape
    pitch_x, pitch_y = state.constant("pitch_x"), state.constant("pitch_y")
    more_x, more_y = (math.ceil(BEYOND * height_m / pitch) if goes_on else 0 for pitch in (pitch_x, pitch_y))
    x, y = pitch_x * np.arange(columns + 2 * more_x), pitch_y * np.arange(rows + 2 * more_y)
    nodes = np.stack(np.meshgrid(x, y), axis=-1)
    inside = np.zeros(nodes.shape[:2], np.bool_)
    inside[more_y : more_y + rows, more_x : more_x + columns] = True
    own = np.flatnonzero(np.tile(inside.ravel(), 2))
    solve = splu((state.material.shear_modulus_pa * sheet_stiffness(nodes, height_m)).tocsc()).solve
    pulled = np.zeros((4 * inside.size, len(own)))
    pulled[own, np.arange(len(own))] = 1.0
    squeeze = Squeeze(nodes, height_m)
    pushed = np.zeros((4 * inside.size, inside.sum()))
    for number, node in enumerate(zip(*np.nonzero(inside), strict=True)):
        normal = np.zeros(inside.shape)
        normal[node] = 1.0
        pushed[: 2 * inside.size, number] = np.moveaxis(squeeze.of(normal), 2, 0).ravel()
    return solve(pulled)[own], solve(pushed)[own]


def _exact_answers(state: gel.GelState) -> tuple[Floats, Floats]:
    """Return displacements in m of the exact layer per N on a node: by shear, (2 n, 2 n), and by pressure, (2 n, n).

    A force is uniform over the node's cell, and the displacement is the mean over a cell. The result is a sum over the
    waves of a box of BOX pads. Waves finer than the grid alias to coarser ones and are added to those.
    """
    rows, columns = state.stuck.shape
    pitch_x, pitch_y = state.constant("pitch_x"), state.constant("pitch_y")
    answers = np.zeros((5, BOX * rows, BOX * columns), dtype=np.complex128)
    for finer_y in range(-FINER, FINER + 1):
        for finer_x in range(-FINER, FINER + 1):
            per_x = np.fft.fftfreq(BOX * columns) + finer_x  # waves for each node
            per_y = np.fft.fftfreq(BOX * rows) + finer_y
            k_x, k_y = np.meshgrid(2 * np.pi / pitch_x * per_x, 2 * np.pi / pitch_y * per_y)
            k = np.hypot(k_x, k_y)
            along, across, aside = np.ones((3, *k.shape)) * state.material.height_m / state.material.shear_modulus_pa
            waves = k > 0
            exact = compliance(k[waves], state.material.height_m, state.material.shear_modulus_pa)
            along[waves], across[waves], aside[waves] = exact.along, exact.across, exact.aside
            k[~waves] = 1.0
            over_cells = (np.sinc(per_y)[:, None] * np.sinc(per_x)) ** 2
            towards_x, towards_y = k_x / k, k_y / k
            answers[0] += over_cells * (across + (along - across) * towards_x**2)
            answers[1] += over_cells * (along - across) * towards_x * towards_y
            answers[2] += over_cells * (across + (along - across) * towards_y**2)
            answers[3] += 1j * over_cells * aside * towards_x
            answers[4] += 1j * over_cells * aside * towards_y
    apart = np.fft.ifft2(answers).real / state.cell_area_m2
    row, column = (index.ravel() for index in np.indices((rows, columns)))
    xx, xy, yy, of_x, of_y = apart[:, row[:, None] - row, column[:, None] - column]
    return np.block([[xx, xy], [xy, yy]]), np.concatenate([of_x, of_y])


def simulate_dense(
    trial: GelCase, order: int, dt_s: float, theta: float, *, goes_on: bool = False, tolerance: float = 1e-6
) -> Motion:
    """Simulate a trial with the time steps of `gel.step` on a `dense_layer`, its balance found by another method.

    By alternating directions: a linear system of all nodes, whose matrix is inverted once; then the friction of each
    node; then the force that makes both agree. The trial's material must be coupled (order 0 drops it here).
    """
    state, shares = trial.start()
    stiffness, squeezes = dense_layer(state, order, goes_on=goes_on)
    squeeze = squeezes @ shares.ravel()
    viscous_s, share, arm_s = (state.constant(name) for name in ("viscous_time", "maxwell_share", "maxwell_time"))
    count = shares.size
    h = theta * dt_s
    mu = trial.friction.static
    gain = -share * arm_s * math.expm1(-h / arm_s)
    matrix = state.constant("node_mass") / h * np.eye(2 * count) + (h + viscous_s + gain) * stiffness
    ends = np.linalg.eigvalsh(matrix)[[0, -1]]
    penalty = math.sqrt(float(ends[0] * ends[1]))  # between the softest and the stiffest pattern
    matrix[np.diag_indices(2 * count)] += penalty
    soften = cho_solve(cho_factor(matrix), np.eye(2 * count))
    weight = state.inertia / h / state.pads
    moved, moving, lagging, slip, price = np.zeros((5, 2 * count))
    samples = []
    for k in range(round(trial.seconds / dt_s)):
        grip_n = trial.load((k + theta) * dt_s)
        bound = mu * grip_n * shares.ravel() / penalty
        right = state.constant("node_mass") / h * moving - stiffness @ moved + grip_n * squeeze
        right -= math.exp(-h / arm_s) * lagging
        body_right = weight * state.twist + np.array(trial.force_at((k + theta) * dt_s)) / state.pads
        arm = (state.node_xy_m - state.pose[:2]).reshape(-1, 2).T
        ways = np.zeros((3, 2, count))  # motion of the nodes with the object
        ways[0, 0] = ways[1, 1] = 1.0
        ways[2] = -arm[1], arm[0]
        rigid = ways.reshape(3, 2 * count)
        soft = penalty * rigid @ soften
        system = np.diag(weight) + penalty * rigid @ (rigid - soft).T
        scale = float(np.abs(right).sum() + penalty * bound.sum() + np.abs(body_right).sum())
        for _ in range(5000):
            alone = soften @ (right + penalty * (slip - price))
            body = np.linalg.solve(system, body_right + penalty * rigid @ (alone - slip + price))
            velocity = alone + body @ soft
            apart = velocity - body @ rigid
            wanted = apart + price
            speed = np.maximum(np.hypot(wanted[:count], wanted[count:]), 1e-300)
            before, slip = slip, np.tile(np.maximum(0.0, 1.0 - bound / speed), 2) * wanted
            price = wanted - slip
            off = max(float(np.abs(apart - slip).max()), float(np.abs(slip - before).max()))
            if penalty * off <= tolerance * scale:
                break
        else:
            raise RuntimeError(f"no balance in step {k}")
        lagging[:] *= math.exp(-dt_s / arm_s)
        build = -share * arm_s * math.expm1(-dt_s / arm_s)
        lagging[:] += build * (stiffness @ velocity)
        moved[:] += dt_s * velocity
        moving = moving + (velocity - moving) / theta
        state.pose += dt_s * body
        state.twist += (body - state.twist) / theta
        if (k + 1) % round(SAMPLE_S / dt_s) == 0:
            samples.append((state.pose.copy(), moved.reshape(2, count).T.copy()))
    return Motion(*(np.array(column) for column in zip(*samples, strict=True)))
