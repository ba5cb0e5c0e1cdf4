"""The dot grid from a press recording: whole, cut, in part, over a default, and from files of the official software."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate, empty, slice_starts
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.params.learning import Featurize, Track
from evetac_cli.params.recording import Calibrate, Record
from evetac_cli.resources import SCENES
from evetac_cli.sim.camera import gel_camera
from evetac_cli.sim.scene import sensor_row
from evetac_cli.stages import calibrate, featurize, record, track
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.provenance import Recipe
from evetac_cli.store.read import open_recording
from evetac_cli.text_files import as_toml
from tests.conftest import DATA

Grid = NDArray[np.float64]
Show = Callable[[NDArray[np.bool_]], Path]

Y, X = np.mgrid[:480, :640]

REAL = DATA / "evetac_base_calibration.json"
PICKLE = DATA / "evetac_base_calibration.pkl"
NOISE = DATA / "dvxplorer_static_noise.aedat4"
needs_data = pytest.mark.skipif(not PICKLE.exists(), reason="the official calibration is not here")


@pytest.fixture(scope="module")
def truth() -> Grid:
    """The grid of the real sensor; without it, that of the simulated one."""
    if REAL.exists():
        return read_calibration(REAL).dot_xy_px
    return gel_camera.dot_grid(sensor_row("evetac"), cut=False)


@pytest.fixture(scope="module")
def pressed(tmp_path_factory: pytest.TempPathFactory, truth: Grid) -> Path:
    """A press recording of that grid, with fewer and faster strokes than the scene's."""
    scene = tomllib.loads((SCENES / "press.toml").read_text())
    scene["motion"] |= {"speed_mm_s": 120.0, "lines": 5, "approach_s": 0.1, "press_s": 0.05}
    scene["solver"] = {"node_pitch_mm": 1.45}
    scene["time"]["rest_s"] = 0.1
    folder = tmp_path_factory.mktemp("pressed")
    (folder / "press.toml").write_text(as_toml(scene))
    chosen = Record(scene=str(folder / "press.toml"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gel_camera, "dot_grid", lambda sensor_row, cut: truth)
        (job,) = record.jobs([], chosen, folder / "press.recording.h5")
        record.run(job, chosen)
    return job.output


@pytest.fixture(scope="module")
def events(pressed: Path) -> Events:
    with open_recording(pressed) as recording:
        return recording.between(0, len(recording))


def recorded(path: Path, events: Events, frame_px: tuple[int, int] = (640, 480)) -> Path:
    """Events as an imported recording without a grid."""
    arrays: dict[str, Any] = {
        **{f"events/{column}": getattr(events, column) for column in Events._fields},
        "ms_to_idx": slice_starts(events.t, int(events.t[-1]) // 1000 + 1 if events.size else 0),
        "t_offset": np.int64(0),
        "sensor/frame_px": np.array(frame_px, np.int32),
        "sensor/name": "unknown",
    }
    write_stage(path, Recipe("recording", 1, {"made": path.name}, content="0" * 64), arrays)
    return path


def selected(events: Events, keep: NDArray[np.bool_]) -> Events:
    return Events(*(column[keep] for column in events))


@pytest.fixture(scope="module")
def halves(pressed: Path) -> tuple[RestImage, RestImage]:
    with open_recording(pressed) as recording:
        return calibrate.rest_images(recording)


@pytest.fixture
def seen(halves: tuple[RestImage, RestImage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Show:
    """A recording that shows only some pixels of what was pressed."""

    def show(pixels: NDArray[np.bool_]) -> Path:
        shown = tuple(RestImage(half.brighter * pixels, half.darker * pixels) for half in halves)
        monkeypatch.setattr(calibrate, "rest_images", lambda recording, progress: shown)
        return recorded(tmp_path / "part.recording.h5", empty())

    return show


def calibrated(source: Path, **chosen: Any) -> tuple[dict[str, Any], Path]:
    """The row of a calibration beside its recording, and the file."""
    wanted = Calibrate(**chosen)
    (job,) = calibrate.jobs([source], wanted, source.with_suffix(".json"))
    return calibrate.run(job, wanted).rows[0], job.output


def worst_px(path: Path, truth: Grid) -> float:
    """Largest distance of a dot that was found from the true one in its place."""
    return float(np.nanmax(np.linalg.norm(read_calibration(path).dot_xy_px - truth, axis=2)))


@pytest.mark.slow
def test_every_dot_from_scratch(pressed: Path, truth: Grid) -> None:
    """Assert that all dots are found within 0.5 px in their places, and that the file says how, and how well."""
    row, path = calibrated(pressed)
    assert (row["dots"], row["missing_dots"], row["rows"], row["columns"], row["gel"]) == (63, 0, 7, 9, "closed")
    assert worst_px(path, truth) < 0.5
    assert row["error_px_worst"] == pytest.approx(worst_px(path, truth), abs=1e-3)
    assert 0 < row["jitter_px_rms"] < 0.5
    assert row["radius_px"] == pytest.approx(15.0 - 0.6, abs=0.2)  # 0.6: see dot_search
    table = json.loads(path.read_text())
    assert np.array(table["mask"]).shape == (7, 9)
    assert np.array(table["mask"]).all()
    assert sorted(len(around) for around in table["neighbours"]) == [3] * 4 + [5] * 24 + [8] * 35
    assert set(table["neighbours"][0]) == {1, 9, 10}
    with open_recording(pressed) as recording:
        assert table["provenance"]["parents"] == [recording.header["id"]]
    assert table["provenance"]["simulated"] is True
    assert "evetac" in table["provenance"]["made"]
    assert table["quality"]["jitter_px_rms"] == row["jitter_px_rms"]


@pytest.mark.slow
def test_again_and_otherwise(seen: Show, tmp_path: Path) -> None:
    """Assert that a calibration that is there is kept, another recipe refused until --force, and nothing is left."""
    short = seen(X >= 0)
    first, path = calibrated(short)
    before = path.read_bytes()
    again, _ = calibrated(short)
    assert again == first | {"status": "up to date"}
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="any_grid is false in the file, true wanted"):
        calibrated(short, any_grid=True)
    forced = Calibrate(any_grid=True)
    (job,) = calibrate.jobs([short], forced, path)
    assert calibrate.run(job, forced, force=True).made
    path.write_text("{}")
    with pytest.raises(InputError, match="no calibration made by evetac"):
        calibrated(short)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["part.recording.h5", "part.recording.json"]


def test_cut_gel(seen: Show, truth: Grid) -> None:
    """Assert that a gel without its last column is taken for a cut one with its window, and not if called closed."""
    path = seen(X < 520)
    row, made = calibrated(path)
    assert (row["dots"], row["columns"], row["gel"], row["window_px"]) == (56, 8, "cut", "540 0 640 480")
    assert worst_px(made, truth[:, :8]) < 0.5
    made.unlink()
    with pytest.raises(InputError, match="not the whole grid"):
        calibrated(path, gel="closed")


@pytest.mark.parametrize("part", [X < 300, X > 300, Y < 240, X > 90], ids=["left", "right", "upper", "no first"])
def test_half_a_gel_is_refused(seen: Show, part: NDArray[np.bool_]) -> None:
    """Assert that a gel of which a part was not pressed is not taken for a whole one, nor a lost first column."""
    path = seen(part)
    with pytest.raises(InputError, match="press over the whole gel"):
        calibrated(path)
    assert not path.with_suffix(".json").exists()


def test_refine(seen: Show, tmp_path: Path, truth: Grid) -> None:
    """Assert that dots that were pressed are found, and the others follow the default, moved as those were."""
    path = seen(X < 300)
    default = tmp_path / "default.json"
    default.write_text(
        json.dumps({"frame_px": [640, 480], "radius_px": 20, "dot_xy_px": (truth + (9.0, -7.0)).tolist()})
    )
    row, made = calibrated(path, refine=default)
    assert row["dots"] == 63
    assert 63 - 7 * 4 >= row["kept_from_default"] >= 63 - 7 * 5
    results = read_calibration(made).dot_xy_px
    assert np.abs(results[:, :4] - truth[:, :4]).max() < 0.5
    assert np.abs(results - truth).max() < 1.0
    made.unlink()
    row, made = calibrated(path, any_grid=True)
    assert row["columns"] in (4, 5)


def test_missing_dot(seen: Show, tmp_path: Path, events: Events, truth: Grid) -> None:
    """Assert that a dot that never shows is missing in its place, and that track and featurize do without it."""
    row, made = calibrated(seen(np.hypot(X - truth[2, 3, 0], Y - truth[2, 3, 1]) > 30))
    assert (row["dots"], row["missing_dots"]) == (62, 1)
    dots = read_calibration(made).dot_xy_px
    assert np.argwhere(np.isnan(dots[..., 0])).tolist() == [[2, 3]]
    table = json.loads(made.read_text())
    assert table["mask"][2][3] is False
    assert table["dot_xy_px"][2][3] == [None, None]
    assert table["neighbours"][2 * 9 + 3] == []
    short = recorded(tmp_path / "short.recording.h5", selected(events, events.t < 300_000))
    tracking = Track(calibration=made)
    (job,) = track.jobs([short], tracking, None)
    track.run(job, tracking)
    (job,) = featurize.jobs([short], Featurize(), None)
    featurize.run(job, Featurize())
    with StageFile(job.output, "features") as features:
        displacement = features.read("displacement_px")
    assert np.isfinite(displacement).all()
    assert (displacement[:, 2 * 9 + 3] == 0).all()
    assert displacement.max() > 1


def test_hidden_dots(seen: Show, truth: Grid) -> None:
    """Assert that a gel with more than a quarter of its dots missing is refused, and taken as it is when told to."""
    hidden = np.zeros((480, 640), bool)
    for x, y in truth[1:6:2, 1:8].reshape(-1, 2):
        hidden |= np.hypot(X - x, Y - y) < 30
    path = seen(~hidden)
    with pytest.raises(InputError, match="21 dots missing"):
        calibrated(path)
    row, _ = calibrated(path, any_grid=True)
    assert (row["dots"], row["missing_dots"]) == (42, 21)


@pytest.mark.slow
def test_thresholds_that_differ_by_polarity(tmp_path: Path, events: Events, truth: Grid) -> None:
    """Assert that a camera that loses a quarter of its darker events, and has noise, moves no centre by 1 px."""
    rng = np.random.default_rng(0)
    seen = selected(events, (events.p == 1) | (rng.uniform(size=events.size) > 0.25))
    count = 95 * int(seen.t[-1]) // 1000  # as a bare DVXplorer
    noise = Events(
        rng.integers(0, int(seen.t[-1]), count), rng.integers(0, 640, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16), rng.integers(0, 2, count).astype(np.uint8),
    )  # fmt: skip
    both = concatenate([seen, noise])
    order = np.argsort(both.t, kind="stable")
    row, made = calibrated(recorded(tmp_path / "odd.recording.h5", selected(both, order)))  # type: ignore[arg-type]
    assert row["missing_dots"] == 0
    assert worst_px(made, truth) < 1.0


@pytest.mark.slow
def test_half_the_resolution(tmp_path: Path, events: Events, truth: Grid) -> None:
    """Assert that a smaller frame, with dots of half the size, is calibrated just so."""
    small = Events(events.t, events.x // 2, events.y // 2, events.p)
    row, made = calibrated(recorded(tmp_path / "small.recording.h5", small, (320, 240)))
    assert (row["dots"], row["missing_dots"]) == (63, 0)
    assert read_calibration(made).frame_px == (320, 240)
    assert worst_px(made, (truth - 0.5) / 2) < 0.5
    assert row["radius_px"] == pytest.approx(7.2, abs=0.5)


def test_larger_frame(
    halves: tuple[RestImage, RestImage], tmp_path: Path, truth: Grid, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a gel in the middle of a larger frame is found there, once any grid is allowed."""
    larger = tuple(RestImage(*(np.pad(side, ((60, 60), (80, 80))) for side in half)) for half in halves)
    monkeypatch.setattr(calibrate, "rest_images", lambda recording, progress: larger)
    path = recorded(tmp_path / "large.recording.h5", empty(), (800, 600))
    with pytest.raises(InputError, match="not the whole grid"):
        calibrated(path)
    row, made = calibrated(path, any_grid=True)
    assert (row["dots"], row["missing_dots"]) == (63, 0)
    assert worst_px(made, truth + (80, 60)) < 0.5


def test_nothing_moved(tmp_path: Path, events: Events) -> None:
    """Assert that rest, no events at all, and a stroke without rests are refused in words, and leave nothing."""
    nothing = selected(events, np.zeros(events.size, bool))
    for name, part, words in (
        ("rest", selected(events, events.t < 90_000), "no dot was seen to move"),
        ("empty", nothing, "no dot was seen to move"),
        ("stroke", selected(events, (events.t >= 280_000) & (events.t < 350_000)), "not at rest before and after"),
    ):
        part = Events(part.t - (part.t[0] if part.size else 0), *part[1:])  # noqa: PLW2901 - the same, from t = 0
        path = recorded(tmp_path / f"{name}.recording.h5", part)
        with pytest.raises(InputError, match=words):
            calibrated(path)
        assert not path.with_suffix(".json").exists()


@pytest.mark.skipif(not NOISE.exists(), reason="the recording of noise is not here")
def test_noise_is_no_dot(tmp_path: Path) -> None:
    """Assert that a real camera's noise at a still scene is refused, also when taken for strokes."""
    importing = Record(source=NOISE)
    (job,) = record.jobs([], importing, tmp_path / "noise.recording.h5")
    record.run(job, importing)
    with pytest.raises(InputError, match="no dot was seen to move"):
        calibrated(job.output)
    with open_recording(job.output) as recording:
        noise = recording.between(0, len(recording))
    rests = selected(noise, (noise.t // 1000 % 400 >= 100) | (noise.x < 40))
    with pytest.raises(InputError, match="no dots were seen to move: 0 found"):
        calibrated(recorded(tmp_path / "strokes.recording.h5", rests))


@needs_data
def test_official_files_give_one_grid(tmp_path: Path, truth: Grid) -> None:
    """Assert that pickle and JSON of the official calibration become the same grid, with neighbours along rows."""
    tables = []
    for source in (PICKLE, REAL):
        chosen = Calibrate(source=source)
        (job,) = calibrate.jobs([], chosen, tmp_path / f"{source.suffix[1:]}.json")
        outcome = calibrate.run(job, chosen)
        assert not outcome.simulated
        assert (outcome.rows[0]["dots"], outcome.rows[0]["gel"]) == (63, "closed")
        assert worst_px(job.output, truth) < 1e-3
        tables.append(json.loads(job.output.read_text()))
    first, second = ({key: table[key] for key in table if key != "provenance"} for table in tables)
    assert first == second
    assert {4 * 9 + 3, 4 * 9 + 5, 3 * 9 + 4, 5 * 9 + 4} <= set(first["neighbours"][4 * 9 + 4])


def test_the_file_of_a_sensor_is_imported(tmp_path: Path) -> None:
    """Assert that identify's file gives dots as its camera sees them, contrast over both thresholds and stiffness."""
    source = tmp_path / "mine.sensor.toml"
    source.write_text(
        'like = "evetac"\nshear_modulus_pa = 9e4\nlog_contrast = 1.5\nthreshold = 0.25\nthreshold_off = 0.3\n'
        "distortion = [-0.05, 0.0]\n"
    )
    chosen = Calibrate(source=source)
    (job,) = calibrate.jobs([], chosen, tmp_path / "mine.json")
    outcome = calibrate.run(job, chosen)
    assert (outcome.rows[0]["dots"], outcome.rows[0]["gel"]) == (56, "cut")
    result = read_calibration(job.output)
    assert result.sensitivity == pytest.approx(((1.5 / 0.25 + 1.5 / 0.3) / 2, 9e4))
    straight = gel_camera.dot_grid(sensor_row("evetac"), cut=True)
    moved_px = np.linalg.norm(result.dot_xy_px - straight, axis=2)
    assert moved_px.max() > 1.0  # in a corner; a straight lens would leave all in place
    assert moved_px.min() < 0.1  # in the middle of the frame


def test_command_line(tmp_path: Path) -> None:
    """Assert that nothing to work on, too much of it and wrong names end with 2 and say what is wanted."""
    hostile = tmp_path / "hostile.pkl"
    hostile.write_bytes(b"cos\nsystem\n(S'touch " + str(tmp_path / "owned").encode() + b"'\ntR.")
    for arguments, words in (
        ([], "or --import FILE"),
        (["--import", str(hostile)], "os.system"),
        (["--import", str(hostile), str(hostile)], "takes neither recordings"),
        (["a.recording.h5", "-o", "b.h5"], "a name that ends in .json"),
        (["a.recording.h5", "b.recording.h5", "-o", "b.json"], "cannot hold several"),
        (["nowhere.recording.h5"], "no such file"),
    ):
        result = CliRunner().invoke(app, ["calibrate", *arguments])
        assert result.exit_code == 2
        assert words in result.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["hostile.pkl"]
