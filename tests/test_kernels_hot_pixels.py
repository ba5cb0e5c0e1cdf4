"""Hot pixels: found, forgotten, told from edges, and left out without losing what belongs to an event."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels import hot_pixels

LIMIT = 16


class Filter:
    """Feeds slices and returns what is kept of them."""

    def __init__(self) -> None:
        self.fired = np.zeros(hot_pixels.FIRED_SHAPE, np.uint16)
        self.slices = 0

    def keep(self, xy: NDArray[np.integer], p: NDArray[np.uint8] | None = None) -> NDArray[np.integer]:
        x, y = np.asarray(xy, np.uint16).reshape(-1, 2).T.copy()
        cool_xy, cool_p = np.zeros((2, len(x)), np.uint16), np.zeros(len(x), np.uint8)
        given = np.empty(0, np.uint8) if p is None else p
        kept = hot_pixels.keep_cool(x, y, given, self.fired, self.slices, LIMIT, cool_xy[0], cool_xy[1], cool_p)
        self.slices += 1
        if kept < 0:
            return np.column_stack([x, y] if p is None else [x, y, p])
        columns = [cool_xy[0], cool_xy[1]] + ([] if p is None else [cool_p])
        return np.column_stack([column[:kept] for column in columns])


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


def test_polarities_stay_with_their_events() -> None:
    """Assert that kept events have their own polarities."""
    rng = np.random.default_rng(1)
    cool = Filter()
    for _ in range(50):
        xy = rng.integers(0, 400, (30, 2))
        xy[::3] = (77, 77)
        p = (xy.sum(axis=1) % 2).astype(np.uint8)
        kept = cool.keep(xy, p)
        assert (kept[:, 2] == (kept[:, 0] + kept[:, 1]) % 2).all()
    assert len(kept) == 20


@pytest.mark.parametrize("corner", [(0, 0), (639, 0), (0, 479), (639, 479)])
def test_corners_and_beyond(corner: tuple[int, int]) -> None:
    """Assert that a corner of the frame can be hot, and that events outside are dropped with it."""
    cool = Filter()
    for _ in range(20):
        cool.keep(np.array([corner]))
    assert cool.keep(np.array([corner, (640, 0), (0, 480), (300, 300)])).tolist() == [[300, 300]]
