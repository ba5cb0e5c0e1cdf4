"""The smallest valid file of each kind, written in milliseconds, for tests that change one thing and read the file."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest

from evetac_cli import resources
from evetac_cli.events import SLICE_US, Events, slice_starts
from evetac_cli.store import files
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.streams import mark_row
from tests.make import event_arrays, label_arrays, truth_arrays, write_recording

SLICES = 24
ROWS, COLUMNS = 3, 4
DOTS = ROWS * COLUMNS
EVENTS_A_SLICE = 10
ONSET = 15
FRAME_PX = (640, 480)
GRID_PX = np.stack(np.meshgrid([100.0, 200.0, 300.0, 400.0], [100.0, 200.0, 300.0]), axis=-1)
TRACKER = {"preset": "default", "constants": {}}


def _sensor() -> dict[str, Any]:
    return {
        "sensor/frame_px": np.array(FRAME_PX, np.int32),
        "sensor/name": "evetac",
        "sensor/dot_xy_px": GRID_PX.copy(),
        "sensor/dot_radius_px": np.float64(15.0),
        "sensor/contrast_over_threshold": np.float64(8.0),
        "sensor/shear_modulus_pa": np.float64(145e3),
        "sensor/window_px": np.array([540, 0, 640, 480], np.int32),
    }


def events() -> Events:
    """Return a given number of events in each slice, all over the frame."""
    rng = np.random.default_rng(0)
    count = SLICES * EVENTS_A_SLICE
    t = np.arange(count, dtype=np.int64) * (1000 // EVENTS_A_SLICE)
    x, y = (rng.integers(0, size, count).astype(np.uint16) for size in FRAME_PX)
    return Events(t, x, y, rng.integers(0, 2, count).astype(np.uint8))


def recording_of(path: Path, counts: list[int]) -> Path:
    """Write a recording with a given number of events in each slice, and nothing else."""
    of_slice = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
    x, y = ((of_slice % size).astype(np.uint16) for size in FRAME_PX)
    events = Events(of_slice * SLICE_US, x, y, (of_slice % 2).astype(np.uint8))
    return write_recording(path, event_arrays(events, len(counts)))


def recording(path: Path, *, lost_slices: bool = True) -> Header:
    """Write a simulated recording with every group."""
    made = events()
    slices = np.arange(SLICES)
    steps = SLICES // 2
    spread = np.array([1.0, 2.0, 3.0])
    arrays = {
        **{f"events/{name}": getattr(made, name) for name in Events._fields},
        "ms_to_idx": slice_starts(made.t, SLICES),
        "t_offset": np.int64(0),
        **_sensor(),
        "gripper/t_us": np.arange(steps, dtype=np.int64) * 2000,
        "gripper/current_target_ma": np.full(steps, np.nan),
        "gripper/current_written_ma": np.zeros(steps, np.int32),
        "gripper/current_ma": np.zeros(steps, np.float32),
        "gripper/position_ticks": np.full(steps, 400, np.int32),
        "capture/ended": "the end",
        "capture/slices_per_s": np.float64(1000.0),
        "capture/commands_per_s": np.float64(500.0),
        "capture/lost/camera.dropped": np.int64(0),
        "capture/lost_slices": np.array([[2, 4], [6, 7]] if lost_slices else np.empty((0, 2)), np.int64),
        "capture/clock_offset_us": np.float64(0.0),
        "capture/command_misses": np.int64(0),
        "capture/command_us": spread,
        "capture/slice_late_us": spread,
        "capture/step_late_us": spread,
        "capture/latency_us": spread,
        "capture/released_us": np.float64(0.0),
        "capture/scheduling": "normal",
        **truth_arrays(np.tile(GRID_PX.reshape(1, DOTS, 2), (SLICES, 1, 1)), slices >= ONSET, 1.0),
        "truth/tone_hz": np.zeros(SLICES, np.float32),
        "truth/tone_amplitude_um": np.zeros(SLICES, np.float32),
        "control/t_us": np.arange(steps, dtype=np.int64) * 2000,
        "control/u_ff_ticks": np.zeros(steps, np.float32),
        "control/x_ref_ticks": np.full(steps, np.nan, np.float32),
        "control/goal_ticks": np.full(steps, 400, np.int32),
        "control/slip": np.zeros(steps, np.uint8),
        "control/phase": np.repeat([0, 1, 2], steps // 3).astype(np.uint8),
        "control/missed": np.zeros(steps, np.int32),
        "control/slices_processed": np.arange(steps, dtype=np.int64),
        "control/outcome": "{}",
        "control/probability": np.full(SLICES, np.nan, np.float32),
        **{name: np.array([value]) for name, value in mark_row(4200, "lifted").items()},
        "streams/arm/t_us": np.arange(5, dtype=np.int64) * 5000,
        "streams/arm/about": '{"what": "pose of the arm", "units": {"x_m": "m"}}',
        "streams/arm/x_m": np.linspace(0.0, 1.0, 5),
        "streams/wrist/t_us": np.array([0, 12_000], np.int64),
        "streams/wrist/about": '{"what": "camera at the wrist"}',
        "streams/wrist/frames": np.zeros((2, 6, 8, 3), np.uint8),
    }
    return write_stage(path, Recipe("recording", 1, {}, seed=1, simulated_source=True), arrays, force=True)


def tracks(path: Path, of: Header) -> Header:
    """Write tracks of dots that do not move."""
    arrays = {
        "dot_xy_px": np.broadcast_to(GRID_PX.reshape(1, DOTS, 2), (SLICES, DOTS, 2)).astype(np.float32),
        "events_per_dot": np.ones((SLICES, DOTS), np.int32),
        "lost": np.zeros((SLICES, DOTS), np.uint8),
        **_sensor(),
    }
    return write_stage(path, Recipe("tracks", 1, TRACKER, parents=(of,)), arrays, force=True)


def _label() -> Any:
    return np.where(np.arange(SLICES) >= ONSET, 1, 0).astype(np.int8)


def labels(path: Path, of: Header) -> Header:
    """Write labels with slip that starts at ONSET."""
    recipe = Recipe("labels", 1, {"method": "truth"}, parents=(of,))
    return write_stage(path, recipe, label_arrays(_label(), ONSET), force=True)


def unsure_labels(path: Path, of: Header) -> Header:
    """Write labels with an uncertain onset, within a slice of ONSET."""
    label = _label()
    label[ONSET - 1 : ONSET + 2] = -1
    interval = {"earliest_slice": np.int64(ONSET - 1), "latest_slice": np.int64(ONSET + 1)}
    arrays = label_arrays(label, ONSET) | interval | {"abstained": np.uint8(1), "doubt": "it slides slowly"}
    return write_stage(path, Recipe("labels", 1, {"method": "event-flow"}, parents=(of,)), arrays, force=True)


def features(path: Path, of: tuple[Header, ...]) -> Header:
    """Write labelled features with images of two pixels per slice."""
    arrays = {
        "displacement_px": np.zeros((SLICES, DOTS), np.float32),
        "displacement_xy_px": np.zeros((SLICES, DOTS, 2), np.float32),
        "events_per_dot": np.ones((SLICES, DOTS), np.int32),
        "events_total": np.full(SLICES, EVENTS_A_SLICE, np.int32),
        "events_outside": np.full(SLICES, EVENTS_A_SLICE, np.int32),
        "sensor/contrast_over_threshold": np.float64(8.0),
        "sensor/shear_modulus_pa": np.float64(145e3),
        "gripper_position_ticks": np.full(SLICES, 300.0, np.float32),
        "gripper_goal_ticks": np.full(SLICES, np.nan, np.float32),
        "gripper_goal_ma": np.full(SLICES, 60.0, np.float32),
        "sticking_share": np.ones(SLICES, np.float32),
        "truth/visible_slip_share": np.zeros(SLICES, np.float32),
        "label": _label(),
        "onset_slice": np.int64(ONSET),
        "dot_shape": np.array([ROWS, COLUMNS], np.int32),
        "image/start": np.arange(SLICES + 1, dtype=np.int64) * 2,
        "image/pixel": np.tile(np.array([0, 539], np.uint32), SLICES),
        "image/sign": np.tile(np.array([1, -1], np.int8), SLICES),
    }
    return write_stage(path, Recipe("features", 1, {}, parents=of), arrays, force=True)


def force_model(path: Path, of: Header) -> Header:
    """Write a force model with hidden layers of 5 and 4."""
    inputs = 2 * DOTS
    arrays = {
        "sensor": "events",
        "sensor_name": "evetac",
        "dot_shape": np.array([ROWS, COLUMNS], np.int32),
        "regression/slope_n_px": np.eye(2),
        "regression/offset_n": np.zeros(2),
        "network/scale_px": np.float64(1.0),
        "network/scale_n": np.float64(1.0),
        "network/0/weight": np.zeros((5, inputs), np.float32),
        "network/0/bias": np.zeros(5, np.float32),
        "network/1/weight": np.zeros((4, 5), np.float32),
        "network/1/bias": np.zeros(4, np.float32),
        "network/2/weight": np.zeros((2, 4), np.float32),
        "network/2/bias": np.zeros(2, np.float32),
        "curve/learned_n": np.array([2.0, 1.0]),
        "curve/held_out_n": np.array([2.0, 1.0]),
        "curve/chosen": np.int64(1),
    }
    return write_stage(path, Recipe("force-model", 1, {}, parents=(of,)), arrays, force=True)


def touch_arrays(slices: int = SLICES) -> dict[str, Any]:
    """Return a touch of 1 N of shear and 2 N of pressure in all slices, with two maps of 4 x 5 cells."""

    def everywhere(value: float, *shape: int) -> Any:
        return np.full(shape, value, np.float32)

    flags, maps = np.ones(slices, np.uint8), (2, 4, 5)
    return {
        **{"known": flags, "touches": flags, "reference_slice": np.zeros(slices, np.int64)},
        **{name: everywhere(1.0, slices, 2) for name in ("shear_n", "shear_since_n", "centre_mm")},
        **{name: everywhere(0.1, slices, 2) for name in ("shear_sd_n", "shear_since_sd_n", "centre_sd_mm")},
        **{"normal_n": everywhere(2.0, slices), "area_mm2": everywhere(20.0, slices)},
        **{"torsion_n_mm": everywhere(0.5, slices), "sticking_share": everywhere(0.75, slices)},
        **{name: everywhere(0.2, slices) for name in ("normal_sd_n", "torsion_sd_n_mm", "area_sd_mm2")},
        **{"sticking_share_sd": everywhere(0.1, slices), "slip_direction_rad": everywhere(0.0, slices)},
        **{"map/slice": np.array([0, slices - 1]), "map/x_mm": np.arange(5.0), "map/y_mm": np.arange(4.0)},
        **{"map/patch": np.ones(maps, np.uint8), "map/shear_pa": everywhere(5e4, 2, 2, 4, 5)},
        **{"map/shear_sd_pa": everywhere(1e3, 2, 2, 4, 5), "map/pressure_pa": everywhere(1e5, *maps)},
        "map/pressure_sd_pa": everywhere(2e3, *maps),
    }


def touch(path: Path, of: Header) -> Header:
    """Write the touch of `touch_arrays`."""
    return write_stage(path, Recipe("touch", 1, {}, parents=(of,)), touch_arrays(), force=True)


def report(path: Path) -> Header:
    """Write a report of one row."""
    arrays = {"command": "evaluate slip", "rows": '[{"f1": 0.5, "object": "8"}]', "summary": '{"f1": 0.5}'}
    return write_stage(path, Recipe("report", 1, {}), arrays, force=True)


def every_kind(folder: Path, *, lost_slices: bool = True) -> dict[str, Path]:
    """Write a small valid file of every kind, all of one trial, with the pretrained model; return paths by kind."""
    paths = {}
    for kind, content in _every_kind(lost_slices).items():
        paths[kind] = folder / f"a.{kind}.h5"
        paths[kind].write_bytes(content)
    return paths


@cache
def _every_kind(lost_slices: bool) -> dict[str, bytes]:
    """Return the contents of the files, made once for all tests of a process."""
    with TemporaryDirectory() as folder:
        return {kind: path.read_bytes() for kind, path in _make_every_kind(Path(folder), lost_slices).items()}


def _make_every_kind(folder: Path, lost_slices: bool) -> dict[str, Path]:
    paths = {
        kind: folder / f"a.{kind}.h5"
        for kind in ("recording", "tracks", "labels", "features", "model", "force-model", "touch", "report")
    }
    of_recording = recording(paths["recording"], lost_slices=lost_slices)
    of_tracks = tracks(paths["tracks"], of_recording)
    of_labels = labels(paths["labels"], of_recording)
    features(paths["features"], (of_recording, of_tracks, of_labels))
    force_model(paths["force-model"], of_tracks)
    touch(paths["touch"], of_tracks)
    report(paths["report"])
    shutil.copy(resources.MODEL, paths["model"])
    return paths


def remove_dimensions(h5: h5py.File) -> None:
    """Remove the named dimensions from a file, so that its datasets may have other shapes."""
    names: list[str] = []
    h5.visititems(lambda name, item: names.append(name) if item.attrs.get("CLASS") == b"DIMENSION_SCALE" else None)
    for name in names:
        del h5[name]


@contextmanager
def nonsense_is_written() -> Iterator[None]:
    """Within the block, write files without checking their values, like a foreign program might."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_check_new", lambda *_: None)
        yield
