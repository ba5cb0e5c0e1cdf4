"""What the rows of a gripper tell, against commands, readings and gains that are known."""

import numpy as np
import pytest

from evetac_cli.kernels.identify import gripper
from tests.quick import few


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
    delay, jitter = gripper.delay_and_jitter(gripper.lateness(*rows, step_ms=1.0))
    assert delay.low - 0.1 <= delay_ms <= delay.high + 0.1 and delay.high - delay.low <= 1.1
    assert jitter.low - 0.1 <= jitter_ms <= jitter.high + 0.1 and jitter.high - jitter.low <= 1.1


def test_commands_that_others_follow_at_once_do_not_count() -> None:
    """Assert that nothing is told by a current that changes in every row, nor by one that never changes."""
    time_us = np.arange(1000) * 2000
    for current in (np.arange(1000.0), np.zeros(1000)):
        between = gripper.lateness(time_us, current, current, 1.0)
        assert len(between) == 0
        with pytest.raises(ValueError, match="too few commands"):
            gripper.delay_and_jitter(between)


@pytest.mark.parametrize("noise_ticks", few([0.15, 0.4, 0.7, 1.5], 0.15, 1.5))
def test_encoder_noise(noise_ticks: float) -> None:
    """Assert the noise of readings at eight places, and at one, where it is less sure."""
    rng = np.random.default_rng(1)
    places = rng.uniform(100, 200, 8)
    rests = [np.floor(place + noise_ticks * rng.normal(size=300)).astype(np.int64) for place in places]
    estimate = gripper.encoder_noise(rests)
    assert estimate.low <= noise_ticks <= estimate.high
    assert estimate.value == pytest.approx(noise_ticks, rel=0.15)
    alone = gripper.encoder_noise(rests[:1])
    assert alone.high - alone.low > estimate.high - estimate.low


def test_encoder_without_noise() -> None:
    """Assert that readings which never change allow no noise or little."""
    estimate = gripper.encoder_noise([np.full(300, place) for place in range(8)])
    assert estimate.low < 0.01 and estimate.high < 0.2


def servo_rows(gain: float, delay_rows: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Goals that change every 40 rows and come late, and a motor that stays 3 ticks behind with a noisy encoder."""
    rng = np.random.default_rng(seed)
    goal = np.repeat(rng.integers(100, 140, 30), 40).astype(float)
    late = np.concatenate([np.full(delay_rows + 1, goal[0]), goal])[: len(goal)]
    place = np.floor(late - 3 + 0.5 * rng.normal(size=len(goal)))
    return np.arange(len(goal)) * 2000, goal, place, gain * (late - place)


@pytest.mark.parametrize("delay_rows", [0, 3])
def test_servo_gain(delay_rows: int) -> None:
    """Assert the gain, late goals or not."""
    estimate = gripper.servo_gain(*servo_rows(6.2, delay_rows), np.random.default_rng(0))
    assert estimate.low <= 6.2 <= estimate.high and estimate.high - estimate.low < 0.1


def test_no_servo_gain() -> None:
    """Assert that nothing is told where the goal is always reached, or the current does not follow it."""
    time_us, goal, place, current = servo_rows(6.2, 0)
    with pytest.raises(ValueError, match="too few rows"):
        gripper.servo_gain(time_us, goal, np.append(goal[0], goal[:-1]), current, np.random.default_rng(0))
    with pytest.raises(ValueError, match="does not follow"):
        gripper.servo_gain(time_us, goal, place, -current, np.random.default_rng(0))
