"""The table of slip detectors: the paper's model configurations, its image baselines, and our own; what plug-ins add.

Why so: the table stands here and not beside the networks, because `grasp` and `evaluate` need a detector's history and
inputs but must not import torch. This module needs numpy alone.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICES_PER_S
from evetac_cli.kernels.event_representation import Representation
from evetac_cli.kernels.sensitivity import Sensitivity

CHANNELS = ("distance", "events", "x", "y")  # features of every dot and slice; displacements in px
# What a network may be told beside the dots, of every slice: where the fingers are and what they are commanded, in
# ticks (extras.py), and which share of the contact sticks, 0 to 1.
EXTRAS = ("position", "command", "sticking")
IN_TICKS = ("position", "command")
# Of the sensor `evetac`, to which others are scaled: events of a pixel as a dot's rim passes it, and of its gel.
EVENTS_A_RIM = 8.0
SHEAR_MODULUS_PA = 145e3
GEL_PX = (540, 480)  # width and height of an event image: the frame without the window strip

# Widths that are the same in all rows of the paper's table.
CONV1 = 16  # channels
CONV2 = 32
FC3 = 32
FC4 = 10
IMAGE_CONVS = (15, 20, 25, 32)  # channels of the baseline's convolutions
IMAGE_KERNEL = 5
IMAGE_FC = 10
LEAST_ROWS, LEAST_COLUMNS = 2, 4  # of a grid of dots that a network over them can take


class ChannelView(NamedTuple):
    """How a network sees one channel of a dot: newest slices as they are, then means over consecutive blocks.

    With `change`, all but the first value v are given as newest value - v: otherwise a displacement of many px would
    hide that it grows by hundredths of a px.
    """

    channel: str  # one of CHANNELS
    recent: int = 0  # newest slices, newest first
    block: int = 1  # slices of a block
    means: int = 0  # blocks, the newest first
    change: bool = False

    @property
    def history(self) -> int:
        """Slices that it reaches back, the newest one included."""
        return max(self.recent, self.block * self.means)


class ExtraView(NamedTuple):
    """How a network sees one of EXTRAS: whether it is known, its newest value, and by how much it changed since.

    Known is 1 where the newest value and all that changes are taken from are known; else all are 0. Why changes: where
    the fingers are tells the object's width, and a network would know by it which object of its training it is.
    """

    extra: str  # one of EXTRAS
    newest: bool = False
    changes_ms: tuple[int, ...] = ()

    @property
    def width(self) -> int:
        """Inputs."""
        return 1 + self.newest + len(self.changes_ms)

    @property
    def history(self) -> int:
        """Slices that it reaches back, the newest one included."""
        return 1 + max(self.changes_ms, default=0)


class Factors(NamedTuple):
    """What the features of a dot are multiplied by: displacements (distance, x, y), and events."""

    displacement: float = 1.0
    events: float = 1.0


@dataclass(frozen=True)
class DotArchitecture:
    """A network that encodes each dot, then looks at their grid: a row of the paper's table, or one of our own."""

    name: str
    views: tuple[ChannelView, ...]  # in the order of the inputs
    fc1: int  # widths of the two layers that encode a dot
    fc2: int
    every: int = 1  # slices from one prediction to the next; held in between
    # Whether displacements and events are scaled to those of one sensor, as far as the sensor's own figures are known:
    # a gel of half the modulus moves twice as far under the same force, and a camera of half the threshold gives twice
    # the events for the same motion. The paper's models take what there is.
    like_one_sensor: bool = False
    extras: tuple[ExtraView, ...] = ()  # given to every dot, after its own inputs; any of them may be unknown

    def __post_init__(self) -> None:
        channels = [view.channel for view in self.views]
        if not self.views or len(set(channels)) < len(channels) or not set(channels) <= set(CHANNELS):
            raise ValueError(f"views: expected different channels of {', '.join(CHANNELS)}, found {channels}")
        for view in self.views:
            if min(view.recent, view.means) < 0 or view.block < 1 or view.recent + view.means < 1:
                raise ValueError(f"view: expected at least one slice or block of at least one slice, found {view}")
            if view.change and view.recent < 1:
                raise ValueError(f"view: expected a newest slice to take the change from, found {view}")
        across = [tuple(view[1:]) for view in self.views if view.channel in ("x", "y")]
        if len(across) == 1 or (across and across[0] != across[1]):
            raise ValueError(f"views: expected x and y seen alike, so that they can be rotated, found {self.views}")
        seen = [view.extra for view in self.extras]
        if len(set(seen)) < len(seen) or not set(seen) <= set(EXTRAS):
            raise ValueError(f"extras: expected different ones of {', '.join(EXTRAS)}, found {seen}")
        if any(view.width < 2 or min(view.changes_ms, default=1) < 1 for view in self.extras):
            raise ValueError(f"extras: expected a newest value, or changes over 1 ms or more, found {self.extras}")
        if min(self.fc1, self.fc2, self.every) < 1:
            raise ValueError(f"at least one unit a layer and one slice a prediction are needed, found {self}")

    @property
    def history(self) -> int:
        """Slices that one prediction needs."""
        return max(*(view.history for view in self.views), *(view.history for view in self.extras), 0)

    @property
    def inputs_per_dot(self) -> int:
        """Length of the vector that describes one dot, l_i in the paper's table; with what it is told beside."""
        return self.own_inputs + sum(view.width for view in self.extras)

    @property
    def own_inputs(self) -> int:
        """How many of them are of the dot itself: the first."""
        return sum(view.recent + view.means for view in self.views)

    @property
    def sees_direction(self) -> bool:
        """Whether it needs displacements with their direction."""
        return not {"x", "y"}.isdisjoint(view.channel for view in self.views)

    def channel_columns(self, channel: str) -> slice:
        """Columns of a channel among the inputs of a dot; an empty slice if the network does not see it."""
        first = 0
        for view in self.views:
            if view.channel == channel:
                return slice(first, first + view.recent + view.means)
            first += view.recent + view.means
        return slice(0, 0)

    @property
    def train_cut_ms(self) -> int:
        """How much of a trajectory after its onset is trained on."""
        return _train_cut_ms(self.history)

    def factors(self, sensor: Sensitivity) -> Factors:
        """What the features of a sensor are multiplied by."""
        if not self.like_one_sensor:
            return Factors()
        stiffer = 1.0 if sensor.shear_modulus_pa is None else sensor.shear_modulus_pa / SHEAR_MODULUS_PA
        ratio = sensor.contrast_over_threshold
        return Factors(stiffer, stiffer if ratio is None else stiffer * EVENTS_A_RIM / ratio)


@dataclass(frozen=True)
class ImageArchitecture:
    """The paper's baseline on event images of 540 x 480 px: four convolutions of 5 x 5 with max pooling, two layers.

    `pool_px` sums the image over squares of so many px first, so that a CPU can train it; `pools` (width, height) are
    those after each convolution, and must bring the image to a single pixel.
    """

    name: str
    history: int
    pools: tuple[tuple[int, int], ...]
    pool_px: int = 1
    every: int = 1

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(history, height, width) of one input."""
        return self.history, GEL_PX[1] // self.pool_px, GEL_PX[0] // self.pool_px

    @property
    def train_cut_ms(self) -> int:
        """How much of a trajectory after its onset is trained on."""
        return _train_cut_ms(self.history)


class PluginLayers:
    """The layers of a network of another package, written down twice: as torch modules, and as nodes of a graph.

    A layer has arrays NAME.weight and NAME.bias, one value of it for each row of the weight. The graph in a model file
    is never run for what it is: it is written anew by `add_layers` from the weights, and refused if it is another.
    A network has to set `method`: 1, and one more whenever it computes other numbers under its name; it is part of
    recipes, so that models are trained anew then.
    """

    name: str
    method: ClassVar[int]

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """Shape of the weight of each layer, by the layer's name, for so many rows and columns of dots."""
        raise NotImplementedError(f"{self.name} has no layers")

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """Add nodes to an onnx_graphs.GraphWriter: from inputs (batch, ...) to logits (batch, 1)."""
        raise NotImplementedError(f"{self.name} has no layers")

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """The layers as torch modules, for `train`; the last, a Linear, makes the logit of what `hidden` gives."""
        raise NotImplementedError(f"{self.name} cannot be trained")

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """Torch: from inputs (batch, ...) to those of the last layer; modules: by their names."""
        raise NotImplementedError(f"{self.name} cannot be trained")


@dataclass(frozen=True)
class PluginArchitecture(PluginLayers, DotArchitecture):
    """A network over dots of another package: its inputs are `views`, normalised as ours; its layers are its own.

    Its inputs are (batch, dots, inputs_per_dot).
    """

    fc1: int = 1  # it has none of these
    fc2: int = 1


@dataclass(frozen=True)
class PluginImageArchitecture(PluginLayers):
    """A network over images of events of another package; rows and columns of dots mean nothing to its layers.

    of: what an image shows of the events outside the window, of a frame of 640 x 480 px; one ends with every slice that
    a prediction is made for, and each of the `images` - 1 before it 1000 / rate_hz slices earlier. Of a surface, events
    more than window_ms before the end of the first image are not known. Its inputs are (batch, images * channels,
    height, width), the newest image first, normalised by channel. ValueError where images are not whole slices apart.
    """

    name: str
    of: Representation
    images: int = 1

    def __post_init__(self) -> None:
        if self.images < 1 or self.of.frame_px != FRAME_PX or SLICES_PER_S % self.of.rate_hz:
            raise ValueError(
                f"expected images of {FRAME_PX[0]} x {FRAME_PX[1]} px, a whole number of ms apart, found {self}"
            )

    @property
    def every(self) -> int:
        """Slices from one prediction to the next, and from one image to the next."""
        return int(SLICES_PER_S // self.of.rate_hz)

    @property
    def history(self) -> int:
        """Slices that one prediction needs."""
        return (self.images - 1) * self.every + self.of.window_ms

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(channels of all images, height, width) of one input."""
        *channels, height, width = self.of.shape
        return self.images * int(np.prod(channels)), height, width

    @property
    def train_cut_ms(self) -> int:
        """How much of a trajectory after its onset is trained on."""
        return _train_cut_ms(self.history)


OverImages = ImageArchitecture | PluginImageArchitecture
PluginNetwork = PluginArchitecture | PluginImageArchitecture
Architecture = DotArchitecture | OverImages
Weights = NDArray[np.float32]


def channels(architecture: Architecture) -> int:
    """How many channels are normalised, each by itself: inputs of a dot, or channels of all images."""
    if isinstance(architecture, DotArchitecture):
        return architecture.inputs_per_dot
    return architecture.input_shape[0]


def joined(networks: Sequence[Mapping[str, Weights]]) -> dict[str, Weights]:
    """The weights of a detector of these networks: of one as they are, of several named with the network's number.

    Such a detector's logit is the mean of those of its networks.
    """
    if len(networks) == 1:
        return dict(networks[0])
    return {f"{number}.{name}": array for number, each in enumerate(networks) for name, array in each.items()}


def prefixes(names: Iterable[str]) -> list[str]:
    """What the names of each network's weights begin with: nothing where there is only one network."""
    numbers = {first for first, _, rest in (name.partition(".") for name in names) if first.isdigit() and rest}
    return [f"{number}." for number in range(len(numbers))] if numbers else [""]


def parted(weights: Mapping[str, Weights]) -> list[dict[str, Weights]]:
    """The weights of each network of a detector, by their names in it: what `joined` joined."""
    return [
        {name.removeprefix(prefix): array for name, array in weights.items() if name.startswith(prefix)}
        for prefix in prefixes(weights)
    ]


def weight_shapes(
    architecture: Architecture, rows: int, columns: int, networks: Sequence[str] = ("",)
) -> dict[str, tuple[int, ...]]:
    """Shape of every array of a detector's weights by its name; rows and columns of dots mean nothing for images.

    networks: what the names of each network's weights begin with, as from `prefixes`.
    """
    layers: dict[str, tuple[int, ...]]
    wide = channels(architecture)
    if isinstance(architecture, ImageArchitecture):
        entering = (wide, *IMAGE_CONVS)
        layers = {
            f"convs.{index}": (after, before, IMAGE_KERNEL, IMAGE_KERNEL)
            for index, (before, after) in enumerate(zip(entering, IMAGE_CONVS, strict=False))
        }
        layers |= {"fc1": (IMAGE_FC, IMAGE_CONVS[-1]), "fc2": (1, IMAGE_FC)}
    elif isinstance(architecture, PluginLayers):
        layers = architecture.layers(rows, columns)
    else:
        layers = {
            "fc1": (architecture.fc1, wide),
            "fc2": (architecture.fc2, architecture.fc1),
            "conv1": (CONV1, architecture.fc2, 3, 3),
            "conv2": (CONV2, CONV1, 3, 3),
            "fc3": (FC3, CONV2 * (rows // 2) * ((columns - 2) // 2)),
            "fc4": (FC4, FC3),
            "fc5": (1, FC4),
        }
    shapes: dict[str, tuple[int, ...]] = {"input_scale": (wide,), "input_offset": (wide,)}
    for name, shape in layers.items():
        shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    return {prefix + name: shape for prefix in networks for name, shape in shapes.items()}


_DIRECTIONS = (
    ChannelView("x", 10, 10, 5, change=True),
    ChannelView("y", 10, 10, 5, change=True),
    ChannelView("events", 10, 10, 5),
)
_PAPER_POOLS = ((3, 3), (3, 3), (4, 4), (9, 7))
# why so: 90 x 80 px hold the first of the paper's pools; then only these leave 5 x 5 px for every convolution
_POOLS_6X6 = ((3, 3), (2, 2), (1, 1), (4, 2))


def last_layer(architecture: Architecture, rows: int, columns: int) -> str:
    """The name of the layer that gives the logit, of networks over so many dots; of plug-ins it takes torch."""
    if isinstance(architecture, PluginLayers):
        return list(architecture.modules(rows, columns))[-1]
    return "fc2" if isinstance(architecture, ImageArchitecture) else "fc5"


def with_scaled_logit(weights: Mapping[str, Weights], layer: str, scale: float, offset: float) -> dict[str, Weights]:
    """Weights of a detector whose logit is scale * logit + offset of this one's; layer: the last of each network."""
    changed = dict(weights)
    for prefix in prefixes(weights):
        weight, bias = f"{prefix}{layer}.weight", f"{prefix}{layer}.bias"
        changed[weight] = (scale * weights[weight].astype(np.float64)).astype(np.float32)
        changed[bias] = (scale * weights[bias].astype(np.float64) + offset).astype(np.float32)
    return changed


def _train_cut_ms(history: int) -> int:
    """15 ms for a history of 10 or less, 20 ms to 20, 50 ms beyond (paper, Model Training & Data Selection)."""
    if history <= 10:
        return 15
    return 20 if history <= 20 else 50


def _distance_and_events(recent: int, block: int = 1, means: int = 0) -> tuple[ChannelView, ChannelView]:
    return ChannelView("distance", recent, block, means), ChannelView("events", recent, block, means)


ARCHITECTURES: dict[str, Architecture] = {
    row.name: row
    for row in (
        # the paper's table of model configurations
        DotArchitecture("no-hist", _distance_and_events(1), fc1=10, fc2=4),
        DotArchitecture("hist10", _distance_and_events(10), fc1=12, fc2=4),
        DotArchitecture("events-only", (ChannelView("events", 10),), fc1=8, fc2=4),
        DotArchitecture("disp-only", (ChannelView("distance", 10),), fc1=8, fc2=4),
        DotArchitecture("hist20", _distance_and_events(20), fc1=20, fc2=8),
        DotArchitecture("down5", _distance_and_events(0, 5, 10), fc1=12, fc2=4, every=5),
        DotArchitecture("fast-slow", _distance_and_events(10, 10, 5), fc1=15, fc2=8),
        # and its baselines
        ImageArchitecture("no-hist-img", 1, _PAPER_POOLS),
        ImageArchitecture("hist10-img", 10, _PAPER_POOLS),
        ImageArchitecture("no-hist-img-6x6", 1, _POOLS_6X6, pool_px=6),
        ImageArchitecture("hist10-img-6x6", 10, _POOLS_6X6, pool_px=6),
        # Ours, on the time scales of fast-slow. In incipient slip the border of the contact moves while its middle
        # sticks: what matters is the direction in which a dot moves against its neighbours, by hundredths of a px a
        # ms. The paper's models see the distance from rest alone, which has no direction and hides changes as small.
        # So: direction, and changes.
        # Twice the time (100 ms) was no better on unseen objects.
        DotArchitecture(
            "disp-xy",
            _DIRECTIONS,
            fc1=24,
            fc2=8,
            like_one_sensor=True,
        ),
        # The same, and what the gripper does and how much of the contact sticks, where that is known: fingers that
        # open a tick move the dots as a contact that begins to slip does.
        DotArchitecture(
            "disp-xy-grip",
            _DIRECTIONS,
            fc1=24,
            fc2=8,
            like_one_sensor=True,
            extras=(
                ExtraView("position", changes_ms=(10, 20, 30, 40, 50)),
                ExtraView("command", changes_ms=(10, 20, 30, 40, 50)),
                ExtraView("sticking", newest=True, changes_ms=(10, 50)),
            ),
        ),
    )
}
