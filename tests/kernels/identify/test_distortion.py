"""The lens from the places of dots, against the simulated camera's own lens."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import distortion
from evetac_cli.sim.camera.lens import Lens

FRAME_PX = (640, 480)
PRINTED = np.stack(np.meshgrid(np.linspace(60, 560, 9), np.linspace(40, 420, 7)), axis=-1)


def flat_dots(rng: np.random.Generator, jitter_px: float) -> np.ndarray:
    """The printed grid, turned, moved and a little smaller, each dot a little off."""
    angle = 0.02
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return 0.97 * PRINTED.reshape(-1, 2) @ turn + [6.0, -4.0] + jitter_px * rng.standard_normal((63, 2))


@pytest.mark.parametrize("k1", [-0.05, 0.0, 0.02])
def test_the_lens_is_found(k1: float) -> None:
    """Assert that k1 of regular dots is exact, and that of irregular ones within its interval in 17 of 20 cases."""
    lens = Lens(FRAME_PX, k1, 0.0)
    exact = distortion.estimate(lens.seen(flat_dots(np.random.default_rng(0), 0.0)), PRINTED.reshape(-1, 2), FRAME_PX)
    assert exact.value == pytest.approx(k1, abs=2e-4)
    held = 0
    for seed in range(20):
        seen = lens.seen(flat_dots(np.random.default_rng(seed), 1.5))
        estimated = distortion.estimate(seen, PRINTED.reshape(-1, 2), FRAME_PX)
        held += estimated.low <= k1 <= estimated.high
    assert held >= 17


def test_flat_undoes_the_lens() -> None:
    """Assert that points are where they would be without the lens."""
    dots = flat_dots(np.random.default_rng(1), 1.0)
    for k1 in (-0.05, 0.02):
        np.testing.assert_allclose(distortion.flat(Lens(FRAME_PX, k1, 0.0).seen(dots), k1, FRAME_PX), dots, atol=1e-6)


def test_too_few_dots() -> None:
    """Assert that a few dots are refused."""
    with pytest.raises(ValueError, match="12 dots"):
        distortion.estimate(np.zeros((5, 2)), np.zeros((5, 2)), FRAME_PX)
