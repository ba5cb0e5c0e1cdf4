"""The slip detector as a torch network, as named arrays, and as an ONNX graph that needs no torch to run.

The network is the paper's (section Slip Detection, Model Architectures, and its figure): each dot is encoded alone by
two shared layers, the codes are laid out as the dots lie in the gel, two convolutions combine neighbours, and three
layers judge the whole. Only `train` imports this module, as torch takes more than a second to import.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from evetac_cli.kernels.slip import Architecture

CONV1 = 16  # channels, the same in all rows of the paper's table
CONV2 = 32
FC3 = 32
FC4 = 10

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
        architecture: Architecture,
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
        """Judge features (batch, dots row-major, inputs_per_dot): logits (batch,), whose sigmoid is the probability."""
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


def parameters(network: SlipNet) -> int:
    """Count what is trained."""
    return sum(parameter.numel() for parameter in network.parameters())


def weights(network: SlipNet) -> dict[str, NDArray[np.float32]]:
    """Copy out all weights and the input normalisation, by their names in the network."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def from_weights(
    architecture: Architecture, arrays: Mapping[str, NDArray[np.float32]], rows: int = 7, columns: int = 8
) -> SlipNet:
    """Build the network that `weights` came from; ValueError where names, shapes or values do not fit."""
    network = SlipNet(architecture, rows, columns)
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


def onnx_graph(network: SlipNet) -> bytes:
    """Build the ONNX file of the network: features (batch, dots, inputs_per_dot) float32 -> probability (batch,).

    Why so: written node by node, because torch's exporters are deprecated or want more packages, and this graph is
    short, the same for every torch, and identical byte for byte for identical weights.
    """
    arrays = weights(network)
    dots = network.rows * network.columns
    wide = network.architecture.inputs_per_dot
    nodes: list[Any] = []
    constants: dict[str, NDArray[Any]] = {
        name: value for name, value in arrays.items() if not name.startswith("input_")
    }
    constants["per_dot"] = np.array([-1, wide], np.int64)
    constants["per_grid"] = np.array([-1, network.rows, network.columns, network.architecture.fc2], np.int64)
    constants["per_batch"] = np.array([-1], np.int64)

    def add(operator: str, value: str, *more: str, output: str = "", **attributes: Any) -> str:
        output = output or f"value{len(nodes)}"
        nodes.append(helper.make_node(operator, [value, *more], [output], **attributes))
        return output

    def layer(operator: str, value: str, name: str, **attributes: Any) -> str:
        return add(operator, value, f"{name}.weight", f"{name}.bias", **attributes)

    value = "features"
    # left out where it is the identity; not folded into fc1, as a channel that hardly varies would cancel there
    if not (np.all(arrays["input_offset"] == 0) and np.all(arrays["input_scale"] == 1)):
        constants |= {name: arrays[name] for name in ("input_offset", "input_scale")}
        value = add("Mul", add("Sub", value, "input_offset"), "input_scale")
    value = add("Reshape", value, "per_dot")
    value = add("Relu", layer("Gemm", value, "fc1", transB=1))
    value = add("Relu", layer("Gemm", value, "fc2", transB=1))
    value = add("Transpose", add("Reshape", value, "per_grid"), perm=[0, 3, 1, 2])
    value = add("Relu", layer("Conv", value, "conv1", pads=[1, 0, 1, 0]))
    value = add("MaxPool", value, kernel_shape=[2, 2], strides=[2, 2])
    value = add("Relu", layer("Conv", value, "conv2", pads=[1, 1, 1, 1]))
    value = add("Flatten", value)
    value = add("Relu", layer("Gemm", value, "fc3", transB=1))
    value = add("Relu", layer("Gemm", value, "fc4", transB=1))
    value = add("Sigmoid", layer("Gemm", value, "fc5", transB=1))
    add("Reshape", value, "per_batch", output="probability")

    graph = helper.make_graph(
        nodes,
        network.architecture.name,
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["batch", dots, wide])],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, ["batch"])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    opset = [helper.make_opsetid("", ONNX_OPSET)]
    model = helper.make_model(graph, producer_name="evetac", opset_imports=opset, ir_version=ONNX_IR)
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content


def _channels(values: ArrayLike, wide: int) -> Tensor:
    array = np.asarray(values, np.float32)
    if array.shape not in {(), (wide,)} or not np.isfinite(array).all():
        raise ValueError(f"expected one finite value a channel, ({wide},), found shape {array.shape}: {array}")
    return torch.from_numpy(np.broadcast_to(array, wide).copy())
