"""evaluate force of touch maps: errors of force by knowledge of the sensor's gel (simulated recordings).

Each tracks file has a row for each of these states of knowledge:

- `unknown`: nothing but the dots;
- `known`: scale and shear modulus of the sensor, the modulus with the error of `--stiffness-error` (creep stays
  unknown);
- `identified`, with `--identified`: the results of `evetac identify`;
- `adapted`, with `--adapt-on`: starting from `unknown`, adapted on tracks of the same sensor; the others adapted too.

Truth is compared without the noise of a force sensor, every 40 ms of the contact. Readings used for adaptation have
that noise. `shear_within_sd` and `normal_within_sd` are the shares of errors within one estimated standard deviation
(68 % if that is correct). `contact_right` is the share of slices in which contact is detected correctly. `usable` is
the share of slices in contact with enough tracked dots and a detected contact; errors are over these slices
(`slices_counted` of `slices_in_contact`). A trajectory without such slices has no errors; means are over the others.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evetac_cli.arrays import Flags, Floats
from evetac_cli.commands.parameter import recipe_of
from evetac_cli.errors import InputError
from evetac_cli.evaluate.common.report import ModelsReportJob, report
from evetac_cli.evaluate.common.rows import each, mean
from evetac_cli.evaluate.force import EvaluateForce
from evetac_cli.evaluate.subject import grouped
from evetac_cli.jobs import Outcome, Progress, Rows
from evetac_cli.kernels.force.gel_forces import Forces
from evetac_cli.kernels.force.models import CONTACT_N
from evetac_cli.sim.setup.plan import read_sensor
from evetac_cli.sim.setup.sensor import Sensor
from evetac_cli.stages.force import adapt_touch
from evetac_cli.stages.related_files import check_disjoint, recording_with_truth
from evetac_cli.stages.touch import known_gel
from evetac_cli.stages.touch.known_gel import SHEAR_MODULUS_PA, GelShape, GelWeights, KnownGel
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import sensor_values
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import Recording

if TYPE_CHECKING:
    from evetac_cli.stages.touch.touch_fold import Slices

METHOD = 4
ERRORS = (
    *("mae_n_x", "mae_n_y", "mae_n", "normal_mae_n", "normal_mae_of_range"),
    *("shear_within_sd", "normal_within_sd"),
)


@dataclass(frozen=True)
class ForceReportJob(ModelsReportJob):
    """A report over files and models; the `own` files before the models are tracks to adapt on."""

    own: int


class ForceTrial(NamedTuple):
    """A trial's truth and the estimates of it, by knowledge of the gel."""

    path: Path
    sensor_name: str
    shear_n: Floats
    normal_n: Floats
    predicted: dict[str, Forces]
    touches: dict[str, Flags]


class _Folds:
    """Touch maps of tracks, computed once per image scale and shape; force over modulus does not depend on modulus."""

    def __init__(self) -> None:
        self._found: dict[tuple[Path, float, GelShape], Slices] = {}

    def of(self, gel: GelWeights, tracks: StageFile) -> "Slices":
        """Return the touch maps from a tracks file for the image scale of a gel."""
        from evetac_cli.stages.touch import touch_fold  # imports scipy

        key = tracks.path, gel.mm_per_px, gel.shape
        if key not in self._found:
            self._found[key] = touch_fold.slices_of(gel._replace(modulus_pa=SHEAR_MODULUS_PA), tracks)
        return self._found[key]


def run(job: ForceReportJob, params: EvaluateForce, *, force: bool, progress: Progress) -> Outcome:
    """Return rows for every file and every state of knowledge."""
    files, own = job.inputs[: len(job.inputs) - job.own], job.inputs[len(job.inputs) - job.own :]
    headers, own_headers, by_sensor = _headers(files, own)
    identified = _identified(params.identified, files) if params.identified else {}
    folds = _Folds()

    def measure() -> tuple[Rows, dict[str, Any]]:
        gels: dict[str, dict[str, GelWeights]] = {}
        trials = [_predict(path, folds, gels, by_sensor, identified, params) for path in each(files, progress)]
        range_n = max(float(one.normal_n.max()) for one in trials)
        if not range_n > 0:
            raise InputError("no contact", where=str(files[0]), expected="recordings in which the gel is pressed")
        rows = [_row(one, name, range_n) for one in trials for name in one.predicted]
        return rows, _summary(trials, rows, range_n, params)

    parents = [*headers, *own_headers]
    recipe = recipe_of(params) | (
        {"identified": {name: gel.for_recipe() for name, gel in identified.items()}} if identified else {}
    )
    return report(job, "evaluate force", METHOD, recipe, parents, measure, force=force)


def _headers(
    files: tuple[Path, ...], own: tuple[Path, ...]
) -> tuple[list[Header], list[Header], dict[str, list[Path]]]:
    """Return headers of the files and of those to adapt on, and the latter by sensor.

    Raise InputError if they do not fit.
    """
    headers, own_headers, names = [], [], []
    by_sensor: dict[str, list[Path]] = {}
    values_of: dict[str, str | None] = {}  # of the sensors, by name: gels are kept by it
    for number, path in enumerate((*files, *own)):
        with StageFile(path, "tracks") as tracks, recording_with_truth(tracks) as recording:
            header, name = tracks.header, str(tracks.read("sensor/name"))
            values = sensor_values(header)
            if values_of.setdefault(name, values) != values:
                expected = f"the values that {name} has in the first of these files"
                hint = "evaluate them apart"
                raise InputError("two sensors of one name", where=str(path), expected=expected, hint=hint)
            if number < len(files):
                known_sensor(recording)
                headers.append(header)
                names.append(name)
            else:
                own_headers.append(header)
                by_sensor.setdefault(name, []).append(path)
    if own:
        check_disjoint(own_headers, headers, "evaluated on", list(files))
        missing = sorted(set(names) - set(by_sensor))
        if missing:
            expected, found = "tracks of each evaluated sensor", f"none of {', '.join(missing[:5])}"
            raise InputError("no tracks to adapt on", where="--adapt-on", expected=expected, found=found)
    return headers, own_headers, by_sensor


def _identified(folder: str, files: tuple[Path, ...]) -> dict[str, KnownGel]:
    """Return the gel data in a folder's sensor files, for each sensor that has one; raise InputError if none has."""
    gel_by_sensor: dict[str, KnownGel] = {}
    for path in files:
        with StageFile(path, "tracks") as tracks:
            name = str(tracks.read("sensor/name"))
        file = Path(folder) / f"{name.rpartition(':')[2]}.sensor.toml"
        if file.exists():
            gel_by_sensor[name] = known_gel.known_of(str(file))
    if not gel_by_sensor:
        expected = "files such as 7.sensor.toml for randomized:7"
        raise InputError("no file of any evaluated sensor", where=f"--identified {folder}", expected=expected)
    return gel_by_sensor


def known_sensor(recording: Recording) -> Sensor:
    """Return the simulated sensor; raise InputError if the recording does not name it."""
    return read_sensor(recording.header["parameters"], str(recording.path))


def _gels(
    name: str,
    sensor: Sensor,
    folds: _Folds,
    own: list[Path],
    identified: KnownGel | None,
    params: EvaluateForce,
) -> dict[str, GelWeights]:
    """Return state of knowledge of a sensor's gel -> its weights."""
    rng = np.random.default_rng([params.seed, zlib.crc32(name.encode())])
    moduli, noise = rng.spawn(2)
    off = float(np.exp(params.stiffness_error * moduli.standard_normal()))
    # all of the true gel except its creep
    true = KnownGel(off * sensor.shear_modulus_pa, sensor.mm_per_px, None, known_gel.edges_of(sensor))
    known_gels = {"unknown": KnownGel(), "known": true}
    if identified is not None:
        known_gels["identified"] = identified
    gels = {state: known_gel.gel_of(gel, params.stiffness_error) for state, gel in known_gels.items()}
    if own:
        for before in list(gels):
            after = "adapted" if before == "unknown" else f"{before}, adapted"
            known_forces, _ = adapt_touch.known_forces(gels[before], own, params.noise_n, noise, fold=folds.of)
            gels[after] = adapt_touch.adapted(gels[before], known_forces, params.noise_n)
    return gels


def _predict(
    path: Path,
    folds: _Folds,
    gels: dict[str, dict[str, GelWeights]],
    by_sensor: Mapping[str, list[Path]],
    identified: Mapping[str, KnownGel],
    params: EvaluateForce,
) -> ForceTrial:
    from evetac_cli.stages.touch import touch_fold  # imports scipy

    with StageFile(path, "tracks") as tracks, recording_with_truth(tracks) as recording:
        name = str(tracks.read("sensor/name"))
        if name not in gels:
            own = by_sensor.get(name, [])
            gels[name] = _gels(name, known_sensor(recording), folds, own, identified.get(name), params)
        at = slice(None, None, adapt_touch.EVERY)
        predicted, touches = {}, {}
        for state, gel in gels[name].items():
            over = folds.of(gel, tracks)
            predicted[state] = Forces(*(values[at] for values in touch_fold.forces_of(gel, over)))
            touches[state] = over.touches[at]
        shear_n = recording.read("truth/shear_force_n")[at].astype(float)
        normal_n = recording.read("truth/normal_force_n")[at].astype(float)
        return ForceTrial(path, name, shear_n, normal_n, predicted, touches)


def _row(trial: ForceTrial, name: str, range_n: float) -> dict[str, Any]:
    forces, touches = trial.predicted[name], trial.touches[name]
    pressed = trial.normal_n >= CONTACT_N
    usable = pressed & touches
    row: dict[str, Any] = {"file": trial.path.name, "sensor_name": trial.sensor_name, "stiffness": name}
    row |= dict.fromkeys(ERRORS)
    if usable.any():
        off = np.abs(forces.shear_n[usable] - trial.shear_n[usable])
        normal_off = np.abs(forces.normal_n[usable] - trial.normal_n[usable])
        mae, normal_mae = off.mean(axis=0), float(normal_off.mean())
        row |= {
            "mae_n_x": float(mae[0]),
            "mae_n_y": float(mae[1]),
            "mae_n": float(mae.mean()),
            "normal_mae_n": normal_mae,
            "normal_mae_of_range": normal_mae / range_n,
            "shear_within_sd": float((off <= forces.shear_sd_n[usable]).mean()),
            "normal_within_sd": float((normal_off <= forces.normal_sd_n[usable]).mean()),
        }
    return row | {
        "contact_right": float((touches == pressed).mean()),
        "usable": float(usable.sum() / max(pressed.sum(), 1)),
        "slices_counted": int(usable.sum()),
        "slices_in_contact": int(pressed.sum()),
    }


def _summary(trials: list[ForceTrial], rows: Rows, range_n: float, params: EvaluateForce) -> dict[str, Any]:
    """Return means over files for each state of knowledge, and the range of the true forces."""
    shear = np.concatenate([one.shear_n for one in trials])
    summary: dict[str, Any] = {
        "trajectories": len(trials),
        "sensors": len({one.sensor_name for one in trials}),
        "stiffness_error": params.stiffness_error,
        "true_shear_n_mean": float(np.abs(shear).mean()),
        "true_shear_n_most": float(np.abs(shear).max()),
        "normal_range_n": range_n,
    }
    for name in dict.fromkeys(name for one in trials for name in one.predicted):
        selected_rows = [row for row in rows if row["stiffness"] == name]
        word = name.replace(", ", "_and_")
        known = [row for row in selected_rows if row["slices_counted"]]
        summary[f"{word}_counted"] = len(known)
        for key in ERRORS[2:]:
            summary[f"{word}_{key}"] = mean(row[key] for row in known)
        by_sensor = [float(np.mean([row["mae_n"] for row in of])) for of in grouped(known, ("sensor_name",))]
        summary[f"{word}_sensors"] = len(by_sensor)
        summary[f"{word}_worst_sensor_mae_n"] = max(by_sensor, default=None)
    summary["contact_right"] = mean(row["contact_right"] for row in rows if row["stiffness"] == "unknown")
    return summary
