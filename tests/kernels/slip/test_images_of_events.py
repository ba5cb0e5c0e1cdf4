"""Networks over images of events: the images are those of `Recording.frames` and its like, online as in training."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from evetac_cli.events import FRAME_PX, SLICE_US, Events, SliceBlock, slice_starts
from evetac_cli.kernels.event_drawing import fold
from evetac_cli.kernels.event_representation import Representation
from evetac_cli.kernels.slip import features, inputs, networks
from evetac_cli.kernels.slip.architectures import PluginImageArchitecture, channels
from evetac_cli.kernels.slip.detector import Detector, LiveDetector
from evetac_cli.kernels.slip.features import GelEvents
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from tests.plugin.evetac_toy.images import MeanOfPicture

SLICES = 60
WINDOW = (540, 0, 640, 480)
DOTS = np.stack(np.meshgrid(60.0 + 60 * np.arange(8), 50.0 + 60 * np.arange(7)), axis=2).reshape(-1, 2)
SEEN = {
    "frames": Representation("frames", FRAME_PX, (16, 12), 200.0, 5),
    "signed": Representation("frames", FRAME_PX, (16, 12), 500.0, 6, polarity="signed"),
    "histogram": Representation("histogram", FRAME_PX, (16, 12), 200.0, 10, bins=4),
    "voxels": Representation("voxels", FRAME_PX, (8, 6), 100.0, 20, bins=3),
    "surface": Representation("surface", FRAME_PX, (16, 12), 200.0, 15, decay_ms=2.0),
}


@pytest.fixture(scope="module")
def events() -> Events:
    rng = np.random.default_rng(2)
    count = 4000
    t = np.sort(rng.integers(0, SLICES * SLICE_US, count))
    x, y, p = (rng.integers(0, most, count) for most in (*FRAME_PX, 2))
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


@pytest.fixture(scope="module")
def series(events: Events) -> GelEvents:
    return features.gel_events(events, slice_starts(events.t, SLICES), WINDOW)


def slices(events: Events) -> Iterator[Events]:
    starts = slice_starts(events.t, SLICES)
    return (events.part(*edges) for edges in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))


def test_the_window_is_left_out(events: Events, series: GelEvents) -> None:
    """Assert that a series has the events outside the window, with times in their slices, and parts of it are its."""
    outside = events.at((events.x < 540) | (events.x >= 640))
    assert len(series.x) == outside.size < events.size
    np.testing.assert_array_equal(series.t_us, outside.t % SLICE_US)
    np.testing.assert_array_equal(np.searchsorted(outside.t, np.arange(SLICES + 1) * SLICE_US), series.start)
    whole = inputs.join([inputs.part(series, 0, 7), inputs.part(series, 7, SLICES)])
    assert isinstance(whole, GelEvents)
    assert all(map(np.array_equal, whole, series))
    assert inputs.length(series) == SLICES


@pytest.mark.parametrize("name", SEEN)
def test_images_are_those_of_the_recording(name: str, events: Events, series: GelEvents) -> None:
    """Assert that a network sees the images that `fold` makes of the gel's events, the newest first."""
    of = SEEN[name]
    seen = MeanOfPicture(name, of, images=3)
    gel = events.at((events.x < 540) | (events.x >= 640))
    starts = slice_starts(gel.t, SLICES)
    (block,) = fold(of, [SliceBlock(0, starts, gel)])
    ends = block.end_us // SLICE_US - 1
    full = np.flatnonzero(ends >= seen.history - 1)
    batch = inputs.at(seen, series, ends[full])
    assert batch.shape == (len(full), *seen.input_shape)
    expected = np.stack([block.images[k - 2 : k + 1][::-1].reshape(seen.input_shape) for k in full])
    if of.kind == "surface":  # events older than 15 ms before the first image are not known
        np.testing.assert_allclose(batch, expected, atol=np.exp(-15 / 2.0))
    else:
        np.testing.assert_array_equal(batch, expected.astype(np.float32))


def network_of(architecture: PluginImageArchitecture) -> tuple[Any, Detector]:
    rng = np.random.default_rng(4)
    wide = channels(architecture)
    scales = rng.uniform(0.5, 2.0, wide), rng.uniform(0.0, 0.3, wide)
    network = networks.build(architecture, 7, 8, *scales)
    return network, Detector(networks.onnx_graph(network), architecture)


@pytest.mark.parametrize("name", SEEN)
def test_online_as_in_training(name: str, events: Events, series: GelEvents) -> None:
    """Assert that slice by slice a detector says what it says of the whole trajectory, bit for bit, and as torch."""
    import torch

    architecture = MeanOfPicture(name, SEEN[name], images=3)
    network, detector = network_of(architecture)
    offline = detector.over(series)
    live = LiveDetector(detector, tracker.start(DOTS, PRESETS["stable"]), WINDOW)
    assert live.needs_times
    online = [live.step(one.x, one.y, one.p, one.t) for one in slices(events)]
    np.testing.assert_array_equal(np.float32(online), offline)
    due = np.arange(architecture.history - 1, SLICES, architecture.every)
    with torch.no_grad():
        wanted = torch.sigmoid(network(torch.from_numpy(inputs.at(architecture, series, due)))).numpy()
    np.testing.assert_allclose(offline[due], wanted, atol=1e-5)
    assert np.ptp(offline[due]) > 0


def test_what_cannot_be_seen() -> None:
    """Assert that images between slices or of another frame are refused."""
    for changed in ({"rate_hz": 300.0}, {"frame_px": (320, 240)}):
        of = Representation(**{**SEEN["frames"].__dict__, **changed})  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="640 x 480 px, a whole number of ms apart"):
            MeanOfPicture("a", of)
    with pytest.raises(ValueError, match="a whole number of ms apart"):
        MeanOfPicture("a", SEEN["frames"], images=0)
