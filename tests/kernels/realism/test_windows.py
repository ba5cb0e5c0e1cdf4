"""Windows described by numbers: from events whose rates and polarities are known."""

import numpy as np

from evetac_cli.events import Events
from evetac_cli.kernels.realism import windows

FRAME_PX = (64, 48)


def drawn(rates: np.ndarray, on_share: float, seed: int) -> tuple[Events, np.ndarray]:
    """Events of so many a slice, anywhere, and where each slice starts."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(rates)
    starts = np.concatenate([[0], np.cumsum(counts)])
    t_us = np.sort(np.repeat(1000 * np.arange(len(rates)), counts) + rng.integers(0, 1000, starts[-1]))
    x, y = rng.integers(0, FRAME_PX, (starts[-1], 2)).T.astype(np.uint16)
    return Events(t_us, x, y, (rng.random(starts[-1]) < on_share).astype(np.uint8)), starts


def test_rest_and_motion_are_told_apart() -> None:
    """Assert the rates and shares of a window that rests for half of its time."""
    at_rest = np.arange(500) < 250
    numbers = windows.features(*drawn(np.where(at_rest, 5.0, 200.0), 0.6, 0), at_rest, FRAME_PX)
    of = dict(zip(windows.FEATURES, numbers, strict=True))
    assert abs(of["rest, log events a slice"] - np.log(5.0)) < 0.1
    assert abs(of["motion, log events a slice"] - np.log(200.0)) < 0.02
    assert abs(of["motion, ON share"] - 0.6) < 0.01 and abs(of["rest, ON share"] - 0.6) < 0.05
    between = [of[f"motion, log time between ON events, {share} %"] for share in windows.QUANTILES]
    assert between == sorted(between)
    assert abs(of["motion, correlation over 2 px"]) < 0.1


def test_what_is_not_there_is_nan() -> None:
    """Assert that a window without rest, without motion, or without any event has NaN there and no more."""
    rest = [name.startswith("rest") for name in windows.FEATURES]
    moving = windows.features(*drawn(np.full(500, 100.0), 0.5, 1), np.zeros(500, np.bool_), FRAME_PX)
    still = windows.features(*drawn(np.full(500, 3.0), 0.5, 1), np.ones(500, np.bool_), FRAME_PX)
    empty = windows.features(*drawn(np.zeros(500), 0.5, 1), np.ones(500, np.bool_), FRAME_PX)
    assert np.isnan(moving[rest]).all() and np.isfinite(still[rest]).all()
    assert np.isnan(still[~np.array(rest)]).all() and np.isnan(empty).all()
