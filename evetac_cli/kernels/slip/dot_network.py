"""The networks over dots, compiled: from the inputs of a slice to its slip probability.

It has the same layers, on the same weights, as the torch network (networks.py) and the ONNX graph (onnx_graphs.py).

Reasons:
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

from collections.abc import Mapping
from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import CONV1, CONV2, FC3, FC4, DotArchitecture, parted

_NAMES = ("fc1", "fc2", "conv1", "conv2", "fc3", "fc4", "fc5")  # layers in packing order
_SIDE = 3  # kernel size of the convolutions
_ZERO = np.float32(0.0)


class DotNetworks(NamedTuple):
    """The packed networks of a detector: `weights` (networks, values), and their `sizes`.

    sizes: rows and columns of dots, inputs of a dot, widths of fc1 and fc2.
    """

    weights: NDArray[np.float32]
    sizes: NDArray[np.int64]


def pack(
    architecture: DotArchitecture, weights: Mapping[str, NDArray[np.float32]], rows: int, columns: int
) -> DotNetworks:
    """Pack the weights of a detector, with the names and shapes of `weight_shapes`."""
    sizes = [rows, columns, architecture.inputs_per_dot, architecture.fc1, architecture.fc2]
    packed = [_packed(network, rows, columns) for network in parted(weights)]
    return DotNetworks(np.stack(packed), np.array(sizes, np.int64))


def _packed(network: Mapping[str, NDArray[np.float32]], rows: int, columns: int) -> NDArray[np.float32]:
    pieces = [network["input_offset"], network["input_scale"]]
    for name in _NAMES:
        weight = network[f"{name}.weight"]
        if name.startswith("conv"):  # (after, before, y, x) -> a row per position and input, in the order of _patches
            weight = weight.transpose(2, 3, 1, 0).reshape(-1, len(weight))
        elif name == "fc3":  # its inputs have the order (channel, y, x) in the network, and (y, x, channel) here
            grid = weight.reshape(len(weight), CONV2, rows // 2, (columns - 2) // 2)
            weight = grid.transpose(2, 3, 1, 0).reshape(-1, len(weight))
        else:
            weight = weight.T
        pieces += [weight.reshape(-1), network[f"{name}.bias"]]
    return np.concatenate(pieces, dtype=np.float32)


@njit(cache=True)
def predict(
    inputs: NDArray[np.float32],
    weights: NDArray[np.float32],
    sizes: NDArray[np.int64],
    probability: NDArray[np.float32],
) -> None:
    """Compute the slip probability (k,) of inputs (k, dots, inputs of a dot) from `inputs.at`; see `DotNetworks`."""
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
        logit = _ZERO
        for network in range(weights.shape[0]):
            values = weights[network]
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
            logit += output[0, 0] + values[end - 1]
        mean = np.float64(logit / np.float32(weights.shape[0]))
        probability[k] = np.float32(1.0 / (1.0 + exp(-mean)))


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
