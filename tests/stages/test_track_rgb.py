"""Frames of an RGB sensor: what their noise is drawn from."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.commands.track import Track
from evetac_cli.stages import track, track_rgb
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from tests.make import event_arrays, events_at, run_stage, truth_arrays

SLICES = 240


def moving_grid(path: Path, trial: int = 0, seed: int = 5, **more: Any) -> Path:
    """A recording without events of a grid of dots that move by 1 px, with the parameters of a trial."""
    time = np.arange(SLICES)
    rest = np.stack(np.meshgrid(60.0 + 62.0 * np.arange(9), 40.0 + 62.0 * np.arange(7)), axis=-1)
    arrays = event_arrays(events_at([]), SLICES) | {
        "sensor/name": "evetac",
        "sensor/dot_xy_px": rest,
        "sensor/dot_radius_px": np.float64(15.0),
        **truth_arrays(rest.reshape(1, -1, 2) + time[:, None, None] / SLICES, normal_n=1.0),
    }
    parameters = {"object": 8, "trial": trial, **more}
    write_stage(path, Recipe("recording", 1, parameters, seed=seed, simulated_source=True), arrays)
    return path


def tracks(path: Path) -> np.ndarray:
    """Where the dots of a recording are found in its frames."""
    output, _ = run_stage(track, [path], Track(rgb=True))
    with StageFile(output) as made:
        result: np.ndarray = made.read("dot_xy_px")
    return result


def test_the_noise_is_that_of_the_trial(tmp_path: Path) -> None:
    """Assert that two trials have different noise, and that a parameter of another name changes none."""
    first = moving_grid(tmp_path / "a.recording.h5")
    renamed = moving_grid(tmp_path / "renamed.recording.h5", another_name=1)
    with StageFile(first) as one, StageFile(renamed) as other:
        assert one.header["id"] != other.header["id"]
    same = tracks(first)
    assert np.array_equal(same, tracks(renamed))
    for name, changed in {"trial": {"trial": 1}, "seed": {"seed": 6}, "object": {"object": 9}}.items():
        assert not np.array_equal(same, tracks(moving_grid(tmp_path / f"{name}.recording.h5", **changed))), name


@pytest.mark.parametrize("change", [{"trial": 4}, {"object": 2}, {"tone_hz": 200.0}, {"trimmed": {"from_ms": 10}}])
def test_what_names_a_trial(change: dict[str, Any]) -> None:
    """Assert that each number that names a trial, and the seed of the stage, is part of the key; the id is not."""
    header = {"id": "ab" * 32, "seed": 3, "parameters": {"object": 8, "trial": 1}}
    other = copy.deepcopy(header)
    other["parameters"] |= change  # type: ignore[operator]
    key = track_rgb.noise_seeds(0, header)
    assert key != track_rgb.noise_seeds(0, other)
    assert key != track_rgb.noise_seeds(1, header)
    assert key != track_rgb.noise_seeds(0, {**header, "seed": 4})
    assert key == track_rgb.noise_seeds(0, {**header, "id": "cd" * 32})
