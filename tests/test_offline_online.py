"""Offline is online: what track, featurize and a model compute over a file is what the online detector computes.

The same bits and the same decisions. That a sample has the same bits alone and in a batch is asserted for every
architecture in kernels/slip/test_detector.py.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.commands.featurize import Featurize
from evetac_cli.commands.track import Track
from evetac_cli.events import SLICE_US, Events, Slicer, SliceStarts, concatenate, empty, slice_starts
from evetac_cli.kernels.slip.alarms import alarming, levels
from evetac_cli.kernels.slip.architectures import OF_GRIPPER
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.kernels.tracking import presets
from evetac_cli.resources import MODEL
from evetac_cli.stages import featurize, track
from evetac_cli.stages.model_files import chosen_threshold
from evetac_cli.stages.slip_detectors import load_detector, read_series
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from tests.conftest import Made
from tests.make import run_stage


def stream(rng: np.random.Generator, slices: int, count: int) -> Events:
    t = np.sort(rng.integers(0, slices * 1000, count))
    x, y = rng.integers(0, 640, count, np.uint16), rng.integers(0, 480, count, np.uint16)
    return Events(t, x, y, rng.integers(0, 2, count, np.uint8))


def packets(events: Events, cuts: list[int]) -> list[Events]:
    edges = [0, *sorted(cut % (events.size + 1) for cut in cuts), events.size]
    return [events.part(first, last) for first, last in zip(edges, edges[1:], strict=False)]


@given(
    seed=st.integers(0, 2**31),
    slices=st.integers(1, 40),
    count=st.integers(0, 200),
    cuts=st.lists(st.integers(0, 1000)),
)
def test_slices_do_not_depend_on_packets(seed: int, slices: int, count: int, cuts: list[int]) -> None:
    """Assert that however a stream is cut into packets, the slices are those of the index, empty ones included."""
    events = stream(np.random.default_rng(seed), slices, count)
    slicer = Slicer()
    result = [piece for packet in packets(events, cuts) for piece in slicer.push(packet)]
    result += slicer.close_until(slices)
    starts = slice_starts(events.t, slices)
    assert len(result) == slices
    for index, piece in enumerate(result):
        expected = events.part(int(starts[index]), int(starts[index + 1]))
        assert all((one == other).all() for one, other in zip(piece, expected, strict=True))


def test_slicer_refuses_backward_time() -> None:
    """Assert that an event earlier than one already seen is refused, within a packet and across packets."""
    late = Events(np.array([5000]), *(np.zeros(1, dtype) for dtype in (np.uint16, np.uint16, np.uint8)))
    early = late._replace(t=np.array([4999]))
    slicer = Slicer()
    slicer.push(late)
    slicer.push(empty())
    with pytest.raises(ValueError, match="5000 us"):
        slicer.push(early)
    with pytest.raises(ValueError, match="order of time"):
        Slicer().push(concatenate([late, early]))


@pytest.fixture(scope="module", params=["trained here", "of the package"])
def model_path(request: pytest.FixtureRequest, made: Made) -> Path:
    """A model of dots: the session's (hist10), and the one that `grasp` uses by default."""
    return made.model if request.param == "trained here" else MODEL


@pytest.fixture(scope="module")
def features_path(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Features of the session's first recording, with the sticking share."""
    recording = made.recordings[0]
    chosen = Featurize(tracks=made.beside(recording, "tracks"), sticking_share=True)
    output, _ = run_stage(featurize, [recording], chosen, tmp_path_factory.mktemp("features"))
    return output


def open_online(model: StageFile, recording: Recording) -> OnlineSlipDetector:
    dots = recording.dot_xy_px
    assert dots is not None
    assert recording.dot_radius_px is not None
    known = recording.sensitivity
    constants = presets.PRESETS["stable"].for_dots(recording.dot_radius_px, known.contrast_over_threshold)
    threshold = chosen_threshold(model)
    return OnlineSlipDetector.start(model, dots, recording.window_px, constants, threshold, known)


@settings(max_examples=5, deadline=None)
@given(cuts=st.lists(st.integers(0, 10**7), min_size=1, max_size=400))
def test_live_features_are_those_of_the_files(
    made: Made, model_path: Path, features_path: Path, cuts: list[int]
) -> None:
    """Assert that tracks, probabilities and decisions from randomly cut packets are those of the files, bit for bit."""
    path = made.recordings[0]
    with open_recording(path) as recording, StageFile(model_path) as model:
        events, slices = recording.between(0, len(recording)), len(recording)
        online = open_online(model, recording)
        detector = load_detector(model)
    with StageFile(made.beside(path, "tracks")) as tracks, StageFile(features_path) as features:
        expected_dots, expected_counts = tracks.read("dot_xy_px"), tracks.read("events_per_dot")
        series = read_series(features, detector.architecture)
        if isinstance(series, LoadPath):
            series.numbers[:, OF_GRIPPER] = 0  # nobody tells of the gripper
        offline = detector.over(series)
    # A threshold that a probability just reaches in float32 and misses in float64: both sides must round alike.
    highest = float(np.nanmax(levels(offline)[: len(offline) // 2]))
    online.alarm.threshold = highest * (1 + 1e-9)
    decisions = np.cumsum(alarming(offline, online.threshold))
    assert decisions[-1] > 0
    slicer = Slicer()
    live = [piece for packet in packets(events, cuts) for piece in slicer.push(packet)] + slicer.close_until(slices)
    assert len(live) == slices
    probability = np.empty(slices, np.float32)
    counts = np.empty(slices, np.int64)
    for index, piece in enumerate(live):
        probability[index] = online.step(piece)
        counts[index] = online.count
        assert (online.tracking.dot_xy_px.astype(np.float32) == expected_dots[index]).all()
        assert (online.tracking.events_per_dot == expected_counts[index]).all()
    np.testing.assert_array_equal(probability, offline)
    np.testing.assert_array_equal(counts, decisions)
    if not isinstance(series, LoadPath):
        np.testing.assert_array_equal(np.isnan(offline), np.arange(slices) < detector.architecture.history - 1)


def test_a_grasp_can_be_replayed_offline(made: Made, tmp_path: Path) -> None:
    """Assert that a grasp's probabilities and decisions are those of track, featurize and model on its recording."""
    (job,) = track.jobs([made.grasp], Track(), tmp_path)
    track.run(job, Track())
    chosen = Featurize(tracks=job.output)
    (job,) = featurize.jobs([made.grasp], chosen, tmp_path)
    featurize.run(job, chosen)
    with StageFile(made.model) as model, StageFile(job.output) as features, open_recording(made.grasp) as recording:
        detector = load_detector(model)
        offline = detector.over(read_series(features, detector.architecture))
        np.testing.assert_array_equal(recording.read("control/probability"), offline)
        last_seen = recording.read("control/t_us") // SLICE_US - 1  # the slice that ended as a control step began
        step_slip = recording.read("control/slip")
        threshold = chosen_threshold(model)
    slips = np.concatenate([[0], np.cumsum(alarming(offline, threshold))])
    np.testing.assert_array_equal(step_slip, np.diff(slips[last_seen + 1], prepend=0) > 0)


@given(st.lists(st.integers(0, 9000), max_size=40), st.lists(st.integers(0, 40), max_size=5), st.integers(0, 3))
def test_slice_starts_of_blocks(times: list[int], cuts: list[int], empty_slices: int) -> None:
    """Assert that starts are the same however the events were cut into blocks, with empty slices at the end."""
    t = np.sort(np.array(times, np.int64))
    slices = (int(t[-1]) // SLICE_US + 1 if t.size else 0) + empty_slices
    starts = SliceStarts()
    for block in np.split(t, sorted(min(cut, t.size) for cut in cuts)):
        starts.add(block)
    assert starts.finish(slices).tolist() == slice_starts(t, slices).tolist()
