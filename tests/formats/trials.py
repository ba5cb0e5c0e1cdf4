"""Small trials with random values for the tests of tables and of data sets for policies."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests import small_files
from tests.small_files import DOTS, SLICES

COMMANDS = SLICES // 2


def write_grasp(
    folder: Path,
    name: str,
    number: int | None = 8,
    seed: int = 1,
    kinds: str = "tracks labels features touch",
    name_of_sensor: str = "evetac",
    **more: Any,
) -> Path:
    """A simulated grasp of an object with these kinds of files beside it; `more`: datasets, `__` for each `/`."""
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.recording.h5"
    small_files.recording(path)
    with StageFile(path) as file:
        arrays = {dataset: file.read(dataset) for dataset in file.contents()}
    arrays |= {
        "truth/normal_force_n": rng.random(SLICES, np.float32),
        "truth/shear_force_n": rng.random((SLICES, 2), np.float32),
        "gripper/position_ticks": rng.integers(300, 500, COMMANDS).astype(np.int32),
        "gripper/current_ma": rng.random(COMMANDS, np.float32),
        "control/goal_ticks": rng.integers(300, 500, COMMANDS).astype(np.int32),
        "control/probability": np.where(np.arange(SLICES) < 9, np.nan, rng.random(SLICES)).astype(np.float32),
    }
    arrays |= {dataset.replace("__", "/"): values for dataset, values in more.items()}
    arrays = {dataset: values for dataset, values in arrays.items() if values is not None}
    parameters = {
        "object": number,
        "sensor": name_of_sensor,
        "scene": {"name": "lift", "summary": "an object is lifted"},
    }
    of = write_stage(path, Recipe("recording", 1, parameters, seed=seed, simulated_source=True), arrays, force=True)
    beside = {kind: folder / f"{name}.{kind}.h5" for kind in ("tracks", "labels", "features", "touch")}
    of_tracks = small_files.tracks(beside["tracks"], of)
    of_labels = small_files.labels(beside["labels"], of)
    small_files.features(beside["features"], (of, of_tracks, of_labels))
    small_files.touch(beside["touch"], of_tracks)
    with h5py.File(beside["tracks"], "r+") as h5:
        h5["dot_xy_px"][...] += rng.random((SLICES, DOTS, 2), np.float32)
        h5["events_per_dot"][...] = rng.integers(0, 9, (SLICES, DOTS))
    with h5py.File(beside["features"], "r+") as h5:
        h5["displacement_xy_px"][...] = rng.normal(size=(SLICES, DOTS, 2))
    with h5py.File(beside["touch"], "r+") as h5:
        h5["shear_n"][...] = rng.normal(size=(SLICES, 2))
        h5["normal_n"][...] = np.where(np.arange(SLICES) < 3, np.nan, rng.random(SLICES))
        h5["map/pressure_pa"][...] = 1e4 * rng.random(h5["map/pressure_pa"].shape)
    for kind, file_path in beside.items():
        if kind not in kinds.split():
            file_path.unlink()
    return path
