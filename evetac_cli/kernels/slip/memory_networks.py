"""The compiled networks of a detector with memory: a layer, a gated recurrent unit, and an output over both.

The same networks are in torch (networks.py) and ONNX (onnx_graphs.py). Inputs are normalised and limited, because a
contact unlike all others must not fill the memory. The state of a contact begins at 0.
"""

from collections.abc import Mapping
from math import exp, nan, tanh
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.compiled import njit
from evetac_cli.kernels.slip.architectures import parted

Singles = NDArray[np.float32]
MOST_INPUT = 6.0  # limit of an input, in standard deviations
_ZERO, _MOST = np.float32(0.0), np.float32(MOST_INPUT)


class MemoryNetworks(NamedTuple):
    """The weights of a detector, each with the networks as its first axis.

    Matrices have a row per input and a column per output, as `_add_product` reads them.
    """

    offset: Singles
    scale: Singles
    first: Singles  # (networks, numbers, hidden)
    first_bias: Singles
    entering: Singles  # (networks, hidden, 3 hidden): update, reset, new content
    entering_bias: Singles
    recurring: Singles
    recurring_bias: Singles
    last: Singles  # (networks, 2 hidden, 1)
    last_bias: Singles

    @property
    def memory(self) -> Singles:
        """The state at the start of a contact, (networks, hidden)."""
        return np.zeros(self.first_bias.shape, np.float32)


def pack(weights: Mapping[str, Singles]) -> MemoryNetworks:
    """Pack the weights of a detector, with the names and shapes of `weight_shapes`."""
    every = parted(weights)
    arrays = [np.stack([one[name] for one in every]) for name in ("input_offset", "input_scale")]
    for layer in ("first", "entering", "recurring", "last"):
        arrays.append(np.ascontiguousarray(np.stack([one[f"{layer}.weight"].T for one in every])))
        arrays.append(np.stack([one[f"{layer}.bias"] for one in every]))
    return MemoryNetworks(*(array.astype(np.float32) for array in arrays))


@njit(cache=True)
def predict_step(numbers: Singles, networks: MemoryNetworks, memory: Singles) -> float:
    """Return the slip probability after one more step of a contact, from its numbers; memory: changed in place."""
    logit = _ZERO
    for network in range(memory.shape[0]):
        state = memory[network]
        hidden = state.shape[0]
        seen = (numbers - networks.offset[network]) * networks.scale[network]
        seen = np.minimum(np.maximum(seen, -_MOST), _MOST)
        layer = networks.first_bias[network].copy()
        _add_product(seen, networks.first[network], layer)
        layer = np.maximum(layer, _ZERO)
        enters, recurs = networks.entering_bias[network].copy(), networks.recurring_bias[network].copy()
        _add_product(layer, networks.entering[network], enters)
        _add_product(state, networks.recurring[network], recurs)
        for unit in range(hidden):
            update = _sigmoid(enters[unit] + recurs[unit])
            reset = _sigmoid(enters[hidden + unit] + recurs[hidden + unit])
            new = tanh(enters[2 * hidden + unit] + reset * recurs[2 * hidden + unit])
            state[unit] = (1.0 - update) * new + update * state[unit]
        output = networks.last_bias[network].copy()
        _add_product(state, networks.last[network, :hidden], output)
        _add_product(layer, networks.last[network, hidden:], output)
        logit += output[0]
    probability: float = _sigmoid(logit / np.float32(memory.shape[0]))
    return probability


@njit(cache=True)
def predict_steps(
    numbers: Singles, touches: NDArray[np.bool_], networks: MemoryNetworks, memory: Singles, probability: Singles
) -> None:
    """Compute the slip probability (steps,) of numbers (steps, n); NaN without contact, which clears the memory."""
    for k in range(numbers.shape[0]):
        probability[k] = predict_touch(numbers[k], touches[k], networks, memory)


@njit(cache=True)
def predict_touch(numbers: Singles, touches: bool, networks: MemoryNetworks, memory: Singles) -> float:
    """Return `predict_step` with contact; without, clear the memory and return NaN."""
    if touches:
        probability: float = predict_step(numbers, networks, memory)
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
