"""train-force --method touch: correct the scale of touch maps for one sensor, by recordings under known forces.

Prior knowledge of the gel, general or from `--sensor`, is weighted by its certainty. A minute of readings changes the
stiffness most, creep less, and offsets only if the readings clearly require it.

The readings of a force sensor are a table `NAME.force.csv` next to `NAME.tracks.h5`, with a first line
`t_s,shear_x_n,shear_y_n,normal_n`, then a line for each reading; without it they are a simulation's truth with noise.
The time t_s begins at the start of the recording. A force that was not measured is left empty. Shear is the force of
the object on the gel, x to the right and y down in the image, as `truth/shear_force_n` of simulated recordings.
"""

import csv
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import Job, Outcome, Progress, outcome, silent
from evetac_cli.kernels.force import gel_forces
from evetac_cli.kernels.force.gel_forces import KnownForces
from evetac_cli.stages import output_in
from evetac_cli.stages.related_files import recording_with_truth
from evetac_cli.stages.touch import known_gel
from evetac_cli.stages.touch.known_gel import GelShape, GelWeights
from evetac_cli.store.files import StageFile, stem, up_to_date, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import UNKNOWN_SENSOR
from evetac_cli.text_files import read_text

if TYPE_CHECKING:
    from evetac_cli.stages.touch.touch_fold import Slices

Fold = Callable[[GelWeights, StageFile], "Slices"]

OUTPUT = "force-model"
METHOD = 1
SHORTEST_CONTACT_MS = 200
GAP_MS = 200  # a shorter time without contact, for example while dots are lost briefly, does not divide a contact
CONTACT_READING_N = 0.5  # measured normal force that counts as contact; it is more reliable than the dots
READING_LASTS_MS = 1000  # longest time for which a reading is valid if no other follows
COLUMNS = ["t_s", "shear_x_n", "shear_y_n", "normal_n"]
EVERY = 40  # slices between two used readings
MOST_BYTES = 1 << 26
LARGEST_N = 1e4


class Readings(NamedTuple):
    """Forces in N at some slices, NaN if not measured."""

    slice_: NDArray[np.int64]  # (n,)
    shear_n: Floats  # (n, 2)
    normal_n: Floats  # (n,)


def table_beside(tracks: Path) -> Path:
    """Return the path of a tracks file's table of readings, which may not exist."""
    return tracks.with_name(f"{stem(tracks)}.force.csv")


def readings_digest(tracks: Path) -> str:
    """Return the identity of a tracks file's readings for a recipe: the hash of their table, or `truth`."""
    table = table_beside(tracks)
    return hashlib.sha256(read_text(table, MOST_BYTES).encode()).hexdigest() if table.exists() else "truth"


def read_readings(tracks: StageFile, noise_n: float, rng: np.random.Generator) -> Readings:
    """Return the readings of a tracks file, at most one per 40 ms; InputError if there is neither a table nor truth."""
    table = table_beside(tracks.path)
    if table.exists():
        return _from_table(table, tracks.length("dot_xy_px"))
    try:
        with recording_with_truth(tracks) as recording:
            shear_n = recording.read("truth/shear_force_n")[::EVERY].astype(float)
            normal_n = recording.read("truth/normal_force_n")[::EVERY].astype(float)
    except InputError as error:
        expected = f"a table {table.name} with {', '.join(COLUMNS)}, or a simulated recording"
        raise InputError(f"no known forces: {error.message}", where=str(tracks.path), expected=expected) from None
    slices = EVERY * np.arange(len(shear_n))
    return Readings(
        slices,
        shear_n + rng.normal(0.0, noise_n, shear_n.shape),
        normal_n + rng.normal(0.0, noise_n, normal_n.shape),
    )


def _from_table(path: Path, slices: int) -> Readings:
    """Return the first reading of each 40 ms; lines without a force are left out. InputError for any other text.

    slices: length of the recording, within which all readings must be.
    """
    text = read_text(path, MOST_BYTES).removeprefix("\ufeff")  # written by Excel
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise InputError(f"not a table of forces: {error}", where=str(path), expected=",".join(COLUMNS)) from None
    first = [name.strip() for name in lines[0]] if lines else []
    if first != COLUMNS:
        found = ",".join(first)[:80]
        raise InputError("not a table of forces", where=f"{path}, line 1", expected=",".join(COLUMNS), found=found)
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        if not line:
            continue
        try:
            row = [float(entry) if entry.strip() else np.nan for entry in line]
        except ValueError:
            row = []
        is_within = len(row) == len(COLUMNS) and 0 <= row[0] * SLICES_PER_S < slices
        if not is_within or np.nanmax(np.abs(row)) > LARGEST_N:
            expected = f"t_s of the recording, 0 to {slices / SLICES_PER_S:g}, and forces of at most {LARGEST_N:g} N"
            where, written = f"{path}, line {number}", ",".join(line)[:80]
            raise InputError("not a reading", where=where, expected=expected, found=written)
        rows.append(row)
    values = np.array(rows).reshape(-1, len(COLUMNS))
    values = values[np.isfinite(values[:, 1:]).any(axis=1)]
    if not len(values):
        raise InputError("the table of forces has no reading", where=str(path))
    slice_ = np.floor(values[:, 0] * SLICES_PER_S + 1e-6).astype(np.int64)  # 1.001 s is slice 1001
    _, kept = np.unique(slice_ // EVERY, return_index=True)
    return Readings(slice_[kept], values[kept, 1:3], values[kept, 3])


def job(files: list[Path], params: TrainForce, out: Path | None) -> Job:
    """Return the job of one model from all tracks files: `own.force-model.h5` next to the first."""
    return Job(tuple(files), output_in(out, files[0].parent, f"own.{OUTPUT}.h5"))


def run(job: Job, params: TrainForce, *, force: bool, progress: Progress = silent) -> Outcome:
    """Correct the prior knowledge of the gel by the readings, and store the result as a model."""
    gel_values = known_gel.known_of(params.sensor)
    headers, names, sources = [], [], []
    for path in job.inputs:
        with StageFile(path, "tracks") as tracks:
            known_gel.check_scale(tracks, gel_values)
            headers.append(tracks.header)
            names.append(str(tracks.read("sensor/name")))
        sources.append(readings_digest(path))
    sensors = sorted(set(names) - {UNKNOWN_SENSOR}) or [UNKNOWN_SENSOR]
    if len(sensors) > 1:
        raise InputError("recordings of different sensors", where=str(job.inputs[0]), found=", ".join(sensors))
    shape = GelShape.of(params, gel_values)
    parameters: dict[str, Any] = {
        "method": "touch",
        "noise_n": params.noise_n,
        "known": gel_values.for_recipe(),
        "readings": sources,
        **shape._asdict(),
        "edges_mm": params.gel_mm,
        **({} if params.sensor is None else {"stiffness_error": params.stiffness_error}),
    }
    recipe = Recipe(OUTPUT, METHOD, parameters, seed=params.seed, parents=tuple(headers))
    if up_to_date(job.output, recipe, force=force):
        return outcome(job, made=False, simulated=recipe.simulated)
    gel = known_gel.gel_of(gel_values, params.stiffness_error, shape)
    rng = np.random.default_rng(params.seed)
    force_readings, unused = known_forces(gel, job.inputs, params.noise_n, rng, progress)
    after = adapted(gel, force_readings, params.noise_n)
    arrays = {"sensor": "events", "sensor_name": sensors[0], **known_gel.arrays_of(after)}
    made = write_stage(job.output, recipe, arrays, force=force) is not None
    return outcome(
        job,
        made=made,
        simulated=recipe.simulated,
        sensor_name=sensors[0],
        contacts=len(np.unique(force_readings.contact)),
        readings=len(force_readings.contact),
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


def adapted(gel: GelWeights, force_readings: KnownForces, noise_n: float) -> GelWeights:
    """Return the weights and errors corrected by known forces."""
    scale, errors = gel_forces.adapt(gel.scale, gel.errors, force_readings, noise_n)
    return gel._replace(scale=scale, errors=errors)


def known_forces(
    gel: GelWeights,
    paths: Sequence[Path],
    noise_n: float,
    rng: np.random.Generator,
    progress: Progress = silent,
    fold: Fold | None = None,
) -> tuple[KnownForces, list[Path]]:
    """Return terms and readings of all contacts in tracks files, and the files without any; InputError if none has any.

    Readings without contact by the dots are left out.
    noise_n: standard deviation, in N, of noise that is added to the truth of simulated recordings.
    fold: touch_fold.slices_of, or a function that caches its results.
    """
    from evetac_cli.stages.touch import touch_fold  # brings scipy

    fold = fold or touch_fold.slices_of

    parts: list[KnownForces] = []
    unused: list[Path] = []
    contacts = 0
    for number_of_file, path in enumerate(paths):
        with StageFile(path, "tracks") as tracks:
            read = read_readings(tracks, noise_n, rng)
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
        expected = f"contacts of {SHORTEST_CONTACT_MS} ms or more, with readings"
        raise InputError("there is no reading during a contact", where=", ".join(map(str, paths)), expected=expected)
    return whole, unused


def _touches(dots_say: NDArray[np.bool_], read: Readings) -> NDArray[np.bool_]:
    """Return whether there is contact in each slice: by the normal force if it was measured, else by the dots."""
    touches = dots_say.copy()
    until = np.append(read.slice_[1:], len(touches))
    for first, end, normal_n in zip(read.slice_, until, read.normal_n, strict=True):
        if np.isfinite(normal_n):
            touches[first : min(end, first + READING_LASTS_MS)] = normal_n >= CONTACT_READING_N
    return touches


def contact_numbers(touches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of each slice's contact, or -1; short gaps are ignored, and short contacts do not count."""
    numbers = np.full(len(touches), -1)
    edges = np.flatnonzero(np.diff(touches, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    apart = begins[1:] - ends[:-1] >= GAP_MS
    begins, ends = np.append(begins[:1], begins[1:][apart]), np.append(ends[:-1][apart], ends[-1:])
    lasting = ends - begins >= SHORTEST_CONTACT_MS
    for number, (begin, end) in enumerate(zip(begins[lasting], ends[lasting], strict=True)):
        numbers[begin:end] = number
    return numbers
