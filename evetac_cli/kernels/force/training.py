"""Train the network that predicts the shear force from dots (paper, "Dot-based Shear Force Reconstruction").

From the paper: two hidden layers of 128 with ReLU and 25 % dropout, 50 epochs, and the weights of the epoch with the
smallest loss on a held-out trajectory. Not given in the paper: Adam with a learning rate of 0.002 that falls to 0 as a
cosine, batches of 32, mean squared error. Displacements and forces are each divided by their root mean square over the
training samples. The initial weights of the hidden layers are a fifth of torch's.

Reason for small initial weights: three trajectories contain three contact positions, and other patterns of dots reach
initial weights that were never trained. These settings were among the best of some twenty on simulated trajectories
that no report uses. A constant rate of 0.001 with torch's initial weights had larger errors than the regression.

Only `train-force` imports this module, because torch takes more than a second to import.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from evetac_cli.arrays import Floats
from evetac_cli.kernels.force.models import DenseLayer, Network, check_samples

HIDDEN = (128, 128)  # units of the hidden layers (paper)
DROPOUT = 0.25  # share (paper)
LEARNING_RATE = 2e-3  # of Adam, at the start
BATCH = 32  # samples
FIRST_WEIGHTS = 0.2  # factor on torch's initial weights of the hidden layers


class ForceTraining(NamedTuple):
    """A trained network, with its root mean squared errors after every epoch, in N."""

    network: Network
    learned_n: NDArray[np.float64]  # (epochs,) on the training samples, with dropout
    held_out_n: NDArray[np.float64]  # (epochs,)
    best_epoch: int  # epoch of these weights, counted from 0


def train(
    moved_px: Floats,
    force_n: Floats,
    held_out_moved_px: Floats,
    held_out_force_n: Floats,
    rng: np.random.Generator,
    epochs: int = 50,
    on_progress: Callable[[int, int], None] | None = None,
) -> ForceTraining:
    """Train on displacements (n, dots, 2) and forces (n, 2); choose the epoch by the held-out samples.

    ValueError for samples that do not fit, do not move, or have no force.
    """
    check_samples(moved_px, force_n)
    check_samples(held_out_moved_px, held_out_force_n)
    scale_px, scale_n = (float(np.sqrt(np.mean(values**2))) for values in (moved_px, force_n))
    if scale_px == 0 or scale_n == 0:
        raise ValueError(f"expected dots that move and forces, found {scale_px} px and {scale_n} N (rms)")
    torch.set_num_threads(1)  # too small for several threads, and one thread gives reproducible results
    learn = _tensor(moved_px, scale_px), _tensor(force_n, scale_n)
    held_out = _tensor(held_out_moved_px, scale_px), _tensor(held_out_force_n, scale_n)
    learned_n, held_out_n = np.empty(epochs), np.empty(epochs)
    best: Network | None = None
    with torch.random.fork_rng(devices=[]):  # initial weights and dropout use torch's global generator only
        torch.manual_seed(int(rng.integers(2**63)))
        network = _build(learn[0].shape[1])
        optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
        for epoch in range(epochs):
            network.train()
            for group in optimiser.param_groups:
                group["lr"] = LEARNING_RATE * 0.5 * (1 + np.cos(np.pi * epoch / epochs))
            squares = 0.0
            order = torch.from_numpy(rng.permutation(len(moved_px)))
            for first in range(0, len(order), BATCH):
                batch = order[first : first + BATCH]
                optimiser.zero_grad()
                loss = nn.functional.mse_loss(network(learn[0][batch]), learn[1][batch])
                torch.autograd.backward(loss)
                optimiser.step()
                squares += float(loss.detach()) * len(batch)
            network.eval()
            with torch.no_grad():
                held_out_loss = float(nn.functional.mse_loss(network(held_out[0]), held_out[1]))
            learned_n[epoch] = scale_n * np.sqrt(squares / len(moved_px))
            held_out_n[epoch] = scale_n * np.sqrt(held_out_loss)
            if best is None or held_out_n[epoch] < held_out_n[:epoch].min():
                best = _arrays(network, scale_px, scale_n)
            if on_progress:
                on_progress(epoch + 1, epochs)
    assert best is not None
    return ForceTraining(best, learned_n, held_out_n, int(np.argmin(held_out_n)))


def _tensor(values: Floats, scale: float) -> torch.Tensor:
    return torch.from_numpy((values.reshape(len(values), -1) / scale).astype(np.float32))


def _build(inputs: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for before, after in zip((inputs, *HIDDEN), HIDDEN, strict=False):
        hidden = nn.Linear(before, after)
        hidden.weight.data *= FIRST_WEIGHTS
        parts += [hidden, nn.ReLU(), nn.Dropout(DROPOUT)]
    return nn.Sequential(*parts, nn.Linear(HIDDEN[-1], 2))


def _arrays(network: nn.Sequential, scale_px: float, scale_n: float) -> Network:
    linear = [part for part in network if isinstance(part, nn.Linear)]
    layers = [DenseLayer(*(each.detach().numpy().copy() for each in (part.weight, part.bias))) for part in linear]
    return Network(tuple(layers), scale_px, scale_n)
