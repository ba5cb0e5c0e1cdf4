"""The dot grid from a press recording: whole, cut, in part, over a default, and from files of the official software."""

import itertools
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
from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.record import Record
from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.events import Events, concatenate, empty
from evetac_cli.kernels.calibration.rest_image import RestImage
from evetac_cli.resources import SCENES
from evetac_cli.sim.camera import gel_camera
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages import calibrate, featurize, gel_at_rest, track
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.text_files import as_toml
from evetac_cli.trials import record
from tests.make import event_arrays, run_stage, write_recording
from tests.quick import few

Grid = NDArray[np.float64]
Show = Callable[[NDArray[np.bool_]], Path]

Y, X = np.mgrid[:480, :640]


@pytest.fixture(scope="module")
def truth() -> Grid:
    """The grid of the simulated sensor."""
    return gel_camera.dot_grid(one_sensor("evetac"), cut=False)


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
        patch.setattr(gel_camera, "dot_grid", lambda sensor, cut: truth)
        output, _ = run_stage(record, [], chosen, folder / "press.recording.h5")
    return output


@pytest.fixture(scope="module")
def events(pressed: Path) -> Events:
    with open_recording(pressed) as recording:
        return recording.between(0, len(recording))


def recorded(path: Path, events: Events, frame_px: tuple[int, int] = (640, 480)) -> Path:
    """Events as an imported recording without a grid."""
    slices = int(events.t[-1]) // 1000 + 1 if events.size else 0
    return write_recording(path, event_arrays(events, slices, frame_px), source=path.name)


def selected(events: Events, keep: NDArray[np.bool_]) -> Events:
    return Events(*(column[keep] for column in events))


@pytest.fixture(scope="module")
def halves(pressed: Path) -> tuple[RestImage, RestImage]:
    with open_recording(pressed) as recording:
        return gel_at_rest.rest_images(recording)


@pytest.fixture
def seen(halves: tuple[RestImage, RestImage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Show:
    """A recording that shows only some pixels of what was pressed."""

    def show(pixels: NDArray[np.bool_]) -> Path:
        shown = tuple(RestImage(half.brighter * pixels, half.darker * pixels) for half in halves)
        monkeypatch.setattr(gel_at_rest, "rest_images", lambda recording, progress: shown)
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
    assert 0 < row["jitter_px_rms"] < 0.5
    assert row["radius_px"] == pytest.approx(9.0 - 0.6, abs=0.2)  # 0.6: see dot_search
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
    with pytest.raises(InputError, match="irregular is false in the file, true"):
        calibrated(short, irregular=True)
    forced = Calibrate(irregular=True)
    assert run_stage(calibrate, [short], forced, path, force=True)[1].made
    path.write_text("{}")
    with pytest.raises(InputError, match="not a calibration made by evetac"):
        calibrated(short)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["part.recording.h5", "part.recording.json"]


def test_cut_gel(seen: Show, truth: Grid) -> None:
    """Assert that a gel without its last column is cut, with its window, or closed, as it is said; else it is asked."""
    path = seen(X < 520)
    with pytest.raises(InputError, match=r"is the gel cut(.|\n)*window_px 540 0 640 480"):
        calibrated(path)
    row, made = calibrated(path, gel="cut")
    assert (row["dots"], row["columns"], row["gel"], row["window_px"]) == (56, 8, "cut", "540 0 640 480")
    assert row["notes"] is None
    assert worst_px(made, truth[:, :8]) < 0.5
    made.unlink()
    row, made = calibrated(path, gel="closed")
    assert (row["dots"], row["missing_dots"], row["columns"], row["window_px"]) == (56, 7, 9, None)
    assert row["notes"] == "no dot was found in column 9: worn, or not pressed?"
    assert worst_px(made, truth) < 0.5


def test_a_recording_says_what_its_gel_is(seen: Show, tmp_path: Path, truth: Grid) -> None:
    """Assert that a gel is not asked for where the recording knows its sensor, unless its window cannot be true."""
    path = seen(X < 520)
    with open_recording(path) as recording:
        arrays = {name: recording.read(name) for name in ("ms_to_idx", "t_offset", "sensor/frame_px")}
        arrays |= {f"events/{name}": recording.read(f"events/{name}") for name in Events._fields}
    arrays |= {"sensor/name": "known", "sensor/dot_xy_px": truth[:, :8], "sensor/dot_radius_px": np.float64(15.0)}
    for window, expected in (((550, 0, 640, 480), "550 0 640 480"), (None, None), ((300, 0, 640, 480), "asked")):
        known = arrays if window is None else arrays | {"sensor/window_px": np.array(window, np.int32)}
        write_stage(path, Recipe("recording", 1, {"made": str(window)}, content="0" * 64), known, force=True)
        if expected == "asked":
            with pytest.raises(InputError, match="is the gel cut"):
                calibrated(path)
            continue
        row, made = calibrated(path)
        assert (row["gel"], row["window_px"]) == ("closed" if window is None else "cut", expected)
        made.unlink()


WORN = {  # dots of a closed gel that do not show, and how many of its rows and columns are left
    "first column": (np.s_[:, :1], 7, "column 1"),
    "last column": (np.s_[:, -1:], 7, "column 9"),
    "first and last column": (np.s_[:, [0, -1]], 14, "column 1, column 9"),
    "first row": (np.s_[:1], 9, "row 1"),
    "last row": (np.s_[-1:], 9, "row 7"),
    "four dots of the last column": (np.s_[:4, -1:], 4, None),
    "four dots of the first column": (np.s_[3:, :1], 4, None),
}


@pytest.mark.parametrize("which", few(WORN, "first column", "four dots of the first column"))
def test_worn_dots_do_not_make_a_window(seen: Show, truth: Grid, which: str) -> None:
    """Assert that a closed gel with a worn border is never taken for a cut one, and is whole if called closed."""
    part, missing, gone = WORN[which]
    hidden = np.zeros((480, 640), bool)
    for x, y in truth[part].reshape(-1, 2):
        hidden |= np.hypot(X - x, Y - y) < 30
    path = seen(~hidden)
    with pytest.raises(InputError) as refused:
        calibrated(path)
    assert "--gel closed" in str(refused.value)
    row, made = calibrated(path, gel="closed")
    assert (row["dots"], row["missing_dots"], row["rows"], row["columns"]) == (63 - missing, missing, 7, 9)
    assert row["window_px"] is None
    assert row["notes"] == (gone and f"no dot was found in {gone}: worn, or not pressed?")
    assert worst_px(made, truth) < 0.5
    assert np.isnan(read_calibration(made).dot_xy_px[part]).all()


MOUNTED = {  # a picture, its window at 540 0 640 480 and its dots, as a sensor sees them that is mounted otherwise
    "turned by 180 degrees": (lambda image: image[::-1, ::-1], lambda d: (639, 479) - d[::-1, ::-1], "0 0 100 480"),
    "mirrored left to right": (lambda image: image[:, ::-1], lambda d: d[:, ::-1] * (-1, 1) + (639, 0), "0 0 100 480"),
    "mirrored top to bottom": (lambda image: image[::-1], lambda d: d[::-1] * (1, -1) + (0, 479), "540 0 640 480"),
    "turned by 90 degrees": (np.rot90, lambda d: np.rot90(d)[..., ::-1] * (1, -1) + (0, 639), "0 0 480 100"),
}


@pytest.mark.parametrize(
    ("how", "cut"),
    few(itertools.product(MOUNTED, (False, True)), ("turned by 180 degrees", False), ("turned by 90 degrees", True)),
)
def test_a_sensor_that_is_mounted_otherwise(
    how: str, cut: bool, halves: tuple[RestImage, RestImage], tmp_path: Path, truth: Grid, monkeypatch: Any
) -> None:
    """Assert that all dots of a turned or mirrored sensor are found, with its window, and how it is mounted."""
    turned, places, window = MOUNTED[how]
    pressed = X < 520 if cut else X >= 0
    shown = tuple(RestImage(*(turned(side * pressed) for side in half)) for half in halves)
    monkeypatch.setattr(gel_at_rest, "rest_images", lambda recording, progress: shown)
    frame_px = (480, 640) if "90" in how else (640, 480)
    path = recorded(tmp_path / "mounted.recording.h5", empty(), frame_px)
    size = {"gel": "cut"} if cut else {}
    if frame_px[0] < frame_px[1]:
        with pytest.raises(InputError, match="these (dots are not the whole grid|are not the dots)") as refused:
            calibrated(path, **size)
        size |= {"rows": 8 if cut else 9, "columns": 7, "gel": "cut" if cut else "closed"}
        assert f"--rows {size['rows']} --columns 7" in refused.value.hint
    elif cut:
        with pytest.raises(InputError, match=f"is the gel cut(.|\n)*window_px {window}"):
            calibrated(path)
    row, made = calibrated(path, **size)
    assert (row["dots"], row["missing_dots"], row["window_px"]) == (56 if cut else 63, 0, window if cut else None)
    shown_by_window = "mirrored or turned by 180 degrees" if cut and window.startswith("0 0") else None
    said = "turned by 90 degrees" if "90" in how else shown_by_window
    assert row["notes"] is None if said is None else f"the sensor seems to be {said}" in row["notes"]
    assert worst_px(made, places(truth[:, :8] if cut else truth)) < 0.5


def test_the_size_that_is_said(seen: Show, truth: Grid) -> None:
    """Assert that another grid is found by its size, and that a wrong size names the right one."""
    path = seen(X < 300)
    row, made = calibrated(path, rows=7, columns=4, gel="closed")
    assert (row["dots"], row["rows"], row["columns"], row["gel"], row["notes"]) == (28, 7, 4, "closed", None)
    assert worst_px(made, truth[:, :4]) < 0.5
    made.unlink()
    row, made = calibrated(path, rows=7, columns=4, gel="cut")  # from half way to the column that is not there
    assert row["window_px"] == "540 0 640 480"
    made.unlink()
    with pytest.raises(InputError, match="is the gel cut"):
        calibrated(path, rows=7, columns=4)
    for rows, columns, words in (
        (6, 4, "more rows of dots"),
        (7, 3, "more columns of dots"),
        (7, 5, "the dots do not show which column is missing"),
        (8, 9, "more than 25% of them are missing|the dots do not show which"),
    ):
        with pytest.raises(InputError, match=words) as refused:
            calibrated(path, rows=rows, columns=columns, gel="closed")
        assert f"{rows} rows and {columns} columns" in refused.value.expected
        assert "7 rows and 4 columns, 0 dots missing" in refused.value.found
        assert "--rows 7 --columns 4 --gel closed" in refused.value.hint
    assert not made.exists()


PARTS = {"left": X < 300, "right": X > 300, "upper": Y < 240, "no first": X > 90}


@pytest.mark.parametrize("part", few(PARTS, "upper", "no first"))
def test_half_a_gel_is_refused(seen: Show, part: str) -> None:
    """Assert that a gel of which a part was not pressed is not taken for a whole one, nor a lost first column."""
    path = seen(PARTS[part])
    with pytest.raises(InputError, match="press on the whole gel"):
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
    """Assert that a gel with more than a quarter of its dots missing is refused, and its dots taken without a grid."""
    hidden = np.zeros((480, 640), bool)
    for x, y in truth[1:6:2, 1:8].reshape(-1, 2):
        hidden |= np.hypot(X - x, Y - y) < 30
    path = seen(~hidden)
    with pytest.raises(InputError, match="21 dots missing"):
        calibrated(path)
    row, _ = calibrated(path, irregular=True)
    assert (row["dots"], row["missing_dots"], row["rows"]) == (42, 0, None)


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


def test_larger_frame(
    halves: tuple[RestImage, RestImage], tmp_path: Path, truth: Grid, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a gel in the middle of a larger frame is found there, once it is said that there are no more dots."""
    larger = tuple(RestImage(*(np.pad(side, ((60, 60), (80, 80))) for side in half)) for half in halves)
    monkeypatch.setattr(gel_at_rest, "rest_images", lambda recording, progress: larger)
    path = recorded(tmp_path / "large.recording.h5", empty(), (800, 600))
    with pytest.raises(InputError, match=r"space for more dots(.|\n)*--rows 7 --columns 9"):
        calibrated(path)
    row, made = calibrated(path, rows=7, columns=9, gel="closed")
    assert (row["dots"], row["missing_dots"], row["notes"]) == (63, 0, None)
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


def resting(path: Path, hot_xy: NDArray[np.integer], seconds: float) -> Path:
    """A gel that is at rest but for a stroke in the middle, behind a camera with hot pixels of 60 events per second."""
    rng = np.random.default_rng(5)
    slices = round(1000 * seconds)
    of_hot = rng.poisson(60 * seconds, len(hot_xy))
    stroke = 20_000
    t = np.concatenate([rng.uniform(0, 1000 * slices, of_hot.sum()), rng.uniform(450, 550, stroke) * slices])
    places = np.concatenate([np.repeat(hot_xy, of_hot, axis=0), rng.integers(0, 480, (stroke, 2))])
    order = np.argsort(t)
    columns = t.astype(np.int64)[order], *places.T.astype(np.uint16)[:, order], np.ones(len(t), np.uint8)
    return recorded(path, Events(*columns))


def test_hot_pixels_between_strokes(tmp_path: Path) -> None:
    """Assert that pixels that fire at rest are found, row by row, but not in a short rest or where things move."""
    hot_xy = np.random.default_rng(6).permutation(480)[:80].reshape(40, 2)
    with open_recording(resting(tmp_path / "a.recording.h5", hot_xy, 4.0)) as recording:
        found = gel_at_rest.hot_pixels(recording)
    assert found is not None
    assert found.tolist() == sorted(hot_xy.tolist(), key=lambda pixel: pixel[::-1])
    with open_recording(resting(tmp_path / "b.recording.h5", hot_xy, 1.0)) as recording:
        assert gel_at_rest.hot_pixels(recording) is None
    edge_xy = np.column_stack([np.arange(100, 200), np.full(100, 50)])
    with open_recording(resting(tmp_path / "c.recording.h5", edge_xy, 4.0)) as recording:
        assert gel_at_rest.hot_pixels(recording) is None


def test_noise_is_no_dot(tmp_path: Path, outside_file: Callable[[str], Path]) -> None:
    """Assert that a real camera's noise at a still scene is refused, also when taken for strokes."""
    importing = Record(source=outside_file("dvxplorer_static_noise.aedat4"))
    output, _ = run_stage(record, [], importing, tmp_path / "noise.recording.h5")
    with pytest.raises(InputError, match="no dot was seen to move"):
        calibrated(output)
    with open_recording(output) as recording:
        noise = recording.between(0, len(recording))
    rests = selected(noise, (noise.t // 1000 % 400 >= 100) | (noise.x < 40))
    with pytest.raises(InputError, match=r"too few dots were seen to move(.|\n)*found: +0"):
        calibrated(recorded(tmp_path / "strokes.recording.h5", rests))


def test_official_files_give_one_grid(tmp_path: Path, outside_file: Callable[[str], Path]) -> None:
    """Assert that pickle and JSON of the official calibration become the same grid, with neighbours along rows.

    Only the pickle is known to hold diameters; the JSON is taken at its word.
    """
    tables = []
    sources = [outside_file(name) for name in ("evetac_base_calibration.pkl", "evetac_base_calibration.json")]
    truth = read_calibration(sources[1]).dot_xy_px
    for source in sources:
        chosen = Calibrate(source=source)
        output, outcome = run_stage(calibrate, [], chosen, tmp_path / f"{source.suffix[1:]}.json")
        assert not outcome.simulated
        assert (outcome.rows[0]["dots"], outcome.rows[0]["gel"]) == (63, "closed")
        assert worst_px(output, truth) < 1e-3
        tables.append(json.loads(output.read_text()))
    first, second = ({key: table[key] for key in table if key != "provenance"} for table in tables)
    assert (first.pop("radius_px"), second.pop("radius_px")) == (10.311, 20.621)
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
    output, outcome = run_stage(calibrate, [], chosen, tmp_path / "mine.json")
    assert (outcome.rows[0]["dots"], outcome.rows[0]["gel"]) == (56, "cut")
    result = read_calibration(output)
    assert result.sensitivity == pytest.approx(((1.5 / 0.25 + 1.5 / 0.3) / 2, 9e4))
    straight = gel_camera.dot_grid(one_sensor("evetac"), cut=True)
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
        (["--import", str(hostile), str(hostile)], "recordings or a default grid"),
        (["a.recording.h5", "-o", "b.h5"], "a name that ends in .json"),
        (["a.recording.h5", "b.recording.h5", "-o", "b.json"], "cannot hold several"),
        (["nowhere.recording.h5"], "no such file"),
        (["a.recording.h5", "--rows", "6"], "expected: both, or neither"),
        (["a.recording.h5", "--columns", "6"], "expected: both, or neither"),
        (["a.recording.h5", "--rows", "1", "--columns", "17"], "expected: 2 to 128"),
        (["a.recording.h5", "--rows", "6", "--columns", "9", "--irregular"], "have no rows and columns"),
        (["a.recording.h5", "--refine", "b.json", "--gel", "cut"], "leave out --gel"),
        (["a.recording.h5", "--refine", "b.json", "--irregular"], "leave out --irregular"),
        (["--import", "b.sensor.toml", "--rows", "6", "--columns", "9"], "leave out --rows"),
        (["--import", "b.sensor.toml", "--irregular"], "leave out --irregular"),
    ):
        result = CliRunner().invoke(app, ["calibrate", *arguments])
        assert result.exit_code == 2
        assert words in result.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["hostile.pkl"]
