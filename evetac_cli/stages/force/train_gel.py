"""train-force --method gel: a model of shear force, normal force and contact for any sensor.

A network learns force over modulus from simulated contacts of many gels (static_contacts). How far it is off, and what
tells contact, is then measured on tracks of simulated recordings, which it never saw: with camera, tracker, creep and
motion.
"""

from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.arrays import Floats
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import ForceErrorModel
from evetac_cli.kernels.force.models import CONTACT_N
from evetac_cli.sim.setup.plan import read_sensor, sensor_ranges
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.stages.force import gel_model, readings
from evetac_cli.stages.force.gel_model import GelModel
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import Recording

OUTPUT = "force-model"
METHOD = 3
RANGES = "randomized"  # the sensors that contacts are of


def job(files: list[Path], out: Path | None) -> Job:
    """One model: `gel.force-model.h5` beside the first file."""
    output = out if out is not None and out.suffix == ".h5" else (out or files[0].parent) / f"gel.{OUTPUT}.h5"
    return Job(tuple(files), output)


def run(job: Job, params: TrainForce, *, force: bool, progress: Progress) -> Outcome:
    """Train on contacts, measure errors on the files, and store the model as arrays."""
    headers = []
    for path in job.inputs:
        with StageFile(path, "tracks") as tracks, recording_with_truth(tracks) as recording:
            headers.append(tracks.header)
            known_sensor(recording)
    ranges = sensor_ranges()
    parameters = {"method": "gel", "contacts": params.contacts, "epochs": params.epochs, "sensor_ranges": ranges}
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=tuple(headers))
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=True)

    from evetac_cli.kernels.force import gel_training  # brings torch
    from evetac_cli.stages.force import static_contacts

    sampling, training = np.random.default_rng(params.seed).spawn(2)
    contacts = static_contacts.sample(ranges, params.contacts, sampling, progress)
    trained = gel_training.train(contacts.field_mm, contacts.over_modulus_mm2, training, params.epochs, progress)
    prior = gel_model.prior_of(contacts.sensors)
    unmeasured = GelModel(trained.network, ForceErrorModel(0.0, 0.0, 0.0, 0.0), np.zeros(3), prior, None)
    model = measured(unmeasured, job.inputs)
    arrays: dict[str, Any] = {"sensor": "events", "sensor_name": RANGES, **gel_model.arrays_of(model)}
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=True,
        contacts=params.contacts,
        trajectories=len(job.inputs),
        **{name: float(value) for name, value in model.errors._asdict().items()},
    )


def known_sensor(recording: Recording) -> Sensor:
    """The sensor that was simulated; InputError where the recording does not say."""
    return read_sensor(recording.header["parameters"], str(recording.path))


def measured(model: GelModel, paths: tuple[Path, ...]) -> GelModel:
    """The model with the errors and the signs of contact that tracks of simulated recordings show."""
    shear, normal, signs, touches = [], [], [], []
    for path in paths:
        with StageFile(path, "tracks") as tracks, recording_with_truth(tracks) as recording:
            sensor = known_sensor(recording)
            estimated, sign = gel_model.over_modulus(model, tracks, sensor.mm_per_px)
            normal_n = recording.read("truth/normal_force_n").astype(float)
            shear_n = recording.read("truth/shear_force_n").astype(float)
        true_shear = shear_n / (1e-6 * sensor.shear_modulus_pa)
        true_normal = normal_n / (1e-6 * sensor.normal_modulus_pa)
        at = np.arange(0, len(estimated), readings.EVERY)
        at = at[np.isfinite(estimated[at]).all(axis=1)]
        pressed = at[normal_n[at] >= CONTACT_N]
        shear.append((estimated[pressed, :2], true_shear[pressed]))
        normal.append((estimated[pressed, 2:], true_normal[pressed, None]))
        signs.append(sign[at])
        touches.append(normal_n[at] >= CONTACT_N)
    contact = np.concatenate(touches)
    if contact.all() or not contact.any():
        raise InputError("errors cannot be measured", expected="recordings with and without contact in them")

    def of(parts: list[tuple[Floats, Floats]]) -> tuple[float, float]:
        return gel_forces.fit_errors(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    errors = ForceErrorModel(*of(shear), *of(normal))
    return model._replace(errors=errors, contact=gel_forces.fit_contact(np.concatenate(signs), contact))
