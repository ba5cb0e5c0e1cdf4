"""train-force --adapt: a force model for any sensor, corrected for one by recordings under known forces.

What is known of the gel before, of all gels or by `--sensor`, counts as much as it is sure: a minute of readings moves
the stiffness most, creep less, and offsets only where the readings insist.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, outcome
from evetac_cli.kernels.force import gel_forces
from evetac_cli.resources import model_file
from evetac_cli.stages.force import gel_model, readings
from evetac_cli.stages.force.gel_model import GelModel, GelWeights
from evetac_cli.stages.force.readings import Readings
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR

OUTPUT = "force-model"
METHOD = 2
SHORTEST_CONTACT_MS = 200
GAP_MS = 200  # a shorter time without contact, as dots that are lost for a moment make it, divides no contact
CONTACT_READING_N = 0.5  # a normal force that was measured tells contact better than dots do
READING_LASTS_MS = 1000  # until the next one, at most


class ForceTerms(NamedTuple):
    """Terms of the forces and readings, of all contacts of some recordings."""

    shear: Floats
    normal: Floats
    shear_n: Floats
    normal_n: Floats
    contact: NDArray[np.int64]
    time_s: Floats


def job(files: list[Path], params: TrainForce, out: Path | None) -> Job:
    """One model from all tracks files: `own.force-model.h5` beside the first."""
    output = out if out is not None and out.suffix == ".h5" else (out or files[0].parent) / f"own.{OUTPUT}.h5"
    return Job((*files, model_file(params.adapt, "force-model", "--adapt")), output)


def run(job: Job, params: TrainForce, *, force: bool) -> Outcome:
    """Correct the model's weights and store it as a model of its own."""
    *paths, model_path = job.inputs
    known = gel_model.known_of(params.sensor)
    headers, names, sources = [], [], []
    for path in paths:
        with StageFile(path, "tracks") as tracks:
            gel_model.check_scale(tracks, known)
            headers.append(tracks.header)
            names.append(str(tracks.read("sensor/name")))
        sources.append(readings.digest(path))
    sensors = sorted(set(names) - {UNKNOWN_SENSOR}) or [UNKNOWN_SENSOR]
    if len(sensors) > 1:
        expected = "recordings of one sensor"
        raise InputError(
            "recordings of different sensors", where=str(paths[0]), expected=expected, found=", ".join(sensors)
        )
    with StageFile(model_path, OUTPUT) as file:
        model_header, model = file.header, gel_model.read_gel_model(file)
    if model.adapted is not None:
        hint = "adapt the model that it was made from, with all recordings"
        raise InputError("the model is adapted already", where=str(model_path), hint=hint)
    parameters = {
        "method": "gel, adapted",
        "noise_n": params.noise_n,
        "stiffness_error": params.stiffness_error,
        "known": known.named(),
        "readings": sources,
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=(*headers, model_header))
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=recipe.simulated)
    gel = gel_model.gel_of(model, known, params.stiffness_error)
    estimated, unused = known_forces(model, gel, paths, params.noise_n, np.random.default_rng(params.seed))
    after = adapted(model, gel, estimated, params.noise_n)
    arrays = {
        "sensor": "events",
        "sensor_name": sensors[0],
        **gel_model.arrays_of(model._replace(adapted=after, errors=after.errors)),
    }
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        sensor_name=sensors[0],
        contacts=len(np.unique(estimated.contact)),
        readings=len(estimated.contact),
        without_readings=", ".join(path.name for path in unused) or None,
        shear_modulus_kpa_before=float(1e3 * gel.scale.shear[:, 0].mean()),
        shear_modulus_kpa=float(1e3 * after.scale.shear[:, 0].mean()),
        normal_modulus_kpa_before=float(1e3 * gel.scale.normal[0]),
        normal_modulus_kpa=float(1e3 * after.scale.normal[0]),
        shear_error_factor=_times(after.errors.shear_floor_mm2, model.errors.shear_floor_mm2),
        normal_error_factor=_times(after.errors.normal_floor_mm2, model.errors.normal_floor_mm2),
    )


def _times(after: float, before: float) -> float:
    """How many times as large errors are taken to be; 1 where readings fit what the dots show."""
    return after / before if before > 0 else 1.0


def adapted(model: GelModel, gel: GelWeights, known: ForceTerms, noise_n: float) -> GelWeights:
    """The weights and errors after known forces."""
    scale, errors = gel_forces.adapt(gel.scale, model.errors, *known, noise_n)
    return gel._replace(scale=scale, errors=errors)


def known_forces(
    model: GelModel, gel: GelWeights, paths: Sequence[Path], noise_n: float, rng: np.random.Generator
) -> tuple[ForceTerms, list[Path]]:
    """Terms and readings of all contacts in tracks files, and the files without any; InputError where all are.

    noise_n: sd in N that is added to the truth of simulated recordings.
    """
    parts: list[ForceTerms] = []
    unused: list[Path] = []
    contacts = 0
    for path in paths:
        with StageFile(path, "tracks") as tracks:
            read = readings.read(tracks, noise_n, rng)
            predicted = gel_model.predict(model, gel, tracks)
        number = contact_numbers(_touches(predicted.contact >= gel_model.CONTACT, read))[read.slice_]
        used = number >= 0
        at = read.slice_[used]
        if not used.any():
            unused.append(path)
        parts.append(
            ForceTerms(
                predicted.shear[at],
                predicted.normal[at],
                read.shear_n[used],
                read.normal_n[used],
                contacts + number[used],
                np.asarray(at * gel_forces.SLICE_S, np.float64),
            )
        )
        contacts += int(number.max(initial=-1)) + 1
    whole = ForceTerms(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if not len(whole.contact):
        raise InputError(
            "no reading is during a contact",
            where=f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else str(paths[0]),
            expected=f"contacts of {SHORTEST_CONTACT_MS} ms or more, with readings",
        )
    return whole, unused


def _touches(dots_say: NDArray[np.bool_], read: Readings) -> NDArray[np.bool_]:
    """Whether there is contact in each slice: by the normal force where it was measured, else by the dots."""
    touches = dots_say.copy()
    until = np.append(read.slice_[1:], len(touches))
    for first, end, normal_n in zip(read.slice_, until, read.normal_n, strict=True):
        if np.isfinite(normal_n):
            touches[first : min(end, first + READING_LASTS_MS)] = normal_n >= CONTACT_READING_N
    return touches


def contact_numbers(touches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The number of the contact that each slice belongs to, or -1; short gaps divide none, short contacts are none."""
    numbers = np.full(len(touches), -1)
    edges = np.flatnonzero(np.diff(touches, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    apart = begins[1:] - ends[:-1] >= GAP_MS
    begins, ends = np.append(begins[:1], begins[1:][apart]), np.append(ends[:-1][apart], ends[-1:])
    lasting = ends - begins >= SHORTEST_CONTACT_MS
    for number, (begin, end) in enumerate(zip(begins[lasting], ends[lasting], strict=True)):
        numbers[begin:end] = number
    return numbers
