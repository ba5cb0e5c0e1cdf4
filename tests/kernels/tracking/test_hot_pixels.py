"""Hot pixels: found, forgotten, and told from edges."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.events import FRAME_PX
from evetac_cli.kernels.tracking import hot_pixels

LIMIT = 16


class Filter:
    """Feeds slices and returns what is kept of them."""

    def __init__(self) -> None:
        self.fired = np.zeros(hot_pixels.FIRED_SHAPE, np.uint16)
        self.slices = 0

    def keep(self, xy: NDArray[np.integer]) -> NDArray[np.integer]:
        x, y = np.asarray(xy, np.uint16).reshape(-1, 2).T.copy()
        inside = (x < FRAME_PX[0]) & (y < FRAME_PX[1])
        passed = np.zeros(len(x), np.uint32)
        any_hot = hot_pixels.count(x, y, self.fired, self.slices, LIMIT, passed)
        self.slices += 1
        hot = self.fired[y[inside] + 1, x[inside] + 1] & hot_pixels.HOT > 0
        assert any_hot == hot.any()
        return np.column_stack([x, y])[inside][~hot]


def test_a_hot_pixel_is_left_out_from_its_limit_on() -> None:
    """Assert that a pixel is heard up to its limit of events, then no more, and its neighbours throughout."""
    cool = Filter()
    heard = [len(cool.keep(np.array([[100, 300]]))) for _ in range(40)]
    assert heard == [1] * LIMIT + [0] * (40 - LIMIT)
    assert cool.keep(np.array([[101, 300], [100, 300], [99, 299]])).tolist() == [[101, 300], [99, 299]]


def test_a_flood_from_one_pixel_is_not_heard() -> None:
    """Assert that a million events of one pixel in one slice are left out, and that its count stops at its top."""
    cool = Filter()
    assert len(cool.keep(np.tile([[5, 5]], (1_000_000, 1)))) == 0
    assert cool.fired[6, 6] == 0xFFFF
    assert len(cool.keep(np.array([[5, 5]]))) == 0


def test_an_edge_is_not_hot() -> None:
    """Assert that pixels of a row that all fire are heard, however often."""
    cool = Filter()
    edge = np.stack([np.arange(200, 240), np.full(40, 50)], axis=1)
    assert all(len(cool.keep(edge)) == 40 for _ in range(500))


def test_a_pixel_that_cools_down_is_heard_again() -> None:
    """Assert that a hot pixel that falls silent is forgotten after a few halvings, each of 1.92 s."""
    cool = Filter()
    for _ in range(40):
        cool.keep(np.array([[7, 400]]))
    assert len(cool.keep(np.array([[7, 400]]))) == 0
    for _ in range(2 * 480 * hot_pixels.FADE_SLICES):
        cool.keep(np.empty((0, 2)))
    assert cool.fired[401, 8] == 41 // 4
    assert len(cool.keep(np.array([[7, 400]]))) == 1


@pytest.mark.parametrize("corner", [(0, 0), (639, 0), (0, 479), (639, 479)])
def test_corners_and_beyond(corner: tuple[int, int]) -> None:
    """Assert that a corner of the frame can be hot, and that events outside the frame count nowhere."""
    cool = Filter()
    for _ in range(20):
        cool.keep(np.array([corner]))
    counted = int((cool.fired & 0x7FFF).sum())
    assert cool.keep(np.array([corner, (640, 0), (0, 480), (300, 300)])).tolist() == [[300, 300]]
    assert int((cool.fired & 0x7FFF).sum()) == counted + 2
