"""Whether a field of dots rests: after how long, in spite of which errors, and what ends it."""

import numpy as np
import pytest

from evetac_cli.kernels.touch import rest
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.kernels.touch.rest import BLOCK_MS, REST_MS, RestState

DOTS = np.stack(np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-6, 6, 7)), -1).reshape(-1, 2)
NONE_LOST = np.zeros(len(DOTS), np.bool_)
OWN, COMMON = DotNoise().own_mm, DotNoise().common_mm


def rests_after(slices: list[np.ndarray], state: RestState | None = None) -> RestState:
    """The state after some slices."""
    state = rest.start(DOTS) if state is None else state
    for dots in slices:
        rest.step(state, dots, NONE_LOST)
    return state


def still(slices: int, seed: int = 0, own_mm: float = 0.0) -> list[np.ndarray]:
    """Dots that do not move but for an error of each in each slice."""
    rng = np.random.default_rng(seed)
    return [DOTS + own_mm * rng.normal(size=DOTS.shape) for _ in range(slices)]


def test_still_dots_rest_after_200_ms() -> None:
    """Assert that the last slice of the first 200 is the one with which dots rest, whose mean is their place."""
    state = rests_after(still(REST_MS - 1, own_mm=OWN))
    assert not state.rests and state.rested == -1
    rests_after(still(1), state)
    assert state.rests and state.rested == REST_MS - 1
    assert np.abs(state.rest_mm - DOTS).max() < OWN
    rests_after(still(REST_MS, 1, own_mm=OWN), state)
    assert state.rested == 2 * REST_MS - 1


def test_a_push_ends_a_rest_until_200_ms_after() -> None:
    """Assert that a push of a part of the dots ends a rest within two blocks, and what the next rest's mean is."""
    pushed = DOTS + 0.02 * (np.abs(DOTS[:, :1]) < 3) * [1.0, 0.0]
    state = rests_after(still(REST_MS))
    rests_after([pushed] * 2 * BLOCK_MS, state)
    assert not state.rests
    rests_after([pushed] * (REST_MS + BLOCK_MS), state)
    assert state.rests and state.rest_mm == pytest.approx(pushed)


def test_slow_motion_is_no_rest() -> None:
    """Assert that dots which come apart by 1 px per second never rest, and those of a hundredth of it do."""
    apart = np.sign(DOTS[:, :1]) * [0.0329e-3, 0.0]
    assert rests_after([DOTS + number * apart for number in range(2000)]).rested == -1
    assert rests_after([DOTS + 0.01 * number * apart for number in range(2000)]).rested == 1999


def test_what_all_share_may_drift_farther() -> None:
    """Assert that dots rest while all move by the common error, and not while each moves so far by itself."""
    away = np.random.default_rng(0).choice([-1.0, 1.0], size=DOTS.shape) * COMMON
    assert rests_after(still(100) + [DOTS + [COMMON, 0.0]] * 100).rests
    assert not rests_after(still(100) + [DOTS + away] * 100).rests


def test_lost_dots_stay_and_few_never_rest() -> None:
    """Assert that a lost or infinite dot keeps its place and disturbs no rest, and that three dots never rest."""
    lost = NONE_LOST.copy()
    lost[5] = True
    wild = DOTS.copy()
    wild[5], wild[6] = 99.0, np.nan
    state = rest.start(DOTS)
    for _ in range(REST_MS):
        rest.step(state, wild, lost)
    assert state.rests and not state.tracked[[5, 6]].any() and state.tracked.sum() == len(DOTS) - 2
    assert np.array_equal(state.seen_mm, DOTS)
    state = rest.start(DOTS)
    lost = np.arange(len(DOTS)) > 2
    for _ in range(REST_MS):
        rest.step(state, DOTS, lost)
    assert not state.rests
