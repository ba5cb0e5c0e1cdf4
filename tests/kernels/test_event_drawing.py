"""Events as images: against plain definitions, online as offline, and what is refused."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.events import Events, SliceBlock, slice_starts
from evetac_cli.kernels import event_drawing
from evetac_cli.kernels.event_drawing import MOST_COUNTED, ImageBlock, fold
from evetac_cli.kernels.event_representation import KINDS, Representation, representation

FRAME_PX = (64, 48)
SLICES = 90


def random_events(count: int = 20_000, seed: int = 0) -> Events:
    """Events of SLICES slices, in order of time."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, SLICES * 1000, count))
    x, y = (rng.integers(0, size, count).astype(np.uint16) for size in FRAME_PX)
    return Events(t, x, y, rng.integers(0, 2, count).astype(np.uint8))


def blocks(events: Events, slices: int) -> Iterator[SliceBlock]:
    """The events in blocks of so many slices."""
    starts = slice_starts(events.t, SLICES)
    for first in range(0, SLICES, slices):
        part = starts[first : first + slices + 1]
        yield SliceBlock(first, part - part[0], events.part(int(part[0]), int(part[-1])))


def joined(found: Iterator[ImageBlock]) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Ends and images of all blocks."""
    ends, images = zip(*found, strict=True)
    return np.concatenate(ends), np.concatenate(images)


def plainly(of: Representation, events: Events, end: int) -> NDArray[np.float64]:
    """The image that ends before a slice, event by event."""
    image = np.zeros(of.shape)
    (frame_x, frame_y), (size_x, size_y) = of.frame_px, of.size_px
    before = max(one for one in (0, *map(of.end, range(SLICES))) if one < end)
    window_ms = end - before if of.window_ms is None else of.window_ms
    begin_us = (end - window_ms) * 1000
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        place = y * size_y // frame_y, x * size_x // frame_x
        channel = p if of.polarity == "split" else 0
        if t >= end * 1000:
            break
        if of.kind == "surface":
            image[channel, *place] = np.exp(-(end * 1000 - t) / (of.decay_ms * 1000))
        elif t >= begin_us:
            at = (t - begin_us) / (window_ms * 1000) * of.bins
            sign = 2 * p - 1
            if of.kind == "voxels":
                image[int(at), *place] += sign * (1 - at % 1)
                if int(at) + 1 < of.bins:
                    image[int(at) + 1, *place] += sign * (at % 1)
            else:
                bins = (int(at),) if of.kind == "histogram" else ()
                image[channel, *bins, *place] += sign if of.polarity == "signed" else 1
    return image


CASES = (
    ("frames", 200.0, None, {}),
    ("frames", 1000.0, 1, {"polarity": "sum"}),
    ("frames", 240.0, None, {}),
    ("frames", 60.0, 40, {"polarity": "signed"}),
    ("histogram", 50.0, 35, {"bins": 7}),
    ("histogram", 333.0, None, {"bins": 2}),
    ("voxels", 100.0, 10, {"bins": 5}),
    ("voxels", 30.0, None, {"bins": 4}),
    ("voxels", 33.3, 50, {"bins": 1}),
    ("surface", 100.0, None, {"decay_ms": 4.0}),
    ("surface", 60.0, None, {"polarity": "sum"}),
)


@pytest.mark.parametrize(("kind", "rate_hz", "window_ms", "more"), CASES)
@pytest.mark.parametrize("size_px", [None, (20, 11)])
def test_images_are_as_defined(
    kind: Any, rate_hz: float, window_ms: int | None, more: dict[str, Any], size_px: tuple[int, int] | None
) -> None:
    """Assert that each image is what its definition gives, however blocks are cut, and slice by slice the same bits."""
    events = random_events()
    of = representation(kind, FRAME_PX, size_px, rate_hz, window_ms, **more)
    ends, images = joined(fold(of, blocks(events, 13)))
    assert len(images) == of.images(SLICES)
    assert of.end(len(images) - 1) <= SLICES < of.end(len(images))
    assert images.dtype == of.dtype
    for at in (0, len(ends) // 2, len(ends) - 1):
        expected = plainly(of, events, int(ends[at]) // 1000)
        np.testing.assert_allclose(images[at], expected, rtol=1e-6, atol=1e-5)
    for cut in (1, SLICES):
        np.testing.assert_array_equal(joined(fold(of, blocks(events, cut)))[1], images)
    state = event_drawing.start(of)
    online = [event_drawing.step(state, one) for block in blocks(events, SLICES) for one in block.slices()]
    np.testing.assert_array_equal([image for image in online if image is not None], images)
    assert [k + 1 for k, image in enumerate(online) if image is not None] == (ends // 1000).tolist()


@pytest.mark.parametrize("rate_hz", [30, 60, 120, 240, 333, 600, 999, 1000, 62.5])
@pytest.mark.parametrize("kind", ["frames", "histogram"])
def test_without_a_window_each_event_counts_once(kind: Any, rate_hz: float) -> None:
    """Assert that images follow each other without gap or overlap at any rate, however blocks are cut."""
    events = random_events()
    of = representation(kind, FRAME_PX, (1, 1), rate_hz, None)
    for cut in (1, 13, SLICES):
        ends, images = joined(fold(of, blocks(events, cut)))
        edges = np.searchsorted(events.t, np.append(0, ends))
        assert images.reshape(len(ends), -1).sum(axis=1).tolist() == np.diff(edges).tolist()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("t_us", [-1, 1_000, 1_700_000_000_000_000])
def test_events_of_another_time_are_refused(kind: Any, t_us: int) -> None:
    """Assert that a camera's times that do not count from the first slice write nowhere, but are refused."""
    state = event_drawing.start(representation(kind, FRAME_PX, None, 1000.0, None))
    columns = (np.array([t_us]), np.ones(1, np.uint16), np.ones(1, np.uint16), np.ones(1, np.uint8))
    with pytest.raises(ValueError, match="from 0 to 999 us in slice 0"):
        event_drawing.step(state, Events(*columns))


def test_a_count_goes_no_further() -> None:
    """Assert that a pixel with more events than its number holds stays at the most, and does not turn negative."""
    count = MOST_COUNTED + 10
    events = Events(*(np.zeros(count, type_) for type_ in (np.int64, np.uint16, np.uint16, np.uint8)))
    of = representation("frames", FRAME_PX, (1, 1), 1000.0, None, polarity="sum")
    (block,) = fold(of, [SliceBlock(0, np.array([0, count]), events)])
    assert block.images.ravel().tolist() == [MOST_COUNTED]


def test_events_beside_the_frame_are_refused() -> None:
    """Assert that events outside the sensor's frame write nowhere, but are refused."""
    for x, y in ((FRAME_PX[0], 0), (0, FRAME_PX[1])):
        columns = (np.array([5]), np.array([x], np.uint16), np.array([y], np.uint16), np.ones(1, np.uint8))
        for kind in KINDS:
            of = representation(kind, FRAME_PX, None, 1000.0, None)
            with pytest.raises(ValueError, match="64 x 48 px"):
                event_drawing.step(event_drawing.start(of), Events(*columns))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"kind": "film"}, "kind"),
        ({"polarity": "on"}, "polarity"),
        ({"kind": "surface", "polarity": "signed"}, "polarity"),
        ({"size_px": (65, 48)}, "width"),
        ({"size_px": (64, 0)}, "height"),
        ({"size_px": (16.5, 12)}, "width of size_px: expected a whole number"),
        ({"size_px": 16}, "width and height"),
        ({"size_px": "16x12"}, "width and height"),
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"rate_hz": 1001.0}, "rate_hz"),
        ({"window_ms": 0}, "window_ms"),
        ({"window_ms": 2.5}, "window_ms: expected a whole number"),
        ({"bins": 0}, "bins"),
        ({"decay_ms": float("nan")}, "decay_ms"),
    ],
)
def test_numbers_that_cannot_be(changes: dict[str, Any], named: str) -> None:
    """Assert that they are refused by their name."""
    usual = {"kind": "frames", "frame_px": FRAME_PX, "size_px": FRAME_PX, "rate_hz": 200.0, "window_ms": 5}
    with pytest.raises(ValueError, match=named):
        Representation(**{**usual, **changes})
