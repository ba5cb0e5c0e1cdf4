"""One timed trial through the whole chain, stage by stage as the commands run them.

The stages are record, label, track, featurize, and the probabilities of the pretrained detector as in `evaluate slip`.
Then, not timed, the results are compared with the truth of a reference: the same trial, simulated more finely.
"""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from evetac_cli import resources
from evetac_cli.arrays import Floats
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.evaluate.labels import true_onsets
from evetac_cli.evaluate.rows import SolverSetting
from evetac_cli.evaluate.slip_models import Model, check, predict_all
from evetac_cli.jobs import silent
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


DETECTION_MS = 5.0  # half of the network's 10 ms ahead
# Columns of `slip_errors`, in its order.
SLIP_ERRORS = (
    "error_ms_gross_slip",
    "error_ms_label",
    "error_share_detection",
    "error_px_dots",
    "error_n_shear",
)
