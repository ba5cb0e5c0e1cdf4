"""Shear force from the displacements of dots (paper, "Dot-based Shear Force Reconstruction").

There are two models: a linear regression on the mean displacement of all dots, and a network on the displacement of
each dot. Both run with numpy alone; training.py trains the network, which needs torch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evetac_cli.arrays import Floats

AXES = ("x", "y")
CONTACT_N = 0.03  # smallest normal force that counts as contact


class Regression(NamedTuple):
    """force = mean displacement @ slope_n_px + offset_n."""

    slope_n_px: Floats  # (2, 2): from displacement x, y to force x, y
    offset_n: Floats  # (2,)


class DenseLayer(NamedTuple):
    """One fully connected layer: inputs @ weight.T + bias."""

    weight: NDArray[np.float32]  # (outputs, inputs)
    bias: NDArray[np.float32]  # (outputs,)


class Network(NamedTuple):
    """Fully connected layers with ReLU between them, from displacements in units of scale_px to forces in scale_n."""

    layers: tuple[DenseLayer, ...]
    scale_px: float
    scale_n: float


def displacement(dot_xy_px: ArrayLike, rest_xy_px: ArrayLike) -> Floats:
    """Return displacements (n, dots, 2) of tracked dots (n, dots, 2) from their positions at rest (dots, 2), in px.

    ValueError if a dot's position is NaN.
    """
    dots, rest = np.asarray(dot_xy_px, float), np.asarray(rest_xy_px, float)
    assert dots.ndim == 3 and dots.shape[1:] == rest.shape and rest.shape[-1] == 2
    moved: Floats = dots - rest
    if not np.isfinite(moved).all():
        missing = np.flatnonzero(~np.isfinite(moved).all(axis=(0, 2)))
        raise ValueError(f"expected every dot to have a position, found none for dots {missing[:8].tolist()}")
    return moved


def fit_regression(moved_px: Floats, force_n: Floats) -> Regression:
    """Fit forces (n, 2) to the mean of displacements (n, dots, 2) by least squares.

    ValueError for other shapes, non-finite values, or displacements that do not span the plane.
    """
    check_samples(moved_px, force_n)
    mean = moved_px.mean(axis=1)
    regressors = np.column_stack([mean, np.ones(len(mean))])
    solution, _, rank, _ = np.linalg.lstsq(regressors, force_n, rcond=None)
    if rank < regressors.shape[1]:
        raise ValueError(f"expected dots that moved in x and in y, found mean displacements of rank {rank} of 3")
    return Regression(solution[:2], solution[2])


def apply_regression(model: Regression, moved_px: Floats) -> Floats:
    """Return forces (n, 2) in N from displacements (n, dots, 2)."""
    force: Floats = moved_px.mean(axis=1) @ model.slope_n_px + model.offset_n
    return force


def apply_network(model: Network, moved_px: Floats) -> Floats:
    """Return forces (n, 2) in N from displacements (n, dots, 2); ValueError for a different number of dots."""
    inputs = model.layers[0].weight.shape[1]
    if moved_px[0:1].size not in (0, inputs):
        raise ValueError(f"expected {inputs // 2} dots, as in the network's training, found {moved_px.shape[1]}")
    code = (moved_px.reshape(len(moved_px), inputs) / model.scale_px).astype(np.float32)
    for number, layer in enumerate(model.layers):
        if number:
            code = np.maximum(code, 0)
        code = code @ layer.weight.T + layer.bias
    return code.astype(float) * model.scale_n


def check_samples(moved_px: Floats, force_n: Floats) -> None:
    """Assert that displacements (n, dots, 2) and forces (n, 2) are finite, equally many, at least 3."""
    assert moved_px.ndim == 3 and moved_px.shape[2] == 2 and force_n.shape == (len(moved_px), 2) and len(moved_px) >= 3
    assert np.isfinite(moved_px).all() and np.isfinite(force_n).all()


def sample_slices(normal_force_n: ArrayLike, count: int, every: int) -> NDArray[np.int64]:
    """Return `count` slices, evenly spread over the contact, at rest and in motion; shape (count,).

    The contact extends from the first to the last slice with a normal force (slices,) of at least CONTACT_N. Only
    multiples of `every` slices are used, at which a slower camera has just taken a frame. ValueError without contact,
    or if it is too short.
    """
    touching = np.flatnonzero(np.asarray(normal_force_n) >= CONTACT_N)
    if not len(touching):
        raise ValueError(f"no contact: expected a normal force of at least {CONTACT_N} N in some slice, found none")
    first = -(-int(touching[0]) // every)
    last = int(touching[-1]) // every
    if count < 1 or last - first + 1 < count:
        needed = f"{count} samples, {every} ms apart"
        raise ValueError(f"too short: expected a contact for {needed}, found {len(touching)} ms of contact")
    return np.linspace(first, last, count).round().astype(np.int64) * every


class ForceErrors(NamedTuple):
    """Absolute errors over samples: mean and standard deviation for x and y, in N."""

    mean_n: Floats  # (2,)
    sd_n: Floats  # (2,)


def errors(predicted_n: Floats, measured_n: Floats) -> ForceErrors:
    """Return the absolute errors of predicted against measured forces (n, 2), as in the paper's table."""
    off = np.abs(predicted_n - measured_n)
    return ForceErrors(off.mean(axis=0), off.std(axis=0))
