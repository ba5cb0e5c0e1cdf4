"""The compiled networks over dots give what onnxruntime makes of their graphs."""

import hashlib

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.slip import detector, onnx_graphs
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    DotArchitecture,
    last_layer,
    weight_shapes,
    with_scaled_logit,
)
from evetac_cli.kernels.slip.reliability import OddsScale

DOTS = [row for row in ARCHITECTURES.values() if isinstance(row, DotArchitecture)]
SUMMED = 2e-6  # how far sums of 300 float32 in another order may be apart in a probability


def some_weights(
    architecture: DotArchitecture, rows: int, columns: int, rng: np.random.Generator
) -> dict[str, NDArray[np.float32]]:
    """Weights of a size that neither grows nor fades from layer to layer, and a normalisation."""
    shapes = weight_shapes(architecture, rows, columns)
    weights = {name: rng.normal(0, np.sqrt(2 / np.prod(shape[1:])), shape) for name, shape in shapes.items()}
    weights |= {name: rng.normal(0, 0.1, shape) for name, shape in shapes.items() if name.endswith("bias")}
    weights["input_scale"] = rng.uniform(0.5, 2, shapes["input_scale"])
    weights["input_offset"] = rng.normal(0, 0.5, shapes["input_offset"])
    return {name: array.astype(np.float32) for name, array in weights.items()}


def by_onnxruntime(graph: bytes, batch: NDArray[np.float32]) -> NDArray[np.float32]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    (probability,) = session.run(None, {"features": batch})
    return probability


def predicted(
    architecture: DotArchitecture,
    weights: dict[str, NDArray[np.float32]],
    rows: int,
    columns: int,
    batch: NDArray[np.float32],
) -> NDArray[np.float32]:
    probability = np.empty(len(batch), np.float32)
    detector.predict_dots(batch, *detector.pack_dots(architecture, weights, rows, columns), probability)
    return probability


@pytest.mark.parametrize("architecture", DOTS, ids=lambda row: row.name)
def test_probabilities_are_those_of_onnxruntime(architecture: DotArchitecture) -> None:
    """Assert so for every architecture."""
    rng = np.random.default_rng(int(hashlib.sha256(architecture.name.encode()).hexdigest()[8:16], 16))
    weights = some_weights(architecture, 7, 8, rng)
    batch = rng.normal(0, 1, (60, 56, architecture.inputs_per_dot)).astype(np.float32)
    expected = by_onnxruntime(onnx_graphs.build(architecture, weights), batch)
    assert np.ptp(expected) > 0.05
    np.testing.assert_allclose(predicted(architecture, weights, 7, 8, batch), expected, rtol=0, atol=SUMMED)


@pytest.mark.parametrize("grid", [(2, 4), (2, 5), (3, 4), (5, 5), (6, 9), (16, 16)])
def test_grids_of_other_sizes(grid: tuple[int, int]) -> None:
    """Assert so for odd and even rows and columns, from the smallest grid to the largest."""
    rng = np.random.default_rng(grid[0] * 100 + grid[1])
    architecture = ARCHITECTURES["fast-slow"]
    assert isinstance(architecture, DotArchitecture)
    weights = some_weights(architecture, *grid, rng)
    batch = rng.normal(0, 1, (40, grid[0] * grid[1], 30)).astype(np.float32)
    expected = by_onnxruntime(onnx_graphs.build(architecture, weights, *grid), batch)
    assert np.ptp(expected) > 0.05
    np.testing.assert_allclose(predicted(architecture, weights, *grid, batch), expected, rtol=0, atol=SUMMED)


def test_certain_answers_stay_probabilities() -> None:
    """Assert that logits of thousands give 0 and 1, without a warning."""
    rng = np.random.default_rng(0)
    architecture = ARCHITECTURES["hist10"]
    assert isinstance(architecture, DotArchitecture)
    weights = some_weights(architecture, 7, 8, rng)
    batch = rng.normal(0, 1, (5, 56, 20)).astype(np.float32)
    for bias, certain in ((-1e4, 0.0), (1e4, 1.0)):
        weights["fc5.bias"] = np.array([bias], np.float32)
        assert (predicted(architecture, weights, 7, 8, batch) == certain).all()


def test_no_network_remembers_the_input_before() -> None:
    """Assert that an input has the same bits alone, behind others and behind huge ones."""
    rng = np.random.default_rng(1)
    architecture = ARCHITECTURES["fast-slow"]
    assert isinstance(architecture, DotArchitecture)
    weights = some_weights(architecture, 7, 8, rng)
    batch = rng.normal(0, 1, (6, 56, 30)).astype(np.float32)
    batch[2] *= 1e6
    whole = predicted(architecture, weights, 7, 8, batch)
    alone = [predicted(architecture, weights, 7, 8, batch[k : k + 1])[0] for k in range(6)]
    assert whole.tobytes() == np.array(alone).tobytes()


def test_a_scaled_logit() -> None:
    """Assert that scale and offset in the last layer are those of the logit, and can be taken back."""
    rng = np.random.default_rng(2)
    architecture = ARCHITECTURES["fast-slow"]
    assert isinstance(architecture, DotArchitecture)
    weights = some_weights(architecture, 7, 8, rng)
    batch = rng.normal(0, 1, (30, 56, 30)).astype(np.float32)
    before = predicted(architecture, weights, 7, 8, batch).astype(np.float64)
    assert 0.01 < before.min() < before.max() < 0.99
    scaled = with_scaled_logit(weights, last_layer(architecture, 7, 8), 0.6, -1.5)
    expected = 1 / (1 + np.exp(-(0.6 * np.log(before / (1 - before)) - 1.5)))
    np.testing.assert_allclose(predicted(architecture, scaled, 7, 8, batch), expected, atol=1e-5)
    back = with_scaled_logit(scaled, "fc5", *OddsScale(0.6, -1.5).inverse())
    np.testing.assert_allclose(predicted(architecture, back, 7, 8, batch), before, atol=1e-5)
