"""train-force --method touch: the scale of touch maps, corrected for one sensor by recordings under known forces.

What is known of the gel before, of all gels or by `--sensor`, counts as much as it is sure: a minute of readings moves
the stiffness most, creep less, and offsets only where the readings insist.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import KnownForces
from evetac_cli.stages.force import readings
from evetac_cli.stages.force.readings import Readings
from evetac_cli.stages.touch import known_gel, predict_touch, touch_model
from evetac_cli.stages.touch.known_gel import GelShape, GelWeights
from evetac_cli.store.files import StageFile, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR

if TYPE_CHECKING:
    from evetac_cli.stages.touch.touch_fold import Slices

Fold = Callable[[GelWeights, StageFile], "Slices"]

OUTPUT = "force-model"
METHOD = 1
SHORTEST_CONTACT_MS = 200
GAP_MS = 200  # a shorter time without contact, as dots that are lost for a moment make it, divides no contact
CONTACT_READING_N = 0.5  # a normal force that was measured tells contact better than dots do
READING_LASTS_MS = 1000  # until the next one, at most


def job(files: list[Path], params: TrainForce, out: Path | None) -> Job:
    """One model from all tracks files: `own.force-model.h5` beside the first."""
    predict_touch.check_depth(params.print_depth_mm, params.height_mm)
    output = out if out is not None and out.suffix == ".h5" else (out or files[0].parent) / f"own.{OUTPUT}.h5"
    return Job(tuple(files), output)


def run(job: Job, params: TrainForce, *, force: bool, progress: Progress = silent) -> Outcome:
    """Correct what is known of the gel, and store it as a model."""
    known = known_gel.known_of(params.sensor)
    headers, names, sources = [], [], []
    for path in job.inputs:
        with StageFile(path, "tracks") as tracks:
            known_gel.check_scale(tracks, known)
            headers.append(tracks.header)
            names.append(str(tracks.read("sensor/name")))
        sources.append(readings.digest(path))
    sensors = sorted(set(names) - {UNKNOWN_SENSOR}) or [UNKNOWN_SENSOR]
    if len(sensors) > 1:
        expected = "recordings of one sensor"
        raise InputError(
            "recordings of different sensors", where=str(job.inputs[0]), expected=expected, found=", ".join(sensors)
        )
    shape = GelShape.of(params)
    parameters: dict[str, Any] = {
        "method": "touch",
        "noise_n": params.noise_n,
        "known": known.named(),
        "readings": sources,
        **shape._asdict(),
        **({} if params.sensor is None else {"stiffness_error": params.stiffness_error}),
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=tuple(headers))
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=recipe.simulated)
    gel = known_gel.gel_of(known, params.stiffness_error, shape)
    rng = np.random.default_rng(params.seed)
    told, unused = known_forces(gel, job.inputs, params.noise_n, rng, progress)
    after = adapted(gel, told, params.noise_n)
    arrays = {"sensor": "events", "sensor_name": sensors[0], **touch_model.arrays_of(after)}
    write_stage(job.output, recipe, arrays)
    return outcome(
        job,
        made=True,
        simulated=recipe.simulated,
        sensor_name=sensors[0],
        contacts=len(np.unique(told.contact)),
        readings=len(told.contact),
        without_readings=", ".join(path.name for path in unused) or None,
        shear_modulus_kpa_before=_kpa(gel),
        shear_modulus_kpa=_kpa(after),
        shear_modulus_sd_kpa=float(1e3 * np.sqrt(after.scale.shear_covariance[:, 0, 0].mean())),
        normal_factor=float(after.scale.normal[0] / after.scale.shear[:, 0].mean()),
        shear_error_factor=after.errors.shear_times,
        normal_error_factor=after.errors.normal_times,
    )


def _kpa(gel: GelWeights) -> float:
    return float(1e3 * gel.scale.shear[:, 0].mean())


def adapted(gel: GelWeights, known: KnownForces, noise_n: float) -> GelWeights:
    """The weights and errors after known forces."""
    scale, errors = gel_forces.adapt(gel.scale, gel.errors, known, noise_n)
    return gel._replace(scale=scale, errors=errors)


def known_forces(
    gel: GelWeights,
    paths: Sequence[Path],
    noise_n: float,
    rng: np.random.Generator,
    progress: Progress = silent,
    fold: Fold | None = None,
) -> tuple[KnownForces, list[Path]]:
    """Terms and readings of all contacts in tracks files, and the files without any; InputError where all are.

    noise_n: sd in N that is added to the truth of simulated recordings. What is read where no dot tells of a touch is
    left out. fold: touch_fold.slices_of, or what remembers its results.
    """
    from evetac_cli.stages.touch import touch_fold  # brings scipy

    fold = fold or touch_fold.slices_of

    parts: list[KnownForces] = []
    unused: list[Path] = []
    contacts = 0
    for number_of_file, path in enumerate(paths):
        with StageFile(path, "tracks") as tracks:
            read = readings.read(tracks, noise_n, rng)
            over = fold(gel, tracks)
        number = contact_numbers(_touches(over.touches, read))[read.slice_]
        used = (number >= 0) & over.touches[read.slice_]
        at = read.slice_[used]
        if not used.any():
            unused.append(path)
        shear, normal = touch_fold.terms_of(gel, over)
        parts.append(
            KnownForces(
                shear[at],
                normal[at],
                over.shear_sd_mm2[at],
                over.normal_sd_mm2[at],
                read.shear_n[used],
                read.normal_n[used],
                contacts + number[used],
                np.asarray(at * gel_forces.SLICE_S, np.float64),
            )
        )
        contacts += int(number.max(initial=-1)) + 1
        progress(number_of_file + 1, len(paths))
    whole = KnownForces(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
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
