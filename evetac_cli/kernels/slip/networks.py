"""Slip detectors as torch networks, as named arrays, and as ONNX graphs that need no torch to run.

The networks are the paper's (section Slip Detection, Model Architectures). `SlipNet`: each dot is encoded alone by two
shared layers, the codes are laid out as the dots lie in the gel, two convolutions combine neighbours, and three layers
classify the whole. `ImageNet`: four convolutions on event images, and two layers. Only `train` imports this module, as
torch takes more than a second to import.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from evetac_cli.kernels.slip.architectures import Architecture, DotArchitecture, ImageArchitecture

CONV1 = 16  # channels, the same in all rows of the paper's table
CONV2 = 32
FC3 = 32
FC4 = 10
IMAGE_CONVS = (15, 20, 25, 32)  # channels of the baseline's convolutions
IMAGE_KERNEL = 5
IMAGE_FC = 10

# why so: the onnx package would stamp its newest versions, which the oldest onnxruntime we allow does not read
ONNX_OPSET = 17
ONNX_IR = 8


class SlipNet(nn.Module):
    """Slip detector for a grid of dots.

    Inputs are normalised first as (input - input_offset) * input_scale, both (inputs_per_dot,) and fixed; without them
    this is the identity, as in the paper. They travel with the weights but are not trained nor counted as parameters.
    """

    input_offset: Tensor
    input_scale: Tensor

    def __init__(
        self,
        architecture: DotArchitecture,
        rows: int = 7,
        columns: int = 8,
        input_scale: ArrayLike | None = None,
        input_offset: ArrayLike | None = None,
    ) -> None:
        if rows < 2 or columns < 4:
            raise ValueError(f"expected a grid of at least 2 x 4 dots (rows x columns), found {rows} x {columns}")
        super().__init__()
        self.architecture = architecture
        self.rows = rows
        self.columns = columns
        wide = architecture.inputs_per_dot
        self.register_buffer("input_scale", _channels(1.0 if input_scale is None else input_scale, wide))
        self.register_buffer("input_offset", _channels(0.0 if input_offset is None else input_offset, wide))
        self.fc1 = nn.Linear(wide, architecture.fc1)
        self.fc2 = nn.Linear(architecture.fc1, architecture.fc2)
        # the kernel loses a column on each side but no row, as 7 x 8 dots give 7 x 6 in the paper's table
        self.conv1 = nn.Conv2d(architecture.fc2, CONV1, 3, padding=(1, 0))
        self.pool = nn.MaxPool2d(2)
        self.conv2 = nn.Conv2d(CONV1, CONV2, 3, padding=1)
        self.fc3 = nn.Linear(CONV2 * (rows // 2) * ((columns - 2) // 2), FC3)
        self.fc4 = nn.Linear(FC3, FC4)
        self.fc5 = nn.Linear(FC4, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Logits (batch,), whose sigmoid is the probability, of features (batch, dots row-major, inputs_per_dot)."""
        code = (features - self.input_offset) * self.input_scale
        code = torch.relu(self.fc1(code))
        code = torch.relu(self.fc2(code))
        grid = code.reshape(-1, self.rows, self.columns, self.architecture.fc2).permute(0, 3, 1, 2)
        grid = self.pool(torch.relu(self.conv1(grid)))
        grid = torch.relu(self.conv2(grid))
        flat = torch.relu(self.fc3(grid.flatten(1)))
        flat = torch.relu(self.fc4(flat))
        logits: Tensor = self.fc5(flat)
        return logits[:, 0]


class ImageNet(nn.Module):
    """Slip detector for event images, the paper's baseline; normalised as `SlipNet`, by one value for each image."""

    input_offset: Tensor
    input_scale: Tensor

    def __init__(
        self,
        architecture: ImageArchitecture,
        input_scale: ArrayLike | None = None,
        input_offset: ArrayLike | None = None,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        wide = architecture.history
        self.register_buffer("input_scale", _channels(1.0 if input_scale is None else input_scale, wide))
        self.register_buffer("input_offset", _channels(0.0 if input_offset is None else input_offset, wide))
        entering = (wide, *IMAGE_CONVS)
        self.convs = nn.ModuleList(
            nn.Conv2d(before, after, IMAGE_KERNEL) for before, after in zip(entering, IMAGE_CONVS, strict=False)
        )
        self.fc1 = nn.Linear(IMAGE_CONVS[-1], IMAGE_FC)
        self.fc2 = nn.Linear(IMAGE_FC, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Logits (batch,) of images (batch, history, height, width), the newest first."""
        wide = self.architecture.history
        images = (images - self.input_offset.view(wide, 1, 1)) * self.input_scale.view(wide, 1, 1)
        # why so: a step of training takes 0.7 to 0.8 of the time on a CPU
        images = images.contiguous(memory_format=torch.channels_last)
        for conv, (across, down) in zip(self.convs, self.architecture.pools, strict=True):
            images = torch.relu(nn.functional.max_pool2d(conv(images), (down, across)))
        flat = torch.relu(self.fc1(images.flatten(1)))
        logits: Tensor = self.fc2(flat)
        return logits[:, 0]


Network = SlipNet | ImageNet


def build(
    architecture: Architecture,
    rows: int = 7,
    columns: int = 8,
    input_scale: ArrayLike | None = None,
    input_offset: ArrayLike | None = None,
) -> Network:
    """A network with first weights from torch's generator; rows and columns of dots mean nothing to an `ImageNet`."""
    if isinstance(architecture, ImageArchitecture):
        return ImageNet(architecture, input_scale, input_offset)
    return SlipNet(architecture, rows, columns, input_scale, input_offset)


def parameters(network: Network) -> int:
    """Number of trained weights and biases."""
    return sum(parameter.numel() for parameter in network.parameters())


def weights(network: Network) -> dict[str, NDArray[np.float32]]:
    """Copy out all weights and the input normalisation, by their names in the network."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def from_weights(
    architecture: Architecture, arrays: Mapping[str, NDArray[np.float32]], rows: int = 7, columns: int = 8
) -> Network:
    """Build the network that `weights` came from; ValueError where names, shapes or values do not fit."""
    network = build(architecture, rows, columns)
    state = network.state_dict()
    if set(arrays) != set(state):
        raise ValueError(f"expected weights {sorted(state)}, found {sorted(arrays)}")
    for name, tensor in state.items():
        array = np.asarray(arrays[name], np.float32)
        if array.shape != tuple(tensor.shape):
            raise ValueError(f"{name}: expected shape {tuple(tensor.shape)}, found {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite weights, found {np.count_nonzero(~np.isfinite(array))} others")
        tensor.copy_(torch.from_numpy(array))
    return network


def onnx_graph(network: Network) -> bytes:
    """Build the ONNX file of the network: features (batch, ...) float32, as `inputs.at`, -> probability (batch,).

    Why so: written node by node, because torch's exporters are deprecated or want more packages, and these graphs are
    short, the same for every torch, and identical byte for byte for identical weights.
    """
    graph = _Graph(weights(network))
    if isinstance(network, SlipNet):
        shape = [network.rows * network.columns, network.architecture.inputs_per_dot]
        value = _dot_layers(graph, network, graph.normalised("features", [-1]))
    else:
        shape = list(network.architecture.input_shape)
        value = _image_layers(graph, network, graph.normalised("features", [-1, 1, 1]))
    value = graph.add("Sigmoid", value)
    graph.add("Reshape", value, graph.constant("per_batch", [-1]), output="probability")
    content = helper.make_graph(
        graph.nodes,
        network.architecture.name,
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["batch", *shape])],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, ["batch"])],
        [numpy_helper.from_array(graph.arrays[name], name) for name in graph.used],
    )
    opset = [helper.make_opsetid("", ONNX_OPSET)]
    model = helper.make_model(content, producer_name="evetac", opset_imports=opset, ir_version=ONNX_IR)
    onnx.checker.check_model(model, full_check=True)
    serialised: bytes = model.SerializeToString()
    return serialised


def _dot_layers(graph: "_Graph", network: SlipNet, value: str) -> str:
    wide, fc2 = network.architecture.inputs_per_dot, network.architecture.fc2
    value = graph.add("Reshape", value, graph.constant("per_dot", [-1, wide]))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc1", transB=1))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc2", transB=1))
    value = graph.add("Reshape", value, graph.constant("per_grid", [-1, network.rows, network.columns, fc2]))
    value = graph.add("Transpose", value, perm=[0, 3, 1, 2])
    value = graph.add("Relu", graph.layer("Conv", value, "conv1", pads=[1, 0, 1, 0]))
    value = graph.add("MaxPool", value, kernel_shape=[2, 2], strides=[2, 2])
    value = graph.add("Relu", graph.layer("Conv", value, "conv2", pads=[1, 1, 1, 1]))
    value = graph.add("Flatten", value)
    value = graph.add("Relu", graph.layer("Gemm", value, "fc3", transB=1))
    value = graph.add("Relu", graph.layer("Gemm", value, "fc4", transB=1))
    return graph.layer("Gemm", value, "fc5", transB=1)


def _image_layers(graph: "_Graph", network: ImageNet, value: str) -> str:
    for index, (across, down) in enumerate(network.architecture.pools):
        value = graph.layer("Conv", value, f"convs.{index}")
        if (across, down) != (1, 1):
            value = graph.add("MaxPool", value, kernel_shape=[down, across], strides=[down, across])
        value = graph.add("Relu", value)
    value = graph.add("Flatten", value)
    value = graph.add("Relu", graph.layer("Gemm", value, "fc1", transB=1))
    return graph.layer("Gemm", value, "fc2", transB=1)


class _Graph:
    """Nodes and constants of an ONNX graph, as they are added."""

    def __init__(self, arrays: dict[str, NDArray[np.float32]]) -> None:
        self.nodes: list[Any] = []
        self.arrays: dict[str, NDArray[Any]] = dict(arrays)
        self.used: list[str] = []

    def add(self, operator: str, value: str, *more: str, output: str = "", **attributes: Any) -> str:
        output = output or f"value{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, [value, *more], [output], **attributes))
        return output

    def layer(self, operator: str, value: str, name: str, **attributes: Any) -> str:
        self.used += [f"{name}.weight", f"{name}.bias"]
        return self.add(operator, value, f"{name}.weight", f"{name}.bias", **attributes)

    def constant(self, name: str, values: list[int]) -> str:
        self.arrays[name] = np.array(values, np.int64)
        self.used.append(name)
        return name

    def normalised(self, value: str, shape: list[int]) -> str:
        """Offset and scale, left out where they are the identity.

        Why so: not folded into the first layer, as a channel that hardly varies would cancel there.
        """
        if np.all(self.arrays["input_offset"] == 0) and np.all(self.arrays["input_scale"] == 1):
            return value
        for name in ("input_offset", "input_scale"):
            self.arrays[name] = self.arrays[name].reshape(shape)
            self.used.append(name)
        return self.add("Mul", self.add("Sub", value, "input_offset"), "input_scale")


def _channels(values: ArrayLike, wide: int) -> Tensor:
    array = np.asarray(values, np.float32)
    if array.shape not in {(), (wide,)} or not np.isfinite(array).all():
        raise ValueError(f"expected one finite value a channel, ({wide},), found shape {array.shape}: {array}")
    return torch.from_numpy(np.broadcast_to(array, wide).copy())
