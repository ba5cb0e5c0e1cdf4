"""Graphs of slip detectors: what is written is taken, and one bit more or less is not."""

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray
from onnx import numpy_helper

from evetac_cli.kernels.slip import networks, onnx_graphs
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, DotArchitecture

HIST10 = ARCHITECTURES["hist10"]


def weights_of(name: str, rows: int = 7, columns: int = 8) -> dict[str, NDArray[np.float32]]:
    """Seeded weights, with a normalisation that is not the identity."""
    rng = np.random.default_rng(1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        arrays = networks.weights(networks.build(ARCHITECTURES[name], rows, columns))
    size = arrays["input_scale"].size
    return {**arrays, "input_scale": rng.random(size, np.float32), "input_offset": rng.random(size, np.float32)}


@pytest.mark.parametrize("name", [name for name in ARCHITECTURES if not name.endswith("-img")])
@pytest.mark.parametrize("normalised", [False, True])
def test_what_is_written_is_taken(name: str, normalised: bool) -> None:
    """Assert that the graph of every architecture passes, with and without normalisation, and for another grid."""
    for grid in ((7, 8), (3, 5)):
        weights = weights_of(name, *grid)
        if not normalised:
            weights |= {"input_scale": np.ones_like(weights["input_scale"])}
            weights |= {"input_offset": np.zeros_like(weights["input_offset"])}
        graph = onnx_graphs.build(ARCHITECTURES[name], weights, *grid)
        onnx_graphs.check(graph, ARCHITECTURES[name], *grid, weights)
        onnx_graphs.check(graph, ARCHITECTURES[name], *grid)


def test_weights_are_read_back() -> None:
    """Assert that weights and grid come out of a graph as they went in, and that no foreign graph is read."""
    assert isinstance(HIST10, DotArchitecture)
    weights = weights_of("hist10", 3, 5)
    graph = onnx_graphs.build(HIST10, weights, 3, 5)
    inside, *grid = onnx_graphs.read(graph, HIST10)
    assert grid == [3, 5]
    assert {name: array.tobytes() for name, array in inside.items()} == {
        name: array.tobytes() for name, array in weights.items()
    }
    model = onnx.load_model_from_string(graph)
    next(node for node in model.graph.node if node.op_type == "Relu").op_type = "Abs"
    with pytest.raises(ValueError, match="expected the graph"):
        onnx_graphs.read(model.SerializeToString(), HIST10)
    images = onnx_graphs.build(ARCHITECTURES["hist10-img-6x6"], weights_of("hist10-img-6x6"))
    with pytest.raises(ValueError, match="grid of dots"):
        onnx_graphs.read(images, HIST10)


def test_who_wrote_it_does_not_matter() -> None:
    """Assert that a graph whose file was stamped by another version is the same graph."""
    weights = weights_of("hist10")
    model = onnx.load_model_from_string(onnx_graphs.build(HIST10, weights))
    model.producer_name, model.producer_version, model.ir_version = "another", "9", 9
    onnx_graphs.check(model.SerializeToString(), HIST10, 7, 8, weights)


def test_other_weights_grids_and_architectures_are_refused() -> None:
    """Assert that a graph is refused for weights that differ in one bit, another grid and another architecture."""
    weights = weights_of("hist10")
    graph = onnx_graphs.build(HIST10, weights)
    last_bit = {name: array.copy() for name, array in weights.items()}
    last_bit["fc4.bias"].view(np.uint32)[0] ^= 1
    with pytest.raises(ValueError, match=r"fc4\.bias"):
        onnx_graphs.check(graph, HIST10, 7, 8, last_bit)
    with pytest.raises(ValueError, match="more"):
        onnx_graphs.check(graph, HIST10, 7, 8, {**weights, "more": weights["fc4.bias"]})
    with pytest.raises(ValueError, match=r"weights fc3\.weight"):
        onnx_graphs.check(graph, HIST10, 9, 9)
    with pytest.raises(ValueError, match="expected the graph"):
        onnx_graphs.check(graph, HIST10, 6, 9)  # for which there are as many weights
    with pytest.raises(ValueError, match=r"weights input_scale|weights fc1\.weight"):
        onnx_graphs.check(graph, ARCHITECTURES["hist20"], 7, 8)


@pytest.mark.parametrize("content", [b"", b"\x00", b"no graph", bytes(range(256)) * 10])
def test_other_bytes_are_refused(content: bytes) -> None:
    """Assert that bytes which are no graph, and a graph of nothing, are a ValueError."""
    with pytest.raises(ValueError, match="expected"):
        onnx_graphs.check(content, HIST10, 7, 8)


def test_cut_short_and_with_more_behind() -> None:
    """Assert that a graph that is cut short anywhere, or has an initializer twice, is refused."""
    weights = weights_of("no-hist")
    graph = onnx_graphs.build(ARCHITECTURES["no-hist"], weights)
    for length in range(1, len(graph), 997):
        with pytest.raises(ValueError, match="expected"):
            onnx_graphs.check(graph[:length], ARCHITECTURES["no-hist"], 7, 8)
    model = onnx.load_model_from_string(graph)
    model.graph.initializer.append(numpy_helper.from_array(weights["fc5.bias"], "fc5.bias"))
    with pytest.raises(ValueError, match="expected the graph"):
        onnx_graphs.check(model.SerializeToString(), ARCHITECTURES["no-hist"], 7, 8)
