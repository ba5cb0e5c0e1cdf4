"""`import evetac_cli`: every name has an example that runs, the import loads and changes nothing, types are known."""

import doctest
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evetac_cli as evetac
from evetac_cli import api
from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.commands.record import Record
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels import measure as labels
from evetac_cli.resources import PACKAGE
from evetac_cli.stages.touch import predict_touch
from evetac_cli.trials.record import jobs, run
from tests.conftest import Made
from tests.patience import PATIENCE_S

NAMES = [name for name in evetac.__all__ if name not in ("EvetacError", "InputError", "UnavailableError")]


@pytest.fixture(scope="module")
def files(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of files as the examples name them."""
    folder = tmp_path_factory.mktemp("examples")
    recording = made.recordings[0]
    shutil.copy(recording, folder / "a.recording.h5")
    for kind in ("labels", "tracks", "features"):
        shutil.copy(made.beside(recording, kind), folder / f"a.{kind}.h5")
    shutil.copy(made.model, folder / "slip.model.h5")
    shutil.copy(made.force_model, folder / "dots.force-model.h5")
    (job,) = predict_touch.jobs([folder / "a.tracks.h5"], PredictTouch(map_every=100), None)
    predict_touch.run(job, PredictTouch(map_every=100))
    (job,) = labels.jobs([folder / "a.labels.h5"], EvaluateLabels(), folder / "a.report.h5")
    labels.run(job, EvaluateLabels())
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_every_name_has_an_example_that_runs(name: str, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the docstring of a name holds an example, and that it prints what it says."""
    monkeypatch.chdir(files)
    item = getattr(evetac, name)
    (test,) = (
        test
        for test in doctest.DocTestFinder(recurse=False).find(item, name, globs={"evetac": evetac})
        if test.name == name
    )
    assert test.examples, f"{name} has no example"
    printed: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=printed.append)
    assert result.failed == 0, "".join(printed)


def test_every_public_function_is_offered() -> None:
    """Assert that nothing public stands in api.py that `import evetac_cli` does not give."""
    own = {name for name, item in vars(api).items() if inspect.getmodule(item) is api and not name.startswith("_")}
    assert own <= set(evetac.__all__)
    assert set(evetac.__all__) <= set(dir(evetac))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = evetac.nothing


def test_images_of_a_loop_are_those_of_a_recording(files: Path) -> None:
    """Assert that EventImager, asked for nothing but a size, gives what the methods of a recording do."""
    with evetac.open_recording(files / "a.recording.h5") as recording:
        methods = {"frames": recording.frames, "histogram": recording.histogram}
        methods |= {"voxels": recording.voxels, "surface": recording.time_surface}
        for kind, method in methods.items():
            imager = evetac.EventImager(kind, recording.frame_px, size_px=(16, 12))
            found = [image for events in recording if (image := imager.step(events)) is not None]
            blocks = list(method(size_px=(16, 12)))
            np.testing.assert_array_equal(found, np.concatenate([block.images for block in blocks]))
            assert np.abs(found).max() > 0


def test_simulate_gives_the_events_of_record(short_scene: Path, tmp_path: Path) -> None:
    """Assert that slices and truth of `simulate` are those that `record` writes with the same flags."""
    recipe = Record(scene=str(short_scene), objects="3", seed=5)
    (job,) = jobs([], recipe, tmp_path)
    run(job, recipe)
    trial = evetac.simulate(str(short_scene), 3, seed=5)
    with evetac.open_recording(job.output) as recording:
        shear_n = recording.read("truth/shear_force_n")
        assert trial.window_px == recording.window_px
        slices = 0
        for events, stored in zip(trial, recording, strict=True):
            assert all(np.array_equal(ours, theirs) for ours, theirs in zip(events, stored, strict=True))
            np.testing.assert_array_equal(np.asarray(trial.truth["truth/shear_force_n"], np.float32), shear_n[slices])
            slices += 1
    assert slices == len(shear_n) > 500


def test_a_gel_without_dots_is_refused() -> None:
    """Assert that unknown dots and presets are refused in words, and that dots as large as they are count."""
    with pytest.raises(evetac.InputError, match=r"dots are unknown(.|\n)*calibrate"):
        evetac.DotTracker(evetac.Gel(None, None))
    with pytest.raises(evetac.InputError, match="unknown preset"):
        evetac.DotTracker(evetac.Gel(np.zeros((7, 8, 2)), 15.0), "best")


IMPORT = """
import os, sys
before = dict(os.environ)
import evetac_cli
assert dict(os.environ) == before
print(*sorted(name.split(".")[0] for name in sys.modules))
evetac_cli.SlipDetector
assert dict(os.environ) == before
"""


def test_an_import_loads_and_changes_nothing() -> None:
    """Assert that the import brings no heavy library, and neither it nor a name changes the environment."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORT],
        capture_output=True,
        text=True,
        check=True,
        cwd=PACKAGE.parent,
        timeout=PATIENCE_S,
    )
    assert not {"numpy", "h5py", "torch", "cv2", "scipy", "numba"} & set(done.stdout.split())


SCRIPT = """
import evetac_cli as evetac

with evetac.open_recording("a.recording.h5") as recording:
    detector = evetac.SlipDetector(recording)
    slip: list[float] = [detector.step(events) for events in recording]
"""


@pytest.mark.slow
def test_a_users_script_type_checks_against_the_wheel(tmp_path: Path) -> None:
    """Assert that mypy --strict is content with a script beside the installed wheel (slow: it builds one)."""
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, "--target", str(site), str(PACKAGE.parent)], check=True, timeout=PATIENCE_S)
    assert (site / "evetac_cli" / "py.typed").is_file()
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-incremental", "script.py"],
        cwd=tmp_path,
        env=environment | {"MYPYPATH": "", "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stdout


def test_the_example_of_the_docs_runs(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the Python of docs/python.md, given the files it names, runs as it is written."""
    text = (PACKAGE.parent / "docs" / "python.md").read_text()
    code = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    assert "import evetac_cli as evetac" in code
    for name in re.findall(r'"([^"]+\.h5)"', code):
        (files / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(files / f"a.{name.split('.')[-2]}.h5", files / name)
    write_grid(files)
    monkeypatch.chdir(files)
    made: dict[str, Any] = {}
    exec(compile(code, "docs/python.md", "exec"), made)
    assert made["dot_xy_px"].shape == (56, 2)
    assert np.isnan(made["probability"]) or 0.0 <= made["probability"] <= 1.0  # NaN without contact


def write_grid(files: Path) -> Path:
    """The dot grid of the recording, as `evetac calibrate` writes one."""
    with evetac.open_recording(files / "a.recording.h5") as recording:
        assert recording.dot_xy_px is not None and recording.window_px is not None
        grid = {"dot_xy_px": recording.dot_xy_px.tolist(), "radius_px": recording.dot_radius_px}
        grid |= {"frame_px": list(recording.frame_px), "window_px": list(recording.window_px)}
    (files / "gel.json").write_text(json.dumps(grid))
    return files / "gel.json"


@pytest.mark.parametrize("order", ["shuffled", "tilted"])
def test_a_list_of_points_is_put_into_rows(order: str, files: Path) -> None:
    """Assert that a detector answers alike for dots in rows and for the same dots as a list, in whatever order."""
    with evetac.open_recording(files / "a.recording.h5") as recording:
        assert recording.dot_xy_px is not None
        dots = recording.dot_xy_px.reshape(-1, 2)
        points: Any = np.random.default_rng(0).permutation(dots) if order == "shuffled" else dots
        rows: Any = recording.dot_xy_px
        if order == "tilted":
            turn = np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]])
            points, rows = dots @ turn, recording.dot_xy_px @ turn
        known = recording.dot_radius_px, recording.window_px, recording.sensitivity
        answers = []
        for each in (rows, points):
            detector = evetac.SlipDetector(evetac.Gel(each, *known))
            answers.append([detector.step(events) for events, _ in zip(recording, range(80), strict=False)])
    assert np.array_equal(*answers, equal_nan=True)
    assert not np.isnan(answers[0][-1])


NINE_BY_SEVEN = np.stack(np.meshgrid(60.0 * np.arange(9) + 60.0, 60.0 * np.arange(7) + 50.0), axis=-1)


def test_all_63_dots_of_a_closed_gel_are_a_list_too() -> None:
    """Assert that (63, 2) is taken by tracker and detector, as the 7 rows of 9 that they are."""
    gel = evetac.Gel(NINE_BY_SEVEN.reshape(-1, 2), 15.0)
    empty = evetac.Events(*(np.zeros(0, kind) for kind in (np.int64, np.uint16, np.uint16, np.uint8)))
    assert evetac.DotTracker(gel).step(empty).shape == (63, 2)
    assert np.isnan(evetac.SlipDetector(gel).step(empty))


@pytest.mark.parametrize(
    ("dots", "said"),
    [
        (
            NINE_BY_SEVEN.reshape(-1, 2)[:-1],
            "62 dots in no grid(.|\n)*as \\(rows, columns, 2\\)(.|\n)*rows of equal length",
        ),
        (NINE_BY_SEVEN[:, :7].reshape(-1, 2), "7 rows x 8 columns of dots.*found 7 rows x 7 columns"),
        (NINE_BY_SEVEN.reshape(-1, 2).T, "not dot positions(.|\n)*found:    shape \\(2, 63\\)"),
        (NINE_BY_SEVEN.reshape(-1), "found:    shape \\(126,\\)"),
    ],
)
def test_dots_that_a_detector_cannot_take_are_refused_in_true_words(dots: Any, said: str) -> None:
    """Assert that the refusal speaks of rows, columns and dots, and never calls the shape of an array a grid."""
    with pytest.raises(evetac.InputError, match=said) as refused:
        evetac.SlipDetector(evetac.Gel(dots, 15.0))
    assert "63 x 2" not in str(refused.value)
