"""The compiled network of a detector with memory: a layer, a gated recurrent unit, and an output over both.

The same network is in torch (networks.py) and ONNX (onnx_graphs.py). Inputs are normalised and limited, because a
contact unlike all others must not fill the memory. The state of a contact begins at 0.
"""

from collections.abc import Mapping
from math import exp, nan, tanh
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit

Singles = NDArray[np.float32]
MOST_INPUT = 6.0  # limit of an input, in standard deviations
_ZERO, _MOST = np.float32(0.0), np.float32(MOST_INPUT)


class MemoryWeights(NamedTuple):
    """The weights; matrices have a row per input and a column per output, as `_add_product` reads them."""

    offset: Singles
    scale: Singles
    first: Singles  # (numbers, hidden)
    first_bias: Singles
    entering: Singles  # (hidden, 3 hidden): update, reset, new content
    entering_bias: Singles
    recurring: Singles
    recurring_bias: Singles
    last: Singles  # (2 hidden, 1)
    last_bias: Singles

    @property
    def memory(self) -> Singles:
        """The state at the start of a contact, (hidden,)."""
        return np.zeros(self.first_bias.shape, np.float32)


def pack(weights: Mapping[str, Singles]) -> MemoryWeights:
    """Pack the weights of a detector, with the names and shapes of `weight_shapes`."""
    arrays = [weights["input_offset"], weights["input_scale"]]
    for layer in ("first", "entering", "recurring", "last"):
        arrays += [weights[f"{layer}.weight"].T, weights[f"{layer}.bias"]]
    return MemoryWeights(*(np.array(array, np.float32, order="C") for array in arrays))


@njit(cache=True)
def predict_step(numbers: Singles, weights: MemoryWeights, memory: Singles) -> float:
    """Return the slip probability after one more step of a contact, from its numbers; memory: changed in place."""
    hidden = memory.shape[0]
    seen = (numbers - weights.offset) * weights.scale
    seen = np.minimum(np.maximum(seen, -_MOST), _MOST)
    layer = weights.first_bias.copy()
    _add_product(seen, weights.first, layer)
    layer = np.maximum(layer, _ZERO)
    enters, recurs = weights.entering_bias.copy(), weights.recurring_bias.copy()
    _add_product(layer, weights.entering, enters)
    _add_product(memory, weights.recurring, recurs)
    for unit in range(hidden):
        update = _sigmoid(enters[unit] + recurs[unit])
        reset = _sigmoid(enters[hidden + unit] + recurs[hidden + unit])
        new = tanh(enters[2 * hidden + unit] + reset * recurs[2 * hidden + unit])
        memory[unit] = (1.0 - update) * new + update * memory[unit]
    output = weights.last_bias.copy()
    _add_product(memory, weights.last[:hidden], output)
    _add_product(layer, weights.last[hidden:], output)
    probability: float = _sigmoid(output[0])
    return probability


@njit(cache=True)
def predict_steps(
    numbers: Singles, touches: NDArray[np.bool_], weights: MemoryWeights, memory: Singles, probability: Singles
) -> None:
    """Compute the slip probability (steps,) of numbers (steps, n); NaN without contact, which clears the memory."""
    for k in range(numbers.shape[0]):
        probability[k] = predict_touch(numbers[k], touches[k], weights, memory)


@njit(cache=True)
def predict_touch(numbers: Singles, touches: bool, weights: MemoryWeights, memory: Singles) -> float:
    """Return `predict_step` with contact; without, clear the memory and return NaN."""
    if touches:
        probability: float = predict_step(numbers, weights, memory)
        return probability
    memory[:] = _ZERO
    return nan


@njit(cache=True)
def _add_product(inputs: Singles, matrix: Singles, outputs: Singles) -> None:
    for place in range(inputs.shape[0]):
        for unit in range(outputs.shape[0]):
            outputs[unit] += inputs[place] * matrix[place, unit]


@njit(cache=True)
def _sigmoid(odds: float) -> float:
    return 1.0 / (1.0 + exp(-odds))
