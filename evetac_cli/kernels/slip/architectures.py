"""The table of slip detectors: the paper's model configurations, its image baselines and evetac's own, plus plug-ins.

The table is in this module and not with the networks because `grasp` and `evaluate` need a detector's history and
inputs, but must not import torch. This module only needs numpy.

`Sensitivity` has the known properties of a sensor that make it respond differently from another to the same contact.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX, SLICES_PER_S
from evetac_cli.kernels.event_representation import Representation
from evetac_cli.kernels.tracking.presets import USUAL_CONTRAST


class Sensitivity(NamedTuple):
    """Properties of one sensor, as estimated by `evetac identify`; None if unknown.

    `contrast_over_threshold`: log contrast of a dot over the camera's threshold, which is the number of events of a
    pixel when the rim of a dot passes. `shear_modulus_pa`: of the gel; under the same force a gel of twice the modulus
    moves half as far. Stage files store them as datasets of these names, calibration files as keys.

    >>> import evetac_cli as evetac
    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     evetac.Sensitivity(shear_modulus_pa=9e4).known(), sorted(recording.sensitivity.known())
    ({'shear_modulus_pa': 90000.0}, ['contrast_over_threshold', 'shear_modulus_pa'])
    """

    contrast_over_threshold: float | None = None
    shear_modulus_pa: float | None = None

    def known(self) -> dict[str, float]:
        """Return the known properties by name."""
        return {name: value for name, value in self._asdict().items() if value is not None}


UNKNOWN_SENSITIVITY = Sensitivity()
SENSITIVITY_DATASETS = {name: f"sensor/{name}" for name in Sensitivity._fields}


def sensitivity_of(sensor: Mapping[str, Any]) -> Sensitivity:
    """Return the properties among the datasets `sensor/...` of a file or a trial."""
    return Sensitivity(**{name: float(sensor[path]) for name, path in SENSITIVITY_DATASETS.items() if path in sensor})


CHANNELS = ("distance", "events")  # features of every dot and slice; distance from rest in px
# Properties of the sensor `evetac`, to which others are scaled: events of a pixel as a dot's rim passes, and its gel.
EVENTS_A_RIM = USUAL_CONTRAST
SHEAR_MODULUS_PA = 145e3
GEL_PX = (540, 480)  # width and height of an event image: the frame without the window strip

# Layer widths that are the same in all rows of the paper's table.
CONV1 = 16  # channels
CONV2 = 32
FC3 = 32
FC4 = 10
IMAGE_CONVS = (15, 20, 25, 32)  # channels of the image baseline's convolutions
IMAGE_KERNEL = 5
IMAGE_FC = 10
LEAST_ROWS, LEAST_COLUMNS = 2, 4  # smallest grid of dots for a network over dots


class ChannelView(NamedTuple):
    """How a network sees one channel of a dot: the newest slices as they are, then means over consecutive blocks."""

    channel: str  # one of CHANNELS
    recent: int = 0  # newest slices, newest first
    block: int = 1  # slices of a block
    means: int = 0  # number of blocks, newest first

    @property
    def history(self) -> int:
        """Number of slices that the view covers, including the newest."""
        return max(self.recent, self.block * self.means)


def to_one_sensor(sensor: Sensitivity) -> tuple[float, float]:
    """Return the factors that scale displacements and events of a sensor to those of `evetac`; 1 for what is unknown.

    A gel of half the modulus moves twice as far under the same force, and a camera of half the threshold makes twice
    the events for the same motion.
    """
    stiffer = 1.0 if sensor.shear_modulus_pa is None else sensor.shear_modulus_pa / SHEAR_MODULUS_PA
    ratio = sensor.contrast_over_threshold
    return stiffer, stiffer if ratio is None else stiffer * EVENTS_A_RIM / ratio


@dataclass(frozen=True)
class DotArchitecture:
    """A network that encodes each dot, then looks at their grid: a row of the paper's table."""

    name: str
    views: tuple[ChannelView, ...]  # in the order of the inputs
    fc1: int  # widths of the two layers that encode a dot
    fc2: int
    every: int = 1  # slices from one prediction to the next; it is held in between

    def __post_init__(self) -> None:
        channels = [view.channel for view in self.views]
        if not self.views or len(set(channels)) < len(channels) or not set(channels) <= set(CHANNELS):
            raise ValueError(f"views: expected different channels of {', '.join(CHANNELS)}, found {channels}")
        for view in self.views:
            if min(view.recent, view.means) < 0 or view.block < 1 or view.recent + view.means < 1:
                raise ValueError(f"view: expected at least one slice or block of at least one slice, found {view}")
        if min(self.fc1, self.fc2, self.every) < 1:
            raise ValueError(f"expected at least one unit per layer and one slice per prediction, found {self}")

    @property
    def history(self) -> int:
        """Number of slices that one prediction needs."""
        return max(view.history for view in self.views)

    @property
    def inputs_per_dot(self) -> int:
        """Number of inputs that describe one dot, l_i in the paper's table."""
        return sum(view.recent + view.means for view in self.views)


@dataclass(frozen=True)
class ImageArchitecture:
    """The paper's baseline on event images of 540 x 480 px: four convolutions of 5 x 5 with max pooling, two layers.

    `pool_px`: the image is first summed over squares of this side, so that a CPU can train the network. `pools`
    (width, height): max pooling after each convolution; together they must reduce the image to a single pixel.
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


# What a network with memory sees every 5 slices, in the order of its inputs (load_path.py).
LOAD_PATH = (
    *("size", "shear", "of_most_shear", "bent", "bends_20_ms", "shears_20_ms", "shears_200_ms"),
    *("moves_10_ms", "moves_30_ms", "moves_120_ms", "events", "stiffness", "slip_share_odds", "slip_begun_odds"),
    *("gripper_known", "closes_10_ms", "closes_30_ms", "closes_100_ms", "goal_ahead", "current_rises_20_ms"),
)
OF_GRIPPER = slice(LOAD_PATH.index("gripper_known"), len(LOAD_PATH))


@dataclass(frozen=True)
class MemoryArchitecture:
    """A network with memory of a contact: a layer over LOAD_PATH, a gated recurrent unit, and an output over both.

    hidden: width of the layer and of the memory. It predicts after every 5th slice (`every`), from the whole contact up
    to then, and needs no history besides its memory.
    """

    name: str
    hidden: int = 32
    every: ClassVar[int] = 5
    history: ClassVar[int] = 1


class PluginLayers:
    """Base class for the layers of another package's network, defined twice: as torch modules and as nodes of a graph.

    A layer has arrays NAME.weight and NAME.bias, with one bias value per row of the weight. The graph in a model file
    is never run: `add_layers` writes it again from the weights, and a file with a different graph is rejected. A
    network must set `method`: 1 at first, and one more whenever it computes other numbers under the same name. The
    method version is part of recipes, so that models are then trained again.
    """

    name: str
    method: ClassVar[int]

    def layers(self, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of the weight of each layer, by the layer's name, for a grid of dots."""
        raise NotImplementedError(f"{self.name} has no layers")

    def add_layers(self, graph: Any, value: str, rows: int, columns: int) -> str:
        """Add nodes to an onnx_graphs.GraphWriter: from inputs (batch, ...) to logits (batch, 1); return their name."""
        raise NotImplementedError(f"{self.name} has no layers")

    def modules(self, rows: int, columns: int) -> dict[str, Any]:
        """Return the layers as torch modules, for `train`; the last, a Linear, computes the logit from `hidden`."""
        raise NotImplementedError(f"{self.name} cannot be trained")

    def hidden(self, modules: Any, inputs: Any) -> Any:
        """Return the inputs of the last layer, in torch, from inputs (batch, ...); modules: by their names."""
        raise NotImplementedError(f"{self.name} cannot be trained")


@dataclass(frozen=True)
class PluginArchitecture(PluginLayers, DotArchitecture):
    """Another package's network over dots: its inputs are `views`, normalised as evetac's; its layers are its own.

    Its inputs are (batch, dots, inputs_per_dot).
    """

    fc1: int = 1  # unused, as the next
    fc2: int = 1


@dataclass(frozen=True)
class PluginImageArchitecture(PluginLayers):
    """Another package's network over event images; the rows and columns of dots do not concern its layers.

    of: the image representation of the events outside the window, for a frame of 640 x 480 px. The newest image ends
    with the slice of the prediction, and each of the `images` - 1 others ends 1000 / rate_hz slices before the next. In
    a surface, events older than window_ms before the end of the first image are unknown. Inputs are (batch, images *
    channels, height, width), the newest image first, normalised per channel. ValueError if images are not a whole
    number of slices apart.
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
        """Number of slices from one prediction to the next, and from one image to the next."""
        return int(SLICES_PER_S // self.of.rate_hz)

    @property
    def history(self) -> int:
        """Number of slices that one prediction needs."""
        return (self.images - 1) * self.every + self.of.longest_ms

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """(channels of all images, height, width) of one input."""
        *channels, height, width = self.of.shape
        return self.images * int(np.prod(channels)), height, width


OverImages = ImageArchitecture | PluginImageArchitecture
PluginNetwork = PluginArchitecture | PluginImageArchitecture
Architecture = DotArchitecture | MemoryArchitecture | OverImages
Weights = NDArray[np.float32]


def channels(architecture: Architecture) -> int:
    """Return the number of channels that are normalised separately: inputs of a dot or step, or channels of images."""
    if isinstance(architecture, MemoryArchitecture):
        return len(LOAD_PATH)
    if isinstance(architecture, DotArchitecture):
        return architecture.inputs_per_dot
    return architecture.input_shape[0]


def weight_shapes(architecture: Architecture, rows: int, columns: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of every array of a detector's weights by its name.

    The grid of dots matters only for a DotArchitecture and for plug-ins.
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
    elif isinstance(architecture, MemoryArchitecture):
        hidden = architecture.hidden
        # of the gates of the memory: update, reset and new content, one below the other, as in ONNX
        gates = {"entering": (3 * hidden, hidden), "recurring": (3 * hidden, hidden)}
        layers = {"first": (hidden, wide), **gates, "last": (1, 2 * hidden)}
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
    return shapes


_PAPER_POOLS = ((3, 3), (3, 3), (4, 4), (9, 7))
# The first of the paper's pools needs 90 x 80 px images; only these others leave 5 x 5 px for every convolution.
_POOLS_6X6 = ((3, 3), (2, 2), (1, 1), (4, 2))


def last_layer(architecture: Architecture, rows: int, columns: int) -> str:
    """Return the name of the layer that computes the logit, for this grid of dots; for plug-ins this imports torch."""
    if isinstance(architecture, PluginLayers):
        return list(architecture.modules(rows, columns))[-1]
    if isinstance(architecture, MemoryArchitecture):
        return "last"
    return "fc2" if isinstance(architecture, ImageArchitecture) else "fc5"


def with_scaled_logit(weights: Mapping[str, Weights], layer: str, scale: float, offset: float) -> dict[str, Weights]:
    """Return weights whose logit is scale * logit + offset of the original; layer: the last one."""
    weight, bias = (weights[f"{layer}.{part}"].astype(np.float64) for part in ("weight", "bias"))
    scaled = {f"{layer}.weight": scale * weight, f"{layer}.bias": scale * bias + offset}
    return {**weights, **{name: array.astype(np.float32) for name, array in scaled.items()}}


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
        # evetac's own. Whether a contact is near its limit depends on how it was loaded so far, longer ago than any
        # history above.
        MemoryArchitecture("load-path"),
    )
}
