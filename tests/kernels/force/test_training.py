"""Training of the force network on a made-up gel whose force is known."""

import numpy as np
import pytest
import torch

from evetac_cli.arrays import Floats
from evetac_cli.kernels.force import models, training

DOTS = 63


def gel(samples: int, seed: int) -> tuple[Floats, Floats]:
    """Displacements and forces: dots move together, less at the rim, more the softer the trajectory's contact is."""
    rng = np.random.default_rng(seed)
    force_n = rng.uniform(-10, 10, (samples, 2))
    share = np.linspace(1.0, 0.4, DOTS)[:, None]
    return force_n[:, None] * share * 2.5 + rng.normal(0, 0.05, (samples, DOTS, 2)), force_n


def train(seed: int = 0, epochs: int = 8) -> training.ForceTraining:
    """A short run."""
    return training.train(*gel(300, 1), *gel(100, 2), np.random.default_rng(seed), epochs)


def test_force_is_learned() -> None:
    """Assert that a gel which is linear dot by dot is learned to a tenth of its forces, on samples never seen."""
    moved_px, force_n = gel(100, 3)
    reported = models.apply_network(train().network, moved_px)
    assert models.errors(reported, force_n).mean_n.max() < 0.1 * np.abs(force_n).mean()


def test_the_best_epoch_is_stored() -> None:
    """Assert that the arrays, applied by numpy without dropout, have the least of the held-out errors."""
    made = train()
    moved_px, force_n = gel(100, 2)
    error = np.sqrt(np.mean((models.apply_network(made.network, moved_px) - force_n) ** 2))
    assert error == pytest.approx(made.held_out_n[made.best_epoch], rel=1e-4)
    assert made.held_out_n[made.best_epoch] == made.held_out_n.min()
    assert len(made.held_out_n) == len(made.learned_n) == 8


def test_layers_are_those_of_the_paper() -> None:
    """Assert 126 -> 128 -> 128 -> 2."""
    shapes = [layer.weight.shape for layer in train(epochs=1).network.layers]
    assert shapes == [(128, 126), (128, 128), (2, 128)]


def test_generator_decides_alone() -> None:
    """Assert that the same generator gives the same weights, another other ones, and torch's own is left as it was."""
    state = torch.random.get_rng_state()
    one, same, other = train(epochs=2), train(epochs=2), train(1, epochs=2)
    assert torch.equal(state, torch.random.get_rng_state())
    for layer, again, differs in zip(one.network.layers, same.network.layers, other.network.layers, strict=True):
        assert np.array_equal(layer.weight, again.weight)
        assert not np.array_equal(layer.weight, differs.weight)
