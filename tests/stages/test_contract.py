"""The contract of being a stage, run over all of them; a new stage gets these tests by a row in STAGES.

Only calibrate and identify, which write JSON and TOML, and the evaluations that need no files (cost, stability) have
tests of their own.
"""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest

from evetac_cli.cli.config import with_config
from evetac_cli.commands.attach import Attach
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.grasp import Grasp
from evetac_cli.commands.label import Label
from evetac_cli.commands.parameter import flag_of
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.commands.train import Train
from evetac_cli.commands.train_force import TrainForce
from evetac_cli.commands.trim import Trim
from evetac_cli.errors import InputError
from evetac_cli.evaluate.data_rate import EvaluateDataRate
from evetac_cli.evaluate.data_rate import measure as evaluate_data_rate
from evetac_cli.evaluate.force import EvaluateForce
from evetac_cli.evaluate.force import measure as evaluate_force
from evetac_cli.evaluate.grasp import EvaluateGrasp
from evetac_cli.evaluate.grasp import measure as evaluate_grasp
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels import measure as evaluate_labels
from evetac_cli.evaluate.likeness import EvaluateLikeness
from evetac_cli.evaluate.likeness import command as evaluate_likeness
from evetac_cli.evaluate.realism import EvaluateRealism
from evetac_cli.evaluate.realism import measure as evaluate_realism
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as evaluate_slip
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as evaluate_tracking
from evetac_cli.evaluate.vibration import EvaluateVibration
from evetac_cli.evaluate.vibration import measure as evaluate_vibration
from evetac_cli.inspect import validate
from evetac_cli.resources import PACKAGE
from evetac_cli.stages import (
    attach,
    featurize,
    label,
    track,
    train,
    trim,
)
from evetac_cli.stages.force import train_force
from evetac_cli.stages.touch import predict_touch
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import TRAINED
from evetac_cli.store.layout.provenance import Header
from evetac_cli.trials import grasp, record
from tests.conftest import Made
from tests.make import run_stage
from tests.patience import PATIENCE_S


class Stage(NamedTuple):
    """A stage: its module, parameters to run it with and others, and its inputs in a folder.

    The others give another recipe. A stage without parameters that change numbers has other inputs instead.
    """

    name: str
    module: Any
    params: Callable[[Path], Any]
    other: Callable[[Path], Any]
    inputs: Callable[[Path], list[Path]]
    other_inputs: Callable[[Path], list[Path]] | None = None

    def another(self, folder: Path) -> tuple[Any, list[Path]]:
        """Parameters and inputs of another recipe."""
        return self.other(folder), (self.other_inputs or self.inputs)(folder)


FirstRun = Callable[[Stage], tuple[Path, Any]]


def of(kind: str, number: int = 0) -> Callable[[Path], list[Path]]:
    return lambda folder: [sorted(folder.glob(f"short-*.{kind}.h5"))[number]]


def every(kind: str) -> Callable[[Path], list[Path]]:
    return lambda folder: sorted(folder.glob(f"short-*.{kind}.h5"))


def two_recordings(first: int) -> Callable[[Path], list[Path]]:
    return lambda folder: sorted(folder.glob("short-*.recording.h5"))[first : first + 2]


def one(name: str) -> Callable[[Path], list[Path]]:
    return lambda folder: [folder / name]


def nothing(folder: Path) -> list[Path]:
    return []


def some(cls: type, **values: Any) -> Callable[[Path], Any]:
    return lambda folder: cls(**{k: v(folder) if callable(v) else v for k, v in values.items()})


def scene(folder: Path) -> str:
    return str(folder / "short.toml")


def model(folder: Path) -> Path:
    return folder / "hist10.model.h5"


def force_model(folder: Path) -> Path:
    return folder / "dots.force-model.h5"


ENVIRONMENT = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
POSE = "t_s,z_m\n" + "".join(f"{at / 100},{at}\n" for at in range(10))  # of an arm, for the first tenth of a second


def an_arm(folder: Path) -> list[str]:
    return [f"arm={folder / 'pose.csv'}"]


def force_models(folder: Path) -> str:
    return str(force_model(folder))


def another_grasp(folder: Path) -> list[Path]:
    """A grasp without the detector, which is quickly made."""
    chosen = Grasp(controller="none", lift_s=1.0, balance_s=0.0)
    output, _ = run_stage(grasp, [], chosen, folder / "contact-alone.recording.h5", force=True)
    return [output]


GRASP = {"model": model, "lift_s": 1.0}
TRAIN = {"epochs": 1, "max_steps": 5, "preset": "adam"}
FORCE = {"samples": 10, "epochs": 2}
STAGES = [
    Stage("record", record, some(Record, scene=scene), some(Record, scene=scene, seed=1), nothing),
    Stage("trim", trim, some(Trim, to_ms=200), some(Trim, to_ms=190), of("recording")),
    Stage(
        "attach", attach, some(Attach, stream=an_arm), some(Attach, stream=an_arm, offset=["arm=0.01"]),
        of("recording"),
    ),
    Stage(
        "label", label, some(Label, after_ms=15), some(Label, after_ms=15, slip_distance_px=0.4),
        of("recording"),
    ),
    Stage("track", track, some(Track), some(Track, preset="paper"), of("recording")),
    Stage("featurize", featurize, some(Featurize), some(Featurize, images=True), of("recording")),
    Stage("train", train, some(Train, **TRAIN), some(Train, **TRAIN, seed=1), every("features")),
    Stage("track --rgb", track, some(Track, rgb=True), some(Track, rgb=True, seed=1), of("recording")),
    Stage(
        "train-force", train_force, some(TrainForce, **FORCE), some(TrainForce, **FORCE, seed=1),
        every("tracks"),
    ),
    Stage(
        "predict-touch", predict_touch, some(PredictTouch, map_every=50),
        some(PredictTouch, map_every=0), of("tracks"),
    ),
    Stage(
        "grasp", grasp, some(Grasp, **GRASP, balance_s=0.0), some(Grasp, **GRASP, balance_s=0.1), nothing,
    ),
    Stage(
        "evaluate slip", evaluate_slip, some(EvaluateSlip, model=model),
        some(EvaluateSlip, model=model, threshold=0.5), one("apart.features.h5"),
    ),
    Stage(
        "evaluate labels", evaluate_labels, some(EvaluateLabels), some(EvaluateLabels),
        of("labels"), of("labels", 1),
    ),
    Stage(
        "evaluate tracking", evaluate_tracking, some(EvaluateTracking), some(EvaluateTracking),
        of("tracks"), of("tracks", 1),
    ),
    Stage(
        "evaluate vibration", evaluate_vibration, some(EvaluateVibration, windows="0.2"),
        some(EvaluateVibration, windows="0.25"), of("recording"),
    ),
    Stage(
        "evaluate data-rate", evaluate_data_rate, some(EvaluateDataRate, around_s=0.1),
        some(EvaluateDataRate, around_s=0.05), of("recording"),
    ),
    Stage(
        "evaluate force", evaluate_force, some(EvaluateForce, model=force_models, samples=10),
        some(EvaluateForce, model=force_models, samples=10, seed=1), one("apart.tracks.h5"),
    ),
    Stage(
        "evaluate grasp", evaluate_grasp, some(EvaluateGrasp), some(EvaluateGrasp),
        one("grasp.recording.h5"), another_grasp,
    ),
    Stage(
        "evaluate realism", evaluate_realism, some(EvaluateRealism), some(EvaluateRealism),
        two_recordings(0), two_recordings(1),
    ),
    Stage(
        "evaluate likeness", evaluate_likeness, some(EvaluateLikeness), some(EvaluateLikeness),
        of("recording"), of("recording", 1),
    ),
]  # fmt: skip
FROM_FILES = [stage for stage in STAGES if stage.name not in ("record", "grasp")]


def each(stages: list[Stage]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("stage", stages, ids=[stage.name for stage in stages])


@pytest.fixture
def folder(made: Made, tmp_path: Path) -> Path:
    """A copy of everything that was made, in a folder of its own."""
    return copy_of(made, tmp_path / "work")


def copy_of(made: Made, work: Path) -> Path:
    shutil.copytree(made.folder, work)
    shutil.copy(made.scene, work / "short.toml")
    (work / "pose.csv").write_text(POSE)
    return work


def run_in(stage: Stage, folder: Path, out: Path, **options: Any) -> tuple[Path, Any]:
    return run_stage(stage.module, stage.inputs(folder), stage.params(folder), out, **options)


def arrays(path: Path) -> dict[str, bytes]:
    with StageFile(path) as file:
        return {name: np.asarray(file.read(name)).tobytes() for name in file.contents()}


@pytest.fixture(scope="module")
def first_run(made: Made, tmp_path_factory: pytest.TempPathFactory) -> FirstRun:
    """Output and outcome of a stage, run once for all tests that only read them."""

    @cache
    def first(stage: Stage) -> tuple[Path, Any]:
        place = tmp_path_factory.mktemp("first")
        return run_in(stage, copy_of(made, place / "work"), place / "out")

    return first


def header(path: Path) -> Header:
    with StageFile(path) as file:
        return file.header


def files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


@each(STAGES)
def test_output_is_valid(stage: Stage, first_run: FirstRun) -> None:
    """Assert that the output is of the stage's kind, and that validate finds no fault in it."""
    output, outcome = first_run(stage)
    assert header(output)["kind"] == ("report" if stage.name.startswith("evaluate ") else stage.module.OUTPUT)
    assert [row["faults"] for row in validate.run([output]).rows] == [None]
    assert outcome.made
    json.dumps(outcome.rows)


@each(STAGES)
def test_output_carries_its_history(stage: Stage, folder: Path, first_run: FirstRun) -> None:
    """Assert that the header holds every ancestor once, down to what has no parents, and says simulated.

    But for what a trained file among them learned from.
    """
    output, _ = first_run(stage)
    made = header(output)
    assert made["simulated"]
    history = made.get("ancestors", made["history"])
    waiting, known = list(made["parents"]), set()
    while waiting:
        parent = waiting.pop()
        known.add(parent)
        one = history[parent]
        if one["kind"] not in TRAINED:
            waiting += [other for other in one["parents"] if other not in known]
    assert known == history.keys()
    for path in stage.inputs(folder):
        if stage.name != "evaluate slip":
            assert header(path)["id"] in made["parents"]


@each(STAGES)
def test_same_recipe_same_arrays(stage: Stage, folder: Path, tmp_path: Path, first_run: FirstRun) -> None:
    """Assert that two runs of one recipe, in two folders, give one id and the same arrays, bit for bit."""
    one, _ = first_run(stage)
    other, _ = run_in(stage, folder, tmp_path / "other")
    assert header(one)["id"] == header(other)["id"]
    assert arrays(one) == arrays(other)


@each(STAGES)
def test_output_is_skipped_when_up_to_date(stage: Stage, folder: Path, tmp_path: Path, first_run: FirstRun) -> None:
    """Assert that a second run of the same recipe does nothing and says so."""
    target = tmp_path / "target.h5"
    shutil.copy(first_run(stage)[0], target)
    written = target.stat().st_mtime_ns
    _, outcome = run_in(stage, folder, target)
    assert not outcome.made
    assert target.stat().st_mtime_ns == written


@each(STAGES)
def test_another_recipe_is_refused(stage: Stage, folder: Path, tmp_path: Path, first_run: FirstRun) -> None:
    """Assert that an output of another recipe is left alone, is named, and is replaced only by force.

    So every stage has two recipes here that differ: if they were one, the output would be up to date.
    """
    target = tmp_path / "target.h5"
    shutil.copy(first_run(stage)[0], target)
    before, first_id = target.read_bytes(), header(target)["id"]
    chosen, inputs = stage.another(folder)
    assert (chosen, inputs) != (stage.params(folder), stage.inputs(folder))
    with pytest.raises(InputError, match="another recipe"):
        run_stage(stage.module, inputs, chosen, target)
    assert target.read_bytes() == before
    _, outcome = run_stage(stage.module, inputs, chosen, target, force=True)
    assert outcome.made
    assert header(target)["id"] != first_id


HEAVY = ("numba", "scipy", "cv2", "torch", "onnx", "pandas", "pydantic")
LOADED = """
import runpy, sys
try:
    runpy.run_module("evetac_cli", run_name="__main__", alter_sys=True)
except SystemExit as end:
    print("exit", end.code, file=sys.stderr)
print(*sorted({name.split(".")[0] for name in sys.modules}), file=sys.stderr)
"""


def flags_of(params: Any) -> list[str]:
    """The flags that give a command these parameters."""
    words: list[str] = []
    for item in dataclasses.fields(params):
        value, flag = getattr(params, item.name), flag_of(item)
        if value != item.default:
            values = value if isinstance(value, list) else [value]
            words += [flag] if value is True else [word for one in values for word in (flag, str(one))]
    return words


# These measure, or load the network that their recipe names, before they know that there is nothing to do.
KNOW_LATE = ("grasp", *(f"evaluate {subject}" for subject in ("slip", "labels", "vibration", "grasp", "realism")))


@each([stage for stage in STAGES if stage.name not in KNOW_LATE])
def test_nothing_to_do_loads_no_kernel(stage: Stage, folder: Path, tmp_path: Path, first_run: FirstRun) -> None:
    """Assert that a command whose output is up to date loads no compiled code, and none of what takes long to load."""
    target = tmp_path / "target.h5"
    shutil.copy(first_run(stage)[0], target)
    inputs, flags = map(str, stage.inputs(folder)), flags_of(stage.params(folder))
    words = [*stage.name.split(), *inputs, *flags, "-o", str(target)]
    run = [sys.executable, "-P", "-c", LOADED, *words]
    done = subprocess.run(run, capture_output=True, text=True, timeout=PATIENCE_S, check=True, env=ENVIRONMENT)
    *said, end, loaded = done.stderr.splitlines()
    assert (end, "nothing to do" in "".join(said)) == ("exit 0", True), done.stderr
    assert [name for name in HEAVY if name in loaded.split()] == []


def test_every_stage_takes_part() -> None:
    """Assert that no command that makes a stage file is missing here."""
    assert {stage.name.removesuffix(" --rgb") for stage in STAGES} == set(with_config()) - {
        "calibrate",
        "identify",
        "evaluate cost",
        "evaluate stability",
        "evaluate benchmark",
    }


@each(FROM_FILES)
@pytest.mark.parametrize("fault", ["wrong kind", "truncated", "foreign", "text", "newer"])
def test_bad_input_is_refused(stage: Stage, fault: str, folder: Path, tmp_path: Path) -> None:
    """Assert that an input that is not what the stage eats is refused in words, and that nothing is written."""
    victim = stage.inputs(folder)[0]
    if fault == "wrong kind":
        kind = header(victim)["kind"]
        shutil.copy(folder / "hist10.model.h5" if kind != "model" else folder / "grasp.recording.h5", victim)
    elif fault == "truncated":
        victim.write_bytes(victim.read_bytes()[:-2000])
    elif fault == "foreign":
        with h5py.File(victim, "w") as h5:
            h5["events/t"] = [1, 2, 3]
    elif fault == "text":
        victim.write_text("0.1 1 2 1\n")
    else:
        with h5py.File(victim, "a") as h5:
            h5.attrs["header"] = json.dumps(json.loads(h5.attrs["header"]) | {"version": "2.0"})
    before = files(tmp_path)
    with pytest.raises(InputError):
        run_in(stage, folder, tmp_path / "out")
    assert files(tmp_path) == before


@each(STAGES)
def test_interruption_leaves_nothing_behind(stage: Stage, folder: Path, tmp_path: Path) -> None:
    """Assert that Ctrl-C in the middle of the work leaves no file and no folder, but for what models have judged."""

    def interrupt(done: float, total: float, doing: str = "") -> None:
        if not doing:  # it is past its preparations
            raise KeyboardInterrupt

    before = files(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_in(stage, folder, tmp_path / "out", progress=interrupt)
    assert {path for path in files(tmp_path) if path.parent.suffix != ".judged"} == before


@each([stage for stage in STAGES if stage.name in ("label", "track", "featurize")])
def test_empty_recording(stage: Stage, made: Made, tmp_path: Path) -> None:
    """Assert that a recording without a single slice gives a valid, empty output."""
    empty = tmp_path / "empty.recording.h5"
    empty_recording(made.recordings[0], empty)
    if stage.name == "featurize":
        (job,) = track.jobs([empty], Track(), None)
        track.run(job, Track())
    (job,) = stage.module.jobs([empty], stage.params(tmp_path), None)
    stage.module.run(job, stage.params(tmp_path))
    assert [row["faults"] for row in validate.run([job.output]).rows] == [None]


def empty_recording(like: Path, path: Path) -> None:
    """A recording of 0 slices from the same sensor."""
    from evetac_cli.store.files import write_stage
    from evetac_cli.store.layout.provenance import Recipe, content_digest

    with StageFile(like) as file:
        selected = {name: file.read(name) for name in file.contents() if name.startswith("sensor/")}
        columns = {name: file.read(name, 0, 0) for name in file.contents() if name.startswith("events/")}
    content = {**selected, **columns, "ms_to_idx": np.zeros(1, np.int64), "t_offset": np.int64(0)}
    write_stage(path, Recipe("recording", 1, {}, content=content_digest(content)), content)


def test_labels_of_another_recording_are_refused(folder: Path, tmp_path: Path) -> None:
    """Assert that featurize refuses labels, and tracks, that were made from another recording."""
    one, other, *_ = sorted(folder.glob("short-*.recording.h5"))
    for kind in ("labels", "tracks"):
        foreign = other.with_name(other.name.replace("recording", kind))
        chosen = Featurize(**{kind: foreign})
        (job,) = featurize.jobs([one], chosen, tmp_path / "out.features.h5")
        with pytest.raises(InputError, match="another recording"):
            featurize.run(job, chosen)
    assert not (tmp_path / "out.features.h5").exists()


def test_a_model_is_not_judged_on_what_it_learned(folder: Path, tmp_path: Path) -> None:
    """Assert that evaluate slip refuses features of a recording that the model was trained or validated on."""
    for path in sorted(folder.glob("short-*.features.h5")):
        chosen = EvaluateSlip(model=folder / "hist10.model.h5")
        (job,) = evaluate_slip.jobs([path], chosen, tmp_path / "out.report.h5")
        with pytest.raises(InputError, match="both trained on and evaluated on"):
            evaluate_slip.run(job, chosen)


def test_parameters_reach_the_header(folder: Path) -> None:
    """Assert that every parameter that changes numbers stands in the header of what was made with it."""
    for kind, cls in (("labels", Label),):
        path = sorted(folder.glob(f"short-*.{kind}.h5"))[0]
        names = {item.name for item in dataclasses.fields(cls) if item.metadata["recipe"]}
        assert names == header(path)["parameters"].keys()
