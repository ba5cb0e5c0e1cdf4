"""featurize: directions and event images beside the paper's features, and where tracks and labels are looked for."""

import json
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US
from evetac_cli.kernels.event_representation import event_image
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, SHEAR_MODULUS_PA
from evetac_cli.kernels.slip.features import GelEvents
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath
from evetac_cli.stages import featurize, track
from evetac_cli.stages.slip_detectors import read_series, read_trajectory
from evetac_cli.stages.touch.touch_fold import StickingShare
from evetac_cli.store.files import StageFile, header_of
from evetac_cli.store.recordings.read import open_recording
from tests import small_files
from tests.conftest import Made
from tests.make import run_stage


def test_directions_are_the_displacement(made: Made) -> None:
    """Assert that the stored displacements to the right and down are those of the tracks, with the stored length."""
    path = made.recordings[0]
    with StageFile(made.beside(path, "features")) as features, StageFile(made.beside(path, "tracks")) as tracks:
        result = features.read("displacement_xy_px")
        expected = tracks.read("dot_xy_px") - tracks.read("sensor/dot_xy_px").reshape(-1, 2)
        length = features.read("displacement_px")
        assert not features.has("image")
    np.testing.assert_allclose(result, expected, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(result, axis=2), length, atol=1e-4)


def test_sensitivity_is_of_the_recording_or_of_the_tracks(made: Made, tmp_path: Path) -> None:
    """Assert that features hold what a simulation knows, or what the calibration says that tracks were made with."""
    path = made.recordings[0]
    with StageFile(made.beside(path, "features")) as features, open_recording(path) as recording:
        assert features.sensitivity == recording.sensitivity == pytest.approx((8.06, 145e3), rel=0.01)
        dots, radius_px, window_px = recording.dot_xy_px, recording.dot_radius_px, recording.window_px
    table = {"frame_px": [640, 480], "radius_px": radius_px, "window_px": list(map(int, window_px or ()))}
    table |= {
        "dot_xy_px": np.asarray(dots).tolist(),
        "contrast_over_threshold": 5.5,
        "shear_modulus_pa": 2 * SHEAR_MODULUS_PA,
    }
    grid = tmp_path / "grid.json"
    grid.write_text(json.dumps(table))
    (job,) = track.jobs([path], Track(calibration=grid), tmp_path)
    track.run(job, Track(calibration=grid))
    chosen = Featurize(tracks=job.output)
    (job,) = featurize.jobs([path], chosen, tmp_path)
    featurize.run(job, chosen)
    with StageFile(job.output) as features:
        assert features.sensitivity == (5.5, 2 * SHEAR_MODULUS_PA)


def test_images_are_the_event_images_of_the_gel(made: Made, tmp_path: Path) -> None:
    """Assert that --images stores every slice's event image without the window, and nothing else changes."""
    path = made.recordings[0]
    chosen = Featurize(images=True)
    output, _ = run_stage(featurize, [path], chosen, tmp_path)
    with StageFile(output) as features, StageFile(made.beside(path, "features")) as plain:
        for name in plain.contents():
            np.testing.assert_array_equal(features.read(name), plain.read(name))
        start, pixel, sign = (features.read(f"image/{name}") for name in ("start", "pixel", "sign"))
    with open_recording(path) as recording:
        assert recording.window_px is not None
        x0, y0, x1, y1 = recording.window_px
        assert len(start) == len(recording) + 1
        for index in (0, len(recording) // 2, len(recording) - 1):
            events = recording.between(index, index + 1)
            expected = event_image(events.x, events.y, events.p, (540, 480))
            expected[y0:y1, x0:x1] = 0
            result = np.zeros(540 * 480, np.int8)
            result[pixel[start[index] : start[index + 1]]] = sign[start[index] : start[index + 1]]
            np.testing.assert_array_equal(result.reshape(480, 540), expected)
    assert len(pixel) > 0


def test_events_are_those_of_the_gel(made: Made, tmp_path: Path) -> None:
    """Assert that --events stores what lies outside the window, with times in slices, and nothing else changes."""
    path = made.recordings[0]
    output, _ = run_stage(featurize, [path], Featurize(events=True), tmp_path)
    with open_recording(path) as recording:
        events, slices, window = recording.between(0, len(recording)), len(recording), recording.window_px
    assert window is not None
    outside = events.at((events.x < window[0]) | (events.x >= window[2]))
    assert 0 < outside.size < events.size
    with StageFile(output, "features") as file, StageFile(made.beside(path, "features")) as plain:
        starts = file.read("gel_events/start")
        np.testing.assert_array_equal(starts, np.searchsorted(outside.t, np.arange(slices + 1) * SLICE_US))
        np.testing.assert_array_equal(file.read("gel_events/t_us"), outside.t % SLICE_US)
        for name in "xyp":
            np.testing.assert_array_equal(file.read(f"gel_events/{name}"), getattr(outside, name))
        assert file.contents().keys() - plain.contents().keys() == {f"gel_events/{name}" for name in GelEvents._fields}
        assert (file.header["parameters"]["events"], "events" in plain.header["parameters"]) == (True, False)


def test_tracks_and_labels_of_a_folder(tmp_path: Path) -> None:
    """Assert that --labels may be a folder that holds those of every recording, or a file."""
    recordings = [tmp_path / f"{name}.recording.h5" for name in "ab"]
    truth = tmp_path / "truth"
    truth.mkdir()
    (truth / "a.labels.h5").touch()
    result = featurize.jobs(recordings, Featurize(labels=truth), None)
    assert [job.inputs[2] for job in result] == [truth / "a.labels.h5", truth / "b.labels.h5"]
    assert [job.inputs[1] for job in result] == [tmp_path / "a.tracks.h5", tmp_path / "b.tracks.h5"]
    (one,) = featurize.jobs(recordings[:1], Featurize(tracks=truth / "x.h5"), None)
    assert one.inputs[1] == truth / "x.h5"


def test_truth_is_copied_on_request_alone(made: Made, tmp_path: Path) -> None:
    """Assert that features hold nothing of a simulation's truth unless asked, and then under a name that says truth."""
    path = made.recordings[0]
    output, _ = run_stage(featurize, [path], Featurize(true_slip_share=True), tmp_path)
    with (
        StageFile(output) as asked,
        StageFile(made.beside(path, "features")) as plain,
        open_recording(path) as recording,
    ):
        assert not [name for name in plain.contents() if "truth" in name or "share" in name]
        assert set(asked.contents()) - set(plain.contents()) == {"truth/visible_slip_share"}
        share = recording.read("truth/visible_slip_share")
        np.testing.assert_array_equal(asked.read("truth/visible_slip_share"), share)
        assert asked.header["parameters"]["true_slip_share"] is True
        assert share.max() > 0.5


def test_truth_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """Assert that a recording without truth cannot be asked for it."""
    recording = small_files.recording_of(tmp_path / "a.recording.h5", [10] * small_files.SLICES)
    small_files.tracks(tmp_path / "a.tracks.h5", header_of(recording, "recording"))
    with pytest.raises(InputError, match="has no truth"):
        run_stage(featurize, [recording], Featurize(true_slip_share=True), tmp_path)


def test_a_slice_is_told_what_the_gripper_did_before_it(made: Made) -> None:
    """Assert that features hold the position and the goal current last known as each slice began."""
    path = made.recordings[0]
    with open_recording(path) as recording, StageFile(made.beside(path, "features")) as features:
        t_us, position = recording.read("gripper/t_us"), recording.read("gripper/position_ticks")
        goal_ma = recording.read("gripper/current_written_ma")
        told = {name: features.read(f"gripper_{name}") for name in ("position_ticks", "goal_ma")}
        assert not features.has("gripper_goal_ticks")  # a scene in which a current falls has no goal position
        for k in range(len(recording)):
            before = np.flatnonzero(t_us <= 1000 * k)
            if not len(before):
                assert np.isnan(told["position_ticks"][k]) and np.isnan(told["goal_ma"][k])
                continue
            assert told["position_ticks"][k] == position[before[-1]]
            assert told["goal_ma"][k] == goal_ma[before[-1]]
        assert np.ptp(goal_ma) > 0


def test_the_sticking_share_is_told_on_request(made: Made, tmp_path: Path) -> None:
    """Assert that a slice is told the share that the network of touch maps tells of the tracks up to the one before."""
    path = made.recordings[0]
    tracks = made.beside(path, "tracks")
    output, _ = run_stage(featurize, [path], Featurize(sticking_share=True), tmp_path)
    with StageFile(output) as features, StageFile(tracks) as of_tracks:
        share = features.read("sticking_share")
        dots, lost = of_tracks.read("dot_xy_px"), of_tracks.read("lost") != 0
        live = StickingShare(of_tracks.read("sensor/dot_xy_px").reshape(-1, 2), of_tracks.read("sensor/frame_px"))
        path_of = read_series(features, ARCHITECTURES["load-path"])
    told = [live.step(*one) for one in zip(dots.astype(np.float64), lost, strict=True)]
    np.testing.assert_array_equal(share, np.array([np.nan, *told[:-1]], np.float32))
    assert np.isnan(share).any() and np.nanmin(share) < 0.5 < np.nanmax(share)
    assert isinstance(path_of, LoadPath)
    np.testing.assert_array_equal(path_of.touches, np.isfinite(share[EVERY - 1 :: EVERY]))


def test_labels_that_abstain_are_features_that_are_not_timed(tmp_path: Path) -> None:
    """Assert that features say that their labels abstain, and that a trajectory of them is not timed."""
    recording = tmp_path / "a.recording.h5"
    of = small_files.recording(recording, lost_slices=False)
    small_files.tracks(tmp_path / "a.tracks.h5", of)
    timed = []
    for make in (small_files.labels, small_files.unsure_labels):
        make(tmp_path / "a.labels.h5", of)
        (job,) = featurize.jobs([recording], Featurize(), None)
        (row,) = featurize.run(job, Featurize(), force=True).rows
        trajectory = read_trajectory(job.output, ARCHITECTURES["fast-slow"])
        timed.append((row["abstained"], trajectory.timed, int((trajectory.label < 0).sum())))
    assert timed == [(False, True, 0), (True, False, 3)]
