"""Shear and normal force of any sensor, from the displacement of its gel and what is known of the gel's stiffness.

What dots show is force over modulus: a bonded layer of height H answers a shear force F with displacements whose
integral is F H / G, and a normal force N with an indentation whose integral is N H / E, seen by how the dots spread.
A small network that was trained on contacts of such a layer gives both in mm2 (times MPa: N) from the field on a
lattice (dot_field). As the layer is linear, the field is divided by its root mean square first, and the result
multiplied by it: the network learns shapes of contacts, not sizes of forces.

Force is then a sum of terms whose weights are known as well as the gel is: `Scale`, mean and covariance. For the shear
force, of force over modulus, of its part faster than each of two times (creep), and an offset; for the normal force, of
force over modulus and an offset. A sensor's stiffness gives the weights, and known forces correct them: `adapt`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.kernels import logistic
from evetac_cli.kernels.force.models import DenseLayer

SLICE_S = 1e-3
LEAST_MM = 2e-3  # added to the field's root mean square: a gel at rest moves by what the tracker errs
OFFSET_N = 0.1  # sd of an offset of the shear force that is not yet known
NORMAL_OFFSET_N = 0.3
ROUNDS = 5  # in which errors are enlarged until they explain what readings are off by
AGREES_S = 1.0  # errors this close in time are taken as one: so much less do many samples tell
LOG_FLOOR_MM = 1e-3
CREEP_ARMS = 2


class GelNetwork(NamedTuple):
    """Fully connected layers with ReLU between them, and a linear part beside them; to x, y, normal in mm2."""

    layers: tuple[DenseLayer, ...]
    linear: DenseLayer
    scale_mm2: Floats  # (3,): what comes out is multiplied by it


class ForceErrorModel(NamedTuple):
    """How far force over modulus is off, sd: a floor in mm2, and a share of it that is the same in all of a contact."""

    shear_floor_mm2: float
    shear_share: float
    normal_floor_mm2: float
    normal_share: float


class Stiffness(NamedTuple):
    """What is known of a gel: moduli in MPa, each with the sd of its logarithm, and how it creeps.

    creep_share, creep_sd: (2,), part of the shear modulus that lasts creep_time_s (2,) only.
    """

    shear_mpa: float
    shear_log_sd: float
    normal_mpa: float
    normal_log_sd: float
    creep_share: Floats
    creep_sd: Floats
    creep_time_s: Floats


class Scale(NamedTuple):
    """Weights of the terms of a force, and how sure they are; those of x and y in the first dimension."""

    shear: Floats  # (2, 4) in MPa, the last in N
    shear_covariance: Floats  # (2, 4, 4)
    normal: Floats  # (2,)
    normal_covariance: Floats  # (2, 2)


class Forces(NamedTuple):
    """Forces in N and their standard deviations, a sample each; NaN where too few dots are tracked."""

    shear_n: Floats  # (n, 2)
    shear_sd_n: Floats  # (n, 2)
    normal_n: Floats  # (n,)
    normal_sd_n: Floats  # (n,)


def over_modulus(network: GelNetwork, field_mm: Floats) -> Floats:
    """Shear force x, y over the shear modulus, normal force over the normal modulus, (n, 3) in mm2; NaN as the field.

    field_mm: (n, places, 2) as from `dot_field.lattice_field`. The normal force is 0 or more.
    """
    rms = np.sqrt((field_mm**2).mean(axis=(1, 2)))[:, None] + LEAST_MM
    inputs = field_mm.reshape(len(field_mm), -1) / rms
    code = inputs
    for number, layer in enumerate(network.layers):
        if number:
            code = np.maximum(code, 0.0)
        code = code @ layer.weight.T + layer.bias
    result: Floats = (code + inputs @ network.linear.weight.T + network.linear.bias) * rms * network.scale_mm2
    result[:, 2] = np.where(np.isnan(result[:, 2]), np.nan, np.maximum(result[:, 2], 0.0))
    return result


def shear_terms(shear_mm2: Floats, creep_time_s: Floats, step_s: float = SLICE_S) -> Floats:
    """Terms (n, 2, 4) of the shear force from force over modulus (n, 2) at even times.

    They are itself, its parts faster than each creep time, and 1. Samples without a value (NaN) move no slow part.
    """
    from scipy import signal  # here, as it takes most of a second and a file that exists needs none of it

    known = np.asarray(np.isfinite(shear_mm2).all(axis=1))
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1)) if len(known) else np.empty(0, int)
    held = np.where((last >= 0)[:, None], shear_mm2[last], 0.0)
    terms = np.ones((len(shear_mm2), 2, CREEP_ARMS + 2))
    terms[:, :, 0] = shear_mm2
    for arm, time_s in enumerate(creep_time_s):
        kept = np.exp(-step_s / time_s)
        slow = signal.lfilter([1.0 - kept], [1.0, -kept], held, axis=0) if len(held) else held
        terms[:, :, 1 + arm] = shear_mm2 - slow
    return terms


def normal_terms(normal_mm2: Floats) -> Floats:
    """Terms (n, 2) of the normal force: force over modulus (n,), and 1."""
    return np.column_stack([normal_mm2, np.ones(len(normal_mm2))])


def scale_of(gel: Stiffness) -> Scale:
    """The weights that a gel's stiffness gives, before any known force."""
    shear = gel.shear_mpa * np.array([1.0, *gel.creep_share, 0.0])
    covariance = np.outer(shear, shear) * gel.shear_log_sd**2
    covariance += np.diag([0.0, *(gel.shear_mpa * gel.creep_sd) ** 2, OFFSET_N**2])
    normal = np.array([gel.normal_mpa, 0.0])
    normal_covariance = np.diag([(gel.normal_mpa * gel.normal_log_sd) ** 2, NORMAL_OFFSET_N**2])
    return Scale(np.stack([shear] * 2), np.stack([covariance] * 2), normal, normal_covariance)


def predict(scale: Scale, errors: ForceErrorModel, shear: Floats, normal: Floats) -> Forces:
    """Forces from their terms: shear (n, 2, 4), normal (n, 2); NaN where these are. The normal force is 0 or more."""
    shear_n = np.einsum("nak,ak->na", shear, scale.shear)
    shear_variance = np.einsum("nak,akl,nal->na", shear, scale.shear_covariance, shear)
    modulus = scale.shear[:, 0]
    shear_variance += (errors.shear_floor_mm2 * modulus) ** 2
    shear_variance += (errors.shear_share * modulus * np.linalg.norm(shear[..., 0], axis=1)[:, None]) ** 2
    normal_n = normal @ scale.normal
    normal_variance = np.einsum("nk,kl,nl->n", normal, scale.normal_covariance, normal)
    normal_variance += (errors.normal_floor_mm2 * scale.normal[0]) ** 2
    normal_variance += (errors.normal_share * scale.normal[0] * normal[:, 0]) ** 2
    normal_n = np.where(np.isnan(normal_n), np.nan, np.maximum(normal_n, 0.0))
    return Forces(shear_n, np.sqrt(shear_variance), normal_n, np.sqrt(normal_variance))


def adapt(
    scale: Scale,
    errors: ForceErrorModel,
    shear: Floats,
    normal: Floats,
    shear_n: Floats,
    normal_n: Floats,
    contact: NDArray[np.int64],
    time_s: Floats,
    reading_sd_n: float,
) -> tuple[Scale, ForceErrorModel]:
    """The weights after known forces, by regression with the weights before as prior (ridge towards them), and errors.

    The errors are those given, or as much larger as readings are farther off than they allow: of dots that were tracked
    badly, readings say little about the gel.

    shear (n, 2, 4), normal (n, 2): terms; shear_n (n, 2), normal_n (n,): readings of a force sensor, NaN where there is
    none; contact (n,): the number of the contact that a sample belongs to; time_s (n,): rising in each contact.
    Why contacts count: the error of a contact is the same in all its samples, so each has an unknown part of its own
    here, and a hundred samples of one contact tell less of the gel than ten of each of ten.
    """

    def floor(share_mm2: float, modulus: float) -> float:
        return float((share_mm2 * modulus) ** 2 + reading_sd_n**2)

    shears = [
        _update(
            scale.shear[axis],
            scale.shear_covariance[axis],
            _Readings(
                shear[:, axis],
                shear_n[:, axis],
                scale.shear[axis, 0] * np.linalg.norm(shear[..., 0], axis=1),
                contact,
                time_s,
            ),
            errors.shear_share,
            floor(errors.shear_floor_mm2, scale.shear[axis, 0]),
            offsets=True,
        )
        for axis in (0, 1)
    ]
    normals = _update(
        scale.normal,
        scale.normal_covariance,
        _Readings(normal, normal_n, scale.normal[0] * normal[:, 0], contact, time_s),
        errors.normal_share,
        floor(errors.normal_floor_mm2, scale.normal[0]),
        offsets=False,
    )
    of_shear, of_normal = max(one[2] for one in shears), normals[2]
    enlarged = ForceErrorModel(
        of_shear * errors.shear_floor_mm2,
        of_shear * errors.shear_share,
        of_normal * errors.normal_floor_mm2,
        of_normal * errors.normal_share,
    )
    means, covariances = np.stack([one[0] for one in shears]), np.stack([one[1] for one in shears])
    return Scale(means, covariances, normals[0], normals[1]), enlarged


class _Readings(NamedTuple):
    """Terms (n, k) and readings (n,) of a force, its size about, and the contact and time of each sample."""

    terms: Floats
    reading_n: Floats
    size_n: Floats
    contact: NDArray[np.int64]
    time_s: Floats


def _update(
    mean: Floats, covariance: Floats, readings: _Readings, share: float, variance: float, *, offsets: bool
) -> tuple[Floats, Floats, float]:
    """Mean and covariance of weights after readings, and how many times as large as expected errors are.

    Each contact has a factor of its own besides, of sd `share`.
    variance: of a reading that has no other within AGREES_S; so many as there are tell together what one does.
    offsets: and an offset of its own, of its typical force times `share`, as a force of both signs may have.
    """
    terms, reading_n, size_n, contact, time_s = readings
    known = np.isfinite(reading_n) & np.isfinite(terms).all(axis=1)
    if not known.any():
        return mean, covariance, 1.0
    terms, reading_n, size_n = terms[known], reading_n[known], size_n[known]
    numbers, place = np.unique(contact[known], return_inverse=True)
    of_contact = np.equal(place.reshape(-1)[:, None], np.arange(len(numbers)))
    alone = 1.0 / _beside(contact[known], time_s[known])
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
        # in units of the prior's deviations: terms of any size are solved equally well, and what is sure stays
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
    """How many samples (n,) lie within AGREES_S about each one in its contact, itself counted."""
    many = np.empty(len(time_s))
    for number in np.unique(contact):
        of_contact = contact == number
        times = time_s[of_contact]
        last = np.searchsorted(times, times + AGREES_S / 2, side="right")
        many[of_contact] = last - np.searchsorted(times, times - AGREES_S / 2)
    return many


def contact_signs(field_mm: Floats, normal_mm2: Floats) -> Floats:
    """What tells contact, (n, 3): 1, logarithms of the field's root mean square and of normal force over modulus."""
    rms = np.sqrt((field_mm**2).mean(axis=(1, 2)))
    return np.column_stack(
        [np.ones(len(rms)), np.log10(rms + LOG_FLOOR_MM), np.log10(np.maximum(normal_mm2, 0.0) + 1e-2)]
    )


def contact_probability(signs: Floats, weights: Floats) -> Floats:
    """Probability of contact (n,) from its signs (n, 3); NaN where they are."""
    from scipy.special import expit

    probability: Floats = expit(signs @ weights)
    return probability


def fit_contact(signs: Floats, contact: NDArray[np.bool_], ridge: float = 1e-2) -> Floats:
    """Weights (3,) of the logistic regression from signs (n, 3) to contact (n,); both sides count as much."""
    balance = np.where(contact, 0.5 / max(contact.sum(), 1), 0.5 / max((~contact).sum(), 1)) * len(contact)
    return logistic.fit(signs, contact.astype(np.float64), np.full(signs.shape[1], ridge), balance)


def fit_errors(found_mm2: Floats, true_mm2: Floats) -> tuple[float, float]:
    """Floor in mm2 and share of errors of found (n, k) against true force over modulus (n, k), by maximum likelihood.

    Both are then made larger or smaller together so that 68.3 % of the errors are within one sd.
    """
    off = found_mm2 - true_mm2
    size2 = (found_mm2**2).sum(axis=1)[:, None]
    typical = float(np.median(np.abs(off)))
    best = (np.inf, 1.0, 0.0)
    for floor in max(typical, 1e-6) * np.geomspace(0.1, 10.0, 25):
        for share in (0.0, *np.geomspace(0.005, 1.0, 30)):
            variance = floor**2 + share**2 * size2
            cost = float(np.mean(np.log(variance) + off**2 / variance))
            if cost < best[0]:
                best = (cost, float(floor), float(share))
    _, floor, share = best
    within = float(np.quantile(np.abs(off) / np.sqrt(floor**2 + share**2 * size2), 0.683))
    return floor * within, share * within
