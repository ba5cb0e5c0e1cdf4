"""How late commands take effect, against commands whose lateness is known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import latency


def commands(delay_ms: float, jitter_ms: float, seed: int = 0, count: int = 400) -> tuple[np.ndarray, ...]:
    """Rows every 2 ms and at commands, of a current that changes every 27 ms and is measured whole ms late."""
    rng = np.random.default_rng(seed)
    end = 27 * (count + 1)
    commanded, measured = np.zeros(end), np.zeros(end)
    current = 0.0
    for number in range(count):
        at = 27 * (number + 1)
        current = 8.0 - current
        commanded[at:] = current
        measured[at + 1 + int(np.ceil(delay_ms + jitter_ms * rng.uniform())) :] = current
    rows = np.array([ms for ms in range(end) if ms % 2 == 0 or (ms % 27 == 0)])
    return rows * 1000, commanded[rows], measured[rows]


@pytest.mark.parametrize(("delay_ms", "jitter_ms"), [(2.3, 3.1), (6.4, 2.2), (1.0, 0.0), (4.5, 0.2)])
def test_delay_and_jitter(delay_ms: float, jitter_ms: float) -> None:
    """Assert that the truth is within the intervals, and that these are narrow."""
    rows = commands(delay_ms, jitter_ms)
    delay, jitter = latency.delay_and_jitter(latency.lateness(*rows, step_ms=1.0))
    assert delay.low - 0.1 <= delay_ms <= delay.high + 0.1 and delay.high - delay.low <= 1.1
    assert jitter.low - 0.1 <= jitter_ms <= jitter.high + 0.1 and jitter.high - jitter.low <= 1.1


def test_commands_that_others_follow_at_once_do_not_count() -> None:
    """Assert that nothing is told by a current that changes in every row, nor by one that never changes."""
    time_us = np.arange(1000) * 2000
    for current in (np.arange(1000.0), np.zeros(1000)):
        between = latency.lateness(time_us, current, current, 1.0)
        assert len(between) == 0
        with pytest.raises(ValueError, match="too few commands"):
            latency.delay_and_jitter(between)


def test_commands_without_effect() -> None:
    """Assert that a current which never follows is no delay."""
    time_us, commanded, _ = commands(2.0, 1.0)
    between = latency.lateness(time_us, commanded, np.full(len(commanded), 50.0), 1.0)
    with pytest.raises(ValueError, match="no effect"):
        latency.delay_and_jitter(between)
