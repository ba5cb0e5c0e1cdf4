"""The part `pipeline`: effect of the settings of a recording on the results of the whole chain, and their run time.

Every setting records the same seeded slip trials and grasps, and derives everything from them as the commands do:
labels, tracks, features, the probabilities of the pretrained detector. All are compared with the truth of a reference:
the same trials, simulated more finely in every respect. Columns, as means over the trials:

- error_ms_gross_slip: onset of gross slip (`truth/slip`) in the simulation with this setting.
- error_ms_label: onset of the labels, against the onset of gross slip in the reference's truth.
- error_share_detection: share of trials in which the first detection by the pretrained detector (trained to warn 10 ms
  ahead) moves by more than DETECTION_MS from that on the reference.
- detection_moved_ms_median: the median of this shift. A mean would be dominated by single trials that shift by hundreds
  of ms near the threshold.
- error_px_dots: tracked dots against the reference's true dots, root mean square up to gross slip.
- error_n_shear: shear force on a pad, estimated from the tracked dots by a regression fitted at the defaults on other
  trials, against the reference's true force, root mean square up to gross slip.
- error_share_lost, error_mm_moved: grasps whose object was not held to the end, and the absolute difference of the
  object's motion in the gripper from the reference.
- time_us_*: processor time of the chain per recorded millisecond, over the trials. record_us_median, grasp_us_median:
  of recording alone, and per simulated millisecond of the grasp.

A second table has the paired difference of every setting from the defaults, with its interval (see rows). Every row
contains the errors of labels, tracker and regression; the effect of a setting is in the differences.

Only the chain is timed: the comparison with the reference is not.
"""

import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeVar

import numpy as np

from evetac_cli import resources
from evetac_cli.arrays import Floats
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.evaluate.common.rows import (
    ConfidenceInterval,
    Extent,
    SolverSetting,
    difference,
    draw,
    line,
    mean,
    quantile,
    run_times,
    share_difference,
)
from evetac_cli.evaluate.cost import EvaluateCost
from evetac_cli.evaluate.labels.measure import true_onsets
from evetac_cli.evaluate.slip.models import Model, check, predict_all
from evetac_cli.jobs import Progress, Row, Rows, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.kernels.slip import metrics
from evetac_cli.stages import featurize, label, track
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp import simulated as simulated_grasp
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from evetac_cli.trials.record import simulated as simulated_record
from evetac_cli.trials.trial import SimulatedTrial

TRIALS = Extent(quick=4, full=20)
OBJECTS = (8, 1, 12, 4, 16, 3, 14, 6, 10, 17)  # these slip; used in turn
GRASPED = (11, 17, 12, 13, 10, 18)  # used in turn

DEFAULTS = SolverSetting("defaults")
REFERENCE = SolverSetting("reference", solver={"step_ms": 0.125, "node_pitch_mm": 0.625, "camera_substeps": 4})
FINEST = SolverSetting("reference", solver={"step_ms": 0.05, "node_pitch_mm": 0.5, "camera_substeps": 8})
CHOICES = Extent[tuple[SolverSetting, ...]](
    quick=(
        *line("fixed step", "step_ms", (1.0,), "ms"),
        *line("tolerance", "tolerance_um", (0.05,), "um"),
        *line("node pitch", "node_pitch_mm", (1.25,), "mm"),
        *line("scans", "scans_per_ms", (2,), "a ms"),
    ),
    full=(
        *line("fixed step", "step_ms", (1.0, 0.5, 0.25, 0.125), "ms"),
        *line("tolerance", "tolerance_um", (5.0, 2.0, 1.0, 0.5, 0.1, 0.05), "um"),
        *line("theta", "theta", (1.0, 0.75, 0.5)),
        *line("node pitch", "node_pitch_mm", (1.67, 1.25, 1.0, 0.625), "mm"),
        *line("camera sub-steps", "camera_substeps", (2, 4)),
        *line("scans", "scans_per_ms", (1, 2, 10), "a ms"),
    ),
)

DETECTION_MS = 5.0  # half of the network's 10 ms ahead
# Columns of `slip_errors`, in its order.
SLIP_ERRORS = (
    "error_ms_gross_slip",
    "error_ms_label",
    "error_share_detection",
    "error_px_dots",
    "error_n_shear",
)
GRASP_ERRORS = ("error_share_lost", "error_mm_moved")
ERRORS = (*SLIP_ERRORS, *GRASP_ERRORS)
SLICE_MS = 1.0  # onsets are whole slices
Result = TypeVar("Result")

GRASP_CHOICES: dict[str, Any] = {"controller": "paper", "model": Path(resources.SHIPPED), "node_pitch_mm": 1.45}
LIFT_S, BALANCE_S = 3.5, 0.5  # of a grasp: the hand reaches 50 mm, the least that counts as held, after 3.1 s


class ChainTrial(NamedTuple):
    """A trial by the flags that select it: its object, its seed, and the object of the grasp with that seed.

    number: index of the trial with that object and seed, as with `--count`.
    """

    object: int
    seed: int
    grasped: int
    number: int = 0


CALIBRATION = (ChainTrial(8, 9000, 11), ChainTrial(3, 9001, 11))  # of the regression; seeds of no reported trial


class Chain(NamedTuple):
    """Results of the chain for one trial; onsets are slices, None if not found.

    - gross_slip_ms: in the simulation's truth; label_ms: in the labels;
    - detection_ms: first slice that the detector takes for slip;
    - dot_xy_px, true_dot_xy_px (slices, dots, 2): tracked and true positions; rest_xy_px (dots, 2);
    - shear_force_n (slices, 2): of the object on one pad;
    - record_us, chain_us: run time per recorded millisecond.
    """

    gross_slip_ms: int | None
    label_ms: int | None
    detection_ms: int | None
    dot_xy_px: Floats
    true_dot_xy_px: Floats
    rest_xy_px: Floats
    shear_force_n: Floats
    record_us: float
    chain_us: float

    @property
    def slices(self) -> int:
        """Number of slices of the recording."""
        return len(self.dot_xy_px)


class Lifted(NamedTuple):
    """Result of one grasp: held to the end or not, motion of the object in the gripper, and run time."""

    held: bool
    moved_mm: float
    grasp_us: float


def compared(results: tuple[Chain, Lifted], reference: tuple[Chain, Lifted], force: forces.Regression) -> Row:
    """Return the errors and run times of a trial with a setting, compared with those of the reference."""
    (chain, lifted), (true_chain, true_lifted) = results, reference
    both_held = lifted.held and true_lifted.held
    return {
        **slip_errors(chain, true_chain, force),
        "error_share_lost": float(not lifted.held),
        "error_mm_moved": abs(lifted.moved_mm - true_lifted.moved_mm) if both_held else float("nan"),
        "detection_moved_ms": detection_moved_ms(chain, true_chain),
        "chain_us": chain.chain_us,
        "record_us": chain.record_us,
        "grasp_us": lifted.grasp_us,
    }


def trials(count: int, seed: int) -> list[ChainTrial]:
    """Return trials with seeds starting at `seed`, each with an object that slips and one that is grasped."""
    return [ChainTrial(OBJECTS[k % len(OBJECTS)], seed + k, GRASPED[k % len(GRASPED)]) for k in range(count)]


def measure(params: EvaluateCost, inputs: Sequence[Path], progress: Progress) -> Rows:
    """Return a row per setting including the reference, and per paired difference from the defaults."""
    settings = [FINEST if params.full else REFERENCE, DEFAULTS, *CHOICES.pick(params.full)]
    tried = trials(params.trials or TRIALS.pick(params.full), params.seed)
    measured: list[tuple[SolverSetting, Rows]] = [(setting, []) for setting in settings]
    done, total = 0, len(CALIBRATION) + len(settings) * len(tried)
    calibration = []
    for trial in CALIBRATION:
        with TemporaryDirectory() as folder:
            calibration.append(run_chain(trial, DEFAULTS, Path(folder)))
        done += 1
        progress(done, total)
    force = fit_force(calibration)
    for trial in tried:
        reference: tuple[Chain, Lifted] | None = None
        for setting, rows in measured:
            with TemporaryDirectory() as folder:  # files of all settings have the same names
                results = run_chain(trial, setting, Path(folder)), run_grasp(trial, setting, Path(folder))
            reference = reference or results
            rows.append(compared(results, reference, force))
            done += 1
            progress(done, total)
    return tables(measured)


def tables(measured: Sequence[tuple[SolverSetting, Rows]]) -> Rows:
    """Return the two tables from the rows of each setting's trials; the first are the reference and the defaults."""
    _, (_, defaults), *others = measured
    rows = [_row(setting, trials, is_reference=not number) for number, (setting, trials) in enumerate(measured)]
    for name in ERRORS:
        for setting, trials in others:
            apart = _more(name, *(np.array([trial[name] for trial in some]) for some in (trials, defaults)))
            error = {"error": name.removeprefix("error_"), "setting": setting.name}
            rows.append({**error, **apart.columns("more_than_defaults"), "trials": apart.trials})
    return rows


def _more(name: str, ours: Floats, theirs: Floats) -> ConfidenceInterval:
    """Return the paired difference of an error; the shares are of the trials in which both are known."""
    if not name.startswith("error_share"):
        return difference(ours, theirs, SLICE_MS if name.startswith("error_ms") else 0.0)
    both = np.isfinite(ours) & np.isfinite(theirs)
    return share_difference(ours[both] > 0.0, theirs[both] > 0.0)


def _row(setting: SolverSetting, trials: Rows, *, is_reference: bool) -> Row:
    """Return the row of a setting; a reference has no errors against itself, only those of the methods behind it."""
    compared_with_itself = ("error_ms_gross_slip", "error_share_detection", "error_mm_moved") if is_reference else ()
    columns = {name: [trial[name] for trial in trials] for name in trials[0]}
    return {
        "setting": setting.name,
        "flags": setting.flags or "none",
        "trials": len(trials),
        **{name: None if name in compared_with_itself else mean(columns[name]) for name in ERRORS},
        "detection_moved_ms_median": None if is_reference else quantile(columns["detection_moved_ms"]),
        **run_times(np.array(columns["chain_us"])),
        "record_us_median": float(np.median(columns["record_us"])),
        "grasp_us_median": float(np.median(columns["grasp_us"])),
    }


def summary(rows: Rows) -> dict[str, Any]:
    """Return the numbers of settings and trials, and the flags of the reference."""
    settings = [row for row in rows if "flags" in row]
    return {"settings": len(settings), "trials": settings[0]["trials"], "reference": settings[0]["flags"]}


def draw_settings(figure: Any, rows: Rows, errors: Sequence[str]) -> None:
    """Plot each error of the settings over the run time of the chain, or of the grasp."""
    draw(figure, [row for row in rows if "flags" in row], errors, dict.fromkeys(GRASP_ERRORS, "grasp_us_median"))


def slip_trial(trial: ChainTrial, setting: SolverSetting, folder: Path, scene: str = "slip") -> SimulatedTrial:
    """Return the trial of `evetac record --scene slip --object N --seed N` with the flags of a setting."""
    options: dict[str, Any] = dict(setting.solver)
    params = Record(scene=scene, objects=str(trial.object), seed=trial.seed, count=trial.number + 1, **options)
    planned = record.jobs([], params, folder)[trial.number]
    assert isinstance(planned, SimulatedTrial)
    return planned


def run_chain(trial: ChainTrial, setting: SolverSetting, folder: Path, scene: str = "slip") -> Chain:
    """Record a trial with a setting, and compute everything that follows from it, in the given folder."""
    return chain_of(slip_trial(trial, setting, folder, scene))


def chain_of(trial: SimulatedTrial) -> Chain:
    """Record a trial, and compute everything that follows from it, next to it."""
    _, record_s = timed(lambda: simulated_record.run(trial, force=False, progress=silent))
    path = trial.output

    def further() -> int | None:
        for stage, params in ((label, Label()), (track, Track()), (featurize, Featurize())):
            (job,) = stage.jobs([path], params, None)
            stage.run(job, params)
        return detection(output_path(path, "features", None))

    detected_ms, rest_s = timed(further)
    with open_recording(path) as recording:
        gross_slip_ms = true_onsets(recording)["t_s_ms"]
        true_dots, shear = recording.read("truth/dot_xy_px"), recording.read("truth/shear_force_n")
        slices = len(recording)
    with StageFile(output_path(path, "labels", None), "labels") as labels:
        onset = int(labels.read("onset_slice"))
    with StageFile(output_path(path, "tracks", None), "tracks") as tracks:
        dots, rest = tracks.read("dot_xy_px"), tracks.read("sensor/dot_xy_px").reshape(-1, 2)
    return Chain(
        gross_slip_ms,
        onset if onset >= 0 else None,
        detected_ms,
        dots.astype(float),
        true_dots.astype(float),
        rest,
        shear.astype(float),
        1e6 * record_s / slices,
        1e6 * (record_s + rest_s) / slices,
    )


def detection(features: Path) -> int | None:
    """Return the first slice that the pretrained detector takes for slip; None if there is none."""
    first = metrics.onset(prediction(features).detected(package_model().threshold))
    return first if first >= 0 else None


def prediction(features: Path) -> metrics.Prediction:
    """Return the probabilities of the pretrained detector."""
    model = package_model()
    ((predicted,),) = predict_all([model], [features], check([model], [features]), silent)
    return predicted


@cache
def package_model() -> Model:
    """Return the pretrained slip detector."""
    return Model.read(resources.MODEL)


def run_grasp(trial: ChainTrial, setting: SolverSetting, folder: Path) -> Lifted:
    """Run the grasp of `evetac grasp --object N --seed N` with the flags of GRASP_CHOICES and of a setting."""
    options: dict[str, Any] = dict(setting.solver)
    times: dict[str, Any] = {"count": trial.number + 1, "lift_s": LIFT_S, "balance_s": BALANCE_S}
    params = Grasp(objects=str(trial.grasped), seed=trial.seed, **times, **(GRASP_CHOICES | options))
    job = grasp.jobs([], params, folder)[trial.number]
    assert isinstance(job, SimulatedGrasp)
    outcome, seconds = timed(lambda: simulated_grasp.run(job, force=False, progress=silent))
    (row,) = outcome.rows
    return Lifted(bool(row["balanced"]), float(row["moved_mm"]), 1e6 * seconds / row["slices"])


def timed(act: Callable[[], Result]) -> tuple[Result, float]:
    """Return a function's result and its processor time in s; other programs do not count."""
    started = time.process_time()
    result = act()
    return result, time.process_time() - started


def fit_force(chains: list[Chain]) -> forces.Regression:
    """Fit the shear force to the mean displacement of tracked dots, by least squares, up to gross slip."""
    moved = [(chain.dot_xy_px - chain.rest_xy_px)[: chain.gross_slip_ms] for chain in chains]
    force = [chain.shear_force_n[: chain.gross_slip_ms] for chain in chains]
    return forces.fit_regression(np.concatenate(moved), np.concatenate(force))


def slip_errors(chain: Chain, reference: Chain, force: forces.Regression) -> dict[str, float]:
    """Return the errors of a chain against the reference's truth, by column; NaN if the reference does not slip.

    A missing onset counts as one at the end of the recording. The detector is compared with itself on the reference: 1
    if its first detection moves by more than DETECTION_MS, else 0. Tracks and forces are compared up to the reference's
    onset of gross slip: after it the object falls, and a small shift in time is a large distance.
    """
    truth_ms = reference.gross_slip_ms
    if truth_ms is None:
        return dict.fromkeys(SLIP_ERRORS, float("nan"))
    late = [abs(_found(chain, onset) - truth_ms) for onset in (chain.gross_slip_ms, chain.label_ms)]
    stop = min(truth_ms, chain.slices)
    apart_px = chain.dot_xy_px[:stop] - reference.true_dot_xy_px[:stop]
    estimated_n = forces.apply_regression(force, (chain.dot_xy_px - chain.rest_xy_px)[:stop])
    apart_n = estimated_n - reference.shear_force_n[:stop]
    values: tuple[Any, ...] = (
        *late,
        detection_moved_ms(chain, reference) > DETECTION_MS,
        np.sqrt((apart_px**2).sum(-1).mean()),
        np.sqrt((apart_n**2).sum(-1).mean()),
    )
    return dict(zip(SLIP_ERRORS, map(float, values), strict=True))


def detection_moved_ms(chain: Chain, reference: Chain) -> float:
    """Return the distance in ms of the first detection from that on the reference; NaN if the reference does not slip.

    Near its threshold a detector fires or does not: one setting in one trial can move the first detection by hundreds
    of ms, so a mean over trials means little.
    """
    if reference.gross_slip_ms is None:
        return float("nan")
    return float(abs(_found(chain, chain.detection_ms) - _found(reference, reference.detection_ms)))


def _found(chain: Chain, onset: int | None) -> int:
    return chain.slices if onset is None else onset
