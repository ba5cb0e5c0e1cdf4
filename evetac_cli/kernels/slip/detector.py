"""Run a trained slip detector: slice by slice while grasping, or over a whole trajectory.

Networks over dots run compiled; networks over images, and those of plug-ins, run in onnxruntime. A network with memory
(memory_networks.py) needs a trajectory from its start.

Online, a slice of events becomes a probability in one compiled call. The reason: each call into compiled code costs
about 1 us, and the Python code between two calls as much, while the whole takes 20 us.

The compiled networks have the same layers, on the same weights, as the torch networks (networks.py) and the ONNX graphs
(onnx_graphs.py). Reasons:
- Such a network is 100,000 multiplications. For one input, onnxruntime spends most of its time between them and takes
  2.7 times as long (in batches of 1000 the times are equal). Here every layer is one matrix product, which scipy's BLAS
  computes for numba.
- Inputs are processed one at a time, even if there are thousands. So a slice has the same bits alone and in a batch,
  which no batch library guarantees.
- The matrices of a layer are stored in the layout that is fastest for BLAS: a row per input, a column per output. A
  convolution is such a product too, once the 3 x 3 dots around each dot are copied into one row.
- Max pooling comes before bias and ReLU. The result is the same, because both are monotonic, and outputs that pooling
  would discard, such as the last of an odd number of rows, are not computed.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from math import exp
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip import features, inputs, load_path, memory_networks, onnx_graphs
from evetac_cli.kernels.slip.architectures import (
    CONV1,
    CONV2,
    FC3,
    FC4,
    GEL_PX,
    LOAD_PATH,
    UNKNOWN_SENSITIVITY,
    Architecture,
    DotArchitecture,
    MemoryArchitecture,
    OverImages,
    PluginArchitecture,
    PluginImageArchitecture,
    Sensitivity,
)
from evetac_cli.kernels.slip.features import EventImages, GelEvents
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.kernels.slip.memory_networks import MemoryWeights
from evetac_cli.kernels.tracking import tracker

_NAMES = ("fc1", "fc2", "conv1", "conv2", "fc3", "fc4", "fc5")  # layers in packing order
_SIDE = 3  # kernel size of the convolutions
_ZERO = np.float32(0.0)


class DotWeights(NamedTuple):
    """The weights of a network over dots, one after the other.

    sizes: rows and columns of dots, inputs of a dot, widths of fc1 and fc2.
    """

    values: NDArray[np.float32]
    sizes: NDArray[np.int64]


def pack_dots(
    architecture: DotArchitecture, weights: Mapping[str, NDArray[np.float32]], rows: int, columns: int
) -> DotWeights:
    """Pack the weights of a detector, with the names and shapes of `weight_shapes`."""
    sizes = [rows, columns, architecture.inputs_per_dot, architecture.fc1, architecture.fc2]
    pieces = [weights["input_offset"], weights["input_scale"]]
    for name in _NAMES:
        weight = weights[f"{name}.weight"]
        if name.startswith("conv"):  # (after, before, y, x) -> a row per position and input, in the order of _patches
            weight = weight.transpose(2, 3, 1, 0).reshape(-1, len(weight))
        elif name == "fc3":  # its inputs have the order (channel, y, x) in the network, and (y, x, channel) here
            grid = weight.reshape(len(weight), CONV2, rows // 2, (columns - 2) // 2)
            weight = grid.transpose(2, 3, 1, 0).reshape(-1, len(weight))
        else:
            weight = weight.T
        pieces += [weight.reshape(-1), weights[f"{name}.bias"]]
    return DotWeights(np.concatenate(pieces, dtype=np.float32), np.array(sizes, np.int64))


@njit(cache=True)
def predict_dots(
    inputs: NDArray[np.float32],
    values: NDArray[np.float32],
    sizes: NDArray[np.int64],
    probability: NDArray[np.float32],
) -> None:
    """Compute the slip probability (k,) of inputs (k, dots, inputs of a dot) from `inputs.at`; see `DotWeights`."""
    rows, columns, wide, fc1, fc2 = sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]
    dots, down, across = rows * columns, rows // 2, (columns - 2) // 2
    # Workspace for all inputs; the borders of the padded grids stay 0.
    normalised = np.empty((dots, wide), np.float32)
    code1 = np.empty((dots, fc1), np.float32)
    grid = np.zeros(((rows + 2) * columns, fc2), np.float32)
    patches1 = np.empty((4 * down * across, _SIDE * _SIDE * fc2), np.float32)
    conv1 = np.empty((4 * down * across, CONV1), np.float32)
    pooled = np.zeros(((down + 2) * (across + 2), CONV1), np.float32)
    patches2 = np.empty((down * across, _SIDE * _SIDE * CONV1), np.float32)
    conv2 = np.empty((down * across, CONV2), np.float32)
    hidden3 = np.empty((1, FC3), np.float32)
    hidden4 = np.empty((1, FC4), np.float32)
    output = np.empty((1, 1), np.float32)
    for k in range(inputs.shape[0]):
        _normalise(inputs[k], values[:wide], values[wide : 2 * wide], normalised)
        end = _layer(normalised, values, 2 * wide, code1)
        end = _layer(code1, values, end, grid[columns : columns + dots])
        _patches(grid, columns, 2 * across, patches1)
        end = _product(patches1, values, end, conv1)
        _pool(conv1, 2 * across, pooled)
        for row in range(1, down + 1):
            _bias_and_relu(pooled[row * (across + 2) + 1 : (row + 1) * (across + 2) - 1], values[end - CONV1 : end])
        _patches(pooled, across + 2, across, patches2)
        end = _layer(patches2, values, end, conv2)
        end = _layer(conv2.reshape(1, down * across * CONV2), values, end, hidden3)
        end = _layer(hidden3, values, end, hidden4)
        end = _product(hidden4, values, end, output)
        logit = np.float64(output[0, 0] + values[end - 1])
        probability[k] = np.float32(1.0 / (1.0 + exp(-logit)))


@njit(cache=True)
def _normalise(
    inputs: NDArray[np.float32],
    offset: NDArray[np.float32],
    scale: NDArray[np.float32],
    normalised: NDArray[np.float32],
) -> None:
    for dot in range(inputs.shape[0]):
        for column in range(inputs.shape[1]):
            normalised[dot, column] = (inputs[dot, column] - offset[column]) * scale[column]


@njit(cache=True)
def _product(inputs: NDArray[np.float32], values: NDArray[np.float32], begin: int, outputs: NDArray[np.float32]) -> int:
    """Multiply inputs (n, before) by the matrix (before, after) at `begin`; return the end of the bias after it."""
    before, after = inputs.shape[1], outputs.shape[1]
    bias: int = begin + before * after
    np.dot(inputs, values[begin:bias].reshape(before, after), outputs)
    end: int = bias + after
    return end


@njit(cache=True)
def _layer(inputs: NDArray[np.float32], values: NDArray[np.float32], begin: int, outputs: NDArray[np.float32]) -> int:
    """Apply `_product`, then bias and ReLU; return the end of the bias."""
    end: int = _product(inputs, values, begin, outputs)
    _bias_and_relu(outputs, values[end - outputs.shape[1] : end])
    return end


@njit(cache=True)
def _bias_and_relu(outputs: NDArray[np.float32], bias: NDArray[np.float32]) -> None:
    for row in range(outputs.shape[0]):
        for column in range(outputs.shape[1]):
            outputs[row, column] = max(outputs[row, column] + bias[column], _ZERO)


@njit(cache=True)
def _patches(grid: NDArray[np.float32], columns: int, across: int, patches: NDArray[np.float32]) -> None:
    """Copy 3 x 3 positions of a grid (rows * columns, channels) into one row, for each position of a wide output.

    Positions are unsigned indices into flat arrays, because numba would test signed ones: 0.5 us instead of 16.
    """
    flat, filled = grid.reshape(grid.size), patches.reshape(patches.size)
    wide, step = np.uint64(_SIDE * grid.shape[1]), np.uint64(grid.shape[1])
    into = np.uint64(0)
    for down in range(patches.shape[0] // across):
        for right in range(across):
            for row in range(_SIDE):
                first = np.uint64((down + row) * columns + right) * step
                for value in range(wide):
                    filled[into + value] = flat[first + value]
                into += wide


@njit(cache=True)
def _pool(grid: NDArray[np.float32], columns: int, pooled: NDArray[np.float32]) -> None:
    """Copy the maximum of each 2 x 2 positions of a grid, (rows * columns, channels), into a grid with a border."""
    across = columns // 2
    for place in range(grid.shape[0] // 4):
        row, column = place // across, place % across
        upper, into = 2 * row * columns + 2 * column, (row + 1) * (across + 2) + column + 1
        lower = upper + columns
        for channel in range(grid.shape[1]):
            most = max(grid[upper, channel], grid[upper + 1, channel])
            pooled[into, channel] = max(most, grid[lower, channel], grid[lower + 1, channel])


BATCH_VALUES = 1 << 22  # inputs processed at a time: 16 MiB


class Detector:
    """A trained detector, from the ONNX graph of its model file."""

    def __init__(self, graph: bytes, architecture: Architecture, dot_shape: tuple[int, int] = (7, 8)) -> None:
        """Load the graph; ValueError for invalid bytes, and for dots unless `onnx_graphs.build` wrote the graph.

        dot_shape: rows and columns of dots, which the graph of a network with memory does not have.
        """
        self.architecture, self.dot_shape = architecture, dot_shape
        self.dot_weights: DotWeights | None = None  # of a network over dots
        self.memory_weights: MemoryWeights | None = None  # of a network with memory
        if isinstance(architecture, MemoryArchitecture):
            self.memory_weights = memory_networks.pack(onnx_graphs.read_memory(graph, architecture))
        elif isinstance(architecture, DotArchitecture) and not isinstance(architecture, PluginArchitecture):
            self.dot_weights = pack_dots(architecture, *onnx_graphs.read(graph, architecture))
        else:
            self._session = _session(graph)

    @property
    def needs_sticking(self) -> bool:
        """Whether it needs the sticking share, which also tells a network with memory of the contact."""
        return self.memory_weights is not None

    def probability(self, batch: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the slip probability (k,) of inputs (k, ...) from `inputs.at`; ValueError for another shape.

        With memory, the inputs are the numbers (steps, LOAD_PATH) of one contact from its start.
        """
        if self.memory_weights is not None:
            if batch.shape[1:] != (len(LOAD_PATH),) or batch.dtype != np.float32:
                raise ValueError(f"expected float32 (steps, {len(LOAD_PATH)}), found {batch.dtype} {batch.shape}")
            return self._over_steps(LoadPath(batch, np.ones(len(batch), np.bool_), len(batch) * load_path.EVERY))
        if self.dot_weights is not None:
            rows, columns, wide = self.dot_weights.sizes[:3].tolist()
            if batch.shape[1:] != (rows * columns, wide) or batch.dtype != np.float32:
                wanted = f"float32 (k, {rows * columns}, {wide})"
                raise ValueError(f"expected inputs {wanted}, found {batch.dtype} {batch.shape}")
            result = np.empty(len(batch), np.float32)
            predict_dots(np.ascontiguousarray(batch), *self.dot_weights, result)
            return result
        probability: NDArray[np.float32]
        try:
            (probability,) = self._session.run(None, {"features": batch})
        except Exception as error:  # as in _session
            wanted = self._session.get_inputs()[0].shape
            raise ValueError(f"expected inputs {wanted}, found {batch.shape}: {error}") from error
        # onnxruntime's sigmoid is an approximation: it returns 1.0000001 for some logits around 18.
        return np.minimum(probability, np.float32(1), out=probability)

    @property
    def dots(self) -> int:
        """The number of dots that a network over dots is for."""
        if self.memory_weights is not None:
            return self.dot_shape[0] * self.dot_shape[1]
        dots = self._session.get_inputs()[0].shape[1] if self.dot_weights is None else self.dot_weights.sizes[:2].prod()
        return int(dots)

    def over(self, series: inputs.Series, first: int = 0) -> NDArray[np.float32]:
        """Return the slip probability of every slice of a trajectory.

        NaN until the history is full; with memory, while nothing touches.

        `first`: slice of the trajectory at which the series begins. It matters for a detector that predicts every 5th
        slice, counted from the beginning of the trajectory.
        """
        return over_each([self], series, first)[0]

    def _over_steps(self, path: LoadPath) -> NDArray[np.float32]:
        """Return the slip probability after each step, (steps,)."""
        weights = self.memory_weights
        assert weights is not None
        probability = np.empty(len(path.numbers), np.float32)
        numbers = np.ascontiguousarray(path.numbers)
        memory_networks.predict_steps(numbers, path.touches, weights, weights.memory, probability)
        return probability

    def _over_path(self, path: LoadPath) -> NDArray[np.float32]:
        """Return the slip probability of every slice, held from one step to the next."""
        every = np.full(path.slices, np.nan, np.float32)
        held = np.repeat(self._over_steps(path), load_path.EVERY)[: path.slices - (load_path.EVERY - 1)]
        every[load_path.EVERY - 1 : load_path.EVERY - 1 + len(held)] = held
        return every


def over_each(detectors: Sequence[Detector], series: inputs.Series, first: int = 0) -> list[NDArray[np.float32]]:
    """Return `Detector.over` for several detectors of one architecture, whose inputs are computed only once.

    ValueError if their architectures differ, or if a detector with memory gets a part without the start.
    """
    architecture = detectors[0].architecture
    if any(detector.architecture != architecture for detector in detectors):
        raise ValueError("expected detectors of one architecture, found several")
    if isinstance(architecture, MemoryArchitecture):
        if first or not isinstance(series, LoadPath):
            raise ValueError(f"expected a trajectory from its start, found one from slice {first}")
        return [detector._over_path(series) for detector in detectors]
    slices = inputs.length(series)
    every = [np.full(slices, np.nan, np.float32) for _ in detectors]
    delay = -first % architecture.every  # slices after a full history until the next prediction is due
    due = np.arange(architecture.history - 1 + delay, slices, architecture.every)
    at_once = max(1, BATCH_VALUES // max(1, _input_size(architecture, series)))
    for begin in range(0, len(due), at_once):
        ends = due[begin : begin + at_once]
        batch = inputs.at(architecture, series, ends)
        for detector, probability in zip(detectors, every, strict=True):
            probability[ends] = detector.probability(batch)
    if architecture.every > 1 and len(due):
        indices = np.arange(due[0], slices)
        for probability in every:
            probability[indices] = probability[indices - (indices - due[0]) % architecture.every]
    return every


def _input_size(architecture: Architecture, series: inputs.Series) -> int:
    """Return the number of values of one input."""
    if isinstance(architecture, OverImages):
        return int(np.prod(architecture.input_shape))
    if isinstance(series, inputs.OfEvents):
        return 1
    assert isinstance(architecture, DotArchitecture) and not isinstance(series, LoadPath)
    return int(series.shape[1]) * architecture.inputs_per_dot


def _session(graph: bytes) -> Any:
    """Load a graph into onnxruntime, on one thread; ValueError if onnxruntime rejects it."""
    import onnxruntime  # here, because networks over dots do not need it

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exception classes have no common base that can be imported
        raise ValueError(f"expected an ONNX graph, found bytes that onnxruntime rejects: {error}") from error


class LiveDetector:
    """A tracker and a detector that process one slice after the other.

    The probabilities are bit-identical to those of `Detector.over` on the tracks.
    """

    def __init__(
        self,
        detector: Detector,
        tracking: tracker.TrackerState,
        window_px: tuple[int, int, int, int] | NDArray[np.int32] | None,
        sensor: Sensitivity = UNKNOWN_SENSITIVITY,
        seen_dots: NDArray[np.bool_] | None = None,
    ) -> None:
        """Start before the first slice; tracking: of the dots at rest; the window (x0, y0, x1, y1) or None.

        sensor: its known properties; seen_dots: mask of the dots that the network sees, None for all. ValueError unless
        their number is the one that the network was trained for.
        """
        self.detector = detector
        self.tracking = tracking
        self._window_px = window_px
        self._probability = float("nan")
        architecture, weights = detector.architecture, detector.dot_weights
        self._path: load_path.LoadPathState | None = None  # of a network with memory
        seen = np.arange(len(tracking.rest_xy_px)) if seen_dots is None else np.flatnonzero(seen_dots)
        if isinstance(architecture, DotArchitecture | MemoryArchitecture) and len(seen) != detector.dots:
            raise ValueError(f"expected {detector.dots} dots for the network, found {len(seen)}")
        if detector.memory_weights is not None:
            self._start_path(detector.memory_weights, seen, sensor)
        elif isinstance(architecture, DotArchitecture):
            dots = features.start(tracking.rest_xy_px[seen], architecture.history)
            self._seen, self._features = seen, dots
            if weights is not None:
                batch = np.zeros((1, len(seen), architecture.inputs_per_dot), np.float32)
                # All arguments of the compiled call, in its order, created once.
                self._dots = (
                    *(dots.record, seen, architecture.every, inputs.view_table(architecture.views)),
                    *(batch, *weights, np.full(1, np.nan, np.float32)),
                )
                _compile(_predict_slice, tracking, self._dots)
        self._slices = 0  # number so far, for images and for dots of plug-ins
        self._newest = np.array([architecture.history - 1])
        self._images: deque[tuple[NDArray[Any], ...]] = deque(maxlen=architecture.history)  # columns of each slice
        self._blank = np.zeros(GEL_PX[::-1], np.int8)

    def _start_path(self, weights: MemoryWeights, seen: NDArray[np.int64], sensor: Sensitivity) -> None:
        """Start the numbers and the memory of a network with memory."""
        path = load_path.start(self.detector.dot_shape, sensor, self.tracking.record["frame_px"][0])
        rest = self.tracking.rest_xy_px[seen]
        # All arguments of the compiled call, in its order, created once.
        self._path = path
        self._steps = path.record, seen, rest, weights, weights.memory, np.full(1, np.nan, np.float32)
        _compile(_predict_step_of_slice, self.tracking, self._steps)

    def tell(
        self,
        position_ticks: float,
        goal_ticks: float,
        sticking_share: float = float("nan"),
        slip_begun: float = float("nan"),
    ) -> None:
        """Tell a network with memory of the next slices, until told again; NaN for what is unknown. Others ignore it.

        position_ticks, goal_ticks: of the gripper. sticking_share: of the contact, 0 to 1; slip_begun: probability that
        slip has begun.
        """
        if self._path is not None:
            self._path.told[:] = position_ticks, goal_ticks, np.nan, sticking_share, slip_begun

    @property
    def needs_times(self) -> bool:
        """Whether the network uses the times of events within a slice."""
        return isinstance(self.detector.architecture, PluginImageArchitecture)

    def step(
        self,
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        p: NDArray[np.uint8],
        t_us: NDArray[np.int64] | None = None,
    ) -> float:
        """Return the slip probability after the events of the next slice.

        NaN until the history is full; with memory, while nothing touches.

        t_us: times of the events, from the start of any slice; only networks with `needs_times` use them. Accepts the
        same columns as `tracker.step`.
        """
        if self._path is not None:
            p = tracker.checked_polarities(self.tracking, x, y, p)
            self._probability = _predict_step_of_slice(self.tracking.record, x, y, p, *self._steps)
            return self._probability
        if self.detector.dot_weights is not None:
            p = tracker.checked_polarities(self.tracking, x, y, p)
            self._probability = _predict_slice(self.tracking.record, x, y, p, *self._dots)
            return self._probability
        architecture = self.detector.architecture
        tracker.step(self.tracking, x, y, p)
        self._slices += 1
        if isinstance(architecture, PluginArchitecture):
            dots = self.tracking.dot_xy_px[self._seen], self.tracking.events_per_dot[self._seen]
            features.step(self._features, *dots)
        elif isinstance(architecture, PluginImageArchitecture):
            assert t_us is not None and len(t_us) == len(x)
            of_slice = features.gel_events(Events(t_us, x, y, p), np.array([0, len(x)]), self._window_px)
            self._images.append(of_slice[1:])
        else:
            self._images.append(features.gel_image(x, y, p, self._window_px, self._blank))
        since_full = self._slices - architecture.history
        if since_full >= 0 and since_full % architecture.every == 0:
            series: inputs.Series
            if isinstance(architecture, PluginArchitecture):
                series = features.latest_slices(self._features.record)
            else:
                series = self._stack()
            batch = inputs.at(architecture, series, self._newest)
            self._probability = float(self.detector.probability(batch)[0])
        return self._probability

    def _stack(self) -> inputs.OfEvents:
        start = np.cumsum([0, *(len(columns[0]) for columns in self._images)])
        series = GelEvents if self.needs_times else EventImages
        return series(start, *(np.concatenate(column) for column in zip(*self._images, strict=True)))


def _compile(kernel: Any, tracking: tracker.TrackerState, arguments: tuple[Any, ...]) -> None:
    """Compile or load a kernel of a slice now instead of in the first slice; on copies of its arguments."""
    copied = (array.copy() if isinstance(array, np.ndarray) else array for array in arguments)
    none = np.empty(0, np.uint16)
    kernel(tracking.record.copy(), none, none, np.empty(0, np.uint8), *copied)


@njit(cache=True)
def _predict_slice(
    tracking: NDArray[np.void],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    dots: NDArray[np.void],
    seen: NDArray[np.int64],
    every: int,
    views: NDArray[np.int64],
    batch: NDArray[np.float32],
    values: NDArray[np.float32],
    sizes: NDArray[np.int64],
    probability: NDArray[np.float32],
) -> float:
    """Track the dots, add the features of those seen, and predict when due; `probability` holds the value in between.

    tracking, dots: records of a `tracker.TrackerState` and a `features.FeatureState`. batch: workspace (1, dots,
    inputs). The rest as for `inputs.fill` and `predict_dots`.
    """
    tracker.take_slice(tracking, x, y, p)
    all_xy_px, all_events = tracking[0]["centre_xy_px"][:], tracking[0]["events"][:]
    dot_xy_px, events = np.empty((seen.shape[0], 2)), np.empty(seen.shape[0], np.int32)
    for i in range(seen.shape[0]):
        dot_xy_px[i, 0], dot_xy_px[i, 1] = all_xy_px[seen[i], 0], all_xy_px[seen[i], 1]
        events[i] = all_events[seen[i]]
    features.take_slice(dots, dot_xy_px, events)
    since_full = dots[0]["slices"] - dots[0]["history"]
    if since_full >= 0 and since_full % every == 0:
        ends = np.array([dots[0]["history"] - 1])
        inputs.fill(features.latest_slices(dots), ends, views, batch)
        predict_dots(batch, values, sizes, probability)
    return float(probability[0])


@njit(cache=True)
def _predict_step_of_slice(
    tracking: NDArray[np.void],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    p: NDArray[np.uint8],
    path: NDArray[np.void],
    seen: NDArray[np.int64],
    rest_xy_px: NDArray[np.float64],
    weights: MemoryWeights,
    memory: NDArray[np.float32],
    probability: NDArray[np.float32],
) -> float:
    """Track the dots, add the slice to the load path, and predict at the end of a step; the value is held in between.

    tracking, path: records of a `tracker.TrackerState` and a `load_path.LoadPathState`. rest_xy_px: of the dots seen.
    """
    tracker.take_slice(tracking, x, y, p)
    all_xy_px, all_events = tracking[0]["centre_xy_px"][:], tracking[0]["events"][:]
    moved_px, events = np.empty((seen.shape[0], 2), np.float32), np.empty(seen.shape[0], np.int32)
    for i in range(seen.shape[0]):
        for axis in range(2):
            moved_px[i, axis] = features.offset(all_xy_px[seen[i], axis], rest_xy_px[i, axis])
        events[i] = all_events[seen[i]]
    if load_path.take_slice(path, moved_px, events):
        numbers, touches = path[0]["numbers"][:], path[0]["touches"] != 0
        probability[0] = memory_networks.predict_touch(numbers, touches, weights, memory)
    return float(probability[0])
