"""Patches within friction, and the Gaussian on them: projection, optimum, closed forms, masks."""

import math

import numpy as np
import pytest

from evetac_cli.kernels.touch import patch
from evetac_cli.kernels.touch.dot_motion import (
    MOST_MODES,
    DotNoise,
    GelLayer,
    cells_about,
    dot_motion,
    modes_of,
)
from evetac_cli.kernels.touch.patch import NORMAL, TORSION, fit, weights_of_sums

LAYER = GelLayer()
DOTS = np.stack(np.meshgrid(np.linspace(-7, 7, 8), np.linspace(-5, 5, 6)), -1).reshape(-1, 2)
CELLS = cells_about(DOTS, 4.0)
MIDDLE = CELLS.middle_mm
MOTION = dot_motion(LAYER, CELLS, DOTS)
MODES = modes_of(MOTION)
NOISE = DotNoise()
DISC = np.hypot(MIDDLE[:, 0] - 1, MIDDLE[:, 1]) < 4


def pushed(shear_pa: float = 6e3, pressure_pa: float = 15e3) -> np.ndarray:
    """Motion of the dots (dots, 2) under an even shear along x and pressure on a disc."""
    return np.einsum("dakc,kc->da", MOTION, np.stack([shear_pa * DISC, 0 * DISC, pressure_pa * DISC]))


def test_the_projection_is_the_nearest_point_of_the_cone() -> None:
    """Assert that what comes out is in the cone, stays when in it, and no other point of it is nearer."""
    rng = np.random.default_rng(1)
    field = rng.normal(size=(3, 40)).astype(np.float32)
    near = patch.within_friction(field)
    assert (np.hypot(near[0], near[1]) <= patch.FRICTION * near[2] * (1 + 1e-5) + 1e-6).all()
    assert patch.within_friction(near) == pytest.approx(near, abs=1e-6)
    pressure = rng.uniform(0, 3, (500, 1))
    angle, size = rng.uniform(0, 2 * np.pi, (500, 1)), rng.uniform(0, 1, (500, 1)) * patch.FRICTION * pressure
    others = np.stack([size * np.cos(angle), size * np.sin(angle), pressure])
    distance = np.linalg.norm(others - field[:, None], axis=0)
    assert (distance >= np.linalg.norm(near - field, axis=0) - 1e-5).all()
    assert (near[:, (field[2] < 0) & (np.hypot(field[0], field[1]) < -field[2] / patch.FRICTION)] == 0).all()


def test_roughness_is_the_gradient_of_squared_differences() -> None:
    """Assert the gradient by differences, and that an even field has none."""
    rng = np.random.default_rng(2)
    field = rng.normal(size=(3, 4, 5))

    def energy(of: np.ndarray) -> float:
        return 0.5 * float((np.diff(of, axis=-1) ** 2).sum() + (np.diff(of, axis=-2) ** 2).sum())

    step = 1e-6 * rng.normal(size=field.shape)
    slope = patch.roughness(field.astype(np.float32))
    assert (energy(field + step) - energy(field - step)) / 2 == pytest.approx(float((slope * step).sum()), rel=1e-3)
    assert np.abs(patch.roughness(np.ones((3, 4, 5), np.float32))).max() == 0


def test_tractions_end_where_more_iterations_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that ten times the iterations change little, and that the patch is the disc but for cells at its rim."""
    moved = pushed()
    data, variance = MODES.of(moved), MODES.variance_mm2(NOISE, moved)
    known = patch.finder(MODES, CELLS.shape, LAYER.height_mm / LAYER.shear_modulus_pa)
    rms_mm = float(np.sqrt(np.mean(moved**2)))
    found = patch.tractions(known, data, variance, rms_mm)
    warm = patch.tractions(known, data, variance, rms_mm, found)
    monkeypatch.setattr(patch, "COLD", 1500)
    last = patch.tractions(known, data, variance, rms_mm)
    assert np.linalg.norm(found - last) < 0.1 * np.linalg.norm(last)
    assert np.linalg.norm(warm - last) < np.linalg.norm(found - last)
    told = patch.patch_of(found, 0.35).ravel()
    rim = np.abs(np.hypot(MIDDLE[:, 0] - 1, MIDDLE[:, 1]) - 4) <= 1
    assert (told == DISC)[~rim].all() and (told & DISC).sum() > 0.75 * DISC.sum()


def test_the_scale_of_the_motion_does_not_matter() -> None:
    """Assert that ten times the motion, and noise, gives ten times the tractions: the layer is linear."""
    known = patch.finder(MODES, CELLS.shape, LAYER.height_mm / LAYER.shear_modulus_pa)
    found = []
    for scale in (1.0, 10.0):
        moved = scale * pushed()
        noise = DotNoise(scale * NOISE.own_mm, scale * NOISE.common_mm)
        rms_mm = float(np.sqrt(np.mean(moved**2)))
        found.append(patch.tractions(known, MODES.of(moved), MODES.variance_mm2(noise, moved), rms_mm) / scale)
    assert found[1] == pytest.approx(found[0], rel=1e-3, abs=1e-3 * found[0].max())


def test_holes_belong_to_the_patch_and_nothing_has_none() -> None:
    """Assert that a ring of pressure is a disc, and that no pressure is no patch."""
    found = np.zeros((3, *CELLS.shape))
    assert not patch.patch_of(found, 0.3).any()
    found[2, 3:8, 3:8] = 1.0
    found[2, 5, 5] = 0.1
    assert patch.patch_of(found, 0.3).sum() == 25


def test_modes_keep_what_dots_tell() -> None:
    """Assert that modes are a rotation, the first two the mean, and that many dots lose less than their own error."""
    assert MODES.basis @ MODES.basis.T == pytest.approx(np.eye(2 * len(DOTS)), abs=1e-9)
    even = np.tile([0.3, -0.2], (len(DOTS), 1))
    assert MODES.of(even) == pytest.approx([0.3 * 48**0.5, -0.2 * 48**0.5] + [0.0] * 94, abs=1e-9)
    finer = np.stack(np.meshgrid(np.linspace(-7, 7, 16), np.linspace(-5, 5, 12)), -1).reshape(-1, 2)
    motion = dot_motion(LAYER, CELLS, finer)
    many = modes_of(motion)
    assert len(many.basis) == MOST_MODES
    moved = np.einsum("dakc,kc->da", motion, np.stack([6e3 * DISC, 0 * DISC, 15e3 * DISC]))
    left = moved.ravel() - many.basis.T @ many.of(moved)
    assert 0 < np.sqrt(np.mean(left**2)) < NOISE.own_mm


def test_the_posterior_is_that_of_the_normal_equations() -> None:
    """Assert mean, variance and covariance of sums against the textbook's formula with whole covariance matrices."""
    rng = np.random.default_rng(3)
    spot = np.hypot(*MIDDLE.T) < 2.5
    motion = MOTION[:9]
    modes = modes_of(motion)
    moved = np.einsum("dakc,kc->da", motion, np.stack([5e3 * spot, -2e3 * spot, 9e3 * spot]))
    moved += rng.normal(size=moved.shape) * NOISE.own_mm
    sums = weights_of_sums(MIDDLE)
    told = patch.posterior(modes, MIDDLE, spot, modes.of(moved), modes.variance_mm2(NOISE, moved), sums)

    own_mm2 = NOISE.own_mm**2 + NOISE.model_share**2 * np.mean(moved**2)
    errors = np.kron(own_mm2 * np.eye(9) + NOISE.common_mm**2, np.eye(2))
    operator = motion[..., spot].reshape(18, -1)
    away = np.linalg.norm(MIDDLE[spot, None] - MIDDLE[spot], axis=-1)
    one = np.exp(-away / patch.LENGTH_MM) + patch.COMMON**2
    prior = np.kron(np.diag([1, 1, patch.PRESSURE_RATIO**2]), one)
    data = moved.ravel()

    def deviance(size: float) -> float:
        whole = size**2 * operator @ prior @ operator.T + errors
        square = float(data @ np.linalg.solve(whole, data))
        misfit = max(1.0, square / 18)  # errors and tractions may both be so much larger
        return square / misfit + 18 * math.log(misfit) + float(np.linalg.slogdet(whole)[1])

    size = min(patch.SIZES_PA, key=deviance)
    whole = size**2 * operator @ prior @ operator.T + errors
    gain = size**2 * prior @ operator.T @ np.linalg.inv(whole)
    covariance = size**2 * prior - gain @ operator @ prior * size**2
    misfit = max(1.0, data @ np.linalg.solve(whole, data) / 18)
    mean = gain @ data
    assert (told.gain @ modes.of(moved)).ravel() == pytest.approx(mean, abs=2e-4 * np.abs(mean).max())
    variance = misfit * np.diag(covariance)
    assert told.variance.ravel() == pytest.approx(variance, abs=2e-4 * variance.max())
    flat = sums[:, :, spot].reshape(6, -1)
    expected = misfit * flat @ covariance @ flat.T
    assert told.sums_covariance == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
    assert told.of_sums @ modes.of(moved) == pytest.approx(flat @ mean, rel=1e-3, abs=1e-4)


def test_a_known_patch_gives_its_forces() -> None:
    """Assert that the forces of even tractions on the true disc come out, and that leaving out pressure gives shear."""
    moved = pushed()
    data, variance = MODES.of(moved), MODES.variance_mm2(NOISE, moved)
    sums = weights_of_sums(MIDDLE - [1.0, 0.0])
    told = patch.posterior(MODES, MIDDLE, DISC, data, variance, sums)
    area = DISC.sum() * 1e-6
    found = told.of_sums @ data
    assert found[:2] == pytest.approx([6e3 * area, 0.0], abs=0.02 * 6e3 * area)
    assert found[NORMAL] == pytest.approx(15e3 * area, rel=0.1)
    assert abs(found[TORSION]) < 0.02
    change = pushed(pressure_pa=0.0)
    alone = patch.posterior(MODES, MIDDLE, DISC, MODES.of(change), variance, sums[:3, :2])
    assert (alone.of_sums @ MODES.of(change))[:2] == pytest.approx([6e3 * area, 0.0], abs=0.01 * 6e3 * area)


def test_patches_that_disagree_make_deviations_larger() -> None:
    """Assert that the spread of patches is part of the deviation of sums and cells, and of the area."""
    moved = pushed()
    data, variance = MODES.of(moved), MODES.variance_mm2(NOISE, moved)
    sharp, soft = np.zeros((2, 3, *CELLS.shape))
    sharp[2] = DISC.reshape(CELLS.shape)
    soft[2] = np.maximum(1 - np.hypot(MIDDLE[:, 0] - 1, MIDDLE[:, 1]) / 8, 0).reshape(CELLS.shape)
    sure, unsure = (fit(MODES, MIDDLE, found, data, variance) for found in (sharp, soft))
    assert sure.area_sd_mm2 == 0 and sure.patch.sum() == DISC.sum()
    assert unsure.area_sd_mm2 > 1
    assert unsure.sum_sd[NORMAL] > sure.sum_sd[NORMAL]
