"""Recordings that are made up: no events, dots that moved as a test says, and the forces on them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.store.files import write_stage
from evetac_cli.store.provenance import Recipe


def write_trial(
    folder: Path,
    made: Recipe,
    grid_px: NDArray[np.float64],
    dots_px: NDArray[np.float32],
    normal_n: NDArray[np.floating[Any]],
    shear_n: NDArray[np.floating[Any]],
    sensor_name: str,
    frame_px: tuple[int, int] = (640, 480),
) -> Path:
    """A recording, with truth if it is simulated, and the tracks of its dots; the tracks' path.

    grid_px: (rows, columns, 2), dots_px: (slices, dots, 2), normal_n: (slices,), shear_n: (slices, 2).
    """
    slices = len(dots_px)
    sensor = {
        "sensor/frame_px": np.array(frame_px, np.int32),
        "sensor/name": sensor_name,
        "sensor/dot_xy_px": grid_px,
        "sensor/dot_radius_px": np.float64(15.0 * frame_px[0] / 640),  # seen through the same lens
    }
    none = np.empty(0, np.int64)
    zero = np.zeros(slices, np.float32)
    recording: dict[str, Any] = {
        "events/t": none,
        **{f"events/{key}": none.astype(np.uint16) for key in "xy"},
        "events/p": none.astype(np.uint8),
        "ms_to_idx": np.zeros(slices + 1, np.int64),
        "t_offset": np.int64(0),
        **sensor,
    }
    if made.simulated:
        recording |= {
            "truth/dot_xy_px": dots_px,
            "truth/object_xy_px": np.zeros((slices, 2), np.float32),
            **{f"truth/{key}": zero for key in ("slid_px", "every_node_slid_px", "slip_share", "visible_slip_share")},
            "truth/slip": zero.astype(np.uint8),
            "truth/normal_force_n": normal_n.astype(np.float32),
            "truth/shear_force_n": shear_n.astype(np.float32),
            "truth/sampled_parameters": "{}",
        }
    header = write_stage(folder / f"trial{made.seed}.recording.h5", made, recording)
    tracks = {
        "dot_xy_px": dots_px,
        "events_per_dot": np.zeros(dots_px.shape[:2], np.int32),
        "lost": np.zeros(dots_px.shape[:2], np.uint8),
        **sensor,
    }
    path = folder / f"trial{made.seed}.tracks.h5"
    write_stage(path, Recipe("tracks", 1, {"preset": "exact"}, parents=(header,)), tracks)
    return path
