"""The predictions of evetac's methods for a benchmark: slip detector, dot tracker, touch maps or a force model.

The commands `track`, `featurize` and `predict-touch` process the inputs, which hold no truth, in a folder next to the
report. Files that exist there are not made again.

Closed-loop lifts are played by a law of evetac or of a plug-in.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.track import Track
from evetac_cli.errors import MAKE_MODEL, InputError
from evetac_cli.evaluate.benchmark.data_set import Benchmark, BenchmarkTrial, read_json
from evetac_cli.evaluate.benchmark.predictions import ONSET_KINDS, WARNING_KINDS, Predictions
from evetac_cli.evaluate.common.rows import each
from evetac_cli.evaluate.grasp import measure as grasp_evaluation
from evetac_cli.evaluate.slip.models import Model
from evetac_cli.jobs import Job, Outcome, Progress, Row, Rows, silent
from evetac_cli.kernels.force import models as forces
from evetac_cli.kernels.slip import metrics
from evetac_cli.kernels.slip.architectures import ImageArchitecture, MemoryArchitecture, PluginImageArchitecture
from evetac_cli.kernels.slip.metrics import is_slip
from evetac_cli.stages import featurize, track
from evetac_cli.stages.force.train_force import ForceModel, check_grid, read_model, read_rest_px
from evetac_cli.stages.slip_detectors import probabilities, read_series
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.files import StageFile, header_of
from evetac_cli.store.layout.provenance import Header
from evetac_cli.store.recordings.read import open_recording, ramp_start
from evetac_cli.text_files import as_toml
from evetac_cli.trials import grasp

LIFT_FLAGS = ("sensor", "seed", "lift_s", "balance_s")


@dataclass(frozen=True)
class Methods:
    """The methods that are scored; slip, force: None leaves the tasks out; of_force: which model of a force file."""

    tracker: str
    slip: Model | None
    threshold: float | None
    of_force: str | None
    force_path: Path | None
    force: ForceModel | None
    force_header: Header | None

    def parents(self) -> list[Header]:
        """Return the headers of the models."""
        return [*([self.slip.header] if self.slip else []), *([self.force_header] if self.force_header else [])]

    def for_recipe(self) -> dict[str, Any]:
        """Return what determines the predictions, besides the models."""
        return {"tracker": self.tracker, "slip": self.slip is not None, "force": self.of_force or ""}


def predict(benchmark: Benchmark, methods: Methods, folder: Path, progress: Progress) -> Predictions:
    """Return the predictions of all recordings; folder: of the files of the stages."""
    made = Predictions(dot_xy_px={})
    if methods.slip is not None:
        made.onset_ms, made.warning = {}, {}
    if methods.of_force is not None:
        made.force_n = {}
    for entry in each(benchmark.entries.values(), progress, "recordings"):
        tracks = _tracked(entry, methods.tracker, folder)
        at_ms = [ms for name, ms in benchmark.queries["dots"] if name == entry.name]
        with StageFile(tracks, "tracks") as file:
            if at_ms and made.dot_xy_px is not None:
                made.dot_xy_px[entry.name] = file.read("dot_xy_px").astype(np.float64)[at_ms]
        if made.force_n is not None and entry.kind == "press":
            at_ms = [ms for name, ms in benchmark.queries["force"] if name == entry.name]
            made.force_n[entry.name] = _force(benchmark, entry, methods, tracks)[at_ms]
        if methods.slip is not None and made.warning is not None and entry.kind in WARNING_KINDS:
            score = _slip(entry, methods.slip, tracks)
            made.warning[entry.name] = score
            if made.onset_ms is not None and entry.kind in ONSET_KINDS:
                made.onset_ms[entry.name] = _onset(entry, score, methods)
    return made


def made_or_kept(run: Callable[..., Outcome], job: Job, params: Any) -> None:
    """Run a stage on a job, unless its output exists with the same recipe; replace one with another recipe."""
    try:
        run(job, params, force=False)
    except InputError:  # of another recipe, or damaged; any other fault comes again
        run(job, params, force=True)


def _tracked(entry: BenchmarkTrial, preset: str, folder: Path) -> Path:
    output = folder / preset / f"{entry.name}.tracks.h5"
    output.parent.mkdir(parents=True, exist_ok=True)
    made_or_kept(track.run, Job((entry.path,), output), Track(preset=preset))
    return output


def _slip(entry: BenchmarkTrial, model: Model, tracks: Path) -> NDArray[np.float32]:
    """Return the probability of slip in each ms, NaN until the history is full."""
    architecture = model.architecture
    asked = Featurize(
        images=isinstance(architecture, ImageArchitecture),
        events=isinstance(architecture, PluginImageArchitecture),
        sticking_share=isinstance(architecture, MemoryArchitecture),
    )
    what = "".join(f"-{name}" for name in ("images", "events", "sticking_share") if getattr(asked, name))
    output = tracks.with_name(f"{entry.name}{what}.features.h5")
    made_or_kept(featurize.run, Job((entry.path, tracks), output), asked)
    with StageFile(output, "features") as file:
        shape = tuple(int(size) for size in file.read("dot_shape"))
        if shape != model.dot_shape:
            found, expected = (" x ".join(map(str, one)) for one in (model.dot_shape, shape))
            where = str(model.path)
            raise InputError("another dot grid", where=where, expected=expected, found=found, hint=MAKE_MODEL)
        series = read_series(file, architecture)
        (score,) = probabilities([model.detector()], series, 0)
    return score


def _onset(entry: BenchmarkTrial, score: NDArray[np.float32], methods: Methods) -> int | None:
    """Return the first slice that reaches the threshold, after the current begins to fall, as in `evaluate slip`."""
    assert methods.slip is not None
    with open_recording(entry.path) as recording:
        first = ramp_start(recording)
    detected = is_slip(score, methods.slip.threshold if methods.threshold is None else methods.threshold)
    detected[:first] = False
    found = metrics.onset(detected)
    return None if found < 0 else found


def _force(benchmark: Benchmark, entry: BenchmarkTrial, methods: Methods, tracks: Path) -> Floats:
    """Return the shear force in each ms, (slices, 2); 0 where touch maps know none."""
    if methods.force is None or methods.force_path is None:
        sensor = tracks.with_name(f"{entry.sensor}.sensor.toml")
        scale = {"name": "bench-sensor", "like": "evetac", "mm_per_px": benchmark.mm_per_px[entry.sensor]}
        sensor.write_text(as_toml(scale))
        output = tracks.with_name(f"{entry.name}.touch.h5")
        made_or_kept(predict_touch.run, Job((tracks,), output), PredictTouch(sensor=str(sensor), map_every=0))
        with StageFile(output, "touch") as file:
            shear_n: Floats = np.nan_to_num(file.read("shear_n").astype(np.float64))
        return shear_n
    with StageFile(tracks, "tracks") as file:
        check_grid(methods.force, methods.force_path, file)
        moved_px = forces.displacement(file.read("dot_xy_px"), read_rest_px(file))
    if methods.of_force == "regression":
        return forces.apply_regression(methods.force.regression, moved_px)
    return forces.apply_network(methods.force.network, moved_px)


def methods_of(
    tracker: str, slip: Path | None, threshold: float | None, force: str, force_path: Path | None
) -> Methods:
    """Return the methods; force: touch, regression, network (with a file) or none."""
    header, model = read_model(force_path) if force_path is not None else (None, None)
    return Methods(
        tracker,
        None if slip is None else Model.read(slip),
        threshold,
        None if force == "none" else force,
        force_path,
        model,
        header,
    )


def read_lifts(benchmark: Benchmark) -> dict[str, Row]:
    """Return the lifts by name: split, object, and the flags of `evetac grasp`."""
    path = benchmark.folder / "truth" / "lifts.json"
    found, _ = read_json(path, "the lifts are missing")
    wanted = {"split", "object", *LIFT_FLAGS}
    if not isinstance(found, dict) or any(not isinstance(row, dict) or set(row) != wanted for row in found.values()):
        raise InputError("not the lifts of a benchmark", where=str(path), expected=", ".join(sorted(wanted)))
    return found


def lift_flags(benchmark: Benchmark, name: str, lift: Row, **chosen: Any) -> Grasp:
    """Return the flags of `evetac grasp` that play a lift; chosen: controller, model and others."""
    folder = benchmark.folder / "truth" / "lifts"
    flags = {flag: lift[flag] for flag in LIFT_FLAGS}
    scene, object_name = (str(folder / f"{name}.{what}.toml") for what in ("scene", "object"))
    return Grasp(scene=scene, objects=object_name, **flags, **chosen)


def play_lifts(
    benchmark: Benchmark, lifts: Mapping[str, Row], chosen: Mapping[str, Any], folder: Path, progress: Progress = silent
) -> Rows:
    """Play every lift with the chosen controller and detector, and return the outcomes.

    folder: of the recordings; those that exist are not made again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, lift in each(lifts.items(), progress, "lifts"):
        params, path = lift_flags(benchmark, name, lift, **chosen), folder / f"{name}.recording.h5"
        (job,) = grasp.jobs([], params, path)
        made_or_kept(grasp.run, job, params)
        outcome = grasp_evaluation.trial_row(path, header_of(path, "recording"))
        rows.append({**outcome, "name": name, **{key: lift[key] for key in ("split", "object", "sensor")}})
    return rows
