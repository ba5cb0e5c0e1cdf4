"""Frames of any size: a moving grid is calibrated, recorded, tracked, labelled, featurized and shown in each."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import evetac_cli
from evetac_cli.events import FRAME_PX, concatenate
from evetac_cli.kernels.calibration import grid
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.store.files import StageFile, header_of
from tests.make import answer_of, evetac
from tests.quick import slow

FRAMES = [(346, 260), (260, 346)]
LARGER = [(320, 320), (480, 640), (640, 480), (1280, 720)]
RADIUS_PX, BORDER_PX, WINDOW_PX = 10.0, 18, 60  # the last column's rims come as near as 4 px to the border
SLICES, MOVES, SLIPS, FAR_PX = 560, 200, 400, 4.0  # the dots move by FAR_PX from MOVES to SLIPS
TEXTURE = 500.0  # events per pixel of the object's motion, in the window
SLIDES = 5  # times as fast as the dots before, the object moves once it slips
WORST_PX = 0.2


def grid_of(frame_px: tuple[int, int]) -> NDArray[np.float64]:
    """Return dots (rows, columns, 2) from the window at the left to the other borders, about 50 px apart."""
    width, height = frame_px
    x = np.linspace(WINDOW_PX + 20, width - 1 - BORDER_PX, (width - WINDOW_PX) // 50)
    y = np.linspace(BORDER_PX, height - 1 - BORDER_PX, min(height // 50, grid.MOST_DOTS // len(x)))
    return np.stack(np.meshgrid(x, y), axis=-1)


def write_events(path: Path, frame_px: tuple[int, int], dots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Write what a camera sees of dots that move to the right; return their displacement after each slice.

    An object in the window moves with them, and goes on after SLIPS.
    """
    moved_px = FAR_PX * np.clip((np.arange(SLICES + 1) - MOVES) / (SLIPS - MOVES), 0.0, 1.0)
    rest = dots.reshape(-1, 2)
    places = rest + np.stack([moved_px, 0.3 * moved_px], axis=1)[:, None]
    model = camera.CameraModel(frame_px=frame_px, noise_rate_hz=0.03, hot_pixels=0, dot_radius_px=RADIUS_PX)
    state, rng = camera.start(model, rest, None, np.random.default_rng(0)), np.random.default_rng(1)
    still = (0.0, 0.0)
    slices = []
    for k in range(SLICES):
        seen = camera.step(state, SliceMotion(places[k], places[k + 1], still, still, 0.0), 1000 * k, rng)
        speed = FAR_PX / (SLIPS - MOVES) * ((k >= MOVES) + (SLIDES - 1) * (k >= SLIPS))
        many = rng.poisson(TEXTURE * speed)
        t = np.sort(1000 * k + rng.integers(0, 1000, many))
        x, y, p = (rng.integers(0, most, many) for most in (WINDOW_PX, frame_px[1], 2))
        slices += [seen, type(seen)(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))]
    events = concatenate(slices)
    order = np.argsort(events.t, kind="stable")
    np.savez(path, **{name: column[order] for name, column in events._asdict().items()})
    return places[1:] - rest


@pytest.mark.parametrize(
    "frame_px",
    [*FRAMES, *(slow((frame_px,)) for frame_px in LARGER)],
    ids=lambda frame: "{} x {}".format(*frame),
)
def test_any_frame(tmp_path: Path, frame_px: tuple[int, int]) -> None:
    """Assert that every column is tracked to 0.2 px, at the border as well, and that the other stages know the frame.

    Each stage is a command. The onset of slip is when the dots stop and the object goes on.
    """
    width, height = frame_px
    dots = grid_of(frame_px).round(3)  # as in files
    table = {"frame_px": frame_px, "radius_px": RADIUS_PX, "window_px": [0, 0, WINDOW_PX, height]}
    (tmp_path / "dots.json").write_text(json.dumps(table | {"dot_xy_px": dots.tolist()}))
    moved_px = write_events(tmp_path / "events.npz", frame_px, dots)
    rows, columns = dots.shape[:2]
    size = ("--rows", rows, "--columns", columns, "--gel", "cut")
    gel, recording = tmp_path / "gel.json", tmp_path / "a.recording.h5"
    answer_of("calibrate", "--import", tmp_path / "dots.json", *size, "-o", gel)
    frame = f"{width}x{height}"
    answer_of("record", "--from", tmp_path / "events.npz", "--frame-size", frame, "--calibration", gel, "-o", recording)
    answer_of("track", recording)
    with StageFile(tmp_path / "a.tracks.h5", "tracks") as tracks:
        places = tracks.read("dot_xy_px")
        assert tracks.read("sensor/frame_px").tolist() == [width, height]
        assert not tracks.read("lost").any()
    off_px = (places - dots.reshape(-1, 2) - moved_px[: len(places)]).reshape(-1, rows, columns, 2)[MOVES:]
    of_column = np.linalg.norm(off_px.mean(axis=1), axis=-1).max(axis=0)
    assert of_column.max() < WORST_PX, of_column
    (label,) = answer_of("label", recording)["rows"]
    assert abs(label["onset_ms"] - SLIPS) < 10
    answer_of("featurize", recording, "--sticking-share")
    other = None if frame_px == FRAME_PX else [width, height]  # recipes of an Evetac's frame do not name it
    assert header_of(tmp_path / "a.labels.h5")["parameters"].get("frame_px") == other
    with StageFile(tmp_path / "a.features.h5", "features") as features:
        assert features.header["parameters"].get("frame_px") == other
        np.testing.assert_allclose(features.read("displacement_xy_px"), places - dots.reshape(-1, 2), atol=1e-4)
    answer_of("view", recording)
    assert f'"frame": [{width}, {height}]' in (tmp_path / "a.html").read_text()
    with evetac_cli.open_recording(recording) as seen:
        tracker = evetac_cli.DotTracker(evetac_cli.Gel(dots, RADIUS_PX, frame_px=frame_px))
        for events in seen:
            last = tracker.step(events)
    np.testing.assert_array_equal(last.astype(np.float32), places[-1])


def test_larger_frames_and_more_dots_are_refused(tmp_path: Path) -> None:
    """Assert that calibrate names the tracker's limits for a frame, and for dots in rows and in one row."""
    path = tmp_path / "dots.json"
    whole = np.stack(np.meshgrid(20.0 * np.arange(1, 18), 20.0 * np.arange(1, 17)), axis=-1)
    for frame_px, dots, limit in (
        ((grid.MOST_FRAME_PX + 1, 480), whole[:4], f"<= {grid.MOST_FRAME_PX}"),
        ((640, 480), whole, f"272 dots, more than {grid.MOST_DOTS}, the limit of the tracker"),
        ((640, 480), whole.reshape(1, -1, 2), f"more than {grid.MOST_DOTS}, the limit of the tracker"),
    ):
        path.write_text(json.dumps({"frame_px": frame_px, "radius_px": 5.0, "dot_xy_px": dots.tolist()}))
        refused = evetac("calibrate", "--import", path, "-o", tmp_path / "gel.json")
        assert refused.exit_code == 2
        assert limit in " ".join(refused.stderr.split())
