"""Everything that follows from a simulated slip: its labels, tracks, features, the pretrained detector, run times."""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeVar

from evetac_cli import resources
from evetac_cli.arrays import Floats
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.label import Label
from evetac_cli.commands.track import Track
from evetac_cli.evaluate.labels.measure import true_onsets
from evetac_cli.evaluate.slip.models import Model, check, predict_all
from evetac_cli.jobs import silent
from evetac_cli.kernels.slip import metrics
from evetac_cli.stages import featurize, label, track
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials.record import simulated as simulated_record
from evetac_cli.trials.trial import SimulatedTrial

Result = TypeVar("Result")


class Chain(NamedTuple):
    """Results of the chain for one trial; onsets are slices, None if not found.

    - gross_slip_ms: in the simulation's truth; label_ms: in the labels;
    - detection_ms: first slice that the detector takes for slip;
    - dot_xy_px, true_dot_xy_px (slices, dots, 2): tracked and true positions;
    - record_us, chain_us: run time per recorded millisecond.
    """

    gross_slip_ms: int | None
    label_ms: int | None
    detection_ms: int | None
    dot_xy_px: Floats
    true_dot_xy_px: Floats
    record_us: float
    chain_us: float


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
        true_dots = recording.read("truth/dot_xy_px")
        slices = len(recording)
    with StageFile(output_path(path, "labels", None), "labels") as labels:
        onset = int(labels.read("onset_slice"))
    with StageFile(output_path(path, "tracks", None), "tracks") as tracks:
        dots = tracks.read("dot_xy_px")
    return Chain(
        gross_slip_ms,
        onset if onset >= 0 else None,
        detected_ms,
        dots.astype(float),
        true_dots.astype(float),
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


def timed(act: Callable[[], Result]) -> tuple[Result, float]:
    """Return a function's result and its processor time in s; other programs do not count."""
    started = time.process_time()
    result = act()
    return result, time.process_time() - started
