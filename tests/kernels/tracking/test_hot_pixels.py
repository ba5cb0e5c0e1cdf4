"""Hot pixels: found, forgotten, and distinguished from edges."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.tracking import buckets

LIMIT = 16


class Filter:
    """Feeds slices and returns the events that are not left out."""

    def __init__(self) -> None:
        self.pixel_events = np.zeros((FRAME_PX[1] + 2, FRAME_PX[0] + 2), np.uint16)
        self.slices = 0

    def step(self, xy: NDArray[np.integer]) -> NDArray[np.integer]:
        x, y = np.asarray(xy, np.uint16).reshape(-1, 2).T.copy()
        inside = (x < FRAME_PX[0]) & (y < FRAME_PX[1])
        any_hot = buckets.count_pixels(x, y, self.pixel_events, self.slices, LIMIT)
        self.slices += 1
        hot = self.pixel_events[y[inside] + 1, x[inside] + 1] & buckets.HOT > 0
        assert any_hot == hot.any()
        return np.column_stack([x, y])[inside][~hot]


def test_a_hot_pixel_is_left_out_from_its_limit_on() -> None:
    """Assert that events of a pixel count up to its limit, then no more, and those of its neighbours throughout."""
    hot_filter = Filter()
    counted = [len(hot_filter.step(np.array([[100, 300]]))) for _ in range(40)]
    assert counted == [1] * LIMIT + [0] * (40 - LIMIT)
    assert hot_filter.step(np.array([[101, 300], [100, 300], [99, 299]])).tolist() == [[101, 300], [99, 299]]


def test_a_flood_from_one_pixel_is_left_out() -> None:
    """Assert that a million events of one pixel in one slice are left out, and that its count stops at its top."""
    hot_filter = Filter()
    assert len(hot_filter.step(np.tile([[5, 5]], (1_000_000, 1)))) == 0
    assert hot_filter.pixel_events[6, 6] == 0x9FFF
    assert len(hot_filter.step(np.array([[5, 5]]))) == 0


def test_an_edge_is_not_hot() -> None:
    """Assert that events of a row of pixels that all fire are counted, however often."""
    hot_filter = Filter()
    edge = np.stack([np.arange(200, 240), np.full(40, 50)], axis=1)
    assert all(len(hot_filter.step(edge)) == 40 for _ in range(500))


def test_a_hot_pixel_counts_again_after_a_while() -> None:
    """Assert that a hot pixel that falls silent is forgotten after a few halvings, each of 1.92 s."""
    hot_filter = Filter()
    for _ in range(40):
        hot_filter.step(np.array([[7, 400]]))
    assert len(hot_filter.step(np.array([[7, 400]]))) == 0
    for _ in range(2 * buckets.FADE_SLICES):
        hot_filter.step(np.empty((0, 2)))
    assert hot_filter.pixel_events[401, 8] == 41 // 4
    assert len(hot_filter.step(np.array([[7, 400]]))) == 1
