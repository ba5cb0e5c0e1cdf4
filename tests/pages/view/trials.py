"""Small trials for the tests of view: a recording, tracks and labels, and what is drawn of them."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.commands.view import View
from evetac_cli.events import slice_starts
from evetac_cli.pages.view import collect_view
from evetac_cli.pages.view.trial_files import open_trial
from evetac_cli.pages.view.view_data import ViewData
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from tests import small_files
from tests.make import truth_arrays

SLICES = 300
ONSET = 200
GRIPPED = 100  # in a grasp
WIDTH, HEIGHT = 64, 48
REST = np.stack(np.meshgrid([10.0, 25.0, 40.0], [12.0, 32.0]), axis=-1)
NASTY = "</script><script>document.title='owned'</script><!-- \"quoted\" 'single' & ünïcode \u2028"
SENSOR = {
    "sensor/frame_px": np.array([WIDTH, HEIGHT], np.int32),
    "sensor/name": "evetac",
    "sensor/dot_xy_px": REST,
    "sensor/dot_radius_px": np.float64(3.0),
    "sensor/window_px": np.array([50, 0, WIDTH, HEIGHT], np.int32),
}


def write_recording(
    path: Path,
    slices: int = SLICES,
    rate: int = 4,
    *,
    truth: bool = True,
    scene: str = "slip",
    grasp: bool = False,
    number: int = 8,
    seed: int = 1,
    more: dict[str, Any] | None = None,
    sensor: dict[str, Any] | None = None,
) -> Header:
    """A recording whose events wander over the frame, `rate` a slice; of a grasp, or of a slip of object `number`.

    more: datasets beside. sensor: parameters of another sensor.
    """
    rng = np.random.default_rng(5)
    t = np.repeat(np.arange(slices, dtype=np.int64) * 1000, rate)
    count = len(t)
    arrays: dict[str, Any] = {
        "events/t": t,
        "events/x": ((t // 1000 + rng.integers(0, 8, count)) % WIDTH).astype(np.uint16),
        "events/y": rng.integers(0, HEIGHT, count).astype(np.uint16),
        "events/p": rng.integers(0, 2, count).astype(np.uint8),
        "ms_to_idx": slice_starts(t, slices),
        "t_offset": np.int64(0),
        **SENSOR,
        **(more or {}),
    }
    if truth:
        commands = np.arange(0, slices, 2)
        arrays |= {
            "gripper/t_us": commands * 1000,
            "gripper/current_target_ma": np.linspace(20.0, 0.0, len(commands)),
            "gripper/current_written_ma": np.zeros(len(commands), np.int32),
            "gripper/current_ma": np.linspace(20.0, 0.0, len(commands)).astype(np.float32),
            "gripper/position_ticks": np.full(len(commands), 300, np.int32),
            **truth_arrays(
                np.tile(REST.reshape(1, -1, 2), (slices, 1, 1)),
                slip=np.arange(slices) >= ONSET,
                normal_n=np.linspace(2.0, 1.0, slices),
                shear_n=1.0,
            ),
        }
    parameters: dict[str, Any] = {"scene": {"name": scene, "summary": scene}, "object": number, "sensor": "evetac"}
    parameters["slices"] = slices
    if grasp:
        arrays |= _grasp(slices)
        parameters |= {
            "controller": "paper",
            "slip_threshold": 0.4,
            "object_row": {"material": "paper", "width_mm": 35.0, "height_mm": 145.0},
            "sensor_row": {"mm_per_px": 0.05},
        }
    parameters |= sensor or {}
    path.unlink(missing_ok=True)
    return write_stage(path, Recipe("recording", 1, parameters, seed=seed, simulated_source=truth), arrays)


def _grasp(slices: int) -> dict[str, Any]:
    """What a grasp has beside: gripped in slice GRIPPED, balanced from 200 on; slip is said at 10 and at 250."""
    commands = np.arange(0, slices, 2)
    moved = np.zeros((slices, 2), np.float32)
    moved[:, 0] = np.arange(slices) / 100
    return {
        "gripper/current_target_ma": np.full(len(commands), np.nan),
        "truth/slip": np.zeros(slices, np.uint8),
        "truth/object_xy_px": moved,
        "truth/table_gap_mm": np.linspace(0, 60, slices).astype(np.float32),
        "control/t_us": commands * 1000,
        "control/u_ff_ticks": np.zeros(len(commands), np.float32),
        "control/x_ref_ticks": np.full(len(commands), 300, np.float32),
        "control/goal_ticks": np.full(len(commands), 310, np.int32),
        "control/slip": np.isin(commands, (10, 250)).astype(np.uint8),
        "control/phase": np.select([commands <= GRIPPED, commands < 200], [0, 1], 2).astype(np.uint8),
        "control/outcome": json.dumps({"lifted": True, "balanced": True, "moved_mm": 1.2, "force_end_n": 3.0}),
        "control/probability": np.full(slices, 0.1, np.float32),
    }


def write_tracks(path: Path, parent: Header, dots: np.ndarray, lost: np.ndarray | None = None) -> Header:
    """Tracks of (slices, 6, 2); lost: (slices, 6), none unless given."""
    arrays = {
        "dot_xy_px": dots.astype(np.float32),
        "events_per_dot": np.zeros(dots.shape[:2], np.int32),
        "lost": np.zeros(dots.shape[:2], np.uint8) if lost is None else lost,
        **SENSOR,
    }
    path.unlink(missing_ok=True)
    return write_stage(path, Recipe("tracks", 1, {"preset": "paper"}, parents=(parent,)), arrays)


def moving(slices: int = SLICES) -> np.ndarray:
    """Dots that go right by 4 px in all."""
    return REST.reshape(1, -1, 2) + np.linspace(0, 4, slices)[:, None, None] * np.array([1.0, 0.0])


def write_labels(
    path: Path,
    parent: Header,
    onset: int = ONSET + 3,
    ends: int | None = None,
    *,
    slices: int = SLICES,
    begins: int = 50,
    relative_flow_px: np.ndarray | None = None,
    unknown: int = -1,
    arrays: Mapping[str, Any] = MappingProxyType({}),
    **more: Any,
) -> Header:
    """Labels that examine the slices [begins, ends), but so many either way of the onset; `more`: their parameters.

    arrays: datasets beside the usual ones.
    """
    label = np.full(slices, -1, np.int8)
    label[begins:ends] = 0
    label[onset:ends] = 1
    if unknown >= 0:
        label[onset - unknown : onset + unknown + 1] = -1
    flow = np.where(label < 0, np.nan, 0.1 + label) if relative_flow_px is None else relative_flow_px
    written = {
        "label": label,
        "relative_flow_px": flow.astype(np.float32),
        "onset_slice": np.int64(onset if onset < slices else -1),
        "confidence": np.float64(1.0),
        "flow_pairs_computed": np.int64(9),
        **arrays,
    }
    path.unlink(missing_ok=True)
    return write_stage(path, Recipe("labels", 1, {"threshold_px": 0.3, **more}, parents=(parent,)), written)


def write_touch(trial: Path, changes: dict[str, Any] | None = None, *, adapted: bool = False, **chosen: Any) -> Path:
    """Touch beside a trial, made from its tracks, and from an adapted scale if there is one."""
    with open_trial([trial]) as opened:
        assert opened.tracks is not None
        parents: tuple[Header, ...] = (opened.tracks.header,)
    if adapted:
        parents += (Recipe("force-model", 1, {"method": "touch"}).header(),)
    path = trial.with_name(trial.name.replace("recording", "touch"))
    arrays = {**small_files.touch_arrays(SLICES), **(changes or {})}
    path.unlink(missing_ok=True)
    write_stage(path, Recipe("touch", 1, chosen, parents=parents), arrays)
    return path


def write_trial(folder: Path) -> Path:
    """A recording with tracks and labels beside it."""
    path = folder / "a.recording.h5"
    header = write_recording(path)
    write_tracks(folder / "a.tracks.h5", header, moving())
    write_labels(folder / "a.labels.h5", header)
    return path


def shown(path: Path, **chosen: Any) -> ViewData:
    """The data that the page of a trial draws."""
    with open_trial([path]) as trial:
        return collect_view(trial, View(**chosen), lambda done, total: None)


def page_data(page: Path) -> dict[str, Any]:
    """The data in a page that its script draws."""
    match = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert match is not None
    return dict(json.loads(match[1]))
