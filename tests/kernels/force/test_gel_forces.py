"""Forces from force over modulus: stiffness, creep, adaptation, and standard deviations that hold what they say."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import CreepMemory, ForceErrorModel, KnownForces, Stiffness

NONE = np.zeros(2)
TIMES_S = np.array([0.3, 5.0])
SHEAR_SD_MM2, NORMAL_SD_MM2 = 0.3, 0.5
ERRORS = ForceErrorModel(0.05, 0.08)


def gel(log_sd: float = 0.1, creep: tuple[float, float] = (0.0, 0.0), creep_sd: float = 0.0) -> Stiffness:
    return Stiffness(0.15, log_sd, np.array(creep), np.full(2, creep_sd), TIMES_S)


def known(
    terms: Floats, normal: Floats, shear_n: Floats, normal_n: Floats, contact: NDArray[np.int64], time_s: Floats
) -> KnownForces:
    """Readings, with the deviations that maps of these tests have."""
    sds = np.full((len(terms), 2), SHEAR_SD_MM2), np.full(len(terms), NORMAL_SD_MM2)
    return KnownForces(terms, normal, *sds, shear_n, normal_n, contact, time_s)


def test_force_is_modulus_times_force_over_modulus() -> None:
    """Assert 0.15 N for each mm2 of a gel without creep, of both forces, and standard deviations by closed form."""
    shear_mm2, normal_mm2 = np.array([[20.0, 0.0], [-40.0, 30.0]]), np.array([5.0, 0.0])
    shear_sd, normal_sd = np.array([[0.3, 0.4], [0.5, 0.6]]), np.array([0.5, 0.7])
    terms = gel_forces.shear_terms(shear_mm2, TIMES_S)
    normal = gel_forces.normal_terms(normal_mm2, np.zeros(len(normal_mm2)))
    times = ERRORS._replace(shear_times=2.0, normal_times=3.0)
    for errors in (ERRORS, times):
        told = gel_forces.predict(gel_forces.scale_of(gel()), errors, terms, normal, shear_sd, normal_sd)
        assert np.allclose(told.shear_n, 0.15 * shear_mm2)
        assert np.allclose(told.normal_n, 0.15 * normal_mm2)
        own = errors.shear_times * 0.15 * shear_sd, errors.normal_times * 0.15 * normal_sd
        assert np.allclose(told.shear_sd_n, np.hypot(0.1 * 0.15 * shear_mm2, own[0]))
        assert np.allclose(told.normal_sd_n, np.hypot(0.1 * 0.15 * normal_mm2, own[1]))


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
    memory, blocks = CreepMemory(), np.split(shear_mm2, [1234, 3050, 7000])
    parts = [gel_forces.shear_terms(block, TIMES_S, memory=memory) for block in blocks]
    assert np.allclose(np.concatenate(parts), gap, equal_nan=True)


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
    normal = gel_forces.normal_terms(rng.uniform(0, 20, len(terms)), np.zeros(len(terms)))
    told = known(terms, normal, force_n, 0.24 * normal[:, 0], number, seconds(number))
    after, _ = gel_forces.adapt(before, ERRORS, told, 0.05)
    assert np.allclose(after.shear[:, 0], 0.22, rtol=0.03)
    assert after.normal[0] == pytest.approx(0.24, rel=0.03)
    assert (np.abs(after.shear - truth) <= 4 * np.sqrt(np.diagonal(after.shear_covariance, axis1=1, axis2=2))).all()
    nothing = np.full_like(force_n, np.nan)
    only_shear, _ = gel_forces.adapt(before, ERRORS, told._replace(normal_n=nothing[:, 0]), 0.05)
    assert only_shear.normal[0] == pytest.approx(only_shear.shear[:, 0].mean())
    assert np.sqrt(only_shear.normal_covariance[0, 0]) < 0.03 * only_shear.normal[0]
    same, _ = gel_forces.adapt(before, ERRORS, told._replace(shear_n=nothing, normal_n=nothing[:, 0]), 0.05)
    assert all(np.array_equal(one, other) for one, other in zip(same, before, strict=True))


def test_many_samples_of_one_contact_tell_little() -> None:
    """Assert that one contact leaves the modulus as unsure as its own error, however long it lasts; ten do not."""
    before = gel_forces.scale_of(gel(0.4))
    sds = []
    for contacts, samples in ((1, 2000), (10, 200)):
        terms, force_n, number = readings(np.random.default_rng(2), before.shear[0], contacts, samples)
        normal = gel_forces.normal_terms(np.zeros(len(terms)), np.zeros(len(terms)))
        told = known(terms, normal, force_n, normal[:, 0], number, seconds(number))
        after, _ = gel_forces.adapt(before, ERRORS, told, 0.05)
        sds.append(np.sqrt(after.shear_covariance[0, 0, 0]) / 0.15)
    assert 0.04 < sds[0] < 0.06
    assert sds[1] < 0.5 * sds[0]


def test_how_often_a_contact_is_read_matters_little() -> None:
    """Assert that a table of one reading a second tells nearly as much as one of 25: errors last longer than 40 ms."""
    before = gel_forces.scale_of(gel(0.4))
    terms, force_n, number = readings(np.random.default_rng(7), before.shear[0], contacts=3, samples=250)
    normal = gel_forces.normal_terms(np.zeros(len(terms)), np.zeros(len(terms)))
    sds = []
    for every in (1, 25):
        at = slice(None, None, every)
        told = known(terms[at], normal[at], force_n[at], normal[at, 0], number[at], seconds(number)[at])
        after, _ = gel_forces.adapt(before, ERRORS, told, 0.05)
        sds.append(np.sqrt(after.shear_covariance[0, 0, 0]))
    assert sds[1] == pytest.approx(sds[0], rel=0.05)


def test_readings_that_do_not_fit_change_little() -> None:
    """Assert that known forces beside dots that did not follow leave the modulus as it was, and errors much larger."""
    rng = np.random.default_rng(8)
    before = gel_forces.scale_of(gel(0.1))
    terms, force_n, number = readings(rng, before.shear[0], contacts=6, samples=100)
    terms[:, :, 0] = 0.3 * rng.permutation(terms[:, :, 0])
    normal = gel_forces.normal_terms(np.zeros(len(terms)), np.zeros(len(terms)))
    told = known(terms, normal, force_n, np.full(len(normal), np.nan), number, seconds(number))
    after, errors = gel_forces.adapt(before, ERRORS, told, 0.05)
    assert np.allclose(after.shear[:, 0], before.shear[:, 0], rtol=0.15)
    assert errors.shear_share > 4 * ERRORS.shear_share
    assert errors.shear_times == pytest.approx(errors.shear_share / ERRORS.shear_share)
    assert (errors.normal_share, errors.normal_times) == (ERRORS.normal_share, 1.0)


def test_standard_deviations_cover() -> None:
    """Assert that 62 to 75 % of errors are within one sd after adaptation, over 150 gels and their new contacts.

    A map's own deviation holds what is off in all of a contact, and what is not.
    """
    rng = np.random.default_rng(3)
    before = gel_forces.scale_of(gel(0.4, (0.05, 0.05), 0.03))
    within = []
    for _ in range(150):
        modulus = 0.15 * np.exp(0.4 * rng.standard_normal())
        truth = modulus * np.array([1.0, *(0.05 + 0.03 * rng.standard_normal(2)), 0.0])
        truth[-1] = gel_forces.OFFSET_N * rng.standard_normal()
        terms, force_n, number = readings(rng, truth, contacts=4, samples=25)
        terms[:, :, 0] += rng.normal(0, SHEAR_SD_MM2, (len(terms), 2))
        normal = gel_forces.normal_terms(np.zeros(len(terms)), np.zeros(len(terms)))
        told = known(terms, normal, force_n, normal[:, 0], number, seconds(number))
        after, errors = gel_forces.adapt(before, ERRORS, told, 0.05)
        new, force_n, number = readings(rng, truth, contacts=3, samples=20)
        own = np.hypot(SHEAR_SD_MM2, ERRORS.shear_share * np.linalg.norm(new[..., 0], axis=1))[:, None].repeat(2, 1)
        new[:, :, 0] += rng.normal(0, SHEAR_SD_MM2, (len(new), 2))
        none = np.zeros(len(new))
        estimated = gel_forces.predict(after, errors, new, gel_forces.normal_terms(none, none), own, none)
        within.append(np.abs(estimated.shear_n - force_n) <= estimated.shear_sd_n)
    assert 0.62 < np.mean(within) < 0.75
