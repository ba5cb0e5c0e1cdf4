"""Slip detectors as ONNX graphs: written from their weights, and checked before they are run.

Reasons:
- Graphs are written node by node, because torch's exporters are deprecated or need more packages. The graphs are short,
  the same for every torch version, and byte-identical for identical weights.
- A graph from a file may contain an endless loop or a constant of 32 GB, and onnxruntime would run it. So `check` only
  takes the weights from the file, writes evetac's graph for them, and rejects the file if its graph differs. A checked
  graph thus has no operator, attribute, constant, name or external file that this module does not write, and every size
  is bounded.
- The module does not need torch, because `grasp`, `evaluate` and `validate` check graphs and must not wait for its
  import.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from evetac_cli.kernels.slip.architectures import (
    LEAST_COLUMNS,
    LEAST_ROWS,
    Architecture,
    DotArchitecture,
    ImageArchitecture,
    MemoryArchitecture,
    OverImages,
    PluginLayers,
    channels,
    weight_shapes,
)
from evetac_cli.kernels.slip.memory_networks import MOST_INPUT

# The onnx package would write its newest versions, which the oldest onnxruntime that evetac accepts does not read.
OPSET = 17
IR = 8
PER_GRID = "per_grid"  # name of the constant shape of the dots' codes: all inputs, rows, columns, channels
LIMITS = {"least": -MOST_INPUT, "most": MOST_INPUT}  # of the inputs of a network with memory
# fields about the program that wrote a file, not about its computation
STAMPS = ("ir_version", "producer_name", "producer_version", "doc_string")


def build(
    architecture: Architecture, weights: Mapping[str, NDArray[np.float32]], rows: int = 7, columns: int = 8
) -> bytes:
    """Return the ONNX file of a detector with these weights: features (batch, ...) float32 -> probability (batch,).

    With memory, the batch is the steps of one contact from its start.
    """
    model = _model(architecture, weights, rows, columns)
    onnx.checker.check_model(model, full_check=True)
    serialised: bytes = model.SerializeToString()
    return serialised


def check(
    graph: bytes,
    architecture: Architecture,
    rows: int,
    columns: int,
    weights: Mapping[str, NDArray[np.float32]] | None = None,
) -> None:
    """Raise ValueError unless a graph is what `build` writes for this architecture and these weights (None: any)."""
    model = _parsed(graph)
    if model.functions or model.training_info or model.metadata_props:
        raise ValueError("expected a graph only, found functions, training or metadata in addition")
    inside = _weights_inside(model, architecture, rows, columns)
    if weights is not None:
        for name in sorted({*weights, *inside}):
            if name not in inside or name not in weights or not np.array_equal(inside[name], weights[name]):
                raise ValueError(f"expected the weights of the model file, found different ones for {name}")
    ours = _model(architecture, inside, rows, columns)
    for field in STAMPS:
        model.ClearField(field)
        ours.ClearField(field)
    if model != ours:
        raise ValueError(f"expected the graph of {architecture.name}, found another")


def read(graph: bytes, architecture: DotArchitecture) -> tuple[dict[str, NDArray[np.float32]], int, int]:
    """Return the weights of a graph, and rows and columns of its dots; ValueError unless `build` wrote it."""
    stored = {tensor.name: tensor for tensor in _parsed(graph).graph.initializer}
    per_grid = stored.get(PER_GRID)
    if per_grid is None or len(per_grid.raw_data) != 4 * 8:
        raise ValueError(f"expected the graph of {architecture.name}, found a graph without a grid of dots")
    _, rows, columns, _ = np.frombuffer(per_grid.raw_data, "<i8").tolist()
    if rows < LEAST_ROWS or columns < LEAST_COLUMNS:
        raise ValueError(f"expected at least {LEAST_ROWS} x {LEAST_COLUMNS} dots, found {rows} x {columns}")
    check(graph, architecture, rows, columns)
    return _weights_inside(_parsed(graph), architecture, rows, columns), rows, columns


def read_memory(graph: bytes, architecture: MemoryArchitecture) -> dict[str, NDArray[np.float32]]:
    """Return the weights of the graph of a detector with memory; ValueError unless `build` wrote it."""
    check(graph, architecture, LEAST_ROWS, LEAST_COLUMNS)  # which its weights do not depend on
    return _weights_inside(_parsed(graph), architecture, LEAST_ROWS, LEAST_COLUMNS)


def _parsed(graph: bytes) -> Any:
    try:
        return onnx.ModelProto.FromString(graph)
    except DecodeError:
        raise ValueError("expected an ONNX graph, found other bytes") from None


def _weights_inside(model: Any, architecture: Architecture, rows: int, columns: int) -> dict[str, NDArray[np.float32]]:
    """Return the weights of a graph in the shapes of the architecture; a missing normalisation is the identity."""
    stored = {tensor.name: tensor for tensor in model.graph.initializer}
    arrays = {}
    for name, shape in weight_shapes(architecture, rows, columns).items():
        tensor = stored.get(name)
        if tensor is None and name.endswith(("input_offset", "input_scale")):
            arrays[name] = np.full(shape, float(name.endswith("input_scale")), np.float32)
            continue
        size = int(np.prod(shape, dtype=np.int64))
        if tensor is None or tensor.data_type != TensorProto.FLOAT or len(tensor.raw_data) != 4 * size:
            raise ValueError(f"expected {size} weights {name} in the graph, found none or a different number")
        arrays[name] = np.frombuffer(tensor.raw_data, "<f4").reshape(shape)
    return arrays


def _model(architecture: Architecture, weights: Mapping[str, NDArray[np.float32]], rows: int, columns: int) -> Any:
    graph = GraphWriter(weights)
    if isinstance(architecture, DotArchitecture):
        shape = [rows * columns, architecture.inputs_per_dot]
    elif isinstance(architecture, MemoryArchitecture):
        shape = [channels(architecture)]
    else:
        shape = list(architecture.input_shape)
    value = graph.normalised("features", [-1, 1, 1] if isinstance(architecture, OverImages) else [-1])
    if isinstance(architecture, PluginLayers):
        value = architecture.add_layers(graph, value, rows, columns)
    elif isinstance(architecture, DotArchitecture):
        value = _dot_layers(graph, architecture, rows, columns, value)
    elif isinstance(architecture, MemoryArchitecture):
        value = _memory_layers(graph, architecture, value)
    else:
        value = _image_layers(graph, architecture, value)
    graph.add("Reshape", graph.add("Sigmoid", value), graph.constant("per_batch", [-1]), output="probability")
    content = helper.make_graph(
        graph.nodes,
        architecture.name,
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["batch", *shape])],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, ["batch"])],
        [numpy_helper.from_array(graph.arrays[name], name) for name in graph.used],
    )
    opset = [helper.make_opsetid("", OPSET)]
    return helper.make_model(content, producer_name="evetac", opset_imports=opset, ir_version=IR)


def _dot_layers(graph: "GraphWriter", architecture: DotArchitecture, rows: int, columns: int, value: str) -> str:
    value = graph.add("Reshape", value, graph.constant("per_dot", [-1, architecture.inputs_per_dot]))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc1", transB=1))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc2", transB=1))
    value = graph.add("Reshape", value, graph.constant(PER_GRID, [-1, rows, columns, architecture.fc2]))
    value = graph.add("Transpose", value, perm=[0, 3, 1, 2])
    value = graph.add("Relu", graph.layer("Conv", value, "conv1", pads=[1, 0, 1, 0]))
    value = graph.add("MaxPool", value, kernel_shape=[2, 2], strides=[2, 2])
    value = graph.add("Relu", graph.layer("Conv", value, "conv2", pads=[1, 1, 1, 1]))
    value = graph.add("Flatten", value)
    value = graph.add("Relu", graph.layer("Gemm", value, "fc3", transB=1))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc4", transB=1))
    return graph.layer("Gemm", value, "fc5", transB=1)


def _image_layers(graph: "GraphWriter", architecture: ImageArchitecture, value: str) -> str:
    for index, (across, down) in enumerate(architecture.pools):
        value = graph.layer("Conv", value, f"convs.{index}")
        if (across, down) != (1, 1):
            value = graph.add("MaxPool", value, kernel_shape=[down, across], strides=[down, across])
        value = graph.add("Relu", value)
    value = graph.add("Flatten", value)
    value = graph.add("Relu", graph.layer("Gemm", value, "fc1", transB=1))
    return graph.layer("Gemm", value, "fc2", transB=1)


def _memory_layers(graph: "GraphWriter", architecture: MemoryArchitecture, value: str) -> str:
    hidden, least, most = architecture.hidden, *(graph.limit(name, at) for name, at in LIMITS.items())
    value = graph.add("Clip", value, least, most)
    layer = graph.add("Relu", graph.layer("Gemm", value, "first", transB=1))
    sequence = graph.add("Reshape", layer, graph.constant("per_step", [-1, 1, hidden]))
    direction = graph.constant("direction", [0])
    (entering, enters), (recurring, recurs) = (graph.weights(name) for name in ("entering", "recurring"))
    matrices = [graph.add("Unsqueeze", name, direction) for name in (entering, recurring)]
    biases = graph.add("Unsqueeze", graph.add("Concat", enters, recurs, axis=0), direction)
    # with linear_before_reset the reset gate acts on the product, as in torch
    memory = graph.add("GRU", sequence, *matrices, biases, hidden_size=hidden, linear_before_reset=1)
    memory = graph.add("Reshape", memory, graph.constant("per_state", [-1, hidden]))
    return graph.layer("Gemm", graph.add("Concat", memory, layer, axis=1), "last", transB=1)


class GraphWriter:
    """The nodes and constants of an ONNX graph that is being written."""

    def __init__(self, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        self.nodes: list[Any] = []
        self.arrays: dict[str, NDArray[Any]] = dict(arrays)
        self.used: list[str] = []

    def add(self, operator: str, value: str, *more: str, output: str = "", **attributes: Any) -> str:
        """Add a node with these inputs and attributes; return the name of its output."""
        output = output or f"value{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [value, *more], [output], **attributes))
        return output

    def layer(self, operator: str, value: str, name: str, **attributes: Any) -> str:
        """Add a node whose other inputs are weight and bias of a layer; return the name of its output."""
        return self.add(operator, value, *self.weights(name), **attributes)

    def weights(self, name: str) -> tuple[str, str]:
        """Return the names of weight and bias of a layer, to use as inputs of nodes."""
        weight, bias = f"{name}.weight", f"{name}.bias"
        self.used += [weight, bias]
        return weight, bias

    def limit(self, name: str, value: float) -> str:
        """Add a constant number and return its name, as `constant` does."""
        if name not in self.used:
            self.arrays[name] = np.array(value, np.float32)
            self.used.append(name)
        return name

    def constant(self, name: str, values: list[int]) -> str:
        """Add an integer constant, such as a shape, and return its name; one name must always have the same values."""
        if name not in self.used:
            self.arrays[name] = np.array(values, np.int64)
            self.used.append(name)
        return name

    def normalised(self, value: str, shape: list[int]) -> str:
        """Subtract the offset and multiply by the scale, unless they are the identity; return the output's name.

        They are not folded into the first layer, because a channel that hardly varies would lose its precision there.
        """
        if np.all(self.arrays["input_offset"] == 0) and np.all(self.arrays["input_scale"] == 1):
            return value
        for name in ("input_offset", "input_scale"):
            self.arrays[name] = self.arrays[name].reshape(shape)
            self.used.append(name)
        return self.add("Mul", self.add("Sub", value, "input_offset"), "input_scale")
