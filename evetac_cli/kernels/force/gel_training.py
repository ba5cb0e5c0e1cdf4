"""Training of the network that gives force over modulus from the displacement field of a contact (gel_forces).

Two hidden layers of 192 with ReLU beside a linear part, AdamW at 0.003 falling to 0 with a cosine, batches of 256, and
a loss that is square near 0 and linear beyond, of errors in units of the targets' deviations. Every contact is learned
as it is and mirrored. Only `train-force` imports this module, as torch takes more than a second to import.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from evetac_cli.arrays import Floats
from evetac_cli.checks import check_range
from evetac_cli.kernels.force.gel_forces import LEAST_MM, GelNetwork
from evetac_cli.kernels.force.models import DenseLayer
from evetac_cli.kernels.touch.dot_field import mirrored

HIDDEN = (192, 192)
LEARNING_RATE = 3e-3
DECAY = 1e-2
BATCH = 256
SQUARE_TO = 0.3  # where the loss turns from square to linear


class GelTraining(NamedTuple):
    """A trained network, and the loss after every epoch."""

    network: GelNetwork
    loss: Floats  # (epochs,)


class _WithLinear(nn.Module):
    """Layers, and a linear part beside them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        parts: list[nn.Module] = []
        for before, after in zip((inputs, *HIDDEN), HIDDEN, strict=False):
            parts += [nn.Linear(before, after), nn.ReLU()]
        self.layers = nn.Sequential(*parts, nn.Linear(HIDDEN[-1], outputs))
        self.linear = nn.Linear(inputs, outputs)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Sum of both."""
        result: torch.Tensor = self.layers(inputs) + self.linear(inputs)
        return result


def train(
    field_mm: Floats,
    over_modulus_mm2: Floats,
    rng: np.random.Generator,
    epochs: int,
    on_progress: Callable[[int, int], None] | None = None,
) -> GelTraining:
    """Train on fields (n, places, 2) and forces over moduli (n, 3); ValueError on samples that do not fit."""
    if field_mm.ndim != 3 or over_modulus_mm2.shape != (len(field_mm), 3) or len(field_mm) < 2:
        raise ValueError(
            f"expected (n, places, 2) and (n, 3), n >= 2, found {field_mm.shape}, {over_modulus_mm2.shape}"
        )
    if not (np.isfinite(field_mm).all() and np.isfinite(over_modulus_mm2).all()):
        raise ValueError("expected finite fields and forces")
    check_range("epochs", epochs, 1)
    field_mm = np.concatenate([field_mm, mirrored(field_mm)])
    targets = np.concatenate([over_modulus_mm2, over_modulus_mm2 * [1.0, -1.0, 1.0]])
    rms = np.sqrt((field_mm**2).mean(axis=(1, 2)))[:, None] + LEAST_MM
    scale = (targets / rms).std(axis=0)
    if not (scale > 0).all():
        raise ValueError("expected contacts of different forces")
    torch.set_num_threads(1)  # too small to share, and one thread gives one result
    inputs = torch.from_numpy((field_mm.reshape(len(field_mm), -1) / rms).astype(np.float32))
    wanted = torch.from_numpy((targets / rms / scale).astype(np.float32))
    losses = np.empty(epochs)
    with torch.random.fork_rng(devices=[]):  # first weights come from torch's global generator only
        torch.manual_seed(int(rng.integers(2**63)))
        network = _WithLinear(inputs.shape[1], 3)
        optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=DECAY)
        for epoch in range(epochs):
            total = 0.0
            order = torch.from_numpy(rng.permutation(len(inputs)))
            for first in range(0, len(order), BATCH):
                share = (epoch + first / len(order)) / epochs
                for group in optimiser.param_groups:
                    group["lr"] = LEARNING_RATE * 0.5 * (1 + np.cos(np.pi * share))
                chosen = order[first : first + BATCH]
                optimiser.zero_grad()
                loss = nn.functional.smooth_l1_loss(network(inputs[chosen]), wanted[chosen], beta=SQUARE_TO)
                torch.autograd.backward(loss)
                optimiser.step()
                total += float(loss.detach()) * len(chosen)
            losses[epoch] = total / len(order)
            if on_progress:
                on_progress(epoch + 1, epochs)
    layers = tuple(_layer(part) for part in network.layers if isinstance(part, nn.Linear))
    return GelTraining(GelNetwork(layers, _layer(network.linear), scale), losses)


def _layer(part: nn.Linear) -> DenseLayer:
    return DenseLayer(part.weight.detach().numpy().copy(), part.bias.detach().numpy().copy())
