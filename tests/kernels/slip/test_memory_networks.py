"""The networks with memory: compiled as in torch and onnxruntime, and live as over a file, bit for bit."""

import math

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from evetac_cli.kernels.slip import features, inputs, load_path, networks
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    LOAD_PATH,
    MemoryArchitecture,
    Sensitivity,
)
from evetac_cli.kernels.slip.detector import Detector, LiveDetector, over_each
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath
from evetac_cli.kernels.tracking import tracker
from tests.kernels.slip.test_detector import REST, WINDOW, events_about_rims, started

MEMORY = ARCHITECTURES["load-path"]
assert isinstance(MEMORY, MemoryArchitecture)
SENSOR = Sensitivity(contrast_over_threshold=6.0, shear_modulus_pa=1e5)


def built(seed: int) -> networks.SlipNetwork:
    rng = np.random.default_rng(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return networks.build(MEMORY, 7, 8, rng.uniform(0.3, 2, len(LOAD_PATH)), rng.normal(size=len(LOAD_PATH)))


def detector(seed: int) -> Detector:
    return Detector(networks.onnx_graph(built(seed)), MEMORY)


def contact(steps: int, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).normal(1, 4, (steps, len(LOAD_PATH))).astype(np.float32)


@pytest.mark.parametrize("seed", [0, 1])
def test_three_forms_agree(seed: int) -> None:
    """Assert that compiled, torch and onnxruntime give the same probabilities of a contact within 1e-5."""
    numbers, network = contact(200), built(seed)
    graph = networks.onnx_graph(network)
    with torch.no_grad():
        expected = torch.sigmoid(network(torch.from_numpy(numbers))).numpy()
    (by_onnx,) = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"]).run(
        None, {"features": numbers}
    )
    compiled = detector(seed).probability(numbers)
    assert np.ptp(expected) > 0.2
    np.testing.assert_allclose(by_onnx, expected, atol=1e-5, rtol=0)
    np.testing.assert_allclose(compiled, expected, atol=1e-5, rtol=0)
    assert compiled.dtype == np.float32
    assert networks.difference_of_forms(MEMORY, networks.weights(network), 7, 8, numbers) <= 1e-5


def test_it_remembers_and_forgets() -> None:
    """Assert that a step depends on those before it in its contact, and on none before the contact."""
    result, numbers = detector(4), contact(30)
    touches = np.ones(30, np.bool_)
    touches[[9, 10, 20]] = False
    found = result.over(LoadPath(numbers, touches, 30 * EVERY))[EVERY - 1 :: EVERY]
    assert np.isnan(found).tolist() == (~touches).tolist()
    for begin, end in ((0, 9), (11, 20), (21, 30)):
        np.testing.assert_array_equal(found[begin:end], result.probability(numbers[begin:end]))
    assert abs(found[15] - result.probability(numbers[15:16])[0]) > 1e-4


def test_a_step_is_held_until_the_next() -> None:
    """Assert that slices have the probability of the last step, none before the first, for any length."""
    result, numbers = detector(4), contact(6)
    steps = result.probability(numbers)
    for slices in range(34):
        path = LoadPath(numbers[: slices // EVERY], np.ones(slices // EVERY, np.bool_), slices)
        expected = [math.nan if k < EVERY - 1 else steps[(k + 1) // EVERY - 1] for k in range(slices)]
        np.testing.assert_array_equal(result.over(path), np.array(expected, np.float32))
        np.testing.assert_array_equal(
            result.over(inputs.part(LoadPath(numbers, np.ones(6, np.bool_), 34), 0, slices)), result.over(path)
        )


def told(slices: int) -> NDArray[np.float32]:
    """A contact that is lost and found again, with a gripper that is known from the 30th slice on."""
    rng = np.random.default_rng(8)
    known = np.full((slices, 5), np.nan, np.float32)
    known[30:, 0] = 300 - np.arange(30, slices) // 7
    known[60:, 1] = 310
    known[15:, 3], known[15:, 4] = rng.random((2, slices - 15))
    known[70:82, 3:] = np.nan
    return known


def test_live_is_over() -> None:
    """Assert that a detector that is told as slices come has the bits of one that gets the features of all."""
    slices, result = 140, detector(5)
    known, columns, state = told(slices), events_about_rims(slices), started()
    moved, events = np.empty((slices, 56, 2), np.float32), np.empty((slices, 56), np.int32)
    for k, one in enumerate(columns):
        tracker.step(state, *one)
        moved[k], events[k] = features.displacement_xy(state.dot_xy_px, REST), state.events_per_dot
    path = load_path.over(load_path.start((7, 8), SENSOR), moved, events, known)
    offline = result.over(path)
    live = LiveDetector(result, started(), WINDOW, SENSOR)
    online = np.empty(slices, np.float32)
    for k, one in enumerate(columns):
        position, goal, _, sticks, begun = known[k].tolist()
        live.tell(position, goal, sticks, begun)
        online[k] = live.step(*one)
    np.testing.assert_array_equal(online, offline)
    assert np.isnan(online).any() and np.ptp(online[np.isfinite(online)]) > 1e-3


def test_refusals() -> None:
    """Assert that a part without the start, other inputs, other dots and a changed graph are refused."""
    result = detector(0)
    path = LoadPath(contact(3), np.ones(3, np.bool_), 15)
    with pytest.raises(ValueError, match="start"):
        over_each([result], path, 5)
    for wrong in (contact(3)[:, 1:], contact(3).astype(np.float64)):
        with pytest.raises(ValueError, match="expected float32"):
            result.probability(wrong)
    with pytest.raises(ValueError, match="expected 56 dots"):
        LiveDetector(result, tracker.start(REST[:48], started().constants), None)
    model = onnx.load_model_from_string(networks.onnx_graph(built(0)))
    (gates,) = (node for node in model.graph.node if node.op_type == "GRU")
    del gates.attribute[1]
    with pytest.raises(ValueError, match="expected the graph"):
        Detector(model.SerializeToString(), MEMORY)
