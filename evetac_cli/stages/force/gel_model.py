"""Force models for any sensor: their files, what a sensor's file tells of its gel, and what they predict."""

from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.errors import InputError
from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import ForceErrorModel, Forces, GelNetwork, Scale, Stiffness
from evetac_cli.kernels.force.models import DenseLayer
from evetac_cli.kernels.touch.dot_field import LATTICE_MM, lattice_field
from evetac_cli.sim.setup import sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.sensor import GelCreep, Sensor
from evetac_cli.sim.setup.sensor_rows import FOR_EACH_TRIAL
from evetac_cli.store.files import StageFile
from evetac_cli.text_files import read_toml

LAYERS = 3
SHAPES = {  # what the schema leaves open
    "gel/0/weight": (None, LATTICE_MM.size),
    "gel/2/bias": (3,),
    "gel/errors": (4,),
    "gel/contact": (3,),
    "gel/prior/creep_time_s": (gel_forces.CREEP_ARMS,),
    "adapted/shear_covariance": (2, gel_forces.CREEP_ARMS + 2, gel_forces.CREEP_ARMS + 2),
    "adapted/normal_covariance": (2, 2),
}
BLOCK_SLICES = 5000
LENGTHS_IN_SHEAR, LENGTHS_IN_NORMAL = 3, 2  # powers of mm_per_px in force over modulus
CONTACT = 0.5  # probability from which there is contact
MODULI = {"shear": "shear_modulus_pa", "normal": "normal_modulus_pa"}


class KnownGel(NamedTuple):
    """What `--sensor` says of a gel; None where it does not. Arms of a gel that does not creep are empty."""

    shear_modulus_pa: float | None = None
    normal_modulus_pa: float | None = None
    mm_per_px: float | None = None
    creep: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # share and time in s of its arms

    def named(self) -> dict[str, Any]:
        """As it enters a recipe."""
        named = {name: value for name, value in self._asdict().items() if value is not None}
        if self.creep is not None:
            named["creep"] = dict(zip(("share", "time_s"), map(list, self.creep), strict=True))
        return named


class Prior(NamedTuple):
    """What is expected of a gel before anything is known: the spread of the sensors that were trained on."""

    stiffness: Stiffness
    mm_per_px: float
    mm_log_sd: float


class GelWeights(NamedTuple):
    """A model's weights for one sensor, and how far it is off."""

    scale: Scale
    mm_per_px: float
    creep_time_s: Floats
    errors: ForceErrorModel


class GelModel(NamedTuple):
    """The contents of a force-model file of this method."""

    network: GelNetwork
    errors: ForceErrorModel
    contact: Floats  # (3,)
    prior: Prior
    adapted: GelWeights | None  # to one sensor, by known forces


class Predicted(NamedTuple):
    """What a model tells of every slice: terms of shear and normal force, forces, probability of contact."""

    shear: Floats
    normal: Floats
    forces: Forces
    contact: Floats


def prior_of(sensors: Sequence[Sensor]) -> Prior:
    """Medians and spreads of the gels of many sensors."""

    def logs(values: Iterable[float]) -> tuple[float, float]:
        logarithms = np.log(list(values))
        return float(np.exp(np.median(logarithms))), float(logarithms.std())

    shear_pa, shear_sd = logs(sensor.shear_modulus_pa for sensor in sensors)
    normal_pa, normal_sd = logs(sensor.normal_modulus_pa for sensor in sensors)
    mm_per_px, mm_sd = logs(sensor.mm_per_px for sensor in sensors)
    creeps = [sensor.creep for sensor in sensors]
    arms = gel_forces.CREEP_ARMS
    share = np.array([_padded(() if creep is None else creep.share, arms, 0.0) for creep in creeps])
    time_s = np.array([_padded(() if creep is None else creep.time_s, arms, np.nan) for creep in creeps])
    if np.isfinite(time_s).all(axis=1).any():
        times = np.exp(np.nanmean(np.log(time_s), axis=0))
    else:
        times = np.array([0.3, 5.0])
    stiffness = Stiffness(shear_pa * 1e-6, shear_sd, normal_pa * 1e-6, normal_sd, share.mean(0), share.std(0), times)
    return Prior(stiffness, mm_per_px, mm_sd)


def _padded(values: Sequence[float], size: int, by: float) -> list[float]:
    return [*map(float, values), *[by] * size][:size]


def gel_of(model: GelModel, known: KnownGel, stiffness_error: float) -> GelWeights:
    """The weights for a sensor of which so much is known; an adapted model has its own.

    stiffness_error: sd of the logarithm of moduli that are known. A scale that is not known makes forces less sure.
    """
    if model.adapted is not None:
        return model.adapted
    expected = model.prior.stiffness
    mm_per_px, mm_log_sd = model.prior.mm_per_px, model.prior.mm_log_sd
    if known.mm_per_px is not None:
        mm_per_px, mm_log_sd = known.mm_per_px, 0.0

    def modulus(known_pa: float | None, median_mpa: float, log_sd: float, lengths: int) -> tuple[float, float]:
        mpa, sd = (median_mpa, log_sd) if known_pa is None else (known_pa * 1e-6, stiffness_error)
        return mpa, float(np.hypot(sd, lengths * mm_log_sd))

    arms = gel_forces.CREEP_ARMS
    slow = (expected.creep_share, expected.creep_sd, expected.creep_time_s)
    if known.creep is not None:
        share, time_s = known.creep
        slow = (np.array(_padded(share, arms, 0.0)), np.zeros(arms), np.array(_padded(time_s, arms, 1.0)))
    stiffness = Stiffness(
        *modulus(known.shear_modulus_pa, expected.shear_mpa, expected.shear_log_sd, LENGTHS_IN_SHEAR),
        *modulus(known.normal_modulus_pa, expected.normal_mpa, expected.normal_log_sd, LENGTHS_IN_NORMAL),
        *slow,
    )
    return GelWeights(gel_forces.scale_of(stiffness), mm_per_px, slow[2], model.errors)


def known_of(sensor: str | None) -> KnownGel:
    """What `--sensor` tells of a gel: of a file only the keys that it names itself, of a named sensor all."""
    if sensor is None:
        return KnownGel()
    if sensor in FOR_EACH_TRIAL:
        expected = "one sensor, as in evetac or randomized:7, or its file"
        raise InputError("not one sensor but many", where="--sensor", expected=expected, found=sensor)
    if not sensor.endswith(sensor_file.SUFFIX):
        return _known(one_sensor(sensor), KnownGel._fields)
    _, own = sensor_file.read(Path(sensor), one_sensor)
    return _known(own, read_toml(Path(sensor)))


def _known(sensor: Sensor, named: Container[str]) -> KnownGel:
    """What a sensor says of its gel, of the keys that are named; it creeps if it says so."""
    arms = sensor.creep or GelCreep(share=(), time_s=())
    whole = KnownGel(sensor.shear_modulus_pa, sensor.normal_modulus_pa, sensor.mm_per_px, (arms.share, arms.time_s))
    return KnownGel(**{name: value for name, value in whole._asdict().items() if name in named})


def check_scale(tracks: StageFile, known: KnownGel) -> None:
    """InputError for tracks of another frame than an Evetac's, unless it is known how large a pixel is on the gel.

    Displacements in mm would be wrong by the ratio of the scales, and forces by its square.
    """
    width, height = (int(size) for size in tracks.read("sensor/frame_px"))
    if (width, height) == FRAME_PX or known.mm_per_px is not None:
        return
    raise InputError(
        "the scale of this frame, in mm per pixel on the gel, is not known",
        where=str(tracks.path),
        expected="{} x {} px, or --sensor with mm_per_px".format(*FRAME_PX),
        found=f"{width} x {height} px",
        hint='write like = "evetac" and mm_per_px, by a ruler laid on the gel, into mine.sensor.toml;'
        " --sensor mine.sensor.toml",
    )


def over_modulus(model: GelModel, tracks: StageFile, mm_per_px: float) -> tuple[Floats, Floats]:
    """Force over modulus (slices, 3) in mm2 and the signs of contact (slices, 3) of a tracks file, in blocks."""
    slices = tracks.length("dot_xy_px")
    rest_px = tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    rest_mm = (rest_px - tracks.read("sensor/frame_px") / 2) * mm_per_px
    result, signs = np.empty((slices, 3)), np.empty((slices, 3))
    for first in range(0, slices, BLOCK_SLICES):
        stop = min(first + BLOCK_SLICES, slices)
        moved_mm = (tracks.read("dot_xy_px", first, stop) - rest_px) * mm_per_px
        tracked = tracks.read("lost", first, stop) == 0
        field_mm = lattice_field(moved_mm, rest_mm, tracked)
        result[first:stop] = gel_forces.over_modulus(model.network, field_mm)
        signs[first:stop] = gel_forces.contact_signs(field_mm, result[first:stop, 2])
    return result, signs


def predict(model: GelModel, gel: GelWeights, tracks: StageFile) -> Predicted:
    """Forces and contact in every slice of a tracks file."""
    found_mm2, signs = over_modulus(model, tracks, gel.mm_per_px)
    shear = gel_forces.shear_terms(found_mm2[:, :2], gel.creep_time_s)
    normal = gel_forces.normal_terms(found_mm2[:, 2])
    forces = gel_forces.predict(gel.scale, gel.errors, shear, normal)
    contact = gel_forces.contact_probability(signs, model.contact)
    return Predicted(shear, normal, forces, contact)


def arrays_of(model: GelModel) -> dict[str, Any]:
    """The datasets of a model."""
    network, prior = model.network, model.prior
    arrays: dict[str, Any] = {
        "gel/scale_mm2": network.scale_mm2,
        "gel/linear/weight": network.linear.weight,
        "gel/linear/bias": network.linear.bias,
        "gel/errors": np.array(model.errors),
        "gel/contact": model.contact,
        "gel/prior/shear_modulus_pa": np.float64(prior.stiffness.shear_mpa * 1e6),
        "gel/prior/shear_log_sd": np.float64(prior.stiffness.shear_log_sd),
        "gel/prior/normal_modulus_pa": np.float64(prior.stiffness.normal_mpa * 1e6),
        "gel/prior/normal_log_sd": np.float64(prior.stiffness.normal_log_sd),
        "gel/prior/creep_share": prior.stiffness.creep_share,
        "gel/prior/creep_sd": prior.stiffness.creep_sd,
        "gel/prior/creep_time_s": prior.stiffness.creep_time_s,
        "gel/prior/mm_per_px": np.float64(prior.mm_per_px),
        "gel/prior/mm_log_sd": np.float64(prior.mm_log_sd),
    }
    for number, layer in enumerate(network.layers):
        arrays |= {f"gel/{number}/weight": layer.weight, f"gel/{number}/bias": layer.bias}
    if model.adapted is not None:
        scale = model.adapted.scale
        arrays |= {
            "adapted/shear": scale.shear,
            "adapted/shear_covariance": scale.shear_covariance,
            "adapted/normal": scale.normal,
            "adapted/normal_covariance": scale.normal_covariance,
            "adapted/mm_per_px": np.float64(model.adapted.mm_per_px),
            "adapted/creep_time_s": model.adapted.creep_time_s,
        }
    return arrays


def read_gel_model(file: StageFile) -> GelModel:
    """The model in a force-model file; InputError if it is of another method, or for another lattice."""
    if not file.has("gel"):
        raise InputError(
            "the force model is of the paper's method, for the dots of one sensor",
            where=str(file.path),
            expected="a model of train-force --method gel",
        )
    stored = file.contents()
    for name, shape in SHAPES.items():
        size_of = stored[name][1] if name in stored else shape
        if any(wanted not in (size, None) for size, wanted in zip(size_of, shape, strict=True)):
            raise InputError(
                f"{name} has another shape than models of this version",
                where=str(file.path),
                expected=str(shape),
                found=str(size_of),
                hint="train it again",
            )
    layers = tuple(DenseLayer(file.read(f"gel/{n}/weight"), file.read(f"gel/{n}/bias")) for n in range(LAYERS))
    linear = DenseLayer(file.read("gel/linear/weight"), file.read("gel/linear/bias"))
    stiffness = Stiffness(
        float(file.read("gel/prior/shear_modulus_pa")) * 1e-6,
        float(file.read("gel/prior/shear_log_sd")),
        float(file.read("gel/prior/normal_modulus_pa")) * 1e-6,
        float(file.read("gel/prior/normal_log_sd")),
        file.read("gel/prior/creep_share"),
        file.read("gel/prior/creep_sd"),
        file.read("gel/prior/creep_time_s"),
    )
    prior = Prior(stiffness, float(file.read("gel/prior/mm_per_px")), float(file.read("gel/prior/mm_log_sd")))
    errors, adapted = ForceErrorModel(*file.read("gel/errors").tolist()), None
    if file.has("adapted"):
        scale = Scale(*(file.read(f"adapted/{name}") for name in Scale._fields))
        adapted = GelWeights(scale, float(file.read("adapted/mm_per_px")), file.read("adapted/creep_time_s"), errors)
    network = GelNetwork(layers, linear, file.read("gel/scale_mm2"))
    return GelModel(network, errors, file.read("gel/contact"), prior, adapted)
