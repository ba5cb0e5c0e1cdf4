"""Recordings that are made up: no events, dots that moved as a test says, and the forces on them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, events_at, truth_arrays


def write_trial(
    folder: Path,
    made: Recipe,
    grid_px: NDArray[np.float64],
    dots_px: NDArray[np.float32],
    normal_n: NDArray[np.floating[Any]],
    shear_n: NDArray[np.floating[Any]],
    sensor_name: str,
    frame_px: tuple[int, int] = (640, 480),
    preset: str = "exact",
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
    recording = event_arrays(events_at([]), slices) | sensor
    if made.simulated:
        recording |= truth_arrays(dots_px, normal_n=normal_n, shear_n=shear_n)
    header = write_stage(folder / f"trial{made.seed}.recording.h5", made, recording)
    tracks = {
        "dot_xy_px": dots_px,
        "events_per_dot": np.zeros(dots_px.shape[:2], np.int32),
        "lost": np.zeros(dots_px.shape[:2], np.uint8),
        **sensor,
    }
    path = folder / f"trial{made.seed}.tracks.h5"
    write_stage(path, Recipe("tracks", 1, {"preset": preset}, parents=(header,)), tracks)
    return path
