"""track: the sensor's own dot radius, and what a real camera's noise does to real dots and to a simulated slip."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events
from evetac_cli.formats.imports import read_events
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.stages import track
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from tests.conftest import Made
from tests.make import run_stage


@pytest.fixture(scope="module")
def noise(outside_file: Callable[[str], Path]) -> list[Events]:
    """A real DVXplorer at a still scene, slice by slice: 2.7 s, 94 events a slice, 385 hot pixels."""
    events = read_events(outside_file("dvxplorer_static_noise.aedat4")).events
    edges = np.searchsorted(events.t - events.t[0], np.arange(0, events.t[-1] - events.t[0] + SLICE_US, SLICE_US))
    return [events.part(int(first), int(last)) for first, last in zip(edges, edges[1:], strict=False)]


@pytest.mark.parametrize("dot_radius_px", [15.0, 20.62])
@pytest.mark.parametrize("gate", [10, 0])
def test_real_noise_moves_no_dot_of_the_real_grid(
    noise: list[Events], outside_file: Callable[[str], Path], gate: int, dot_radius_px: float
) -> None:
    """Assert that it moves no dot by more than 0.5 px at any time, whether few events may move a dot or not."""
    rest_px = np.array(
        json.loads(outside_file("evetac_base_calibration.json").read_text())["dot_xy_px"], np.float64
    ).reshape(-1, 2)
    state = tracker.start(rest_px, replace(PRESETS["stable"], min_events=gate).for_dots(dot_radius_px))
    moved_px = []
    for events in noise:
        tracker.step(state, events.x, events.y, events.p)
        moved_px.append(np.linalg.norm(state.dot_xy_px - rest_px, axis=1).max())
    assert max(moved_px) < 0.5
    assert (max(moved_px) > 0.0) == (gate == 0)


def with_noise(recording: Iterator[Events], noise: list[Events]) -> Iterator[Events]:
    """Every slice with the events of a slice of noise behind its own."""
    for number, events in enumerate(recording):
        both = zip(events, noise[number % len(noise)], strict=True)
        yield Events(*(np.concatenate([one, other.astype(one.dtype)]) for one, other in both))


def test_real_noise_hardly_disturbs_a_simulated_slip(noise: list[Events], request: pytest.FixtureRequest) -> None:
    """Assert that noise of about as many events changes the rms error of a simulated slip by less than 0.1 px."""
    made: Made = request.getfixturevalue("made")  # where there is no noise, nothing is made
    with open_recording(made.recordings[0]) as recording:
        rest_px, true_px = recording.dot_xy_px, recording.read("truth/dot_xy_px")
        assert rest_px is not None
        constants = PRESETS["stable"].for_dots(recording.dot_radius_px)
        errors_px = []
        for slices in (iter(recording), with_noise(iter(recording), noise)):
            state = tracker.start(rest_px.reshape(-1, 2), constants)
            found_px = np.empty(true_px.shape)
            for number, events in enumerate(slices):
                tracker.step(state, events.x, events.y, events.p)
                found_px[number] = state.dot_xy_px
            errors_px.append(np.sqrt(np.mean(np.sum((found_px - true_px) ** 2, axis=2))))
        still_px = np.sqrt(np.mean(np.sum((rest_px.reshape(-1, 2) - true_px) ** 2, axis=2)))
    assert errors_px[0] < 0.5 < still_px
    assert 0.0 < abs(errors_px[1] - errors_px[0]) < 0.1


def calibration(path: Path, rest_px: NDArray[np.float64], dot_radius_px: float) -> Path:
    path.write_text(
        json.dumps({"frame_px": [640, 480], "radius_px": dot_radius_px, "dot_xy_px": rest_px.reshape(-1, 2).tolist()})
    )
    return path


def test_the_radius_is_the_recordings(made: Made, tmp_path: Path) -> None:
    """Assert that a calibration with another radius gives `stable`, not `paper`, other tracks, and is in the header."""
    with open_recording(made.recordings[0]) as recording:
        rest_px, radius_px = recording.dot_xy_px, float(recording.read("sensor/dot_radius_px"))
    assert rest_px is not None
    result: dict[str, list[NDArray[np.float32]]] = {"stable": [], "paper": []}
    for preset, tracks_px in result.items():
        for stated_px in (radius_px, radius_px - 2.0):
            grid = calibration(tmp_path / f"{stated_px}.json", rest_px, stated_px)
            params = Track(preset=preset, calibration=grid)
            output, _ = run_stage(track, [made.recordings[0]], params, tmp_path / f"{preset}-{stated_px}.tracks.h5")
            with StageFile(output, "tracks") as tracks:
                tracks_px.append(tracks.read("dot_xy_px"))
                assert tracks.header["parameters"]["dot_radius_px"] == stated_px
                assert tracks.header["parameters"]["constants"]["radius_px"] == PRESETS[preset].radius_px
    with StageFile(made.beside(made.recordings[0], "tracks")) as tracks:
        np.testing.assert_array_equal(tracks.read("dot_xy_px"), result["stable"][0])
    assert np.abs(result["stable"][0] - result["stable"][1]).max() > 0.1
    np.testing.assert_array_equal(result["paper"][0], result["paper"][1])


def test_dots_too_small_for_the_ring_are_refused(made: Made, tmp_path: Path) -> None:
    """Assert that a radius within the ring's half width is refused with what was expected."""
    with open_recording(made.recordings[0]) as recording:
        rest_px = recording.dot_xy_px
    assert rest_px is not None
    params = Track(calibration=calibration(tmp_path / "small.json", rest_px, 3.9))
    (job,) = track.jobs([made.recordings[0]], params, tmp_path / "small.tracks.h5")
    with pytest.raises(InputError, match=r"dot_radius_px: expected .*4.*found 3.9"):
        track.run(job, params)
