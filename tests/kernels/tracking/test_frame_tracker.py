"""Dots in frames: along known paths, at rest, lost."""

import numpy as np
import pytest

from evetac_cli.kernels.tracking import frame_tracker


def drawn(dots: np.ndarray, radius_px: float = 7.5) -> np.ndarray:
    """A frame of soft dark discs."""
    y, x = np.indices((120, 160))
    distance = np.hypot(x[..., None] - dots[:, 0], y[..., None] - dots[:, 1]).min(axis=-1)
    return np.rint(180 - 140 / (1 + np.exp(2 * (distance - radius_px)))).astype(np.uint8)


REST = np.array([[30.0, 30.0], [80.0, 32.0], [33.0, 85.0], [82.0, 80.0]])


def test_dots_are_followed() -> None:
    """Assert that dots on a circle of 10 px, at up to 2 px a frame, are followed to a fifth of a pixel."""
    state = frame_tracker.start(drawn(REST), REST)
    for angle in np.linspace(0, 2 * np.pi, 40):
        moved = REST + 10 * np.array([np.sin(angle), 1 - np.cos(angle)])
        frame_tracker.step(state, drawn(moved))
        assert np.abs(state.dot_xy_px - moved).max() < 0.2
        assert not state.lost.any()


def test_rest_is_rest() -> None:
    """Assert that dots of frames that do not change stay exactly where they are."""
    state = frame_tracker.start(drawn(REST), REST)
    for _ in range(20):
        frame_tracker.step(state, drawn(REST))
    assert np.array_equal(state.dot_xy_px, REST.astype(np.float32))


def test_a_lost_dot_stays() -> None:
    """Assert that a dot whose flow cannot be found is reported as lost and stays where it was."""
    blank = np.full((120, 160), 180, np.uint8)
    state = frame_tracker.start(blank, REST)
    frame_tracker.step(state, blank)
    assert state.lost.all()
    assert np.array_equal(state.dot_xy_px, REST.astype(np.float32))


def test_nonsense_is_refused() -> None:
    """Assert that colour, other sizes, no dots and dots nowhere are refused."""
    frame = drawn(REST)
    with pytest.raises(ValueError, match="finite"):
        frame_tracker.start(frame, [[np.inf, 0]])
    with pytest.raises(ValueError, match="finite"):
        frame_tracker.start(frame, np.empty((0, 2)))
    with pytest.raises(ValueError, match="grey"):
        frame_tracker.start(np.stack([frame] * 3, axis=-1), REST)
    with pytest.raises(ValueError, match="uint8"):
        frame_tracker.step(frame_tracker.start(frame, REST), frame[:-1])
