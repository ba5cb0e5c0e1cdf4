"""Shear force from dots: regression against exact linear gels, a network that is written by hand, samples, errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.arrays import Floats
from evetac_cli.kernels.force import models
from evetac_cli.kernels.force.models import DenseLayer, Network, Regression

slopes = st.lists(st.floats(-5, 5), min_size=4, max_size=4)


def moved(samples: int, dots: int = 63, seed: int = 0) -> Floats:
    """Displacements of dots that all moved differently."""
    return np.random.default_rng(seed).normal(0, 5, (samples, dots, 2))


@given(slopes, st.lists(st.floats(-3, 3), min_size=2, max_size=2))
def test_regression_finds_a_linear_gel(slope: list[float], offset: list[float]) -> None:
    """Assert that a force which is linear in the mean displacement is found exactly, whatever its slopes."""
    given_px = moved(40)
    slope_n_px, offset_n = np.array(slope).reshape(2, 2), np.array(offset)
    result = models.fit_regression(given_px, given_px.mean(axis=1) @ slope_n_px + offset_n)
    assert np.allclose(result.slope_n_px, slope_n_px, atol=1e-9)
    assert np.allclose(result.offset_n, offset_n, atol=1e-9)


def test_regression_is_the_least_of_squares() -> None:
    """Assert that no neighbouring slope or offset has a smaller squared error on noisy forces."""
    rng = np.random.default_rng(1)
    given_px = moved(50)
    measured = given_px.mean(axis=1) @ np.array([[0.4, 0.1], [0.0, 0.5]]) + rng.normal(0, 1, (50, 2))
    best = models.fit_regression(given_px, measured)

    def squares(model: Regression) -> float:
        return float(((models.apply_regression(model, given_px) - measured) ** 2).sum())

    for _ in range(50):
        other = Regression(best.slope_n_px + rng.normal(0, 0.1, (2, 2)), best.offset_n + rng.normal(0, 0.1, 2))
        assert squares(other) > squares(best)


def test_network_by_hand() -> None:
    """Assert that the layers, ReLU, and both scales are applied: relu(x) - relu(-x) is x, summed over dots."""
    dots = 4
    split = np.concatenate([np.eye(2 * dots), -np.eye(2 * dots)]).astype(np.float32)
    same = np.eye(4 * dots, dtype=np.float32)
    total = np.tile(np.eye(2), (1, dots))
    last = np.concatenate([total, -total], axis=1).astype(np.float32)
    bias = np.array([1.0, -2.0], np.float32)
    layers = (
        DenseLayer(split, np.zeros(4 * dots, np.float32)),
        DenseLayer(same, np.zeros(4 * dots, np.float32)),
        DenseLayer(last, bias),
    )
    given_px = moved(10, dots)
    reported = models.apply_network(Network(layers, scale_px=2.0, scale_n=6.0), given_px)
    assert np.allclose(reported, (given_px.sum(axis=1) / 2.0 + bias) * 6.0, atol=1e-4)
    assert models.apply_network(Network(layers, 2.0, 6.0), given_px[:0]).shape == (0, 2)
    with pytest.raises(ValueError, match="expected 4 dots"):
        models.apply_network(Network(layers, 2.0, 6.0), moved(10, 5))


@given(
    st.integers(0, 3000), st.integers(400, 20000), st.integers(0, 2000), st.integers(1, 40), st.sampled_from([1, 7, 40])
)
def test_samples_are_spread_over_the_contact(before: int, touching: int, after: int, count: int, every: int) -> None:
    """Assert that samples are as many as wanted, different, evenly spread, on frames, and within the contact."""
    normal_n = np.concatenate([np.zeros(before), np.ones(touching), np.zeros(after)])
    frames = (before + touching - 1) // every - -(-before // every) + 1
    if count > frames:
        with pytest.raises(ValueError, match="too short"):
            models.sample_slices(normal_n, count, every)
        return
    chosen = models.sample_slices(normal_n, count, every)
    assert len(chosen) == len(set(chosen)) == count
    assert (chosen % every == 0).all()
    assert (normal_n[chosen] > 0).all()
    if count > 1:
        steps = np.diff(chosen)
        assert steps.max() - steps.min() <= every


def test_errors() -> None:
    """Assert mean and standard deviation of absolute errors on figures that can be added by hand."""
    result = models.errors(np.array([[1.0, 0.0], [-3.0, 0.0]]), np.array([[0.0, 2.0], [0.0, -2.0]]))
    assert result.mean_n.tolist() == [2.0, 2.0]
    assert result.sd_n.tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("moved_px", "force_n", "message"),
    [
        (np.zeros((5, 63, 2)), np.zeros((5, 2)), "moved in x and in y"),
    ],
)
def test_bad_samples_are_refused(moved_px: Floats, force_n: Floats, message: str) -> None:
    """Assert that samples that cannot be fitted are refused, and that it is said why."""
    with pytest.raises(ValueError, match=message):
        models.fit_regression(moved_px, force_n)
