"""Forces in N from touch maps and the stiffness of the gel; known forces from a force sensor improve the stiffness.

Dots determine force over shear modulus, in mm2: a touch map's forces divided by the modulus that it assumed. A force is
a weighted sum of terms. `Scale` has the weights as mean and covariance, which express how well the gel is known. For
the shear force, the terms are force over modulus, its parts faster than each of two times (creep), and an offset. For
the normal force, they are force over modulus, the map's own deviation of it, and an offset. The stiffness of a sensor
gives initial weights, and known forces improve them: `adapt`.

Reason for the deviation as a term: a map takes the part of a normal force that the dots do not determine to be 0. So
the less the dots determine a force, the more the map underestimates it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats

SLICE_S = 1e-3
OFFSET_N = 0.1  # sd of an unknown offset of the shear force readings
NORMAL_OFFSET_N = 0.3  # ... of the normal force readings
ROUNDS = 5  # in which the error model is enlarged until it explains the residuals
AGREES_S = 1.0  # errors of samples within this time count as a single one, because they are correlated
CREEP_ARMS = 2
# Error that is the same in all samples of a contact: sd as a share of the force. From 40 simulated contacts of eight
# shapes, seeds 6100-6104 (scripts/studies/touch/contact_maker.py). Net shear: 2.1 %, plus 0.06 mm2, which is part of
# the map's own deviation. Normal force: 5.2 % about the median of 95.6 %.
SHEAR_SHARE, NORMAL_SHARE = 0.02, 0.05
# sd of the correction factor on a touch map's normal force. The map is 4 % low in the median of these contacts and 10 %
# for the worst shape, and may differ for contacts of another gel or camera.
NORMAL_FACTOR_SD = 0.1
MOST_SHARE = 0.5  # largest deviation that counts as a term, as a share of the force
DEVIATION_WEIGHT_SD = 2.5  # sd of the deviation's weight: 2.3 for 219 contacts of 1 to 20 N (seeds 6200-6227)


class ForceErrorModel(NamedTuple):
    """Errors of touch maps, apart from the uncertainty of the gel.

    `shear_share`, `normal_share`: sd of the error that is the same in all of a contact, relative to the force. The
    map's own deviation, which was fitted to contacts with it, includes it. `shear_times`, `normal_times`: ratio of the
    errors to the map's own deviations.
    """

    shear_share: float = SHEAR_SHARE
    normal_share: float = NORMAL_SHARE
    shear_times: float = 1.0
    normal_times: float = 1.0


class Stiffness(NamedTuple):
    """Known stiffness of a gel: its shear modulus in MPa with the sd of its logarithm, and its creep.

    creep_share, creep_sd: (2,), part of the shear modulus that only lasts for creep_time_s (2,).
    """

    shear_mpa: float
    shear_log_sd: float
    creep_share: Floats
    creep_sd: Floats
    creep_time_s: Floats


class Scale(NamedTuple):
    """Weights of the terms of a force, and their covariance; for shear, x and y are the first dimension."""

    shear: Floats  # (2, 4) in MPa, the last in N
    shear_covariance: Floats  # (2, 4, 4)
    normal: Floats  # (3,)
    normal_covariance: Floats  # (3, 3)


class Forces(NamedTuple):
    """Forces in N and their standard deviations, one per sample; NaN if the terms are."""

    shear_n: Floats  # (n, 2)
    shear_sd_n: Floats  # (n, 2)
    normal_n: Floats  # (n,)
    normal_sd_n: Floats  # (n,)


class CreepMemory:
    """State of a creeping gel from one block of samples to the next: its slow parts and the last force."""

    def __init__(self) -> None:
        self.slow_mm2 = np.zeros((CREEP_ARMS, 2))
        self.last_mm2 = np.zeros(2)


def shear_terms(
    shear_mm2: Floats, creep_time_s: Floats, step_s: float = SLICE_S, memory: CreepMemory | None = None
) -> Floats:
    """Return the terms (n, 2, 4) of the shear force, from force over modulus (n, 2) at even times.

    The terms are force over modulus, its parts faster than each creep time, and 1. Samples that are NaN do not change
    the slow parts. memory: state after earlier samples, which this updates; without it, the gel was at rest.
    """
    memory = memory or CreepMemory()
    is_known = np.asarray(np.isfinite(shear_mm2).all(axis=1))
    last = (
        np.maximum.accumulate(np.where(is_known, np.arange(len(is_known)), -1)) if len(is_known) else np.empty(0, int)
    )
    filled_mm2 = np.where((last >= 0)[:, None], shear_mm2[last], memory.last_mm2)
    terms = np.ones((len(shear_mm2), 2, CREEP_ARMS + 2))
    terms[:, :, 0] = shear_mm2
    if not len(filled_mm2):
        return terms
    for arm, time_s in enumerate(creep_time_s):
        kept = np.exp(-step_s / time_s)
        slow = np.column_stack(
            [_low_pass(*pair, kept) for pair in zip(filled_mm2.T, memory.slow_mm2[arm], strict=True)]
        )
        terms[:, :, 1 + arm] = shear_mm2 - slow
        memory.slow_mm2[arm] = slow[-1]
    memory.last_mm2 = filled_mm2[-1]
    return terms


def _low_pass(values: Floats, before: float, kept: float) -> list[float]:
    """Return values (n,) after a low pass of first order; in Python, because loading scipy.signal takes a second."""
    passed = []
    for value in values.tolist():
        before = kept * before + (1.0 - kept) * value
        passed.append(before)
    return passed


def normal_terms(normal_mm2: Floats, normal_sd_mm2: Floats) -> Floats:
    """Return the terms (n, 3) of the normal force: force over modulus (n,), the map's own deviation of it, and 1.

    The deviation is limited to MOST_SHARE of the force: it is larger for contact beyond the dots, without information.
    """
    deviation_mm2 = np.minimum(normal_sd_mm2, MOST_SHARE * np.abs(normal_mm2))
    return np.column_stack([normal_mm2, deviation_mm2, np.ones(len(normal_mm2))])


def scale_of(gel: Stiffness) -> Scale:
    """Return the weights for a gel's stiffness before any known force: no offset, and the map's own normal force.

    The error of the map's normal force is in its own deviation, and not included here.
    """
    shear = gel.shear_mpa * np.array([1.0, *gel.creep_share, 0.0])
    covariance = np.outer(shear, shear) * gel.shear_log_sd**2
    covariance += np.diag([0.0, *(gel.shear_mpa * gel.creep_sd) ** 2, 0.0])
    normal, normal_covariance = np.array([gel.shear_mpa, 0.0, 0.0]), np.zeros((3, 3))
    normal_covariance[0, 0] = (gel.shear_mpa * gel.shear_log_sd) ** 2
    return Scale(np.stack([shear] * 2), np.stack([covariance] * 2), normal, normal_covariance)


def predict(
    scale: Scale, errors: ForceErrorModel, shear: Floats, normal: Floats, shear_sd_mm2: Floats, normal_sd_mm2: Floats
) -> Forces:
    """Return forces from their terms: shear (n, 2, 4), normal (n, 3), and the map's own deviations (n, 2) and (n,)."""
    shear_n = np.einsum("nak,ak->na", shear, scale.shear)
    shear_variance = np.einsum("nak,akl,nal->na", shear, scale.shear_covariance, shear)
    shear_variance += (errors.shear_times * scale.shear[:, 0] * shear_sd_mm2) ** 2
    normal_variance = np.einsum("nk,kl,nl->n", normal, scale.normal_covariance, normal)
    normal_variance += (errors.normal_times * scale.normal[0] * normal_sd_mm2) ** 2
    return Forces(shear_n, np.sqrt(shear_variance), normal @ scale.normal, np.sqrt(normal_variance))


class KnownForces(NamedTuple):
    """Terms of forces at a number of samples, with the readings of a force sensor.

    `shear` (n, 2, 4), `normal` (n, 3): terms. `shear_sd_mm2` (n, 2), `normal_sd_mm2` (n,): the map's own deviations.
    `shear_n` (n, 2), `normal_n` (n,): readings, NaN for none. `contact` (n,): number of the contact that a sample
    belongs to. `time_s` (n,): rising in each contact. Samples whose terms are NaN are ignored.
    """

    shear: Floats
    normal: Floats
    shear_sd_mm2: Floats
    normal_sd_mm2: Floats
    shear_n: Floats
    normal_n: Floats
    contact: NDArray[np.int64]
    time_s: Floats


def adapt(
    scale: Scale, errors: ForceErrorModel, known_forces: KnownForces, reading_sd_n: float
) -> tuple[Scale, ForceErrorModel]:
    """Return the weights and errors after known forces, by regression with the old weights as prior (ridge).

    The errors are the old ones, or larger by the factor by which the readings deviate more than these allow: if dots
    were tracked badly, readings contain little information about the gel. The modulus from shear is also used for the
    normal force, which has an additional factor of its own. An offset of the readings is fitted and discarded.

    The error of a contact is the same in all its samples. So each contact has its own unknown part here, and a hundred
    samples of one contact count less than ten of each of ten.
    """

    def variance(own_sd_mm2: Floats, modulus: float) -> Floats:
        return (modulus * own_sd_mm2) ** 2 + reading_sd_n**2

    offsets_free = np.array([*np.zeros(CREEP_ARMS + 1), OFFSET_N**2])
    shears = [
        _update(
            scale.shear[axis],
            scale.shear_covariance[axis],
            offsets_free,
            _Readings(
                known_forces.shear[:, axis],
                known_forces.shear_n[:, axis],
                scale.shear[axis, 0] * np.linalg.norm(known_forces.shear[..., 0], axis=1),
                variance(known_forces.shear_sd_mm2[:, axis], scale.shear[axis, 0]),
                known_forces.contact,
                known_forces.time_s,
            ),
            errors.shear_share,
            offsets=True,
        )
        for axis in (0, 1)
    ]
    means, covariances = np.stack([one[0] for one in shears]), np.stack([one[1] for one in shears])
    normal, normal_covariance = scale.normal.copy(), scale.normal_covariance.copy()
    if np.isfinite(known_forces.shear_n).any():
        normal[0], normal_covariance[0, 0] = means[:, 0].mean(), covariances[:, 0, 0].mean()
    normals = _update(
        normal,
        normal_covariance,
        np.array([(NORMAL_FACTOR_SD * normal[0]) ** 2, (DEVIATION_WEIGHT_SD * normal[0]) ** 2, NORMAL_OFFSET_N**2]),
        _Readings(
            known_forces.normal,
            known_forces.normal_n,
            normal[0] * known_forces.normal[:, 0],
            variance(known_forces.normal_sd_mm2, normal[0]),
            known_forces.contact,
            known_forces.time_s,
        ),
        errors.normal_share,
        offsets=False,
    )
    of_shear, of_normal = max(one[2] for one in shears), normals[2]
    enlarged = ForceErrorModel(
        of_shear * errors.shear_share,
        of_normal * errors.normal_share,
        of_shear * errors.shear_times,
        of_normal * errors.normal_times,
    )
    for weights, sure in ((means, covariances), (normals[0], normals[1])):
        # the offset belongs to the force sensor, not to the gel
        weights[..., -1] = sure[..., -1, :] = sure[..., :, -1] = 0.0
    return Scale(means, covariances, normals[0], normals[1]), enlarged


class _Readings(NamedTuple):
    """Terms (n, k) and readings (n,) of a force, its approximate size, and the contact and time of each sample.

    variance: of a single reading; all readings within AGREES_S together count as one.
    """

    terms: Floats
    reading_n: Floats
    size_n: Floats
    variance: Floats
    contact: NDArray[np.int64]
    time_s: Floats


def _update(
    mean: Floats, covariance: Floats, free: Floats, readings: _Readings, share: float, *, offsets: bool
) -> tuple[Floats, Floats, float]:
    """Return mean and covariance of the weights after readings, and the factor on the expected errors.

    Each contact also has its own factor, of sd `share`. `free`: additional variance (weights,) that the weights have
    once there are readings. `offsets`: each contact also has its own offset, of sd `share` times its typical force.
    This is for forces of both signs.
    """
    terms, reading_n, size_n, variance, contact, time_s = readings
    is_known = np.isfinite(reading_n) & np.isfinite(terms).all(axis=1)
    if not is_known.any():
        return mean, covariance, 1.0
    covariance = covariance + np.diag(free)
    variance = variance[is_known]
    terms, reading_n, size_n = terms[is_known], reading_n[is_known], size_n[is_known]
    numbers, place = np.unique(contact[is_known], return_inverse=True)
    of_contact = np.equal(place.reshape(-1)[:, None], np.arange(len(numbers)))
    alone = 1.0 / _beside(contact[is_known], time_s[is_known])
    first = terms[:, :1] * mean[0]
    typical = np.sqrt((of_contact * first**2).sum(axis=0) / of_contact.sum(axis=0))
    own = np.column_stack([of_contact * first, *([of_contact * typical] if offsets else [])])
    everything = np.column_stack([terms, own])
    size, start = len(mean), np.concatenate([mean, np.zeros(own.shape[1])])
    before = np.zeros((len(start),) * 2)
    before[:size, :size] = covariance
    larger = 1.0
    for _ in range(ROUNDS):
        before[size:, size:] = np.eye(own.shape[1]) * (larger * share) ** 2
        # In units of the prior's deviations, terms of any size are solved equally well, and certain weights stay fixed.
        values, vectors = np.linalg.eigh(before)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        scaled = everything @ root
        weighted = (alone / (larger**2 * variance))[:, None] * scaled
        precision = scaled.T @ weighted + np.eye(len(before))
        weights = start + root @ np.linalg.solve(precision, weighted.T @ (reading_n - everything @ start))
        off = (alone * (reading_n - everything @ weights) ** 2 / (variance + (share * size_n) ** 2)).sum()
        off += (weights[size:] ** 2).sum() / max(share, 1e-9) ** 2
        larger = max(1.0, float(np.sqrt(off / (alone.sum() + own.shape[1]))))
    after = np.asarray(root @ np.linalg.solve(precision, root.T), np.float64)
    return weights[:size], after[:size, :size], larger


def _beside(contact: NDArray[np.int64], time_s: Floats) -> Floats:
    """Return the number of samples (n,) within AGREES_S around each one in its contact, including itself."""
    many = np.empty(len(time_s))
    for number in np.unique(contact):
        of_contact = contact == number
        times = time_s[of_contact]
        last = np.searchsorted(times, times + AGREES_S / 2, side="right")
        many[of_contact] = last - np.searchsorted(times, times - AGREES_S / 2)
    return many
