"""evaluate slip: several models at once, means over objects and seeds, the paper's figures, what is refused."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.commands.label import Label
from evetac_cli.commands.train import Train
from evetac_cli.errors import InputError
from evetac_cli.evaluate.slip import EvaluateSlip
from evetac_cli.evaluate.slip import measure as slip
from evetac_cli.evaluate.slip import models as slip_models
from evetac_cli.evaluate.slip import tables as slip_tables
from evetac_cli.evaluate.slip.models import Model, check
from evetac_cli.jobs import silent
from evetac_cli.kernels.slip.covariates import WORDS
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.inputs import Series
from evetac_cli.kernels.slip.metrics import Prediction, is_slip
from evetac_cli.stages import slip_detectors, train
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, events_at, run_stage, truth_arrays

SLICES, ONSET = 260, 180


def features_file(
    folder: Path, number: int, *, object_: int, method: str = "event-flow", scene: str | None = None
) -> Path:
    """Features of a made-up trial in which dots move and blink more when it slips."""
    rng = np.random.default_rng(number)
    label = (np.arange(SLICES) >= ONSET).astype(np.int8)
    events = rng.poisson(np.where(label, 8, 1)[:, None], (SLICES, 56)).astype(np.int32)
    total = events.sum(axis=1).astype(np.int32)
    arrays: dict[str, Any] = {
        "displacement_px": rng.exponential(np.where(label, 3.0, 0.3)[:, None], (SLICES, 56)).astype(np.float32),
        "events_per_dot": events,
        "events_total": total,
        "events_outside": total,
        "label": label,
        "onset_slice": np.int64(ONSET),
        "dot_shape": np.array([7, 8], np.int32),
    }
    chosen = {"object": object_} | ({"scene": {"name": scene}} if scene else {})
    recording = Recipe("recording", 1, chosen, seed=number, simulated_source=True).header()
    labels = Recipe("labels", 1, {"method": method}, parents=(recording,)).header()
    path = folder / f"trial-{number:03d}.features.h5"
    write_stage(path, Recipe("features", 2, {}, parents=(recording, labels)), arrays, force=True)
    return path


def trained(files: list[Path], folder: Path, **values: Any) -> list[Path]:
    params = Train(**({"model": "no-hist", "epochs": 1000, "max_steps": 20, "preset": "adam"} | values))
    jobs = train.jobs(files, params, folder)
    for job in jobs:
        train.run(job, params)
    return [job.output for job in jobs]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Trials to learn from (objects 1, 2) and to be judged on (1, 2, 10); models of two seeds, ahead, and of truth."""
    folder = tmp_path_factory.mktemp("slips")
    learn = [features_file(folder, number, object_=1 + number // 2) for number in range(4)]
    truth = [features_file(folder, 50 + number, object_=1, method="truth") for number in range(2)]
    return {
        "learn": learn,
        "known": [features_file(folder, 100 + number, object_=1 + number % 2) for number in range(4)],
        "unseen": [features_file(folder, 200 + number, object_=10) for number in range(2)],
        "seeds": trained(learn, folder / "now", seeds=2),
        "ahead": trained(learn, folder / "ahead", horizon_ms=10),
        "truth": trained(truth, folder / "truth"),
        "fast-slow": trained(learn, folder / "fast", model="fast-slow", horizon_ms=10),
    }


@pytest.fixture(autouse=True)
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pictures: they take longest."""
    monkeypatch.setattr(slip.picture, "beside", lambda outcome, *_: outcome)


def evaluated(files: Sequence[Path], out: Path, **values: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    params = EvaluateSlip(**values)
    _, outcome = run_stage(slip, list(files), params, out)
    return outcome.rows, outcome.summary


def table_of(rows: list[dict[str, Any]], key: str, without: str = "none") -> list[dict[str, Any]]:
    return [row for row in rows if key in row and without not in row]


def test_models_among_the_files(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that models are found behind --model, among the files, in a folder and by a glob, each once."""
    first, second = world["seeds"]
    expected = (*world["known"], first, second)
    for files, given in (
        ([second, *world["known"]], first),
        ([first, second, *world["known"]], first),
        (world["known"], first.parent),
        (world["known"], first.parent / "*-s?.model.h5"),
    ):
        (job,) = slip.jobs(files, EvaluateSlip(model=given), tmp_path)
        assert job.inputs == expected
        assert job.output == tmp_path / f"{world['known'][0].resolve().parent.name}.slip.report.h5"


def test_seeds_are_one_setting(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that models that differ in their seed alone share a row, with means and sd over objects and seeds."""
    rows, summary = evaluated([*world["known"], *world["seeds"], *world["ahead"]], tmp_path)
    settings = table_of(rows, "seeds")
    assert [(row["setting"], row["seeds"]) for row in settings] == [("no-hist", 2), ("no-hist, 10 ms ahead", 1)]
    by_model = table_of(rows, "slips")
    assert [row["file"] for row in by_model] == [path.name for path in (*world["seeds"], *world["ahead"])]
    mean = np.mean([row["f1"] for row in by_model[:2]])
    assert settings[0]["f1"] == pytest.approx(mean)  # f1 of a model is the mean over objects, as many in each
    assert settings[0]["f1_sd_seeds"] == pytest.approx(np.std([row["f1"] for row in by_model[:2]], ddof=1))
    assert settings[1]["f1_sd_seeds"] is None
    assert (summary["models"], summary["settings"], summary["trajectories"]) == (3, 2, 4)


def test_every_object_counts_the_same(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that a setting's figures are the means of its objects' rows, however many trajectories each has.

    The interval of F1 resamples the objects, after the mean over seeds: it spans those of two objects.
    """
    files = [world["known"][0], *world["unseen"], *world["seeds"]]
    rows, _ = evaluated(files, tmp_path)
    (setting,), objects = table_of(rows, "seeds"), [row for row in table_of(rows, "object", "file") if "f1" in row]
    assert [(row["object"], row["trajectories"]) for row in objects] == [("1", 1), ("10", 2)]
    for figure in ("slip_early", "slip_correct", "slip_late", "f1"):
        assert setting[figure] == pytest.approx(np.mean([row[figure] for row in objects]))
    assert (setting["f1_low"], setting["f1_high"]) == pytest.approx(sorted(row["f1"] for row in objects))


def test_ahead_shifts_f1_and_not_timing(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that t_c of a model trained ahead is the labels' onset, and its F1 that of labels shifted by 10 ms."""
    (path,) = world["ahead"]
    rows, _ = evaluated(world["known"][:1], tmp_path, model=path)
    (row,) = table_of(rows, "t_c_ms")
    assert row["t_c_ms"] == ONSET
    model = Model.read(path)
    trajectory = slip_detectors.read_trajectory(world["known"][0], model.architecture)
    detected = is_slip(model.detector().over(trajectory.series), model.threshold)
    label = np.arange(SLICES) >= ONSET - 10
    selected = slice(0, ONSET + 20)
    sklearn = pytest.importorskip("sklearn.metrics")
    assert row["f1"] == pytest.approx(sklearn.f1_score(label[selected], detected[selected]))


def test_other_scenes_are_a_setting_of_their_own(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that a model is named by the scenes that it was trained on, not by those it was validated on."""
    slips, lifts = (features_file(tmp_path, 700 + n, object_=1, scene=name) for n, name in enumerate(("slip", "lift")))
    validate_on = str(features_file(tmp_path, 702, object_=1, scene="shear"))
    models = [
        *trained([slips], tmp_path / "slips.model.h5", validate=validate_on),
        *trained([slips, lifts], tmp_path / "both.model.h5", validate=validate_on),
    ]
    rows, _ = evaluated([*world["known"], *models], tmp_path)
    assert [row["scenes"] for row in table_of(rows, "seeds")] == ["slip", "lift + slip"]
    assert table_of(rows, "seeds")[1]["setting"] == "no-hist, 2 trajectories, scenes lift + slip"


def test_the_papers_figures(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that the paper's figures stand beside the same model, by whether the objects were trained on."""
    known, _ = evaluated([*world["known"], *world["seeds"]], tmp_path / "known")
    (row,) = table_of(known, "seeds")
    assert (row["paper_slip_correct"], row["paper_f1"]) == (0.87, 0.59)
    unseen, _ = evaluated([*world["unseen"], *world["fast-slow"]], tmp_path / "unseen")
    (row,), (timing_bins,) = table_of(unseen, "seeds"), table_of(unseen, "never_detected")
    assert (row["paper_slip_correct"], row["paper_f1"]) == (0.88, None)
    assert timing_bins["paper_10_to_0_ms_ahead"] == 0.57
    both, _ = evaluated([*world["known"], *world["unseen"], *world["seeds"]], tmp_path / "both")
    assert table_of(both, "seeds")[0]["paper_slip_correct"] is None


@pytest.mark.parametrize(
    ("late_by", "name"),
    [
        (-51, "over_50_ms_ahead"),
        (-50, "50_to_31_ms_ahead"),
        (-30, "30_to_11_ms_ahead"),
        (-10, "10_to_0_ms_ahead"),
        (0, "10_to_0_ms_ahead"),
        (20, "1_to_20_ms_after"),
        (21, "over_20_ms_after"),
    ],
)
def test_timing_bins_at_their_borders(late_by: int, name: str) -> None:
    """Assert that each first detection is counted in one place, and those without one are never."""
    at = np.arange(200)
    shares = slip_tables._timing_bins(
        [[prediction(at >= 100 + late_by, 100, "1"), prediction(at < 0, 100, "2")]], [0.5]
    )
    assert shares[name] == 0.5
    assert shares["never_detected"] == 0.5
    assert sum(shares[key] for key in ("never_detected", *(key for key, _, _ in slip_tables.TIMING_BINS))) == 1
    assert shares["t_m_minus_t_c_ms_median"] == late_by
    assert (shares[f"{name}_low"], shares[f"{name}_high"]) == (0, 1)  # either object may be drawn twice


def test_predictions_over_time() -> None:
    """Assert mean probability and detected share at each time about the onset, by object, while the recording lasts."""
    low, high = (prediction(np.arange(140) >= first, 100, "3") for first in (90, 110))
    rows = slip_tables.over_time_rows("a", [[low], [high]], [0.5, 0.5])
    assert [row["after_onset_ms"] for row in rows] == [*range(-20, 61, 5)]
    by_time = {row["after_onset_ms"]: row for row in rows}
    assert [by_time[after]["detected_share"] for after in (-15, -10, 5, 10)] == [0.0, 0.5, 0.5, 1.0]
    assert by_time[35]["predictions"] == 2 and by_time[40]["predictions"] == 0
    assert by_time[40]["probability_mean"] is None
    assert slip_tables.over_time_rows("a", [[prediction(np.zeros(9, bool), -1, "3")]], [0.5]) == []


def prediction(detected: NDArray[np.bool_], onset: int, object_: str) -> Prediction:
    label = (np.arange(len(detected)) >= onset).astype(np.int8) if onset >= 0 else np.zeros(len(detected), np.int8)
    return Prediction(detected.astype(np.float32), label, onset, object_)


def test_an_object_that_never_slips_has_no_timing(world: dict[str, Any]) -> None:
    """Assert that means leave out the timing of an object without an onset, but not its F1."""
    at = np.arange(200)
    cell = slip_tables.by_group([prediction(at >= 100, 100, "1"), prediction(at >= 300, -1, "2")], 0.5, "object")
    row = slip_tables.setting_row("a", Model.read(world["seeds"][0]), [cell])
    assert row["slip_correct"] == 1.0
    assert row["f1"] == 0.5


def test_a_shared_recording_is_named(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that a recording that one of several models has seen is refused, naming the file and the model."""
    files = [*world["known"], world["learn"][2], *world["truth"], *world["seeds"]]
    with pytest.raises(InputError, match="both trained on and evaluated on") as refused:
        evaluated(files, tmp_path)
    assert str(world["learn"][2]) in str(refused.value)
    assert str(world["seeds"][0]) in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_gets_one_table_and_a_verdict(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert few columns, every trajectory where there are few and a row a setting elsewhere, all tables on demand."""
    rows, _ = evaluated([*world["unseen"], world["seeds"][0]], tmp_path / "one.report.h5")
    shown, verdict = slip.for_people(rows, EvaluateSlip())
    shown = [row for row in shown if "covariate" not in row]
    assert [row["file"] for row in shown] == [path.name for path in world["unseen"]]
    assert len({tuple(row) for row in shown}) == 1
    (setting,) = (row for row in rows if "seeds" in row)
    assert f"correct {setting['slip_correct']:.0%}" in verdict[0] and "2 trajectories" in verdict[0]
    assert "50 ms before" in verdict[1] and "20 ms after" in verdict[1]
    assert slip.for_people(rows, EvaluateSlip(all_tables=True))[0] == rows

    files = [*world["known"], *world["unseen"], *world["seeds"], *world["ahead"]]
    rows, _ = evaluated(files, tmp_path / "many.report.h5")
    shown, verdict = slip.for_people(rows, EvaluateSlip())
    shown = [row for row in shown if "covariate" not in row]
    assert [row["setting"] for row in shown] == [row["setting"] for row in rows if "seeds" in row]
    assert {"early", "correct", "late", "f1"} <= set(shown[0]) and len(shown[0]) <= 10
    assert [line.split(":")[0] for line in verdict[: len(shown)]] == [row["setting"] for row in shown]


def judged(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The architectures of the detectors that are run on a trajectory from now on."""
    calls: list[str] = []

    def counted(detectors: Sequence[Detector], series: Series, first: int) -> list[NDArray[np.float32]]:
        calls.append(detectors[0].architecture.name)
        return slip_detectors.probabilities(detectors, series, first)

    monkeypatch.setattr(slip_models, "probabilities", counted)
    return calls


def test_only_what_is_new_is_judged(world: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a model, then a trajectory more costs what is new alone, and the report is as if made at once."""
    calls = judged(monkeypatch)
    report, both = tmp_path / "r.report.h5", world["seeds"]
    known, more = world["known"][:3], world["known"]

    def judged_again(files: list[Path], out: Path) -> tuple[list[dict[str, Any]], int]:
        before = len(calls)
        return run_stage(slip, files, EvaluateSlip(), out, force=True)[1].rows, len(calls) - before

    assert judged_again([*known, both[0]], report)[1] == 3
    assert judged_again([*known, *both], report)[1] == 3
    rows, times = judged_again([*more, *both], report)
    assert times == 2
    assert rows == judged_again([*more, *both], tmp_path / "new" / "r.report.h5")[0]
    assert len(list((tmp_path / "r.judged").iterdir())) == 4
    renamed = replace(Model.read(both[0]), key="of another graph with the same recipe")
    (predictions,) = slip_models.predict_all([renamed], known, check([renamed], known), silent, tmp_path / "r.judged")
    assert len(calls) == 3 + 3 + 2 + 8 + 3
    assert len(predictions) == 3


def test_piece_by_piece_as_a_whole(world: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a long trajectory is judged as it is in one piece, whatever the number of slices in memory."""
    down5 = trained(world["learn"], tmp_path / "models", model="down5")
    files = [*world["known"][:2], *world["fast-slow"], *down5]
    rows, _ = evaluated(files, tmp_path / "whole.report.h5")
    calls = judged(monkeypatch)
    monkeypatch.setattr(slip_models, "MOST_SLICES", 37)
    assert evaluated(files, tmp_path / "pieces.report.h5")[0] == rows
    assert len(calls) > 4


def test_parts_of_a_report(world: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a report finds what its parts judged, in whatever order."""
    monkeypatch.setattr(slip, "AT_ONCE", 3)
    files = [*world["known"], *world["seeds"]]
    rows, _ = evaluated(files, tmp_path / "whole.report.h5")
    (job,) = slip.jobs(files, EvaluateSlip(), tmp_path / "r.report.h5")
    parts = slip.parts(job, EvaluateSlip())
    assert [len(part.inputs) for part in parts] == [5, 3]
    for part in reversed(parts):
        assert slip.run(part, EvaluateSlip()).rows == []
    monkeypatch.setattr(slip_models, "probabilities", None)
    assert slip.run(job, EvaluateSlip()).rows == rows


def recording_of_features(path: Path, folder: Path, *, simulated: bool = True) -> Path:
    """The recording that features_file says its features were made from."""
    with StageFile(path, "features") as file:
        (parent,) = (one for one in file.header["history"].values() if one["kind"] == "recording")
    at = np.arange(SLICES)
    arrays = event_arrays(events_at(np.repeat(at * 1000, np.where(np.abs(at - ONSET + 0.5) < 50, 40, 10))), SLICES)
    if simulated:
        arrays |= truth_arrays(np.zeros((SLICES, 1, 2)), at >= ONSET - 2, 1.0)
        arrays["truth/visible_slip_share"] = np.where(at >= ONSET - 7, 0.9, 0.2).astype(np.float32)
    recording = folder / path.name.replace(".features.", ".recording.")
    recipe = Recipe("recording", 1, parent["parameters"], seed=parent["seed"], simulated_source=True)
    write_stage(recording, recipe, arrays, force=True)
    return recording


def covariates_of(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    by_words = {row["covariate"]: row for row in rows if "covariate" in row}
    return {name: by_words[words] for name, words in WORDS.items() if words in by_words}


def test_covariates_from_features_alone(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that labels and events of features tell the rate about slip, and that what they cannot tell is said."""
    rows, summary = evaluated([*world["known"], world["seeds"][0]], tmp_path)
    known = covariates_of(rows)
    assert set(known) == {"events_per_ms_about_slip"}  # no slice is 500 ms before the onset
    with StageFile(world["known"][0]) as file:
        one = file.read("events_outside")[:].mean()
    assert known["events_per_ms_about_slip"]["n"] == len(world["known"])
    assert known["events_per_ms_about_slip"]["median"] == pytest.approx(one, rel=0.2)
    assert summary["with_truth"] == 0
    _, verdict = slip.for_people(rows, EvaluateSlip())
    assert any("--recordings" in line and WORDS["creep_to_gross_ms"] in line for line in verdict)


@pytest.mark.parametrize("named", [False, True])
def test_covariates_from_the_truth(world: dict[str, Any], tmp_path: Path, named: bool) -> None:
    """Assert that recordings beside the features, or in a folder that is named, tell by their truth, and come first."""
    files = [Path(shutil.copy(path, tmp_path)) for path in world["known"]]
    folder = tmp_path / "elsewhere" if named else tmp_path
    folder.mkdir(exist_ok=True)
    for path in files:
        recording_of_features(path, folder)
    given = {"recordings": folder} if named else {}
    rows, summary = evaluated([*files, world["seeds"][0]], tmp_path / "a.report.h5", **given)
    known = covariates_of(rows)
    assert known["incipient_80_to_gross_ms"]["median"] == 5
    assert known["non_slip_tenth_slipping"]["median"] == 1.0
    assert known["unloading_n_per_s"]["median"] == 0.0
    assert (summary["with_truth"], known["unloading_n_per_s"]["n"]) == (4, 4)
    shown, _ = slip.for_people(rows, EvaluateSlip())
    assert [row["covariate"] for row in shown[: len(known)]] == [row["covariate"] for row in known.values()]
    with pytest.raises(InputError, match="with_truth"):  # without the recordings it is another report
        for path in files:
            recording = folder / path.name.replace(".features.", ".recording.")
            recording.unlink()
        evaluated([*files, world["seeds"][0]], tmp_path / "a.report.h5")


def test_recordings_that_do_not_fit(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that another or a broken recording is passed over beside features, and refused in a named folder."""
    files = [Path(shutil.copy(path, tmp_path)) for path in world["known"][:2]]
    first, second = (path.name.replace(".features.", ".recording.") for path in files)
    shutil.move(recording_of_features(world["known"][2], tmp_path), tmp_path / second)
    (tmp_path / first).write_text("no")
    _, summary = evaluated([*files, world["seeds"][0]], tmp_path / "a.report.h5")
    assert summary["with_truth"] == 0
    for path in files:
        with pytest.raises(InputError):
            evaluated([path, world["seeds"][0]], tmp_path / "b.report.h5", recordings=tmp_path)
    with pytest.raises(InputError, match="no recording of this file"):
        evaluated([files[0], world["seeds"][0]], tmp_path / "b.report.h5", recordings=tmp_path / "none")


def abstaining(path: Path, folder: Path) -> Path:
    """A copy of features whose labels abstain."""
    copied = Path(shutil.copy(path, folder))
    with h5py.File(copied, "r+") as h5:
        h5["abstained"] = np.uint8(1)
        h5["label"][ONSET - 3 : ONSET + 2] = -1  # the interval of the onset
    return copied


def test_n_is_what_was_counted(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that every table, and the sentence, say how many trials are behind shares of slips, and why not more."""
    files = [abstaining(world["known"][0], tmp_path), *world["known"][1:], world["seeds"][0]]
    rows, summary = evaluated(files, tmp_path / "a.report.h5")
    assert [summary[key] for key in ("trajectories", "slips", "abstained", "no_slip")] == [4, 3, 1, 0]
    counts = [tuple(row[key] for key in ("trajectories", "counted", "abstained")) for row in table_of(rows, "counted")]
    assert counts == [(4, 3, 1), (2, 1, 1), (2, 2, 0), (4, 3, 1)]  # the setting, two objects, the sensor
    assert [row["abstained"] for row in table_of(rows, "t_c_ms")] == [True, False, False, False]
    _, verdict = slip.for_people(rows, EvaluateSlip())
    assert "n = 3 of 4 trajectories, 1 abstained" in verdict[0]
    assert "the labels file with the reason was not found (1)" in verdict[1]
    shown, _ = slip.for_people(rows, EvaluateSlip(by="object"))
    assert [(row["object"], row["n"], row["abstained"]) for row in shown] == [("1", 1, 1), ("2", 2, 0)]


def test_judged_by_truth(world: dict[str, Any], tmp_path: Path) -> None:
    """Assert that --truth judges as labels of --method truth, has its own report, and refuses trials without truth."""
    folder = tmp_path / "study" / "a"  # the folders around tmp_path have recordings of other tests
    folder.mkdir(parents=True)
    path = abstaining(world["known"][0], folder)
    with pytest.raises(InputError, match="no recording of this file"):
        evaluated([path, world["seeds"][0]], folder, truth=True)
    recording_of_features(path, folder)
    rows, summary = evaluated([path, world["seeds"][0]], folder, truth=True)
    assert summary["report"] == str(folder / "trial-100.slip-truth.report.h5")
    assert {row["judged_by"] for row in rows if "covariate" not in row} == {"truth of the simulation"}
    same = Path(shutil.copy(path, folder / "same.features.h5"))
    with h5py.File(same, "r+") as h5:
        del h5["abstained"]
        slips = np.arange(SLICES) >= ONSET - 2
        h5["label"][:] = np.where(np.arange(SLICES) >= ONSET - 2 + Label().after_ms, -1, slips)
        h5["onset_slice"][()] = ONSET - 2
    labelled, _ = evaluated([same, world["seeds"][0]], tmp_path / "labels.report.h5")
    (by_truth,), (by_labels,) = (table_of(some, "t_c_ms") for some in (rows, labelled))
    differ = {"file", "judged_by"}
    assert {key: by_truth[key] for key in by_truth.keys() - differ} == {
        key: by_labels[key] for key in by_labels.keys() - differ
    }
    _, verdict = slip.for_people(rows, EvaluateSlip(truth=True))
    assert "judged by truth of the simulation" in verdict[0]


def test_truth_beside_the_labels_is_named(tmp_path: Path) -> None:
    """Assert that a model that learned the true share is named so, alone too, and that its row says it."""
    files = [features_file(tmp_path, 900 + number, object_=1) for number in range(2)]
    for path in files:
        with h5py.File(path, "r+") as h5:
            h5["truth/visible_slip_share"] = np.linspace(0, 1, SLICES).astype(np.float32)
    judged = features_file(tmp_path, 910, object_=1)
    asked = trained(files, tmp_path / "truth", learn_true_slip_share=True)
    rows, _ = evaluated([judged, *asked], tmp_path / "one.report.h5")
    (row,) = table_of(rows, "seeds")
    assert (row["setting"], row["true_slip_share"]) == ("no-hist, true slip share", True)
    rows, _ = evaluated([judged, *asked, *trained(files, tmp_path / "labels")], tmp_path / "two.report.h5")
    assert {(row["setting"], row["true_slip_share"]) for row in table_of(rows, "seeds")} == {
        ("no-hist, true slip share", True),
        ("no-hist", False),
    }
