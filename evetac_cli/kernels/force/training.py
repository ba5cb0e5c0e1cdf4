"""Training of the network that predicts the shear force from dots (paper, "Dot-based Shear Force Reconstruction").

Two hidden layers of 128 with ReLU and 25 % dropout, 50 epochs, and the weights of the epoch with the least loss on a
trajectory held out. Where the paper is silent: Adam at 0.002 falling to 0 with a cosine, batches of 32, mean squared
error; displacements and forces are each divided by their root mean square over the training samples; the first weights
of the hidden layers are a fifth of torch's.

Why so: three trajectories show three places of contact, and other patterns of dots reach first weights that were never
trained. These settings were among the best of some twenty on simulated trajectories that no report uses; a constant
rate of 0.001, on first weights as torch draws them, had larger errors than the regression.

Only `train-force` imports this module, as torch takes more than a second to import.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.kernels.force.models import DenseLayer, Network, check_samples

HIDDEN = (128, 128)
DROPOUT = 0.25
LEARNING_RATE = 2e-3
BATCH = 32
FIRST_WEIGHTS = 0.2  # of the hidden layers, as a share of torch's own


class ForceTraining(NamedTuple):
    """A trained network, and how it came about: root mean squared errors after every epoch, in N."""

    network: Network
    learned_n: NDArray[np.float64]  # (epochs,) on the samples trained on, with dropout
    held_out_n: NDArray[np.float64]  # (epochs,)
    chosen: int  # the epoch, from 0, whose weights these are


def train(
    moved_px: Floats,
    force_n: Floats,
    held_out_moved_px: Floats,
    held_out_force_n: Floats,
    rng: np.random.Generator,
    epochs: int = 50,
    on_progress: Callable[[int, int], None] | None = None,
) -> ForceTraining:
    """Train on displacements (n, dots, 2) and forces (n, 2); choose the epoch on those held out.

    ValueError on samples that do not fit, do not move, or have no force.
    """
    check_samples(moved_px, force_n)
    check_samples(held_out_moved_px, held_out_force_n)
    check_range("epochs", epochs, 1)
    scale_px, scale_n = (float(np.sqrt(np.mean(values**2))) for values in (moved_px, force_n))
    if scale_px == 0 or scale_n == 0:
        raise ValueError(f"expected dots that move and forces, found {scale_px} px and {scale_n} N in the mean")
    torch.set_num_threads(1)  # too small to share, and one thread gives one result
    learn = _tensor(moved_px, scale_px), _tensor(force_n, scale_n)
    held_out = _tensor(held_out_moved_px, scale_px), _tensor(held_out_force_n, scale_n)
    learned_n, held_out_n = np.empty(epochs), np.empty(epochs)
    best: Network | None = None
    with torch.random.fork_rng(devices=[]):  # first weights and dropout come from torch's global generator only
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
                chosen = order[first : first + BATCH]
                optimiser.zero_grad()
                loss = nn.functional.mse_loss(network(learn[0][chosen]), learn[1][chosen])
                torch.autograd.backward(loss)
                optimiser.step()
                squares += float(loss.detach()) * len(chosen)
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
