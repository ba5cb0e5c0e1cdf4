"""Offline is online: what track and featurize compute over a file is what a live detector computes, bit for bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evetac_cli.events import Events, Slicer, concatenate, empty, slice_starts
from evetac_cli.kernels.slip import slip
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.tracking import tracker
from evetac_cli.params import Featurize, Track
from evetac_cli.stages import featurize, track
from evetac_cli.stages.grasp.online_detector import OnlineSlipDetector
from evetac_cli.stages.slip_detectors import series_of
from evetac_cli.store.files import StageFile
from evetac_cli.store.read import open_recording
from tests.conftest import Made


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
    found = [piece for packet in packets(events, cuts) for piece in slicer.push(packet)]
    found += slicer.close_until(slices)
    starts = slice_starts(events.t, slices)
    assert len(found) == slices
    for index, piece in enumerate(found):
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


@settings(max_examples=5, deadline=None)
@given(cuts=st.lists(st.integers(0, 10**7), min_size=1, max_size=400))
def test_live_features_are_those_of_the_files(made: Made, cuts: list[int]) -> None:
    """Assert that tracks and probabilities from randomly cut packets equal those of the tracks and features files."""
    path = made.recordings[0]
    with open_recording(path) as recording, StageFile(made.model) as model:
        events, slices = recording.between(0, len(recording)), len(recording)
        dots = recording.dot_xy_px
        assert dots is not None
        sense = OnlineSlipDetector.start(model, dots, recording.window_px, tracker.PRESETS["stable"])
        architecture = slip.ARCHITECTURES[model.read("architecture")]
        detector = Detector(model.read("onnx").tobytes(), architecture)
    with StageFile(made.beside(path, "tracks")) as tracks, StageFile(made.beside(path, "features")) as features:
        expected_dots, expected_counts = tracks.read("dot_xy_px"), tracks.read("events_per_dot")
        series = series_of(features, architecture)
    offline = detector.over(series)
    slicer = Slicer()
    live = [piece for packet in packets(events, cuts) for piece in slicer.push(packet)] + slicer.close_until(slices)
    assert len(live) == slices
    for index, piece in enumerate(live):
        probability = sense.step(piece)
        assert (sense.tracking.dot_xy_px.astype(np.float32) == expected_dots[index]).all()
        assert (sense.tracking.events_per_dot == expected_counts[index]).all()
        assert probability == pytest.approx(offline[index], abs=1e-6, nan_ok=True)
        assert np.isnan(probability) == (index < architecture.history - 1)


def test_a_grasp_can_be_replayed_offline(made: Made) -> None:
    """Assert that the probability a grasp acted on is that of track, featurize and the model run over its recording."""
    folder = made.folder / "replayed"
    (job,) = track.jobs([made.grasp], Track(), folder)
    track.run(job, Track())
    chosen = Featurize(tracks=job.output)
    (job,) = featurize.jobs([made.grasp], chosen, folder)
    featurize.run(job, chosen)
    with StageFile(made.model) as model, StageFile(job.output) as features, open_recording(made.grasp) as recording:
        detector = Detector(model.read("onnx").tobytes(), slip.ARCHITECTURES[model.read("architecture")])
        offline = detector.over(series_of(features, detector.architecture))
        online = recording.read("control/probability")
    assert offline == pytest.approx(online, abs=1e-6, nan_ok=True)
