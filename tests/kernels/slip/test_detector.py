"""The detector without torch: what it says of a trajectory is what it says slice by slice, bit for bit.

Why so: networks over dots take one input at a time, whatever the batch. For images, nothing in onnxruntime promises
that a sample has the same bits alone and in a batch. It had them in all pairs that were compared on x86-64 (4 networks
of images, 31 to 300 samples each, each with four sizes of batch), so these tests ask for equal bits of images too, and
would show where that ends.
"""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper

from evetac_cli.kernels.slip import features, inputs, networks, onnx_graphs
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, ImageArchitecture, MemoryArchitecture
from evetac_cli.kernels.slip.detector import Detector, LiveDetector, over_each
from evetac_cli.kernels.slip.features import EventImages
from evetac_cli.kernels.tracking import presets, tracker

ROWS = {
    name: row
    for name, row in ARCHITECTURES.items()
    if not name.endswith("-img") and not isinstance(row, MemoryArchitecture)  # that is in test_memory_networks.py
}
REST = np.stack(np.meshgrid(61 + 62.3 * np.arange(8), 41 + 62.4 * np.arange(7)), axis=-1).reshape(-1, 2)
WINDOW = (540, 0, 640, 480)


def trained(name: str, seed: int = 5) -> Detector:
    """A detector with seeded weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = networks.build(ARCHITECTURES[name])
    return Detector(networks.onnx_graph(network), ARCHITECTURES[name])


def events_about_rims(slices: int, seed: int = 0) -> list[list[NDArray]]:
    """Events slice by slice, x, y and p, most of them near the rims of dots."""
    rng = np.random.default_rng(seed)
    columns = []
    for count in rng.integers(0, 400, slices):
        angle = rng.uniform(0, 2 * np.pi, count)
        off_px = rng.normal(15.0, 1.5, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = np.clip(REST[rng.integers(0, len(REST), count)] + off_px, 0, [639, 479])
        places[::5] = rng.uniform(0, [640, 480], (len(places[::5]), 2))
        x, y = places.astype(np.uint16).T.copy()
        columns.append([x, y, (rng.random(count) < 0.5 + 0.4 * np.cos(angle)).astype(np.uint8)])
    return columns


def started() -> tracker.TrackerState:
    return tracker.start(REST, presets.PRESETS["stable"])


def make_series(name: str, slices: int) -> inputs.Series:
    """The trial as `track` and `featurize` would store it."""
    columns = events_about_rims(slices)
    if isinstance(ARCHITECTURES[name], ImageArchitecture):
        blank = np.zeros((480, 540), np.int8)
        pixels, signs = zip(*(features.gel_image(*one, WINDOW, blank) for one in columns), strict=True)
        start = np.cumsum([0, *(len(pixel) for pixel in pixels)])
        return EventImages(start, np.concatenate(pixels), np.concatenate(signs))
    state, stored, counts = started(), np.empty((slices, 56, 2), np.float32), np.empty((slices, 56), np.int32)
    for k, one in enumerate(columns):
        tracker.step(state, *one)
        stored[k], counts[k] = state.dot_xy_px, state.events_per_dot
    return features.series(features.displacement(stored, REST), counts)


@pytest.mark.parametrize("name", ROWS)
def test_live_is_over(name: str) -> None:
    """Assert that a detector gives the same bits slice by slice and over the trajectory, NaN before its history."""
    result = trained(name)
    history = result.architecture.history
    slices = history + 23
    offline = result.over(make_series(name, slices))
    live = LiveDetector(result, started(), WINDOW)
    online = [live.step(*events) for events in events_about_rims(slices)]
    np.testing.assert_array_equal(np.array(online, np.float32), offline)
    np.testing.assert_array_equal(np.isnan(offline), np.arange(slices) < history - 1)
    assert np.ptp(offline[history:]) > 1e-5


def test_several_at_once_are_each_alone() -> None:
    """Assert that detectors of one architecture say together what each says alone, and others are refused."""
    one, two, series = trained("down5"), trained("down5", 6), make_series("down5", 90)
    for first in (0, 3):
        together = over_each([one, two], series, first)
        for alone, found in zip((one, two), together, strict=True):
            np.testing.assert_array_equal(found, alone.over(series, first))
        assert not np.array_equal(*together, equal_nan=True)
    with pytest.raises(ValueError, match="one architecture"):
        over_each([one, trained("hist10")], series)


def test_a_column_more_is_tracked_and_not_seen() -> None:
    """Assert that with a column of dots more, bits are those of the network on the tracks of the others."""
    result = trained("fast-slow")
    known = np.arange(63) % 9 != 8
    rest = np.empty((63, 2))
    rest[known], rest[~known] = REST, REST[7::8] + (62.3, 0)
    live = LiveDetector(result, tracker.start(rest, presets.PRESETS["stable"]), None, seen_dots=known)
    state = tracker.start(rest, presets.PRESETS["stable"])
    stored, counts = np.empty((70, 56, 2), np.float32), np.empty((70, 56), np.int32)
    online = []
    for k, events in enumerate(events_about_rims(70)):
        tracker.step(state, *events)
        stored[k], counts[k] = state.dot_xy_px[known], state.events_per_dot[known]
        online.append(live.step(*events))
        assert live.tracking.record.tobytes() == state.record.tobytes()
    series = features.series(features.displacement(stored, REST), counts)
    np.testing.assert_array_equal(np.array(online, np.float32), result.over(series))


def test_down5_predicts_every_fifth_slice_and_holds() -> None:
    """Assert that down5 says something new at slices 49, 54, ... alone, which is what hist would say there."""
    result = trained("down5")
    series = make_series("down5", 80)
    probabilities = result.over(series)
    assert np.flatnonzero(np.diff(probabilities[49:])).tolist() == [4, 9, 14, 19, 24, 29]
    for t in (49, 54, 79):
        alone = result.probability(inputs.at(result.architecture, series, np.array([t])))
        assert probabilities[t] == alone[0]


@pytest.mark.parametrize("name", ["hist10", "down5", "fast-slow"])
@pytest.mark.parametrize("first", [1, 4, 17])
def test_a_part_is_judged_as_in_the_whole(name: str, first: int) -> None:
    """Assert that a part of a trajectory, told where it begins, has the whole's probabilities once history is full."""
    result = trained(name)
    series = make_series(name, 160)
    full = result.architecture.history + result.architecture.every - 2
    part = result.over(inputs.part(series, first, 160), first)
    np.testing.assert_array_equal(part[full:], result.over(series)[first + full :])


def test_events_in_the_window_reach_no_model() -> None:
    """Assert that an image model says the same whether or not the window strip is full of events."""
    result = trained("hist10-img-6x6")
    with_window, without = (LiveDetector(result, started(), WINDOW) for _ in range(2))
    for x, y, p in events_about_rims(20):
        gel = x < 540
        more = np.concatenate([x[gel], np.full(500, 560, np.uint16)])
        rows = np.concatenate([y[gel], np.arange(500, dtype=np.uint16) % 480])
        probabilities = with_window.step(more, rows, np.concatenate([p[gel], np.ones(500, np.uint8)]))
        assert probabilities == pytest.approx(without.step(x[gel], y[gel], p[gel]), abs=0, nan_ok=True)


def test_no_probability_of_onnxruntime_is_above_one() -> None:
    """Assert so for every logit from 17.5 to 18.5, of which onnxruntime gives some a sigmoid of 1.0000001."""
    logits = np.arange(*np.array([17.5, 18.5], np.float32).view(np.int32), dtype=np.int32).view(np.float32)
    value = partial(helper.make_tensor_value_info, elem_type=TensorProto.FLOAT, shape=[None])
    node = helper.make_node("Sigmoid", ["features"], ["probability"])
    graph = helper.make_graph([node], "sigmoid", [value("features")], [value("probability")])
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", onnx_graphs.OPSET)], ir_version=onnx_graphs.IR
    )
    probabilities = Detector(model.SerializeToString(), ARCHITECTURES["no-hist-img"]).probability(logits)
    assert probabilities.dtype == np.float32
    assert 0.999 < probabilities.min() <= probabilities.max() <= 1


def test_needs_no_torch() -> None:
    """Assert that a detector runs where torch cannot be imported."""
    code = "import sys; sys.modules['torch'] = None; import evetac_cli.kernels.slip.detector, evetac_cli.trials.grasp"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_dots_of_another_number_are_refused() -> None:
    """Assert that a tracker of fewer dots than the network was trained for is refused at the start."""
    with pytest.raises(ValueError, match="expected 56 dots for the network, found 48"):
        LiveDetector(trained("hist10"), tracker.start(REST[:48], presets.PRESETS["stable"]), WINDOW)


def test_m4_inputs_of_another_grid_are_a_value_error() -> None:
    """Assert that inputs of another shape or type are a ValueError in words, not a wrong number."""
    for wrong in (np.zeros((1, 12, 20), np.float32), np.zeros((56, 20), np.float32), np.zeros((1, 56, 20))):
        with pytest.raises(ValueError, match="inputs"):
            trained("hist10").probability(wrong)
