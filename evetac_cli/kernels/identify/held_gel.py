"""Stiffness and creep of a gel, from how far its dots move when the gel takes over the weight of a held object.

The gel layer is that of the simulator (kernels/gel_layer). An object that does not slip moves the gel under it as one
piece; around it the displacement fades. The contact area is unknown. It is modelled as a strip along the weight whose
half width may differ at its two ends, as for a cylinder between fingers that are not quite parallel, and fitted to the
dots.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import spsolve

from evetac_cli.arrays import Floats
from evetac_cli.kernels.gel_layer import sheet_stiffness

HOLDS = 300.0  # stiffness of the bond between object and gel, as a multiple of the layer's: in effect rigid
EDGE_M = 0.3e-3  # blur of the contact's border, so that the fit is differentiable
QUICK_ARM = (0.15, 10e-3)  # share and time in s of the quick viscoelastic arm, the same for every gel (sim/gel)
ARM_S = ((0.1, 1.0), (2.0, 10.0))  # ranges of the time constants of the two slow arms
MOST_SHARE = 0.3  # upper bound on the share of one arm
ARM_TIMES = 7  # time constants tried for each arm


class Pad(NamedTuple):
    """Nodes of a pad, (rows, columns, 2) in m, and the height of the gel."""

    node_xy_m: Floats
    height_m: float


class HeldFit(NamedTuple):
    """Displacement of the held part of the gel along the weight in m, and stiffness over shear modulus in m.

    moved: displacement at each dot, as a share of that of the held part. misfit: rms residual at the dots, as a share
    of the displacement.
    """

    displacement_m: float
    stiffness_m: float
    moved: Floats
    misfit: float


def shape(pad: Pad, stiffness: sparse.csr_matrix, strip: Floats) -> tuple[Floats, float]:
    """Return the displacement of each node per unit of the object's, (rows, columns), and force over shear modulus.

    stiffness: of the layer, from `gel_layer.sheet_stiffness`. strip: half width in m at the pad's first and last
    column, and the middle of the strip, all across x.
    """
    nodes = pad.node_xy_m
    along = (nodes[..., 0] - nodes[0, 0, 0]) / (nodes[0, -1, 0] - nodes[0, 0, 0])
    half = strip[0] * (1 - along) + strip[1] * along
    inside = 1 / (1 + np.exp(np.clip((np.abs(nodes[..., 1] - strip[2]) - half) / EDGE_M * 4, -50, 50)))
    inside *= 1 / (1 + np.exp(np.clip(-half / EDGE_M * 4, -50, 50)))
    area = (nodes[0, 1, 0] - nodes[0, 0, 0]) * (nodes[1, 0, 1] - nodes[0, 0, 1])
    hold = (HOLDS * area / pad.height_m * inside).reshape(-1)
    count = len(hold)
    on_nodes = np.concatenate([hold, hold, np.zeros(2 * count)])  # the object does not move across the weight
    pulled = np.concatenate([hold, np.zeros(3 * count)])
    moved = spsolve((stiffness + sparse.diags(on_nodes)).tocsc(), pulled)
    return moved[:count].reshape(inside.shape), float((stiffness @ moved)[:count].sum())


def fit(pad: Pad, dot_xy_m: Floats, displacement_m: Floats) -> HeldFit:
    """Fit contact and displacement to the displacement of the dots (dots,) along the weight, which is x of the pad.

    ValueError with fewer than 12 dots on the pad, or if they do not move.
    """
    nodes = pad.node_xy_m
    low, high = nodes[0, 0], nodes[-1, -1]
    on_pad = np.all((dot_xy_m >= low) & (dot_xy_m <= high), axis=1) & np.isfinite(displacement_m)
    if on_pad.sum() < 12:
        raise ValueError(f"expected at least 12 dots on the pad, found {on_pad.sum()}")
    largest_m = float(np.percentile(displacement_m[on_pad], 90))
    if not largest_m > 0:
        raise ValueError("the dots do not move along the weight")
    stiffness = sheet_stiffness(pad.node_xy_m, pad.height_m)
    half_pad = float(high[1] - low[1]) / 2

    def at_dots(moved: Floats) -> Floats:
        place = (dot_xy_m[on_pad] - low) / (nodes[1, 1] - nodes[0, 0])
        whole = np.minimum(place.astype(np.intp), np.array(moved.shape)[::-1] - 2)
        part = place - whole
        column, row = whole.T
        x, y = part.T
        upper = moved[row, column] * (1 - x) + moved[row, column + 1] * x
        lower = moved[row + 1, column] * (1 - x) + moved[row + 1, column + 1] * x
        result: Floats = upper * (1 - y) + lower * y
        return result

    wanted = displacement_m[on_pad]

    def residuals(parameters: Floats) -> Floats:
        moved, _ = shape(pad, stiffness, parameters[:3] * 1e-3)
        off: Floats = at_dots(moved) * parameters[3] - wanted / largest_m
        return off

    start = np.array([0.5 * half_pad * 1e3, 0.5 * half_pad * 1e3, float(low[1] + high[1]) * 500, 1.0])
    bounds = ([-2.0, -2.0, start[2] - 5.0, 0.3], [1.2 * half_pad * 1e3] * 2 + [start[2] + 5.0, 3.0])
    fitted = least_squares(residuals, start, bounds=bounds, loss="soft_l1", f_scale=0.1, diff_step=1e-2, max_nfev=30)
    moved, force_m = shape(pad, stiffness, fitted.x[:3] * 1e-3)
    everywhere = np.full(len(dot_xy_m), np.nan)
    everywhere[on_pad] = at_dots(moved)
    misfit = float(np.sqrt(np.mean(residuals(fitted.x) ** 2)))
    return HeldFit(float(fitted.x[3]) * largest_m, force_m, everywhere, misfit)


class Creep(NamedTuple):
    """Shares and times in s of two slow arms, the final displacement, and the rms residual as a share of it."""

    share: tuple[float, float]
    time_s: tuple[float, float]
    final: float
    misfit: float


def creep(time_s: Floats, displacement: Floats, loaded_s: float) -> Creep:
    """Fit two slow arms to the displacement under a constant force that came on within loaded_s before time 0.

    Every pair of time constants is tried; shares and final displacement are fitted for each pair. ValueError if the
    final displacement is not above 0.
    """
    if len(time_s) < 10 or not np.median(displacement[-len(displacement) // 4 :]) > 0:
        raise ValueError("nothing moves under the weight")
    best: tuple[float, Creep] | None = None
    shares = np.array([0.03, 0.03])
    ends = float(np.median(displacement[-len(displacement) // 4 :]))
    for first in np.geomspace(*ARM_S[0], ARM_TIMES):
        for second in np.geomspace(*ARM_S[1], ARM_TIMES):

            def residuals(parameters: Floats, first: float = first, second: float = second) -> Floats:
                expected = response(time_s, loaded_s, parameters[:2], np.array([first, second]))
                off: Floats = parameters[2] * expected - displacement / ends
                return off

            fitted = least_squares(
                residuals, [*shares, 1.0], bounds=([0.0, 0.0, 0.5], [MOST_SHARE, MOST_SHARE, 2.0]), max_nfev=12
            )
            if best is None or fitted.cost < best[0]:
                share = (float(fitted.x[0]), float(fitted.x[1]))
                misfit = float(np.sqrt(np.mean(fitted.fun**2)))
                best = (fitted.cost, Creep(share, (float(first), float(second)), float(fitted.x[2]) * ends, misfit))
    assert best is not None
    return best[1]


def response(time_s: Floats, loaded_s: float, shares: Floats, times_s: Floats) -> Floats:
    """Return displacement over final displacement, at times after a force that came on evenly within loaded_s.

    Generalised Maxwell model: a spring in parallel with arms of a spring and a dashpot in series. Under a constant
    force f = u + sum s v, v' = u' - v/T.
    """
    share = np.append(shares, QUICK_ARM[0])
    rate = 1.0 / np.append(times_s, QUICK_ARM[1])
    at_once = 1.0 / (1.0 + share.sum())
    change = at_once * np.outer(np.ones(len(share)), share * rate) - np.diag(rate)
    values, vectors = np.linalg.eig(change)
    weights = np.linalg.solve(vectors, np.full(len(share), at_once)) * (share @ vectors)
    total: Floats = np.zeros(len(time_s))
    for part in (np.arange(8) + 0.5) / 8:
        since = time_s + part * loaded_s
        total += 1.0 - (np.exp(np.outer(since, values)) @ weights).real
    return total / 8
