"""identify: a sensor's file from recordings, and that it makes recordings like those that it comes from."""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.identify import Identify
from evetac_cli.commands.record import Record
from evetac_cli.commands.trim import Trim
from evetac_cli.errors import InputError, SchemaError
from evetac_cli.kernels import realism
from evetac_cli.sim.camera.gel_camera import dot_grid
from evetac_cli.sim.setup import scene_file, sensor_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.stages import gel_at_rest, identify, trim
from evetac_cli.stages.identify import gripper_rows, pressed
from evetac_cli.stages.identify.sensor_text import Entry
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials import record
from tests.make import run_stage

TRUE_RATIO = 1.61 / 0.2  # of the sensor evetac
HALF_MS = 1350


def recorded(folder: Path, sensor: str = "evetac", seed: int = 0, name: str = "rest") -> Path:
    chosen = Record(scene="rest", sensor=sensor, seed=seed)
    return run_stage(record, [], chosen, folder / f"{name}.recording.h5")[0]


def identified(files: list[Path], out: Path, **chosen: str) -> tuple[dict[str, dict], Path]:
    asked = Identify(**chosen)
    (job,) = identify.jobs(files, asked, out)
    rows = identify.run(job, asked).rows
    return {row["parameter"]: row for row in rows}, job.output


@pytest.fixture(scope="module")
def resting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("resting"))


def test_the_noise_of_a_simulated_sensor(resting: Path, tmp_path: Path) -> None:
    """Assert that the file holds the sensor's own noise, within the interval that stands beside it, and where it is."""
    rows, path = identified([resting], tmp_path)
    assert path == tmp_path / "rest.sensor.toml"
    row = rows["noise_hz"]
    assert row["low"] <= 0.03 <= row["high"] and row["high"] < 1.1 * row["low"]
    assert rows["hot pixels above 20 Hz"]["estimate"] == 6
    name, sensor = sensor_file.read(path, one_sensor)
    assert name == "own-sensor"
    assert sensor.noise_hz == pytest.approx(row["estimate"], rel=1e-5)
    assert sensor.hot_pixels == 0 and sensor.hot_pixel_table is not None and len(sensor.hot_pixel_table.x_px) == 6
    estimated = {"summary", "noise_hz", "noise_on_share", "timestamp_step_us", "hot_pixels", "hot_pixel_table"}
    kept, usual = (
        {key: value for key, value in as_table(one).items() if key not in estimated}
        for one in (sensor, one_sensor("evetac"))
    )
    assert kept == usual
    text = path.read_text()
    assert 'like = "evetac"' in text and "(simulated)" in text
    assert f"# {row['low']:.6g} to {row['high']:.6g}; rest.recording.h5, 0 to " in text


@pytest.mark.slow
def test_its_own_sensor_records(resting: Path, tmp_path: Path) -> None:
    """Assert that the file simulates, and that what it simulates is identified as the same again."""
    rows, path = identified([resting], tmp_path)
    again, _ = identified([recorded(tmp_path, str(path), seed=1, name="again")], tmp_path / "again.sensor.toml")
    for name in ("noise_hz", "noise_on_share", "hot pixels above 20 Hz", "events of hot pixels"):
        assert again[name]["low"] <= rows[name]["high"] and again[name]["high"] >= rows[name]["low"], name


def test_nothing_is_told_where_nothing_rests(resting: Path, tmp_path: Path) -> None:
    """Assert that a recording without a rest says for each figure which recording it takes, and names no value."""
    short = tmp_path / "short.recording.h5"
    asked = Trim(to_ms=300)
    run_stage(trim, [resting], asked, short)
    rows, path = identified([short], tmp_path / "none.sensor.toml")
    assert all(row["estimate"] is None and "cannot be estimated" in row["from"] for row in rows.values())
    assert "make one of 3 s" in rows["noise_hz"]["from"]
    assert sensor_file.read(path, one_sensor)[1].noise_hz == 0.03
    assert "Nothing could be estimated" in path.read_text()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"like": "evtac"}, "did you mean evetac"),
        ({"like": "randomized"}, "not the name of one sensor"),
        ({"name": "Mine!"}, "not a valid sensor name"),
        ({"name": "evetac"}, "evetac already has a sensor"),
    ],
)
def test_what_is_wrong_is_said(given: dict[str, str], says: str, tmp_path: Path) -> None:
    """Assert that names which cannot be are refused before any work."""
    with pytest.raises(InputError, match=says):
        identify.jobs([tmp_path / "a.recording.h5"], Identify(**given), None)


def test_on_the_command_line(resting: Path, tmp_path: Path) -> None:
    """Assert a table with intervals on stdout, and exit code 2 for what is no recording."""
    out = ["-o", str(tmp_path / "mine.sensor.toml")]
    shown = CliRunner().invoke(app, ["identify", str(resting), *out])
    assert shown.exit_code == 0 and "noise_hz" in shown.stdout and "(simulated)" in shown.stdout
    wrong = tmp_path / "wrong.recording.h5"
    wrong.write_text("no recording")
    assert CliRunner().invoke(app, ["identify", str(wrong), *out]).exit_code == 2


def test_recordings_that_do_not_belong_together(resting: Path, tmp_path: Path) -> None:
    """Assert that a recording given twice, and recordings of different sensors, are refused by name."""
    copy = tmp_path / "copy.recording.h5"
    shutil.copy(resting, copy)
    with pytest.raises(InputError, match="given twice") as twice:
        identified([resting, copy], tmp_path)
    assert str(copy) in str(twice.value) and str(resting) in str(twice.value)
    other = recorded(tmp_path, "second", name="second")
    with pytest.raises(InputError, match="different sensors") as differ:
        identified([resting, other], tmp_path)
    assert "evetac (simulated) in rest.recording.h5; second (simulated) in second.recording.h5" in str(differ.value)
    assert not list(tmp_path.glob("*.toml"))


def test_an_imported_recording_may_be_of_any_sensor(
    resting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that one whose sensor is unknown goes with others, but a real one never with a simulated one."""
    headers = {"a": ({"id": "a", "simulated": False}, "unknown"), "b": ({"id": "b", "simulated": False}, "dvxplorer:1")}

    def opened(path: Path) -> contextlib.AbstractContextManager[SimpleNamespace]:
        header, name = headers[path.name]
        return contextlib.nullcontext(SimpleNamespace(header=header, frame_px=(640, 480), read=lambda _: name))

    monkeypatch.setattr(identify, "open_recording", opened)
    assert [header["id"] for header in identify._headers([Path("a"), Path("b")])] == ["a", "b"]
    headers["a"][0]["simulated"] = True
    with pytest.raises(InputError, match="different sensors"):
        identify._headers([Path("a"), Path("b")])


def test_what_no_recording_told(resting: Path, tmp_path: Path) -> None:
    """Assert that recordings from which nothing is taken are named, as the shorter of two rests."""
    short = tmp_path / "short.recording.h5"
    asked = Trim(to_ms=1000)
    run_stage(trim, [resting], asked, short)
    (made,) = identify.jobs([short, resting], Identify(), tmp_path / "both.sensor.toml")
    assert identify.run(made, Identify()).summary["nothing_is_taken_from"] == "short.recording.h5"
    (made,) = identify.jobs([resting], Identify(), tmp_path / "one.sensor.toml")
    assert "nothing_is_taken_from" not in identify.run(made, Identify()).summary


def test_a_sensor_that_cannot_be(resting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that an estimate out of range is refused with the recordings' names, and no file is left."""
    monkeypatch.setattr(gripper_rows, "rows", lambda *_: ([], {"noise_hz": Entry(1e6, None, "x")}))
    with pytest.raises(InputError, match="noise_hz: ") as refused:
        identified([resting], tmp_path)
    assert refused.value.where == str(resting) and not list(tmp_path.iterdir())


def test_a_damaged_press(resting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a file which does not hold what it should is refused, and not taken for one without dots."""
    with open_recording(resting) as recording:

        def damaged(start: int, stop: int) -> None:
            raise SchemaError("ms_to_idx does not fit events/t", where=str(resting))

        monkeypatch.setattr(recording, "between", damaged)
        monkeypatch.setattr(gel_at_rest, "strokes", lambda _: [(0, 100)])
        with pytest.raises(SchemaError, match="does not fit"):
            pressed.find(recording, 1.61, None, 0.0, np.random.default_rng(0))


@pytest.mark.slow
def test_a_real_camera_at_rest(tmp_path: Path, outside_file: Callable[[str], Path]) -> None:
    """Assert that a DVXplorer identified from the first half of a recording simulates its second half, within 10 %.

    Rates, hot pixels and their share of all events, and median and 90th percentile of the times between two events of a
    hot pixel, and between two of one polarity. Simulated with seed 10,000, which chose nothing.
    """
    asked = Record(source=outside_file("dvxplorer_static_noise.aedat4"))
    output, _ = run_stage(record, [], asked, tmp_path / "noise.recording.h5")
    halves = []
    for number in range(2):
        cut = Trim(from_ms=number * HALF_MS, to_ms=(number + 1) * HALF_MS)
        (part,) = trim.jobs([output], cut, tmp_path / f"half{number}.recording.h5")
        trim.run(part, cut)
        halves.append(part.output)
    _, sensor = identified(halves[:1], tmp_path / "dvxplorer.sensor.toml", name="dvxplorer")
    simulated = recorded(tmp_path, str(sensor), seed=10_000)
    real, made = (rest_figures(path) for path in (halves[1], simulated))
    compared = [name for name in real if not name.endswith("_of_typical_pixel")]
    assert len(compared) == 13
    off = {name: made[name] / real[name] - 1 for name in compared}
    assert all(abs(share) <= 0.10 for share in off.values()), off


def rest_figures(path: Path) -> dict[str, float]:
    """Figures of the first HALF_MS of a recording."""
    with open_recording(path) as recording:
        events = recording.between(0, HALF_MS)
    return realism.at_rest(*events, (640, 480), 1000 * HALF_MS)


@pytest.mark.slow
def test_a_press_scene_rests_before_it_presses(tmp_path: Path) -> None:
    """Assert that the noise comes from the rest of a recording in which something moves later on."""
    touch = {"normal_n": 2.0, "shear_n": 1.0, "move_s": [0.2, 0.2]}
    (tmp_path / "touch.toml").write_text(scene_file.changed("rest", {"time": {"rest_s": 0.6}, "motion": touch}))
    chosen = Record(scene=str(tmp_path / "touch.toml"), sensor="bare-dvxplorer")
    output, _ = run_stage(record, [], chosen, tmp_path / "touch.recording.h5")
    rows, _ = identified([output], tmp_path)
    assert rows["noise_hz"]["low"] <= 0.1036 <= rows["noise_hz"]["high"]


@pytest.fixture(scope="module")
def stroked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A press of the sensor evetac, with fewer and faster strokes than the scene's."""
    strokes = {"speed_mm_s": 60.0, "lines": 5, "approach_s": 0.1, "press_s": 0.05}
    faster = scene_file.changed("press", {"motion": strokes, "solver": {"node_pitch_mm": 1.45}})
    folder = tmp_path_factory.mktemp("stroked")
    (folder / "press.toml").write_text(faster)
    chosen = Record(scene=str(folder / "press.toml"), seed=3)
    return run_stage(record, [], chosen, folder / "press.recording.h5")[0]


@pytest.mark.slow
def test_dots_and_optics_from_a_press(stroked: Path, resting: Path, tmp_path: Path) -> None:
    """Assert that dots, radius, blur, contrast over threshold and mismatch of a press are within their intervals.

    Noise comes from the longer rest, the press has but 0.5 s.
    """
    rows, path = identified([resting, stroked], tmp_path)
    truth = {"dots": 63.0, "dot_radius_px": 9.0, "edge_sigma_px": 1.2, "log_contrast / threshold": TRUE_RATIO}
    truth |= {"mismatch": 0.03}
    for name, value in truth.items():
        assert rows[name]["low"] <= value <= rows[name]["high"], (name, rows[name])
        assert rows[name]["from"] == "press.recording.h5"
    assert rows["noise_hz"]["from"].startswith("rest.recording.h5")
    assert rows["log_contrast"]["estimate"] is None
    _, sensor = sensor_file.read(path, one_sensor)
    true_dots = dot_grid(one_sensor("evetac"), cut=False)
    off_px = np.linalg.norm(dot_grid(sensor, cut=False) - true_dots, axis=2)
    assert np.sqrt((off_px**2).mean()) < rows["error of a dot's place, 95 %"]["estimate"]
    assert sensor.log_contrast / sensor.threshold == pytest.approx(
        rows["log_contrast / threshold"]["estimate"], rel=1e-5
    )


def test_a_press_takes_the_noise_of_the_longest_rest(
    resting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that dots are looked for in all recordings with one noise, that of the table."""
    taken = []

    def without_dots(*given: object) -> None:
        taken.append(given[3])
        raise ValueError("no dots")

    monkeypatch.setattr(identify.pressed, "find", without_dots)
    rows, _ = identified([recorded(tmp_path, seed=1, name="other"), resting], tmp_path)
    assert taken == [rows["noise_hz"]["estimate"]] * 2


def test_a_press_is_asked_for(resting: Path, tmp_path: Path) -> None:
    """Assert that without a press the rows of dots say how to make one."""
    rows, _ = identified([resting], tmp_path)
    assert "strokes the whole gel" in rows["dot_radius_px"]["from"] and rows["dot_radius_px"]["estimate"] is None
    assert "cannot be estimated from rest.recording.h5: " in rows["dot_radius_px"]["from"]
