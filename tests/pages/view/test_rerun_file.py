"""view --rrd: rerun's own reader finds every part of a trial, on one timeline, and what was thinned is said."""

import io
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from evetac_cli.commands.view import View
from evetac_cli.errors import InputError
from evetac_cli.pages import view
from evetac_cli.pages.view import rerun_file
from evetac_cli.store.recordings.read import open_recording
from tests.pages.view.trials import (
    REST,
    SENSOR,
    SLICES,
    moving,
    write_labels,
    write_recording,
    write_touch,
    write_tracks,
)

rerun = pytest.importorskip("rerun")

Rows = list[tuple[int, dict[str, Any]]]


def rows_of(path: Path) -> dict[str, Rows]:
    """What rerun reads: under each path the rows with their time in us, in the order of time."""
    parts: dict[str, Rows] = defaultdict(list)
    for chunk in rerun.chunk.RrdReader(path).stream():
        if chunk.is_static:
            continue
        assert chunk.timeline_names == ["t"]
        batch = chunk.to_record_batch()
        t_us = batch.column("t").cast("int64").to_numpy() // 1000
        columns = {name: batch.column(name).to_pylist() for name in batch.schema.names if ":" in name}
        for number, at in enumerate(t_us.tolist()):
            parts[chunk.entity_path].append((at, {name: values[number] for name, values in columns.items()}))
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in parts.items()}


def static_text(path: Path) -> str:
    """The words beside the views."""
    (chunk,) = [chunk for chunk in rerun.chunk.RrdReader(path).stream() if chunk.entity_path == "/about"]
    return str(chunk.to_record_batch().column("TextDocument:text").to_pylist()[0][0])


def rrd_of(recording: Path, **chosen: Any) -> Path:
    """The file of a trial."""
    view.run([recording], View(rrd=True, **chosen), None)
    return recording.with_name("a.rrd")


def test_everything_of_a_trial_is_there(trial: Path) -> None:
    """Assert paths and numbers of rows, and that the events of each slice, dots and series are those of the files."""
    path = rrd_of(trial)
    (stored,) = rerun.chunk.RrdReader(path).recordings()
    assert stored.application_id == "evetac" and len(rerun.chunk.RrdReader(path).blueprints()) == 1
    rows = rows_of(path)
    charts = "/series/"
    assert {name: len(each) for name, each in rows.items()} == {
        "/gel/events": SLICES,
        "/gel/dots": SLICES,
        "/gel/displacement": SLICES,
        "/gel/true_dots": SLICES,
        "/images/events": SLICES - 4,
        f"{charts}00_events_per_millisecond/events": SLICES,
        f"{charts}01_gripper_current/measured": SLICES // 2,
        f"{charts}01_gripper_current/target": SLICES // 2,
        f"{charts}02_gripper_width_between_the_fingers/width": SLICES // 2,
        f"{charts}03_forces_on_one_pad_truth/normal": SLICES,
        f"{charts}03_forces_on_one_pad_truth/shear": SLICES,
        f"{charts}04_share_of_the_contact_that_slips_truth/that_the_camera_sees": SLICES,
        f"{charts}04_share_of_the_contact_that_slips_truth/whole": SLICES,
        f"{charts}05_dots_distance_from_rest/mean": SLICES,
        f"{charts}05_dots_distance_from_rest/farthest": SLICES,
        f"{charts}06_flow_that_labels_slip/window_against_gel": SLICES,
        f"{charts}06_flow_that_labels_slip/threshold": 2,
        "/slip/truth": 3,
        "/slip/label": 4,
    }
    with open_recording(trial) as recording:
        for number, ((at, row), events) in enumerate(zip(rows["/gel/events"], recording, strict=True)):
            assert at == 1000 * number
            assert row["Points2D:positions"] == [[float(x), float(y)] for x, y in zip(events.x, events.y, strict=True)]
            assert row["Points2D:class_ids"] == events.p.tolist()
        force = [row["Scalars:scalars"][0] for _, row in rows["/series/03_forces_on_one_pad_truth/normal"]]
        np.testing.assert_array_equal(force, recording.read("truth/normal_force_n"))
    dots = moving().astype(np.float32)
    np.testing.assert_array_equal([row["Points2D:positions"] for _, row in rows["/gel/dots"]], dots)
    arrows = [row["Arrows2D:vectors"] for _, row in rows["/gel/displacement"]]
    np.testing.assert_allclose(arrows, dots - REST.reshape(-1, 2), atol=1e-5)
    image = bytes(rows["/images/events"][7][1]["EncodedImage:blob"][0])
    assert image.startswith(b"\x89PNG")
    slip = [(at, row["StateChange:state"][0]) for at, row in rows["/slip/truth"]]
    assert slip == [(0, ""), (200_000, "slip"), (300_000, "")]
    assert [row["StateChange:state"][0] for _, row in rows["/slip/label"]] == ["not examined", "", "slip", ""]
    words = static_text(path)
    assert "**Simulated.**" in words and "- truth: 0.200 s" in words and "one in" not in words


def test_touch_maps_are_pictures_and_arrows(trial: Path) -> None:
    """Assert that each map is where it is first shown: a picture of its cells, arrows in them, the centre above."""
    shear, patch = np.zeros((2, 2, 4, 5), np.float32), np.zeros((2, 4, 5), np.uint8)
    patch[1, 2, 3] = patch[1, 2, 4] = 1
    shear[1, 0, 2, 3] = shear[1, 1, 2, 4] = 1e4
    pressure = np.where(patch, 4e4, 0).astype(np.float32)
    write_touch(trial, {"map/shear_pa": shear, "map/pressure_pa": pressure, "map/patch": patch})
    path = rrd_of(trial)
    rows = rows_of(path)
    (first_us, _), (second_us, picture) = rows["/touch/pressure"]
    assert first_us == 0 and second_us == (SLICES - 5) * 1000  # the first image that ends with the map's slice
    with Image.open(io.BytesIO(bytes(picture["EncodedImage:blob"][0]))) as image:
        colours = np.array(image.convert("RGB"))
    assert colours.shape == (4, 5, 3)
    assert colours[2, 3].tolist() == colours[2, 4].tolist() == [253, 231, 37] and colours[0, 0].tolist() == [0, 0, 0]
    (_, none), (_, arrows) = rows["/touch/shear"]
    assert none["Arrows2D:vectors"] == []
    np.testing.assert_allclose(arrows["Arrows2D:vectors"], [[1, 0], [0, 1]], atol=1e-6)
    np.testing.assert_allclose(arrows["Arrows2D:origins"], [[3.0, 2.5], [4.5, 2.0]], atol=1e-6)
    assert {tuple(row["Points2D:positions"][0]) for _, row in rows["/touch/centre"]} == {(1.5, 1.5)}
    assert "40 kPa" in static_text(path) and "10 kPa of shear" in static_text(path)


def test_a_long_recording_is_thinned_and_says_so(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert every third event, rows of two slices and dots of every fourth slice, none of them shifted in time."""
    monkeypatch.setattr(rerun_file, "MOST_EVENTS", 4 * SLICES // 3)
    monkeypatch.setattr(rerun_file, "MOST_ROWS", SLICES // 2)
    monkeypatch.setattr(rerun_file, "MOST_DOTS", 6 * SLICES // 4)
    monkeypatch.setattr(rerun_file, "BLOCK_SLICES", 90)
    path = rrd_of(trial)
    rows = rows_of(path)
    with open_recording(trial) as recording:
        events = recording.between(0, SLICES)
    kept = np.arange(0, events.size, 3)
    shown = [(at, *place) for at, row in rows["/gel/events"] for place in row["Points2D:positions"]]
    assert shown == [(int(events.t[k]) // 2000 * 2000, float(events.x[k]), float(events.y[k])) for k in kept]
    assert [at for at, _ in rows["/gel/events"]] == list(range(0, 1000 * SLICES, 2000))
    assert [at for at, _ in rows["/gel/dots"]] == list(range(0, 1000 * SLICES, 4000))
    np.testing.assert_array_equal(rows["/gel/dots"][3][1]["Points2D:positions"], moving()[12].astype(np.float32))
    words = static_text(path)
    for said in ("1,200 events one in 3", "2 ms at a time", "Of `gel/dots` one slice in 4"):
        assert said in words


def test_dots_that_nobody_knows_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a place that is not a number is not drawn, and a part of a trial begins at its time."""
    path = tmp_path / "a.recording.h5"
    header = write_recording(path, truth=False)
    dots, grid = moving(), REST.copy()
    dots[:, 2] = grid[0, 2] = np.nan
    monkeypatch.setitem(SENSOR, "sensor/dot_xy_px", grid)
    write_tracks(path.with_name("a.tracks.h5"), header, dots)
    rows = rows_of(rrd_of(path, start_s=0.02, stop_s=0.05))
    for name, column in (("/gel/dots", "Points2D:positions"), ("/gel/displacement", "Arrows2D:vectors")):
        assert [(at, len(row[column])) for at, row in rows[name]] == [(1000 * k, 5) for k in range(20, 50)]
    assert "/gel/true_dots" not in rows and "Simulated" not in static_text(path.with_name("a.rrd"))


def test_an_empty_recording_and_tracks_alone(tmp_path: Path) -> None:
    """Assert that a recording without a slice, and files without their recording, make a file too."""
    path = tmp_path / "a.recording.h5"
    header = write_recording(path, slices=0, truth=False)
    assert rows_of(rrd_of(path)) == {}
    path.unlink()
    path.with_name("a.rrd").unlink()
    header = write_recording(path)
    write_tracks(path.with_name("a.tracks.h5"), header, moving())
    write_labels(path.with_name("a.labels.h5"), header)
    path.unlink()
    assert {"/gel/dots", "/gel/displacement", "/slip/label"} <= rows_of(rrd_of(path.with_name("a.tracks.h5"))).keys()


@pytest.mark.slow
def test_a_file_that_is_not_complete_is_no_file(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what the disk did not take leaves words and nothing else; rerun itself says nothing."""
    disconnect = rerun.RecordingStream.disconnect

    def cut(stream: Any) -> None:
        disconnect(stream)
        (unfinished,) = trial.parent.glob(".a.rrd.*")
        unfinished.write_bytes(unfinished.read_bytes()[:-100])

    monkeypatch.setattr(rerun.RecordingStream, "disconnect", cut)
    with pytest.raises(InputError, match="the file is not complete"):
        rrd_of(trial)
    assert list(trial.parent.glob("*.rrd")) == []
