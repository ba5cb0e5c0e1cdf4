"""What a live view shows is what track and grasp would say of the same slices."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import Events
from evetac_cli.kernels.tracking import presets, tracker
from evetac_cli.stages.touch.known_gel import MM_PER_PX, KnownGel, gel_of
from evetac_cli.stages.touch.touch_fold import TouchFold
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.trials.grasp.online_detector import open_view_detector
from evetac_cli.trials.live_view.samples import MOST_BEHIND, MOST_COUNT, SHOWN_MS, Follower, LiveTouch
from evetac_cli.trials.live_view.shared_view import SharedView
from tests.conftest import Made

SLICES = 200


def refuse(sensor: object) -> None:
    raise InputError("the model is for another dot grid")


def of_pixels(xyp: list[tuple[int, int, int]]) -> Events:
    x, y, p = np.array(xyp).reshape(-1, 3).T
    return Events(np.zeros(len(x), np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


@pytest.mark.parametrize("by", [1, 7, 50])
def test_dots_and_slip_are_those_of_the_detector(made: Made, by: int) -> None:
    """Assert dots and probability as of the detector on the same slices, however many come at a time."""
    open_detector = partial(open_view_detector, made.model, "stable", 0.4)
    with open_recording(made.recordings[0]) as recording:
        slices, sensor = [recording[k] for k in range(SLICES)], recording.sensor_datasets()
    shared = SharedView()
    follower = Follower(shared)
    follower.begin(sensor, open_detector)
    expected = open_detector(sensor)
    for k, events in enumerate(slices):
        shared.add_slice(events)
        expected.step(events)
        if (k + 1) % by == 0:
            sample = follower.sample()
            assert sample["slices"] == k + 1
    follower.sample()
    dots = np.array(follower.dots())
    tracking = expected.tracking
    np.testing.assert_allclose(dots[:, :2], tracking.dot_xy_px, atol=0.006)
    np.testing.assert_allclose(dots[:, 2:4], tracking.dot_xy_px - tracking.rest_xy_px, atol=0.006)
    assert follower.left_out == 0
    assert follower.threshold == 0.4
    if by == 1:
        assert sample["probability"] == pytest.approx(expected.probability, rel=1e-4)
        assert sample["normal_n"] is not None
        assert sample["normal_n"] >= 0


def test_without_a_grid_there_are_events_and_a_reason() -> None:
    """Assert that a camera of which no dots are known shows its events, and says what it cannot show."""
    shared = SharedView()
    follower = Follower(shared)
    follower.begin({"sensor/frame_px": np.array([640, 480], np.int32)}, refuse)
    shared.add_slice(of_pixels([(1, 2, 1)]))
    sample = follower.sample()
    assert sample["events_per_s"] == 1000.0
    assert sample["probability"] is None
    assert follower.dots() == []
    assert "--calibration" in follower.notes[0]


def test_another_grid_is_tracked_without_slip(made: Made) -> None:
    """Assert that dots are shown where the model is for another grid, and that this is said."""
    with open_recording(made.recordings[0]) as recording:
        sensor = recording.sensor_datasets()
    follower = Follower(SharedView())
    follower.begin(sensor, refuse)
    assert len(follower.dots()) == np.isfinite(sensor["sensor/dot_xy_px"][..., 0]).sum()
    assert follower.notes == ["no slip: the model is for another dot grid"]
    assert follower.sample()["probability"] is None


def test_touch_is_of_a_frame_whose_scale_is_known(made: Made) -> None:
    """Assert that on another frame than an Evetac's no touch is shown, which is said."""
    with open_recording(made.recordings[0]) as recording:
        sensor = recording.sensor_datasets()
    for frame_px, shown in (((640, 480), True), ((800, 600), False)):
        follower = Follower(SharedView())
        follower.begin({**sensor, "sensor/frame_px": np.array(frame_px, np.int32)}, refuse)
        assert ("normal_n" in follower.sample()) == shown == (follower.touch_map() is not None)
        assert any("no touch" in note for note in follower.notes) != shown


def _pushed(rest_px: np.ndarray, by_px: float) -> np.ndarray:
    """Dots that a contact at the middle pulls right."""
    away = rest_px - [320, 240]
    return rest_px + by_px * np.exp(-(away**2).sum(axis=1) / (2 * 80**2))[:, None] * [1.0, 0.0]


def test_touch_is_what_predict_touch_tells(tmp_path: Path) -> None:
    """Assert forces, torsion and map as in a touch file of the same dots: before, at the begin of and after a touch."""
    grid = np.stack(np.meshgrid(np.arange(60.0, 560, 62), np.arange(40.0, 420, 62)), -1)
    sensor = {
        "sensor/frame_px": np.array([640, 480], np.int32),
        "sensor/name": "evetac",
        "sensor/dot_xy_px": grid,
        "sensor/dot_radius_px": np.float64(9.0),
        "sensor/shear_modulus_pa": np.float64(120e3),
    }
    tracking = tracker.start(grid.reshape(-1, 2), presets.PRESETS["stable"].for_dots(9.0))
    dots = np.stack([_pushed(tracking.rest_xy_px, by_px) for by_px in (0.0, 10.0, 0.0)])
    arrays = {"dot_xy_px": dots.astype(np.float32), **sensor}
    arrays |= {"events_per_dot": np.zeros(dots.shape[:2], np.int32), "lost": np.zeros(dots.shape[:2], np.uint8)}
    recording = Recipe("recording", 1, {}, seed=1, simulated_source=True).header()
    path = tmp_path / "a.tracks.h5"
    write_stage(path, Recipe("tracks", 1, {"preset": "stable"}, parents=(recording,)), arrays)
    live = LiveTouch(sensor, tracking, 1e-3)
    assert live.map() is None
    with StageFile(path, "tracks") as tracks:
        expected = TouchFold(gel_of(KnownGel(shear_modulus_pa=120e3), 0.1), tracks, 1).block(0, 3)
    for number, place in enumerate(dots):
        tracking.dot_xy_px[...] = place.astype(np.float32)
        now, shown = live.now(), live.map()
        assert shown is not None
        for name in ("normal_n", "normal_sd_n", "torsion_n_mm", "torsion_sd_n_mm", "area_mm2"):
            assert now[name] == pytest.approx(expected[name][number], rel=1e-5, abs=1e-6, nan_ok=True), name
        shear = [now["shear_x_n"], now["shear_y_n"]]
        assert shear == pytest.approx(expected["shear_n"][number], rel=1e-5, abs=1e-6)
        patch = expected["map/patch"][number]
        assert (shown["rows"], shown["columns"]) == patch.shape
        assert [cell for cell, *_ in shown["cells"]] == np.flatnonzero(patch).tolist()
        told = np.stack([expected["map/pressure_pa"][number], *expected["map/shear_pa"][number]]).reshape(3, -1)
        for cell, *kpa in shown["cells"]:
            assert kpa == pytest.approx(told[:, cell] * 1e-3, abs=6e-4)
        assert (len(shown["cells"]) > 4) == (now["shear_x_n"] > 0.1) == (number == 1)
        assert (shown["centre_mm"] is None) == (number != 1)
        json.dumps(shown, allow_nan=False)


def test_touch_follows_and_survives_lost_dots() -> None:
    """Assert that a patch follows a contact that moves within a few samples, and that without dots nothing is known."""
    grid = np.stack(np.meshgrid(np.arange(60.0, 560, 62), np.arange(40.0, 420, 62)), -1)
    tracking = tracker.start(grid.reshape(-1, 2), presets.PRESETS["stable"].for_dots(9.0))
    live = LiveTouch({"sensor/frame_px": (640, 480)}, tracking, 0.05)
    centres = []
    for shift_px in (0.0, 120.0):
        for _ in range(8):
            tracking.dot_xy_px[...] = tracking.rest_xy_px - shift_px * np.array([1.0, 0.0])
            moved = _pushed(tracking.dot_xy_px, 10.0) - tracking.dot_xy_px
            tracking.dot_xy_px[...] = tracking.rest_xy_px + moved
            live.now()
        shown = live.map()
        assert shown is not None
        centres.append(shown["centre_mm"])
    assert centres[1][0] - centres[0][0] == pytest.approx(120 * MM_PER_PX, abs=1.0)
    tracking.lost[...] = True
    now, shown = live.now(), live.map()
    assert np.isnan(now["normal_n"]) and shown is not None and not shown["known"] and shown["cells"] == []
    json.dumps(shown, allow_nan=False)


def test_a_picture_counts_the_events_of_each_polarity() -> None:
    """Assert each pixel's counts, clipped, of the latest SHOWN_MS slices alone, without what lies beside the frame."""
    shared = SharedView()
    follower = Follower(shared)
    follower.begin({"sensor/frame_px": np.array([64, 48], np.int32)}, refuse)
    shared.add_slice(of_pixels([(0, 0, 1)]))  # too old
    shared.add_slice(of_pixels([(5, 7, 1)] * 2 + [(5, 7, 0)] * 40 + [(63, 47, 1), (64, 0, 1), (0, 48, 0)]))
    for _ in range(SHOWN_MS - 1):
        shared.add_slice(of_pixels([]))
    follower.sample()
    image = np.frombuffer(follower.image(), np.uint8).reshape(48, 64)
    expected = np.zeros((48, 64), np.uint8)
    expected[7, 5] = 2 | MOST_COUNT << 4
    expected[47, 63] = 1
    np.testing.assert_array_equal(image, expected)


def test_who_is_far_behind_goes_on_at_the_newest() -> None:
    """Assert that a view that was stopped shows the newest slices, and counts those that it left out."""
    shared = SharedView()
    follower = Follower(shared)
    follower.begin({"sensor/frame_px": np.array([640, 480], np.int32)}, refuse)
    for _ in range(MOST_BEHIND + 100):
        shared.add_slice(of_pixels([(1, 1, 1)]))
    sample = follower.sample()
    assert sample["slices"] == MOST_BEHIND + 100
    assert follower.left_out == MOST_BEHIND + 100 - SHOWN_MS
    assert sample["events_per_s"] == 1000.0
