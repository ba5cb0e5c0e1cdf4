"""Slip detectors as torch networks, as named arrays, and as ONNX graphs that need no torch to run.

The networks are the paper's (section Slip Detection, Model Architectures). `SlipNet`: two shared layers encode each dot
separately, the codes are arranged in the grid of the dots, two convolutions combine neighbours, and three layers
classify the whole. `ImageNet`: four convolutions on event images, and two layers. `MemoryNet` is evetac's own: a gated
recurrent unit over the steps of a contact. Only `train` imports this module, because torch takes more than a second to
import.
"""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from evetac_cli.kernels.slip import onnx_graphs
from evetac_cli.kernels.slip.architectures import (
    CONV1,
    CONV2,
    FC3,
    FC4,
    IMAGE_CONVS,
    IMAGE_FC,
    IMAGE_KERNEL,
    LEAST_COLUMNS,
    LEAST_ROWS,
    Architecture,
    DotArchitecture,
    ImageArchitecture,
    MemoryArchitecture,
    OverImages,
    PluginArchitecture,
    PluginImageArchitecture,
    PluginLayers,
    channels,
)
from evetac_cli.kernels.slip.detector import Detector
from evetac_cli.kernels.slip.memory_networks import MOST_INPUT


class SlipNetwork(nn.Module):
    """A slip detector: `last_hidden` and `outputs`, its last layer.

    Inputs are first normalised as (input - input_offset) * input_scale, fixed, one value per channel. By default this
    is the identity, as in the paper. Both are stored with the weights but are not trained or counted as parameters.
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
        """Set initial weights from torch's generator; the grid of dots does not matter for images."""
        super().__init__()
        self.architecture, self.rows, self.columns = architecture, rows, columns
        wide = channels(architecture)
        self._shape = (wide, 1, 1) if isinstance(architecture, OverImages) else (wide,)
        self.register_buffer("input_scale", _channels(1.0 if input_scale is None else input_scale, wide))
        self.register_buffer("input_offset", _channels(0.0 if input_offset is None else input_offset, wide))
        self.add_layers()

    def add_layers(self) -> None:
        """Add all layers, the last of which are the `outputs`."""
        raise NotImplementedError

    def forward(self, features: Tensor) -> Tensor:
        """Return logits (batch,), whose sigmoid is the probability, of features (batch, ...) as from `inputs.at`."""
        logits: Tensor = self.outputs(self.last_hidden(features))
        return logits[:, 0]

    @property
    def outputs(self) -> nn.Linear:
        """The last layer."""
        *_, last = self.children()
        assert isinstance(last, nn.Linear)
        return last

    def last_hidden(self, features: Tensor) -> Tensor:
        """Return the layer before the logits."""
        raise NotImplementedError

    def normalised(self, features: Tensor) -> Tensor:
        """Return features with the normalisation applied."""
        return (features - self.input_offset.view(self._shape)) * self.input_scale.view(self._shape)


class SlipNet(SlipNetwork):
    """Slip detector for a grid of dots."""

    architecture: DotArchitecture

    def add_layers(self) -> None:
        """Add the layers of the paper's table."""
        architecture, rows, columns = self.architecture, self.rows, self.columns
        assert rows >= LEAST_ROWS and columns >= LEAST_COLUMNS
        self.fc1 = nn.Linear(architecture.inputs_per_dot, architecture.fc1)
        self.fc2 = nn.Linear(architecture.fc1, architecture.fc2)
        # The kernel loses a column on each side but no row: 7 x 8 dots give 7 x 6, as in the paper's table.
        self.conv1 = nn.Conv2d(architecture.fc2, CONV1, 3, padding=(1, 0))
        self.pool = nn.MaxPool2d(2)
        self.conv2 = nn.Conv2d(CONV1, CONV2, 3, padding=1)
        self.fc3 = nn.Linear(CONV2 * (rows // 2) * ((columns - 2) // 2), FC3)
        self.fc4 = nn.Linear(FC3, FC4)
        self.fc5 = nn.Linear(FC4, 1)

    def last_hidden(self, features: Tensor) -> Tensor:
        """Return the layer before the logits, (batch, FC4)."""
        code = torch.relu(self.fc1(self.normalised(features)))
        code = torch.relu(self.fc2(code))
        grid = code.reshape(-1, self.rows, self.columns, self.architecture.fc2).permute(0, 3, 1, 2)
        grid = self.pool(torch.relu(self.conv1(grid)))
        grid = torch.relu(self.conv2(grid))
        flat = torch.relu(self.fc3(grid.flatten(1)))
        return torch.relu(self.fc4(flat))


class ImageNet(SlipNetwork):
    """Slip detector for event images, the paper's baseline."""

    architecture: ImageArchitecture

    def add_layers(self) -> None:
        """Add the convolutions and the two layers after them."""
        entering = (self.architecture.history, *IMAGE_CONVS)
        self.convs = nn.ModuleList(
            nn.Conv2d(before, after, IMAGE_KERNEL) for before, after in zip(entering, IMAGE_CONVS, strict=False)
        )
        self.fc1 = nn.Linear(IMAGE_CONVS[-1], IMAGE_FC)
        self.fc2 = nn.Linear(IMAGE_FC, 1)

    def last_hidden(self, features: Tensor) -> Tensor:
        """Return the layer before the logits, (batch, IMAGE_FC)."""
        # With this layout a training step takes 0.7 to 0.8 of the time on a CPU.
        images = self.normalised(features).contiguous(memory_format=torch.channels_last)
        for conv, (across, down) in zip(self.convs, self.architecture.pools, strict=True):
            images = torch.relu(nn.functional.max_pool2d(conv(images), (down, across)))
        return torch.relu(self.fc1(images.flatten(1)))


class MemoryNet(SlipNetwork):
    """Slip detector with memory of a contact, from the numbers of its steps; see memory_networks.py."""

    architecture: MemoryArchitecture

    def add_layers(self) -> None:
        """Add the layer over the numbers, the two of the gates, and the output."""
        hidden = self.architecture.hidden
        self.first = nn.Linear(channels(self.architecture), hidden)
        self.entering, self.recurring = nn.Linear(hidden, 3 * hidden), nn.Linear(hidden, 3 * hidden)
        self.last = nn.Linear(2 * hidden, 1)

    def last_hidden(self, features: Tensor) -> Tensor:
        """Return memory and layer after each step of one contact, (steps, 2 hidden), from numbers (steps, n)."""
        hidden, _ = self.remembered(features[None], torch.zeros(1, 1, self.architecture.hidden, device=features.device))
        return hidden[0]

    def remembered(self, features: Tensor, memory: Tensor, dropout: float = 0.0) -> tuple[Tensor, Tensor]:
        """Return memory and layer after each step, (streams, steps, 2 hidden), and the memory after the last.

        features: (streams, steps, n). memory: before the first step, (1, streams, hidden). dropout: share of the values
        that enter or leave the memory to set to 0, while training.
        """
        seen = torch.clamp(self.normalised(features), -MOST_INPUT, MOST_INPUT)
        layer = torch.relu(self.first(seen))
        drop = nn.functional.dropout
        entering = drop(layer, dropout, self.training)
        weights = [self._as_torch(each) for part in ("weight", "bias") for each in self._gates(part)]
        states, memory = torch.gru(entering, memory, weights, True, 1, 0.0, self.training, False, True)
        return torch.cat([drop(states, dropout, self.training), layer], 2), memory

    def _gates(self, part: str) -> tuple[Tensor, Tensor]:
        return getattr(self.entering, part), getattr(self.recurring, part)

    def _as_torch(self, gates: Tensor) -> Tensor:
        """Return gates in torch's order: reset, update, new content."""
        update, reset, new = gates.chunk(3)
        return torch.cat([reset, update, new])


class PluginNet(SlipNetwork):
    """A network of another package, over dots or images."""

    architecture: PluginArchitecture | PluginImageArchitecture

    def add_layers(self) -> None:
        """Add the layers of the package."""
        for name, module in self.architecture.modules(self.rows, self.columns).items():
            self.add_module(name, module)

    def last_hidden(self, features: Tensor) -> Tensor:
        """Return the layer before the logits."""
        hidden: Tensor = self.architecture.hidden(dict(self.named_children()), self.normalised(features))
        return hidden


def build(
    architecture: Architecture,
    rows: int = 7,
    columns: int = 8,
    input_scale: ArrayLike | None = None,
    input_offset: ArrayLike | None = None,
) -> SlipNetwork:
    """Return a network with initial weights from torch's generator; an `ImageNet` ignores the grid of dots."""
    kind: type[SlipNetwork] = PluginNet if isinstance(architecture, PluginLayers) else SlipNet
    if isinstance(architecture, ImageArchitecture):
        kind = ImageNet
    if isinstance(architecture, MemoryArchitecture):
        kind = MemoryNet
    return kind(architecture, rows, columns, input_scale, input_offset)


def parameters(network: SlipNetwork) -> int:
    """Return the number of trained weights and biases."""
    return sum(parameter.numel() for parameter in network.parameters())


def weights(network: SlipNetwork) -> dict[str, NDArray[np.float32]]:
    """Return copies of all weights and of the input normalisation, by their names in the network."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def from_weights(
    architecture: Architecture, arrays: Mapping[str, NDArray[np.float32]], rows: int = 7, columns: int = 8
) -> SlipNetwork:
    """Build the network from the arrays that `weights` returned; RuntimeError if names or shapes do not fit."""
    network = build(architecture, rows, columns)
    network.load_state_dict({name: torch.from_numpy(np.array(array, np.float32)) for name, array in arrays.items()})
    return network


def onnx_graph(network: SlipNetwork) -> bytes:
    """Return the ONNX file of the network: features (batch, ...) float32, as `inputs.at`, -> probability (batch,)."""
    return onnx_graphs.build(network.architecture, weights(network), network.rows, network.columns)


def difference_of_forms(
    architecture: Architecture,
    arrays: Mapping[str, NDArray[np.float32]],
    rows: int,
    columns: int,
    batch: NDArray[np.float32],
) -> float:
    """Return the largest difference in probability between a network in torch and its ONNX graph, for these inputs."""
    with torch.no_grad():
        logits = from_weights(architecture, arrays, rows, columns).eval()(torch.from_numpy(batch))
    graph = onnx_graphs.build(architecture, arrays, rows, columns)
    return float(np.abs(Detector(graph, architecture).probability(batch) - torch.sigmoid(logits).numpy()).max())


def _channels(values: ArrayLike, wide: int) -> Tensor:
    array = np.asarray(values, np.float32)
    assert array.shape in {(), (wide,)} and np.isfinite(array).all()
    return torch.from_numpy(np.broadcast_to(array, wide).copy())
