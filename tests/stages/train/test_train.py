"""train: names and seeds of its outputs, going on after an interruption, splits, and what a model file needs."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.inspect import validate
from evetac_cli.jobs import Job
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, with_scaled_logit
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.stages import model_files, related_files, slip_detectors, train
from evetac_cli.stages.train import networks, plan
from evetac_cli.store.files import StageFile, header_of, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import run_stage

SLICES, ONSET = 170, 130


def features_file(
    folder: Path,
    number: int,
    *,
    object_: int = 1,
    method: str = "event-flow",
    leave: tuple[str, ...] = (),
    truth: str = "",
    slips: bool = True,
) -> Path:
    """Features of a made-up trial in which dots move and blink more when it slips; all groups but those to leave.

    slips: whether it slips at all; truth: under which name it holds the share of the contact that slips, if it does.
    """
    rng = np.random.default_rng(number)
    label = ((np.arange(SLICES) >= ONSET) & slips).astype(np.int8)
    direction = rng.normal(0, 0.3, (SLICES, 56, 2)) + np.array([3, 0]) * label[:, None, None]
    events = rng.poisson(np.where(label, 8, 1)[:, None], (SLICES, 56)).astype(np.int32)
    total = events.sum(axis=1).astype(np.int32)
    count = np.minimum(total, 40)
    arrays: dict[str, Any] = {
        "displacement_px": np.linalg.norm(direction, axis=2).astype(np.float32),
        "displacement_xy_px": direction.astype(np.float32),
        "events_per_dot": events,
        "events_total": total,
        "events_outside": total,
        "label": label,
        "onset_slice": np.int64(ONSET if slips else -1),
        "dot_shape": np.array([7, 8], np.int32),
        "image/start": np.cumsum([0, *count]),
        "image/pixel": np.concatenate([rng.choice(540 * 480, n, replace=False) for n in count]).astype(np.uint32),
        "image/sign": np.ones(count.sum(), np.int8),
    }
    if truth:
        arrays[truth] = (np.arange(SLICES) / ONSET).clip(0, 1).astype(np.float32)
    arrays = {name: array for name, array in arrays.items() if not name.startswith(leave or ("none",))}
    recording = Recipe("recording", 1, {"object": object_}, seed=number, simulated_source=True).header()
    labels = Recipe("labels", 1, {"method": method}, parents=(recording,)).header()
    path = folder / f"trial-{number:02d}.features.h5"
    write_stage(path, Recipe("features", 2, {"images": True}, parents=(recording, labels)), arrays)
    return path


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Four trials, two of object 1 and two of object 2."""
    folder = tmp_path_factory.mktemp("trials")
    return [features_file(folder, number, object_=1 + number // 2) for number in range(4)]


def small(**values: Any) -> Train:
    """Parameters of a run of a second at most."""
    return Train(**({"epochs": 1000, "max_steps": 120, "preset": "adam"} | values))


def contents(path: Path) -> dict[str, bytes]:
    with StageFile(path, "model") as file:
        return {name: np.asarray(file.read(name)).tobytes() for name in file.contents()} | {
            "id": file.header["id"].encode()
        }


def uncalibrated(model: StageFile) -> dict[str, np.ndarray]:
    """The weights of a model as training left them."""
    calibration = model_files.read_calibration(model)
    assert calibration is not None
    return with_scaled_logit(model_files.read_weights(model), "fc5", *calibration.inverse())


def same_but_for_rounding(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """Assert that weights are the same, those of the last layer but for what a calibration rounds."""
    assert one.keys() == other.keys()
    for name, array in one.items():
        rtol = 1e-5 if name.startswith("fc5") else 0.0
        np.testing.assert_allclose(array, other[name], rtol=rtol, atol=0.1 * rtol)


def test_one_file_a_seed(trials: list[Path], tmp_path: Path) -> None:
    """Assert the names of outputs: the model, how far ahead, and the seed where there are several."""
    names = [job.output.name for job in train.jobs(trials, Train(model="fast-slow"), tmp_path)]
    assert names == ["fast-slow.model.h5"]
    many = train.jobs(trials, Train(model="fast-slow", horizon_ms=10, seed=3, seeds=2), tmp_path)
    assert [job.output for job in many] == [tmp_path / f"fast-slow-10ms-s{seed}.model.h5" for seed in (3, 4)]


@pytest.mark.slow
def test_a_seed_alone_is_that_seed_among_many(trials: list[Path], tmp_path: Path) -> None:
    """Assert that the second of two seeds gives, alone, the same file, and another than the first."""
    for job in train.jobs(trials, small(seeds=2), tmp_path):
        train.run(job, small(seeds=2))
    output, _ = run_stage(train, trials, small(seed=1), tmp_path)
    first, second = (contents(tmp_path / f"hist10-s{seed}.model.h5") for seed in (0, 1))
    assert contents(output) == second
    assert first["weights/fc3.weight"] != second["weights/fc3.weight"]


def interrupted(job: Job, params: Train, monkeypatch: pytest.MonkeyPatch, at: int = 100) -> None:
    """Run until this step, as if Ctrl-C had been pressed there."""

    def stop(done: float, total: float, doing: str = "") -> None:
        if done >= at and not doing:
            raise KeyboardInterrupt

    monkeypatch.setattr(networks, "SAVE_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        train.run(job, params, progress=stop)


def test_features_that_do_not_fit_into_memory_are_trained_on_in_groups(
    trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a recipe says so, that the same comes out again, and that the files are read in turn."""
    chosen = small(max_steps=24, validate=str(trials[3]))
    whole, _ = run_stage(train, trials[:3], chosen, tmp_path / "whole")
    monkeypatch.setattr(plan, "HELD_BYTES", 80_000)  # one trial takes 76 kB
    read: list[Path] = []

    def noted(path: Path, architecture: Any, **options: Any) -> Any:
        read.append(path)
        return slip_detectors.read_trajectory(path, architecture, **options)

    monkeypatch.setattr(networks, "read_trajectory", noted)
    first, _ = run_stage(train, trials[:3], chosen, tmp_path / "first")
    assert len(read) > 3
    assert [sorted(read[at : at + 3]) for at in range(0, len(read) - 2, 3)] == [sorted(trials[:3])] * (len(read) // 3)
    second, _ = run_stage(train, trials[:3], chosen, tmp_path / "second")
    assert contents(first) == contents(second)
    recipes = [header_of(path, "model")["parameters"] for path in (whole, first)]
    assert ["held_bytes" in parameters for parameters in recipes] == [False, True]
    assert recipes[1]["held_bytes"] == 80_000


@pytest.mark.parametrize("model", ["hist10", "no-hist-img-6x6"])
def test_what_features_take_in_memory(trials: list[Path], model: str) -> None:
    """Assert that the bytes are those of the arrays that are read."""
    architecture = ARCHITECTURES[model]
    with StageFile(trials[0], "features") as file:
        series = slip_detectors.read_series(file, architecture)
        arrays = [series] if isinstance(series, np.ndarray) else list(series)
        assert plan.series_bytes(file, architecture) == sum(array.nbytes for array in arrays)


def test_few_trajectories_to_choose_a_threshold_on_are_said(trials: list[Path], tmp_path: Path) -> None:
    """Assert a word before the training and below its table, and none where there are four."""
    (job,) = train.jobs(trials, small(), tmp_path)
    (early,) = train.cautions([job], small())
    (late,) = train.for_people([{"validated_on": 1}], small())[1]
    assert early == late
    assert "chosen on 1 trajectory" in early and "--validate" in early
    assert train.for_people([{"validated_on": 4}], small())[1] == []
    assert train.cautions([replace(job, learned=0)], small()) == []
    assert train.cautions([job], small(folds=2)) == []


def test_files_that_only_validate_are_said(trials: list[Path], tmp_path: Path) -> None:
    """Assert a note on inputs that --validate takes out of the training, and none on other files."""
    both = small(validate=trials[0])
    notes, others = (train.cautions(train.jobs(files, both, tmp_path), both) for files in (trials, trials[1:]))
    assert any("1 of the given files only validate" in note for note in notes)
    assert not any("only validate" in note for note in others)


@pytest.mark.parametrize("preset", ["paper", "adamw"])
@pytest.mark.slow
def test_it_goes_on_after_an_interruption(
    trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    """Assert that a run broken off at step 100 goes on from 50, ends in the same file, and leaves nothing else."""
    params = small(preset=preset)
    output, _ = run_stage(train, trials, params, tmp_path / "whole")
    (job,) = train.jobs(trials, params, tmp_path / "broken")
    interrupted(job, params, monkeypatch)
    (state,) = job.output.parent.iterdir()
    assert state.name == f"hist10.model.{header_of(output)['id'][:8]}.part"
    (row,) = train.run(job, params).rows
    assert row["resumed_at_step"] == 50
    assert contents(job.output) == contents(output)
    assert sorted(path.name for path in job.output.parent.iterdir()) == ["hist10.model.h5"]


@pytest.mark.slow
def test_trainings_onto_one_output_do_not_share_states(
    trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a training neither uses nor removes what another recipe left, and does not use a damaged state."""
    (job,) = train.jobs(trials, small(), tmp_path)
    interrupted(job, small(), monkeypatch)
    (state,) = tmp_path.glob("*.part")
    (row,) = train.run(job, small(max_steps=110)).rows
    assert row["resumed_at_step"] is None and list(tmp_path.glob("*.part")) == [state]
    job.output.unlink()
    kept = state.read_bytes()
    (row,) = train.run(job, small()).rows
    assert row["resumed_at_step"] == 50 and not state.exists()
    job.output.unlink()
    state.write_bytes(kept[:1000])
    (row,) = train.run(job, small()).rows
    assert row["resumed_at_step"] is None


def test_a_cut_run_says_so(trials: list[Path], tmp_path: Path) -> None:
    """Assert that a run ended by --max-steps says how many steps it took of how many, with curve and checkpoints."""
    (job,) = train.jobs(trials, small(), tmp_path)
    (row,) = train.run(job, small()).rows
    assert row["stopped_early"]
    assert row["steps"] == 120 < row["steps_of_all_epochs"]
    with StageFile(job.output, "model") as model:
        assert model.read("curve/step")[-1] == 120
        assert np.isfinite(model.read("curve/loss")).all()
        assert len(model.read("checkpoint/step")) == 3
    assert [row["faults"] for row in validate.run([job.output]).rows] == [None]


def test_every_kept_checkpoint_has_its_graph(trials: list[Path], tmp_path: Path) -> None:
    """Assert that the graphs of the last checkpoints run, and that the chosen one is the model's."""
    output, _ = run_stage(train, trials, small(), tmp_path)
    inputs = np.random.default_rng(0).random((1, 56, 20), np.float32)
    with StageFile(output, "model") as model:
        graphs = [graph.tobytes() for graph in model.read("checkpoint/onnx")]
        assert graphs[int(model.read("checkpoint/chosen"))] == model.read("onnx").tobytes()
    probabilities = {float(Detector(graph, ARCHITECTURES["hist10"]).probability(inputs)[0]) for graph in graphs}
    assert len(probabilities) == 3


@pytest.mark.slow
def test_a_model_needs_neither_torch_nor_pickle(trials: list[Path], tmp_path: Path) -> None:
    """Assert that a model file is run where torch cannot be imported, and opened where pickle does not work."""
    output, _ = run_stage(train, trials, small(), tmp_path)
    code = f"""
import pickle, sys
sys.modules["torch"] = None
import numpy as np
from evetac_cli.stages.slip_detectors import load_detector
from evetac_cli.store.files import StageFile
loads = pickle.load, pickle.loads, pickle.Unpickler
pickle.load = pickle.loads = pickle.Unpickler = None
with StageFile({str(output)!r}, "model") as model:
    detector = load_detector(model)
pickle.load, pickle.loads, pickle.Unpickler = loads  # numba needs them for what it compiled
print(float(detector.probability(np.zeros((1, 56, 20), np.float32))[0]))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 <= float(result.stdout) <= 1


def test_ahead_is_carried_and_relabels(trials: list[Path], tmp_path: Path) -> None:
    """Assert that a model trained 10 ms ahead says so, and feels slip that a model of the present does not."""
    probabilities = {}
    for horizon_ms in (0, 10):
        params = small(horizon_ms=horizon_ms, model="no-hist")
        (job,) = train.jobs(trials, params, tmp_path)
        (row,) = train.run(job, params).rows
        assert row["horizon_ms"] == horizon_ms
        with StageFile(job.output, "model") as model:
            assert model_files.read_horizon_ms(model) == horizon_ms
            result = slip_detectors.load_detector(model)
        trajectory = slip_detectors.read_trajectory(trials[0], result.architecture)
        probabilities[horizon_ms] = result.over(trajectory.series)[ONSET - 10 : ONSET].mean()
        (judged,) = slip_detectors.predict([result], trajectory, {"kind": "features", "history": {}}, horizon_ms)
        assert (judged.onset, np.flatnonzero(judged.label)[0]) == (ONSET, ONSET - horizon_ms)
    assert probabilities[10] > 0.03 > 3 * probabilities[0]


@pytest.mark.parametrize("model", ["hist10", "down5", "hist10-img-6x6"])
@pytest.mark.slow
def test_what_is_not_examined_is_left_out(trials: list[Path], tmp_path: Path, model: str) -> None:
    """Assert that predictions are those of the whole trajectory, from the first slice that is labelled."""
    params = small(model=model, max_steps=2)
    output, _ = run_stage(train, trials, params, tmp_path)
    with StageFile(output, "model") as file:
        detector = slip_detectors.load_detector(file)
    trajectory = slip_detectors.read_trajectory(trials[0], detector.architecture)
    whole = detector.over(trajectory.series)
    for first in (0, 5, 33, 61):
        trajectory.label[:first] = -1
        (one,) = slip_detectors.predict([detector], trajectory, {"kind": "features", "history": {}}, 0)
        assert np.isnan(one.probability[:first]).all()
        assert np.array_equal(one.probability[first:], whole[first:], equal_nan=True)
    trajectory.label[:] = -1
    nothing = trajectory._replace(onset=-1)
    (none,) = slip_detectors.predict([detector], nothing, {"kind": "features", "history": {}}, 0)
    assert np.isnan(none.probability).all()


def test_labels_from_truth_are_marked_and_not_mixed(trials: list[Path], tmp_path: Path) -> None:
    """Assert that a run on labels from truth says so, and that two ways of labelling are refused together."""
    truth = [features_file(tmp_path, number, method="truth") for number in (10, 11)]
    params = small(max_steps=5, validate=str(trials[0]))
    (job,) = train.jobs(truth, params, tmp_path)
    (row,) = train.run(job, params).rows
    assert row["labels"] == "truth"
    (job,) = train.jobs([*truth, trials[1]], params, tmp_path / "mixed")
    with pytest.raises(InputError, match="labelled by different methods") as refused:
        train.run(job, params)
    assert trials[1].name in str(refused.value)
    still = features_file(tmp_path, 12, method="truth", slips=False)
    (job,) = train.jobs([*trials[1:3], still], params, tmp_path / "still")
    (row,) = train.run(job, params).rows
    assert row["labels"] == "event-flow"  # of the slips; who knows that nothing slips may say so
    with StageFile(job.output, "model") as model:
        assert model_files.labelled_by(model.header) == "event-flow, truth"


def test_labels_of_a_person_go_with_those_they_correct(trials: list[Path], tmp_path: Path) -> None:
    """Assert that a training takes a person's labels beside a method's, not beside truth, and says both."""
    mended = features_file(tmp_path, 10, method="person")
    params = small(max_steps=5, validate=str(trials[0]))
    (job,) = train.jobs([mended, trials[1]], params, tmp_path)
    (row,) = train.run(job, params).rows
    assert (row["labels"], row["abstained"]) == ("event-flow, person", 0)
    (job,) = train.jobs([mended, features_file(tmp_path, 11, method="truth")], params, tmp_path / "mixed")
    with pytest.raises(InputError, match="labelled by different methods"):
        train.run(job, params)


def test_folds_leave_objects_out(tmp_path: Path) -> None:
    """Assert that every fold learns from some objects and judges the others, and the last network learns from all."""
    files = [features_file(tmp_path, number, object_=(9, 10, 11, 9, 10)[number]) for number in range(5)]
    headers = []
    for path in files:
        with StageFile(path, "features") as file:
            headers.append(file.header)
    assert related_files.make_folds(headers, 3, 0) == [related_files.Fold([0, 1, 2], [3, 4])]
    assert related_files.make_folds(headers, 3, 3) == [
        related_files.Fold([1, 2], [0, 3]),
        related_files.Fold([0, 2], [1, 4]),
        related_files.Fold([0, 1], [2]),
        related_files.Fold([0, 1, 2], []),
    ]
    left_out = [fold.evaluated_on for fold in related_files.make_folds(headers, 3, 2)]
    assert left_out == [[0, 2, 3], [1, 4], []]  # 9 and 11; 10; none
    for wrong in (1, 4):
        with pytest.raises(InputError, match=r"(?s)--folds.*2 to 3, or 0.*9, 10, 11"):
            related_files.make_folds(headers, 3, wrong)


@pytest.mark.slow
def test_folds_choose_the_threshold_alone(trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that folds leave the network as it is, judge all trials, and go on after an interruption."""
    params = small(folds=2)
    unfolded, job = (train.jobs(trials, params, tmp_path / name)[0] for name in ("plain", "folds"))
    train.run(unfolded, small())
    seen: list[tuple[Any, ...]] = []
    (row,) = train.run(job, params, progress=lambda *at: seen.append(at)).rows
    assert (row["folds"], row["validated_on"]) == (2, 4)
    steps = [at for at in seen if len(at) == 2]  # others say what else is being done
    assert steps == sorted(steps)
    assert steps[-1] == (360, 360)
    plain, folded = contents(unfolded.output), contents(job.output)
    assert plain["curve/loss"] == folded["curve/loss"]
    with StageFile(unfolded.output, "model") as one, StageFile(job.output, "model") as other:
        same_but_for_rounding(uncalibrated(one), uncalibrated(other))

    (again,) = train.jobs(trials, params, tmp_path / "again")
    interrupted(again, params, monkeypatch, at=220)
    left = sorted(path.name for path in again.output.parent.iterdir())
    recipe = header_of(job.output)["id"][:8]
    assert left == [f"hist10.model.{recipe}.network1.part", f"hist10.model.{recipe}.network2.part"]
    train.run(again, params)
    assert contents(again.output) == folded
    assert sorted(path.name for path in again.output.parent.iterdir()) == ["hist10.model.h5"]


@pytest.mark.slow
def test_networks_are_tasks_of_their_own(trials: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the networks of a model, each trained as a job, make the file that one job makes; none is redone."""
    params = small(folds=2, max_steps=60)
    whole, job = (train.jobs(trials, params, tmp_path / name)[0] for name in ("whole", "parts"))
    train.run(whole, params)
    assert train.parts(job, small()) == []
    parts = train.parts(job, params)
    assert len({part.output for part in parts}) == 3
    for number, part in enumerate(reversed(parts), 1):
        assert train.run(part, params).rows == []
        assert len(list(job.output.parent.glob("*.part"))) == number
    monkeypatch.setattr(networks.sampling, "gather", None)  # nothing is trained any more
    (row,) = train.run(job, params).rows
    assert row["resumed_at_step"] is None
    assert contents(job.output) == contents(whole.output)
    assert sorted(path.name for path in job.output.parent.iterdir()) == ["hist10.model.h5"]
    assert not train.run(parts[0], params).made


@pytest.mark.slow
def test_images_are_trained_on(trials: list[Path], tmp_path: Path) -> None:
    """Assert that models of images train from features that have them."""
    output, _ = run_stage(train, trials, small(model="hist10-img-6x6", max_steps=3), tmp_path)
    with StageFile(output, "model") as file:
        assert slip_detectors.load_detector(file).architecture == ARCHITECTURES["hist10-img-6x6"]


@pytest.mark.parametrize(
    ("model", "leave", "hint"),
    [
        ("hist10-img", ("image",), "featurize --images"),
        ("hist10", ("label", "onset"), "evetac label"),
    ],
)
def test_missing_features_are_named(tmp_path: Path, model: str, leave: tuple[str, ...], hint: str) -> None:
    """Assert that features without what a model sees are refused, and it is said how to get it."""
    files = [features_file(tmp_path, number, leave=leave) for number in (20, 21)]
    (job,) = train.jobs(files, small(model=model), tmp_path)
    with pytest.raises(InputError) as refused:
        train.run(job, small(model=model))
    assert hint in str(refused.value)


def test_a_trained_model_is_adapted(trials: list[Path], tmp_path: Path) -> None:
    """Assert that --adapt goes on from a model's weights, with its normalisation, architecture and horizon."""
    output, _ = run_stage(train, trials[2:], small(model="fast-slow", horizon_ms=10), tmp_path)
    adapt = Train(adapt=str(output), max_steps=30)
    (own,) = train.jobs(trials[:2], adapt, tmp_path / "own.model.h5")
    row = train.run(own, adapt).rows[0]
    assert (row["model"], row["preset"], row["horizon_ms"], row["steps"]) == ("fast-slow", "adapt", 10, 30)
    with StageFile(output, "model") as before, StageFile(own.output, "model") as after:
        assert before.header["id"] in after.header["history"]
        trained, adapted = uncalibrated(before), uncalibrated(after)
        for name, weights in trained.items():
            moved = np.abs(adapted[name] - weights).max()
            assert moved < 1e-9 if name.startswith("input_") else 0 < moved < 0.02
    assert train.jobs(trials[:2], replace(adapt, adapt="shipped"), None)[0].output.name.endswith("10ms.model.h5")
    (known,) = train.jobs(trials[2:], adapt, tmp_path / "known.model.h5")
    with pytest.raises(InputError, match="validated on"):  # the model to adapt knows what would judge it
        train.run(known, adapt)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"model": "hist10"}, "--model: cannot be combined with --adapt"),
        ({"horizon_ms": 0}, "--horizon-ms: cannot be combined with --adapt"),
        ({"preset": "paper"}, "--preset: cannot be combined with --adapt"),
        ({"folds": 2}, "--folds: cannot be combined with --adapt"),
        ({"adapt": "missing.model.h5"}, "missing.model.h5"),
    ],
)
def test_what_cannot_be_adapted(trials: list[Path], tmp_path: Path, given: dict[str, Any], says: str) -> None:
    """Assert that settings which are not those of the model are refused in words."""
    with pytest.raises(InputError, match=says):
        train.jobs(trials, Train(**({"adapt": "shipped"} | given)), tmp_path)


def test_truth_is_learned_on_request_alone(tmp_path: Path) -> None:
    """Assert that features with the true share train the same network as without, unless asked."""
    networks_of: dict[str, dict[str, bytes]] = {}
    for name in ("", model_files.TRUE_SLIP_SHARE):
        folder = tmp_path / (name.replace("/", "-") or "none")
        folder.mkdir()
        files = [features_file(folder, number, truth=name) for number in range(2)]
        for asked in (False, True) if name else (False,):
            params = small(preset="adamw", max_steps=20, learn_true_slip_share=asked)
            output, outcome = run_stage(train, files, params, folder / f"{asked}.model.h5")
            networks_of[f"{name} {asked}"] = contents(output)
            assert outcome.rows[0]["learned_true_slip_share"] == (True if asked else None)
            assert model_files.learned_true_slip_share(header_of(output)) is asked
            assert header_of(output)["parameters"]["learn_true_slip_share"] is asked
    weights = {key: arrays["weights/fc3.weight"] for key, arrays in networks_of.items()}
    first = model_files.TRUE_SLIP_SHARE
    assert weights[" False"] == weights[f"{first} False"] != weights[f"{first} True"]


def test_truth_that_features_do_not_hold_is_refused(trials: list[Path], tmp_path: Path) -> None:
    """Assert that truth cannot be learned from features without it, and that the error says where it comes from."""
    with pytest.raises(InputError, match="true slipping share") as error:
        run_stage(train, trials, small(learn_true_slip_share=True), tmp_path)
    assert "featurize --true-slip-share" in str(error.value)


def test_what_was_adapted_from_truth_learned_truth(tmp_path: Path) -> None:
    """Assert that a model says that it learned truth where only the model that it goes on from did."""
    files = [features_file(tmp_path, number, truth=model_files.TRUE_SLIP_SHARE) for number in range(2)]
    own = tmp_path / "own"
    own.mkdir()
    others = [features_file(own, number) for number in range(10, 12)]
    for asked in (False, True):
        params = small(max_steps=10, learn_true_slip_share=asked)
        first, _ = run_stage(train, files, params, tmp_path / f"{asked}.model.h5")
        adapt = Train(adapt=str(first), max_steps=10)
        output, _ = run_stage(train, others, adapt, own / f"{asked}.model.h5")
        assert header_of(output)["parameters"]["learn_true_slip_share"] is False
        assert model_files.learned_true_slip_share(header_of(output)) is asked
