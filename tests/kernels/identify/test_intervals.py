"""Times between events: steps, dead time and two exponentials, against laws that are known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import intervals


def mixed(count: int, share: float, short_us: float, long_us: float, dead_us: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mean_us = np.where(rng.random(count) < share, short_us, long_us)
    return dead_us + rng.exponential(1.0, count) * mean_us


@pytest.mark.parametrize("step_us", [50.3, 197.28, 200.0])
def test_steps_are_found(step_us: float) -> None:
    """Assert that the step of stamped times is found, within its interval, whole microseconds and all."""
    times = np.cumsum(mixed(3000, 0.5, 500.0, 4000.0, 2 * step_us))
    stamped = np.floor(np.floor(times / step_us) * step_us)
    result = intervals.time_step(np.diff(stamped))
    assert result is not None and result.low <= step_us <= result.high
    assert result.high - result.low < 1e-3 * step_us


def test_no_steps() -> None:
    """Assert that uniform times have none, and that a few times say nothing."""
    between_us = np.floor(mixed(3000, 0.5, 500.0, 4000.0, 400.0))
    assert intervals.time_step(between_us) == (0.0, 0.0, 0.0)
    assert intervals.time_step(between_us[:100]) is None
    assert intervals.dead_time(between_us[:100], 0.0, np.random.default_rng(0)) is None


@pytest.mark.parametrize("dead_us", [0.0, 400.0])
def test_dead_time(dead_us: float) -> None:
    """Assert that the dead time's interval holds it in about 95 of 100 cases; rare shorter times do not count."""
    held = 0
    for seed in range(100):
        between_us = mixed(2000, 0.4, 300.0, 3000.0, dead_us, seed)
        between_us[:10] = 1.0
        result = intervals.dead_time(between_us, 0.0, np.random.default_rng(seed))
        assert result is not None
        held += result.low <= dead_us <= result.high
    assert held >= 85


def test_two_exponentials() -> None:
    """Assert that share and mean of the shorter one come back, and that one exponential is left one."""
    two = intervals.two_exponentials(mixed(4000, 0.6, 300.0, 8000.0, 400.0), 400.0, 0.0)
    assert two.short_share == pytest.approx(0.6, abs=0.05)
    assert two.short_us == pytest.approx(300.0, rel=0.2)
    one = [intervals.two_exponentials(mixed(100, 0.0, 1.0, 3000.0, 0.0, seed), 0.0, 0.0) for seed in range(60)]
    assert sum(law.short_share == 0.0 for law in one) >= 42
    assert intervals.two_exponentials(np.array([100.0, 200.0]), 0.0, 0.0) == (0.0, 0.0)


def test_two_exponentials_in_steps() -> None:
    """Assert that whole steps, which hide short times, give the same law."""
    step_us = 200.0
    times = np.cumsum(mixed(6000, 0.5, 400.0, 8000.0, 2 * step_us))
    law = intervals.two_exponentials(np.diff(np.floor(times / step_us) * step_us), 2 * step_us, step_us)
    assert law.short_share == pytest.approx(0.5, abs=0.06)
    assert law.short_us == pytest.approx(400.0, rel=0.25)
