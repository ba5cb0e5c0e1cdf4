"""Forces from force over modulus: stiffness, creep, adaptation, and standard deviations that hold what they say."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import ForceErrorModel, GelNetwork, Stiffness
from evetac_cli.kernels.force.models import DenseLayer
from evetac_cli.kernels.touch.dot_field import LATTICE_MM

NONE = np.zeros(2)
TIMES_S = np.array([0.3, 5.0])
ERRORS = ForceErrorModel(0.3, 0.05, 0.5, 0.08)


def gel(log_sd: float = 0.1, creep: tuple[float, float] = (0.0, 0.0), creep_sd: float = 0.0) -> Stiffness:
    return Stiffness(0.15, log_sd, 1.0, log_sd, np.array(creep), np.full(2, creep_sd), TIMES_S)


def network() -> GelNetwork:
    """Sums of the field's x and y by the linear part, and a normal force of their difference; hidden layers of 0."""
    size = LATTICE_MM.size
    sums = np.zeros((3, size), np.float32)
    sums[0, 0::2], sums[1, 1::2] = 1.0, 1.0
    sums[2] = sums[0] - sums[1]
    hidden = (DenseLayer(np.zeros((4, size), np.float32), np.zeros(4, np.float32)),)
    last = DenseLayer(np.zeros((3, 4), np.float32), np.zeros(3, np.float32))
    return GelNetwork((*hidden, last), DenseLayer(sums, np.zeros(3, np.float32)), np.array([1.0, 2.0, 1.0]))


def test_twice_the_field_is_twice_the_force() -> None:
    """Assert that the network is exact for a linear gel, its normal force is never negative, and NaN stays NaN."""
    field = np.random.default_rng(0).normal(0, 0.3, (6, len(LATTICE_MM), 2))
    result = gel_forces.over_modulus(network(), field)
    x, y = field.sum(axis=1).T
    assert np.allclose(result, np.column_stack([x, 2 * y, np.maximum(x - y, 0)]), rtol=1e-5, atol=1e-5)
    assert np.allclose(gel_forces.over_modulus(network(), 2 * field), 2 * result, rtol=1e-5, atol=1e-5)
    field[2] = np.nan
    assert np.isnan(gel_forces.over_modulus(network(), field)[2]).all()
    assert (gel_forces.over_modulus(network(), 0 * field[:1]) == 0).all()


def test_force_is_modulus_times_force_over_modulus() -> None:
    """Assert 0.15 N of shear and 1 N of normal force for each mm2 of a gel without creep, and sd by closed form."""
    shear_mm2, normal_mm2 = np.array([[20.0, 0.0], [-40.0, 30.0]]), np.array([5.0, 0.0])
    terms = gel_forces.shear_terms(shear_mm2, TIMES_S)
    estimated = gel_forces.predict(gel_forces.scale_of(gel()), ERRORS, terms, gel_forces.normal_terms(normal_mm2))
    assert np.allclose(estimated.shear_n, 0.15 * shear_mm2)
    assert np.allclose(estimated.normal_n, normal_mm2)
    size = np.array([20.0, 50.0])
    variance = (0.1 * 0.15 * shear_mm2) ** 2 + (0.15 * 0.3) ** 2 + (0.15 * 0.05 * size[:, None]) ** 2
    assert np.allclose(estimated.shear_sd_n, np.sqrt(variance + gel_forces.OFFSET_N**2))
    variance = (0.1 * normal_mm2) ** 2 + 0.5**2 + (0.08 * normal_mm2) ** 2 + gel_forces.NORMAL_OFFSET_N**2
    assert np.allclose(estimated.normal_sd_n, np.sqrt(variance))


def test_creep_of_a_step() -> None:
    """Assert that the force of a sudden displacement falls by each arm's exponential, also over a gap without dots."""
    slices = 8000
    shear_mm2 = np.zeros((slices, 2))
    shear_mm2[1000:, 0] = 10.0
    terms = gel_forces.shear_terms(shear_mm2, TIMES_S)
    scale = gel_forces.scale_of(gel(creep=(0.1, 0.2)))
    force_n = np.einsum("nak,ak->na", terms, scale.shear)[:, 0]
    since_s = np.arange(1, slices - 1000 + 1) / 1000
    expected = 1.5 * (1 + 0.1 * np.exp(-since_s / 0.3) + 0.2 * np.exp(-since_s / 5.0))
    assert np.allclose(force_n[1000:], expected, rtol=1e-3)
    shear_mm2[3000:3100] = np.nan
    gap = gel_forces.shear_terms(shear_mm2, TIMES_S)
    assert np.isnan(gap[3000:3100, :, 0]).all()
    assert np.allclose(gap[3100:], terms[3100:])
    assert gel_forces.shear_terms(shear_mm2[:0], TIMES_S).shape == (0, 2, 4)


def readings(
    rng: np.random.Generator, truth: Floats, contacts: int, samples: int = 60
) -> tuple[Floats, Floats, Floats]:
    """Found force over modulus, shear readings in N and numbers of contacts, with ERRORS as they are meant."""
    number = np.repeat(np.arange(contacts), samples)
    real = np.repeat(rng.uniform(-60, 60, (len(number) // 20 + 1, 2)), 20, axis=0)[: len(number)]  # 0.8 s at each place
    exact = gel_forces.shear_terms(real, TIMES_S, step_s=0.04)
    force_n = np.einsum("nak,ak->na", exact, np.stack([truth] * 2))
    own = ERRORS.shear_share * rng.standard_normal((contacts, 2))[number]
    terms = gel_forces.shear_terms(real + own * np.linalg.norm(real, axis=1)[:, None], TIMES_S, step_s=0.04)
    return terms, force_n + rng.normal(0, 0.05, force_n.shape), number


def seconds(contact: NDArray[np.int64]) -> Floats:
    """Times of readings, one every 40 ms."""
    return np.arange(len(contact)) * 0.04


def test_known_forces_find_the_stiffness() -> None:
    """Assert that weights come from readings where these are many, and stay as before where there are none."""
    rng = np.random.default_rng(1)
    truth = 0.22 * np.array([1.0, 0.08, 0.03, 0.0])
    before = gel_forces.scale_of(gel(0.4, (0.05, 0.05), 0.03))
    terms, force_n, number = readings(rng, truth, contacts=30)
    normal = gel_forces.normal_terms(rng.uniform(0, 20, len(terms)))
    after, _ = gel_forces.adapt(
        before, ERRORS, terms, normal, force_n, 1.7 * normal[:, 0], number, seconds(number), 0.05
    )
    assert np.allclose(after.shear[:, 0], 0.22, rtol=0.03)
    assert after.normal[0] == pytest.approx(1.7, rel=0.03)
    assert (np.abs(after.shear - truth) < 4 * np.sqrt(np.diagonal(after.shear_covariance, axis1=1, axis2=2))).all()
    nothing = np.full_like(force_n, np.nan)
    same, _ = gel_forces.adapt(before, ERRORS, terms, normal, nothing, nothing[:, 0], number, seconds(number), 0.05)
    assert all(np.array_equal(one, other) for one, other in zip(same, before, strict=True))


def test_many_samples_of_one_contact_tell_little() -> None:
    """Assert that one contact leaves the modulus as unsure as its own error, however long it lasts; ten do not."""
    before = gel_forces.scale_of(gel(0.4))
    sds = []
    for contacts, samples in ((1, 2000), (10, 200)):
        terms, force_n, number = readings(np.random.default_rng(2), before.shear[0], contacts, samples)
        normal = gel_forces.normal_terms(np.zeros(len(terms)))
        after, _ = gel_forces.adapt(before, ERRORS, terms, normal, force_n, normal[:, 0], number, seconds(number), 0.05)
        sds.append(np.sqrt(after.shear_covariance[0, 0, 0]) / 0.15)
    assert 0.04 < sds[0] < 0.06
    assert sds[1] < 0.5 * sds[0]


def test_how_often_a_contact_is_read_matters_little() -> None:
    """Assert that a table of one reading a second tells nearly as much as one of 25: errors last longer than 40 ms."""
    before = gel_forces.scale_of(gel(0.4))
    terms, force_n, number = readings(np.random.default_rng(7), before.shear[0], contacts=3, samples=250)
    normal = gel_forces.normal_terms(np.zeros(len(terms)))
    sds = []
    for every in (1, 25):
        at = slice(None, None, every)
        known = (terms[at], normal[at], force_n[at], normal[at, 0], number[at], seconds(number)[at])
        after, _ = gel_forces.adapt(before, ERRORS, *known, 0.05)
        sds.append(np.sqrt(after.shear_covariance[0, 0, 0]))
    assert sds[1] == pytest.approx(sds[0], rel=0.05)


def test_readings_that_do_not_fit_change_little() -> None:
    """Assert that known forces beside dots that did not follow leave the modulus as it was, and errors much larger."""
    rng = np.random.default_rng(8)
    before = gel_forces.scale_of(gel(0.1))
    terms, force_n, number = readings(rng, before.shear[0], contacts=6, samples=100)
    terms[:, :, 0] = 0.3 * rng.permutation(terms[:, :, 0])
    normal = gel_forces.normal_terms(np.zeros(len(terms)))
    known = (terms, normal, force_n, np.full(len(normal), np.nan), number, seconds(number))
    after, errors = gel_forces.adapt(before, ERRORS, *known, 0.05)
    assert np.allclose(after.shear[:, 0], before.shear[:, 0], rtol=0.15)
    assert errors.shear_share > 4 * ERRORS.shear_share
    assert errors.normal_share == ERRORS.normal_share


def test_standard_deviations_cover() -> None:
    """Assert that 62 to 75 % of errors are within one sd after adaptation, over 150 gels and their new contacts."""
    rng = np.random.default_rng(3)
    before = gel_forces.scale_of(gel(0.4, (0.05, 0.05), 0.03))
    within = []
    for _ in range(150):
        modulus = 0.15 * np.exp(0.4 * rng.standard_normal())
        truth = modulus * np.array([1.0, *(0.05 + 0.03 * rng.standard_normal(2)), 0.0])
        truth[-1] = gel_forces.OFFSET_N * rng.standard_normal()
        terms, force_n, number = readings(rng, truth, contacts=4, samples=25)
        floor = rng.normal(0, ERRORS.shear_floor_mm2, (len(terms), 2))
        terms[:, :, 0] += floor
        normal = gel_forces.normal_terms(np.zeros(len(terms)))
        after, errors = gel_forces.adapt(
            before, ERRORS, terms, normal, force_n, normal[:, 0], number, seconds(number), 0.05
        )
        new, force_n, number = readings(rng, truth, contacts=3, samples=20)
        new[:, :, 0] += rng.normal(0, ERRORS.shear_floor_mm2, (len(new), 2))
        estimated = gel_forces.predict(after, errors, new, gel_forces.normal_terms(np.zeros(len(new))))
        within.append(np.abs(estimated.shear_n - force_n) <= estimated.shear_sd_n)
    assert 0.62 < np.mean(within) < 0.75


def test_errors_are_found_as_they_were_made() -> None:
    """Assert that floor and share of made-up errors come back, and that 68.3 % of them are within one sd."""
    rng = np.random.default_rng(4)
    true = rng.uniform(-50, 50, (6000, 1)) * rng.random((6000, 1)) ** 2
    estimated = true + 0.4 * rng.standard_normal(true.shape) + 0.1 * np.abs(true) * rng.standard_normal(true.shape)
    floor, share = gel_forces.fit_errors(estimated, true)
    assert floor == pytest.approx(0.4, rel=0.15)
    assert share == pytest.approx(0.1, rel=0.15)
    within = np.abs(estimated - true) <= np.sqrt(floor**2 + (share * estimated) ** 2)
    assert np.mean(within) == pytest.approx(0.683, abs=0.002)


def test_contact() -> None:
    """Assert that what differs in contact is told with the odds that it has, and NaN where nothing is known."""
    rng = np.random.default_rng(5)
    contact = rng.random(4000) < 0.9
    normal_mm2 = np.where(contact, 10.0, 0.02) * np.exp(rng.normal(0, 0.8, 4000))
    field = normal_mm2[:, None, None] * np.full((1, len(LATTICE_MM), 2), 0.01)
    signs = gel_forces.contact_signs(field, normal_mm2)
    weights = gel_forces.fit_contact(signs, contact)
    probability = gel_forces.contact_probability(signs, weights)
    assert ((probability >= 0.5) == contact).mean() > 0.99
    signs[0] = np.nan
    assert np.isnan(gel_forces.contact_probability(signs, weights)[0])
