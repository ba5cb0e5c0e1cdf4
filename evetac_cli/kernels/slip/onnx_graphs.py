"""Slip detectors as ONNX graphs: written from their weights, and checked before anything runs them.

Why so:
- Written node by node, because torch's exporters are deprecated or want more packages, and these graphs are short, the
  same for every torch, and identical byte for byte for identical weights.
- A graph from a file may hold a loop without end or a constant of 32 GB, and onnxruntime would run it. So `check` takes
  out of it nothing but the weights, writes our graph for them, and refuses the one from the file if it is another. That
  leaves no operator, attribute, constant, name or file that our own writer does not write, and bounds every size.
- A detector may be several networks that were trained apart: its logit is the mean of theirs, and the names of their
  weights begin with their number, as in `1.fc1.weight`.
- Without torch, because `grasp`, `evaluate` and `validate` check graphs and must not wait for its import.
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
    PluginLayers,
    prefixes,
    weight_shapes,
)

# why so: the onnx package would stamp its newest versions, which the oldest onnxruntime we allow does not read
OPSET = 17
IR = 8
PER_GRID = "per_grid"  # shape of the dots' codes: all inputs, rows, columns, channels
STAMPS = ("ir_version", "producer_name", "producer_version", "doc_string")  # who wrote a file, not what it computes


def build(
    architecture: Architecture, weights: Mapping[str, NDArray[np.float32]], rows: int = 7, columns: int = 8
) -> bytes:
    """The ONNX file of a detector with these weights: features (batch, ...) float32 -> probability (batch,)."""
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
    """Raise ValueError unless a graph is what `build` writes for this architecture and these weights, or any."""
    model = _parsed(graph)
    if model.functions or model.training_info or model.metadata_props:
        raise ValueError("expected one graph, found functions, training or metadata beside it")
    inside = _weights_inside(model, architecture, rows, columns)
    if weights is not None:
        for name in sorted({*weights, *inside}):
            if name not in inside or name not in weights or not np.array_equal(inside[name], weights[name]):
                raise ValueError(f"expected the weights of the file, found others as {name}")
    ours = _model(architecture, inside, rows, columns)
    for field in STAMPS:
        model.ClearField(field)
        ours.ClearField(field)
    if model != ours:
        raise ValueError(f"expected the graph of {architecture.name}, found {_difference(model, ours)}")


def read(graph: bytes, architecture: DotArchitecture) -> tuple[dict[str, NDArray[np.float32]], int, int]:
    """The weights that a graph holds, and rows and columns of its dots; ValueError unless `build` wrote it."""
    stored = {tensor.name: tensor for tensor in _parsed(graph).graph.initializer}
    per_grid = stored.get(PER_GRID)
    if per_grid is None or len(per_grid.raw_data) != 4 * 8:
        raise ValueError(f"expected the graph of {architecture.name}, found none over a grid of dots")
    _, rows, columns, _ = np.frombuffer(per_grid.raw_data, "<i8").tolist()
    if rows < LEAST_ROWS or columns < LEAST_COLUMNS:
        raise ValueError(f"expected at least {LEAST_ROWS} x {LEAST_COLUMNS} dots, found {rows} x {columns}")
    check(graph, architecture, rows, columns)
    return _weights_inside(_parsed(graph), architecture, rows, columns), rows, columns


def _parsed(graph: bytes) -> Any:
    try:
        return onnx.ModelProto.FromString(graph)
    except DecodeError:
        raise ValueError("expected an ONNX graph, found other bytes") from None


def _weights_inside(model: Any, architecture: Architecture, rows: int, columns: int) -> dict[str, NDArray[np.float32]]:
    """The weights that a graph holds, in the shapes of the architecture; a normalisation left out is the identity."""
    stored = {tensor.name: tensor for tensor in model.graph.initializer}
    arrays = {}
    for name, shape in weight_shapes(architecture, rows, columns, prefixes(stored)).items():
        tensor = stored.get(name)
        if tensor is None and name.endswith(("input_offset", "input_scale")):
            arrays[name] = np.full(shape, float(name.endswith("input_scale")), np.float32)
            continue
        size = int(np.prod(shape, dtype=np.int64))
        if tensor is None or tensor.data_type != TensorProto.FLOAT or len(tensor.raw_data) != 4 * size:
            raise ValueError(f"expected {size} weights {name} inside, found none or others")
        arrays[name] = np.frombuffer(tensor.raw_data, "<f4").reshape(shape)
    return arrays


def _difference(model: Any, ours: Any) -> str:
    """Where a graph departs from ours, in words."""
    operators, wanted = ([node.op_type for node in one.graph.node] for one in (model, ours))
    foreign = sorted(set(operators) - set(wanted))
    if foreign:
        return f"the operators {', '.join(name[:40] for name in foreign[:5])}"
    if operators != wanted:
        return f"{len(operators)} operators in another order, where there are {len(wanted)}"
    return "other constants or attributes"


def _model(architecture: Architecture, weights: Mapping[str, NDArray[np.float32]], rows: int, columns: int) -> Any:
    graph = GraphWriter(weights)
    logits = []
    for prefix in prefixes(weights):
        graph.prefix = prefix
        if isinstance(architecture, DotArchitecture):
            shape = [rows * columns, architecture.inputs_per_dot]
            value = graph.normalised("features", [-1])
        else:
            shape = list(architecture.input_shape)
            value = graph.normalised("features", [-1, 1, 1])
        if isinstance(architecture, PluginLayers):
            logits.append(architecture.add_layers(graph, value, rows, columns))
        elif isinstance(architecture, DotArchitecture):
            logits.append(_dot_layers(graph, architecture, rows, columns, value))
        else:
            logits.append(_image_layers(graph, architecture, value))
    value = graph.add("Sigmoid", logits[0] if len(logits) == 1 else graph.add("Mean", *logits))
    graph.add("Reshape", value, graph.constant("per_batch", [-1]), output="probability")
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


class GraphWriter:
    """Nodes and constants of an ONNX graph, as they are added."""

    def __init__(self, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        self.nodes: list[Any] = []
        self.arrays: dict[str, NDArray[Any]] = dict(arrays)
        self.used: list[str] = []
        self.prefix = ""  # of the weights' names of the network that is being added

    def add(self, operator: str, value: str, *more: str, output: str = "", **attributes: Any) -> str:
        """A node with these inputs and attributes; the name of its output."""
        output = output or f"value{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [value, *more], [output], **attributes))
        return output

    def layer(self, operator: str, value: str, name: str, **attributes: Any) -> str:
        """A node whose other inputs are weight and bias of a layer."""
        names = [f"{self.prefix}{name}.weight", f"{self.prefix}{name}.bias"]
        self.used += names
        return self.add(operator, value, *names, **attributes)

    def constant(self, name: str, values: list[int]) -> str:
        """Whole numbers, such as a shape, by a name that always has the same."""
        if name not in self.used:  # which all networks of a detector share
            self.arrays[name] = np.array(values, np.int64)
            self.used.append(name)
        return name

    def normalised(self, value: str, shape: list[int]) -> str:
        """Offset and scale, left out where they are the identity.

        Why so: not folded into the first layer, as a channel that hardly varies would cancel there.
        """
        offset, scale = f"{self.prefix}input_offset", f"{self.prefix}input_scale"
        if np.all(self.arrays[offset] == 0) and np.all(self.arrays[scale] == 1):
            return value
        for name in (offset, scale):
            self.arrays[name] = self.arrays[name].reshape(shape)
            self.used.append(name)
        return self.add("Mul", self.add("Sub", value, offset), scale)
