"""The slip network: the paper's shapes and counts, its arrays, and its ONNX graph."""

import numpy as np
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from evetac_cli.kernels.slip import networks
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    Architecture,
    DotArchitecture,
    ImageArchitecture,
    MemoryArchitecture,
    channels,
)
from evetac_cli.kernels.slip.networks import ImageNet, SlipNet, SlipNetwork

HIST10 = ARCHITECTURES["hist10"]
assert isinstance(HIST10, DotArchitecture)


@pytest.fixture
def network() -> SlipNet:
    """Give a network with seeded weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return SlipNet(HIST10)


def features(batch: int, seed: int = 0) -> NDArray[np.float32]:
    """Give random inputs as large as a busy gel's."""
    return np.random.default_rng(seed).normal(2, 5, (batch, 56, 20)).astype(np.float32)


def probability(network: SlipNetwork, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Run the network in torch."""
    with torch.no_grad():
        return torch.sigmoid(network(torch.from_numpy(inputs))).numpy()


def session(graph: bytes) -> onnxruntime.InferenceSession:
    """Load a graph for one thread, as grasp does."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("no-hist", 14_895),
        ("hist10", 15_125),
        ("hist20", 16_385),
        ("fast-slow", 15_990),
        # by hand: 25 weights a pair of channels and a bias, then 32 x 10 + 10 and 10 + 1
        ("no-hist-img", 25 * (1 * 15 + 15 * 20 + 20 * 25 + 25 * 32) + 92 + 341),
        ("hist10-img", 25 * (10 * 15 + 15 * 20 + 20 * 25 + 25 * 32) + 92 + 341),
        ("hist10-img-6x6", 25 * (10 * 15 + 15 * 20 + 20 * 25 + 25 * 32) + 92 + 341),
    ],
)
def test_parameter_count_is_the_papers(name: str, count: int) -> None:
    """Assert that layers have the sizes that the paper's table and text give."""
    assert networks.parameters(networks.build(ARCHITECTURES[name])) == count


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("no-hist-img", [(15, 158, 178), (20, 51, 58), (25, 11, 13), (32, 1, 1)]),
        ("no-hist-img-6x6", [(15, 25, 28), (20, 10, 12), (25, 6, 8), (32, 1, 1)]),
    ],
)
def test_images_shrink_to_one_pixel(name: str, sizes: list[tuple[int, int, int]]) -> None:
    """Assert that each convolution and its pool leave the size worked out by hand: 4 px less, then divided."""
    network = networks.build(ARCHITECTURES[name])
    assert isinstance(network, ImageNet)
    result = []
    for index, conv in enumerate(network.convs):
        across, down = network.architecture.pools[index]
        conv.register_forward_hook(
            lambda _, __, out, pool=(down, across): result.append(
                (out.shape[1], out.shape[2] // pool[0], out.shape[3] // pool[1])
            )
        )
    assert network(torch.zeros(1, *network.architecture.input_shape)).shape == (1,)
    assert result == sizes


def test_shapes_are_the_papers(network: SlipNet) -> None:
    """Assert that the layers give 56 x 4, 7 x 6 x 16, 3 x 3 x 32, 32, 10 and 1 values."""
    shapes = {}
    for name, layer in network.named_children():
        layer.register_forward_hook(lambda _, __, out, name=name: shapes.update({name: tuple(out.shape[1:])}))
    assert network(torch.from_numpy(features(2))).shape == (2,)
    assert shapes == {
        "fc1": (56, 12),
        "fc2": (56, 4),
        "conv1": (16, 7, 6),
        "pool": (16, 3, 3),
        "conv2": (32, 3, 3),
        "fc3": (32,),
        "fc4": (10,),
        "fc5": (1,),
    }


def test_dots_lie_row_by_row(network: SlipNet) -> None:
    """Assert that a change at the dot of row 2, column 5 reaches only its 3 x 3 neighbours in the first convolution."""
    outputs = []
    network.conv1.register_forward_hook(lambda _, __, out: outputs.append(out.detach().numpy()))
    inputs = features(1)
    network(torch.from_numpy(inputs))
    inputs[0, 2 * 8 + 5] += 50
    network(torch.from_numpy(inputs))
    touched = np.any(outputs[0] != outputs[1], axis=(0, 1))
    # no padding across columns: column c of the output looks at columns c .. c + 2
    expected = np.zeros((7, 6), bool)
    expected[1:4, 3:6] = True
    np.testing.assert_array_equal(touched, expected)


def test_normalisation_is_applied_first_and_not_trained() -> None:
    """Assert that offset and scale act as (x - offset) * scale and are no parameters."""
    rng = np.random.default_rng(2)
    offset, scale = rng.normal(size=20), rng.uniform(0.5, 2, 20)
    normalised = SlipNet(HIST10, input_scale=scale, input_offset=offset)
    arrays = networks.weights(normalised)
    plain = networks.from_weights(
        HIST10, arrays | {"input_scale": np.ones(20, np.float32), "input_offset": np.zeros(20, np.float32)}
    )
    inputs = features(5)
    moved = ((inputs - offset) * scale).astype(np.float32)
    np.testing.assert_allclose(probability(normalised, inputs), probability(plain, moved), atol=1e-6)
    assert networks.parameters(normalised) == 15_125


@pytest.mark.parametrize("normalised", [False, True])
def test_weights_come_back(normalised: bool) -> None:
    """Assert that a network rebuilt from its arrays has the same arrays and the same verdicts, bit for bit."""
    scale = np.linspace(0.5, 2, 20) if normalised else None
    network = SlipNet(HIST10, input_scale=scale)
    arrays = networks.weights(network)
    again = networks.from_weights(HIST10, arrays)
    assert {array.dtype for array in arrays.values()} == {np.dtype(np.float32)}
    assert all(np.array_equal(networks.weights(again)[name], array) for name, array in arrays.items())
    np.testing.assert_array_equal(probability(again, features(3)), probability(network, features(3)))


def spread(network: SlipNetwork, inputs: NDArray[np.float32]) -> None:
    """Scale and shift the last layer so that the probabilities of some inputs lie on both sides of 0.5."""
    last = network.outputs
    with torch.no_grad():
        logits = network(torch.from_numpy(inputs))
        last.weight.div_(logits.std())
        last.bias.sub_(logits.mean()).div_(logits.std())


def random_inputs(architecture: Architecture, batch: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Give inputs as large as a busy gel's; images from nearly empty to very busy ones."""
    if isinstance(architecture, ImageArchitecture):
        fired = rng.random((batch, *architecture.input_shape)) < np.linspace(0.02, 0.4, batch)[:, None, None, None]
        return np.where(fired, rng.choice(np.array([-1, 1], np.float32), fired.shape), np.float32(0))
    if isinstance(architecture, MemoryArchitecture):
        return rng.normal(2, 5, (batch, channels(architecture))).astype(np.float32)
    return rng.normal(2, 5, (batch, 56, architecture.inputs_per_dot)).astype(np.float32)


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("normalised", [False, True])
def test_onnx_agrees_with_torch(name: str, normalised: bool) -> None:
    """Assert that the ONNX graph gives torch's probabilities to 1e-5, one by one and many at once."""
    architecture, rng = ARCHITECTURES[name], np.random.default_rng(7)
    inputs = random_inputs(architecture, 2 if name.endswith("-img") else 24, rng)
    wide = channels(architecture)
    scale, offset = (rng.uniform(0.2, 2, wide), rng.normal(size=wide)) if normalised else (None, None)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        network = networks.build(architecture, input_scale=scale, input_offset=offset)
    spread(network, inputs)
    graph = session(networks.onnx_graph(network))
    expected = probability(network, inputs)
    assert np.ptp(expected) > 0.2
    for batch in (inputs[:1], inputs):
        (result,) = graph.run(None, {"features": batch})
        np.testing.assert_allclose(result, expected[: len(batch)], atol=1e-5, rtol=0)


def test_other_grids() -> None:
    """Assert that the closed gel's 7 x 9 dots and a small grid go through torch and ONNX alike."""
    for rows, columns in ((7, 9), (2, 4)):
        network = SlipNet(HIST10, rows, columns)
        inputs = np.random.default_rng(3).normal(size=(4, rows * columns, 20)).astype(np.float32)
        (result,) = session(networks.onnx_graph(network)).run(None, {"features": inputs})
        np.testing.assert_allclose(result, probability(network, inputs), atol=1e-5, rtol=0)
