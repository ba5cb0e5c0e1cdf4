"""The gain of a servo, from goals, places and currents."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import servo


def rows(gain: float, delay_rows: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Goals that change every 40 rows and come late, and a motor that stays 3 ticks behind with a noisy encoder."""
    rng = np.random.default_rng(seed)
    goal = np.repeat(rng.integers(100, 140, 30), 40).astype(float)
    late = np.concatenate([np.full(delay_rows + 1, goal[0]), goal])[: len(goal)]
    place = np.floor(late - 3 + 0.5 * rng.normal(size=len(goal)))
    return np.arange(len(goal)) * 2000, goal, place, gain * (late - place)


@pytest.mark.parametrize("delay_rows", [0, 3])
def test_gain(delay_rows: int) -> None:
    """Assert the gain, late goals or not."""
    estimate = servo.gain(*rows(6.2, delay_rows), np.random.default_rng(0))
    assert estimate.low <= 6.2 <= estimate.high and estimate.high - estimate.low < 0.1


def test_no_gain() -> None:
    """Assert that nothing is told where the goal is always reached, or the current does not follow it."""
    time_us, goal, place, current = rows(6.2, 0)
    with pytest.raises(ValueError, match="too few rows"):
        servo.gain(time_us, goal, np.append(goal[0], goal[:-1]), current, np.random.default_rng(0))
    with pytest.raises(ValueError, match="does not follow"):
        servo.gain(time_us, goal, place, -current, np.random.default_rng(0))
