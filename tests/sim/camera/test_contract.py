"""What the camera keeps to, whatever it sees: silence, polarity, order, limits, equal seeds, refusals."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from evetac_cli.events import concatenate
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from tests.sim.camera.small_frames import (
    FRAME,
    QUIET,
    STILL,
    STRIP,
    TEXTURE,
    as_set,
    before_window,
    crowd,
    line,
    play,
    slide,
    start,
    total,
    waits_us,
)

STRAIGHT = line([[20.25, 40.5], [60.0, 30.25]], (1.25, 0.5))  # binary fractions: equal positions, not nearly equal
LAST_SCAN_MS = 0.2  # before the end of a slice


def test_still_scene_is_silent() -> None:
    """Assert that nothing happens where nothing moves."""
    xy = [[30.0, 30.0], [70.0, 50.0]]
    rng = np.random.default_rng(4)
    state = start(xy, window=STRIP, texture=TEXTURE)
    for k in range(20):
        assert camera.step(state, SliceMotion(xy, xy, STILL, STILL, 1.0), 1000 * k, rng).size == 0


def test_polarity_tells_the_direction() -> None:
    """Assert that the leading edge darkens (p 0) and the trailing edge brightens (p 1), as many on either side.

    References end within a threshold of what was seen last.
    """
    state = start([[40.0, 40.0]])
    result = concatenate(play(state, line([[40.0, 40.0]], (0.5, 0.0)), 20))
    assert (result.p[result.x > 50] == 0).all()
    assert (result.p[result.x < 40] == 1).all()
    assert np.count_nonzero(result.p == 0) == pytest.approx(np.count_nonzero(result.p == 1), rel=0.05)
    assert state.seen_dot_xy_px[0, 0] == pytest.approx(50.0 - 0.5 * LAST_SCAN_MS)
    level = optics.gel_level(FRAME, state.seen_dot_xy_px, state.profile)
    assert (np.abs(level - state.reference) <= state.threshold * (1 + 1e-4)).all()


def test_events_of_a_slice() -> None:
    """Assert dtypes, order, and times within the slice."""
    t0_us = 7_000_000_000_000
    state, rng = start([[40.0, 40.0]]), np.random.default_rng(0)
    events = camera.step(state, SliceMotion([[40.0, 40.0]], [[48.0, 44.0]], STILL, STILL, 0.0), t0_us, rng)
    assert [column.dtype for column in events] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert (np.diff(events.t) >= 0).all()
    assert t0_us <= events.t.min() < events.t.max() < t0_us + 1000
    seen_xy = np.array([[48.0, 44.0]]) - np.array([8.0, 4.0]) * LAST_SCAN_MS
    np.testing.assert_allclose(state.seen_dot_xy_px, seen_xy, rtol=1e-15)


def test_pieces_of_a_straight_path() -> None:
    """Assert that a straight path cut into pieces, more or fewer than scans, gives the events of its ends."""
    whole = as_set(play(start(STRAIGHT(0)), STRAIGHT, 12))
    assert len(whole) > 2000
    for pieces in (2, 5, 8, 16):
        cut = as_set(play(start(STRAIGHT(0)), STRAIGHT, 12, pieces=pieces))
        assert len(whole ^ cut) <= 2  # positions at scans are equal but for rounding, which may turn the odd comparison


@pytest.mark.parametrize("texture", [None, TEXTURE], ids=["bare", "texture"])
def test_dots_do_not_show_in_the_window(texture: Any) -> None:
    """Assert that a dot that moves into the window, with or without texture, makes events up to its edge only."""
    state = start([[60.0, 40.0]], window=STRIP, texture=texture)
    result = concatenate(play(state, line([60.0, 40.0], (0.5, 0.0)), 20))
    assert result.size > 1000
    assert result.x.max() < STRIP[0]


def test_first_sight_makes_no_flash() -> None:
    """Assert that an object that is there when the camera is switched on is seen only when it moves or fades."""
    state = before_window()
    assert total(slide(state, STILL, 5)) == 0
    assert total(slide(state, STILL, 1, contrast=0.2)) > 100
    assert total(slide(state, STILL, 5, contrast=0.2)) == 0


def test_no_contrast_no_events() -> None:
    """Assert that an object out of sight slides unseen, and is seen where it has got to when it comes back."""
    state = before_window()
    assert total(slide(state, (3.0, 1.0), 20, contrast=0.0)) == 0
    assert total(slide(state, STILL, 1, contrast=1.0)) > 100


@pytest.mark.parametrize("pieces", [1, 8])
def test_same_generator_same_events(pieces: int) -> None:
    """Assert that equal generator states give equal recordings, bit for bit, and another seed another one."""
    model = dataclasses.replace(QUIET, noise_rate_hz=20.0, hot_pixels=3)
    runs = []
    for seed in (1, 1, 2):
        state = start(crowd(0), model, seed=seed)
        parts = play(state, crowd, 4, pieces=pieces, seed=seed)
        runs.append([column.tobytes() for part in parts for column in part])
    assert runs[0] == runs[1] != runs[2]


def test_full_slice_drops_and_counts() -> None:
    """Assert that a slice never exceeds its limit, the loss is counted, and the picture goes on as if nothing was."""
    path = line([40.0, 40.0], (1.0, 0.0))
    whole, cut = (start(path(0), dataclasses.replace(QUIET, max_events=n)) for n in (QUIET.max_events, 300))
    all_events, stored = play(whole, path, 8), play(cut, path, 8)
    assert [part.size for part in stored] == [min(part.size, 300) for part in all_events]
    assert cut.dropped == total(all_events) - total(stored) > 0
    assert whole.dropped == 0
    np.testing.assert_array_equal(whole.reference, cut.reference)
    assert as_set(stored) < as_set(all_events)


def test_nothing_to_see() -> None:
    """Assert that a camera before no dots, and one before dots out of the frame, sees nothing and does not fail."""
    for pieces in (1, 4):
        assert total(play(start([]), lambda _: np.empty((0, 2)), 3, pieces=pieces)) == 0
    state, rng = start([]), np.random.default_rng(0)
    assert camera.step(state, SliceMotion([], [], STILL, STILL, 0.0), 0, rng).size == 0
    path = line([-60.0, 40.0], (-3.0, 2.0))
    assert total(play(start(path(0)), path, 10)) == 0


@pytest.mark.parametrize(
    ("field", "value"),
    [("dot_radius_px", 0.5), ("dot_radius_px", 200.0), ("edge_sigma_px", 0.01), ("edge_sigma_px", 30.0),
     ("threshold", 0.01), ("log_contrast", 20.0), ("scans_per_ms", 7), ("scans_per_ms", 100),
     ("frame_px", (1, 1)), ("frame_px", (3, 200))],
)  # fmt: skip
@pytest.mark.parametrize(("noise_rate_hz", "pieces"), [(100.0, 1), (0.0, 3)])
def test_extreme_models(field: str, value: Any, noise_rate_hz: float, pieces: int) -> None:
    """Assert that small, large, sharp and blurred dots, odd frames and rates end within a threshold of what they see.

    Events are valid on the way.
    """
    mismatch = 1.0 if field == "threshold" else QUIET.mismatch
    model = dataclasses.replace(QUIET, noise_rate_hz=noise_rate_hz, mismatch=mismatch, **{field: value})
    path = line([40.0, 40.0], (7.3, -2.1))
    state = start(path(0), model)
    for part in play(state, path, 6, pieces=pieces):
        assert (part.x < model.frame_px[0]).all()
        assert (part.y < model.frame_px[1]).all()
        assert (np.diff(part.t) >= 0).all()
    level = optics.gel_level(model.frame_px, state.seen_dot_xy_px, state.profile)
    # A radius is good to 1e-6 px, which at the sharpest edge of all is a level of 1e-3.
    assert (np.abs(level - state.reference) <= state.threshold * (1 + 1e-3) + 1e-3).all()


@pytest.mark.parametrize(
    ("named", "value"),
    [
        ("dot_xy_px_start", [[math.nan, 40.0]]),
        ("dot_xy_px_end", [[40.0, math.inf]]),
        ("dot_xy_px_end", [[40.0, 2e6]]),
        ("dot_path_px", [[[40.0, 40.0]], [[40.0, math.nan]], [[41.0, 40.0]]]),
        ("dot_path_px", [[[40.0, 40.0]], [[math.nan, 40.0]], [[41.0, 40.0]]]),
        ("object_xy_px_start", (math.nan, 0.0)),
        ("object_xy_px_end", (-math.inf, 0.0)),
        ("texture_contrast", math.nan),
        ("texture_contrast", -0.1),
    ],
)
def test_step_refuses(named: str, value: Any) -> None:
    """Assert that a value that is not finite is refused, and the camera is as it was before."""
    good: dict[str, Any] = {
        "dot_xy_px_start": [[40.0, 40.0]],
        "dot_xy_px_end": [[41.0, 40.0]],
        "object_xy_px_start": (0.0, 0.0),
        "object_xy_px_end": (1.0, 0.0),
        "texture_contrast": 1.0,
    }
    state = start(good["dot_xy_px_start"], window=STRIP, texture=TEXTURE)

    def remembered() -> list[Any]:
        names = ("reference", "window_reference", "seen_dot_xy_px", "seen_object")
        return [np.copy(getattr(state, name)) for name in names]

    before = remembered()
    with pytest.raises(ValueError, match=named if named in ("dot_path_px", "texture_contrast") else "finite positions"):
        camera.step(state, SliceMotion(**{**good, named: value}), 0, np.random.default_rng(0))
    for now, then in zip(remembered(), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert np.isnan(state.seen_object).all()


def test_start_refuses() -> None:
    """Assert that a dot without a position is refused when the camera is switched on."""
    with pytest.raises(ValueError, match="dot_xy_px"):
        camera.start(QUIET, [[math.nan, 1.0]], None, np.random.default_rng(0))


@pytest.mark.parametrize(("refractory_us", "least"), [(3000.0, 100), (1700.0, 300)])
def test_refractory_window(refractory_us: float, least: int) -> None:
    """Assert that the window's pixels keep a refractory time, and lose events by it."""
    sizes = []
    for each_us in (0.0, refractory_us):
        state = before_window(dataclasses.replace(QUIET, refractory_us=each_us))
        result = concatenate(slide(state, (2.0, 0.0), 20))
        assert waits_us(result).min() >= max(each_us, 1000 * LAST_SCAN_MS) - 1
        sizes.append(result.size)
    assert least < sizes[1] < sizes[0]


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, STRIP], ids=["no window", "window"])
def test_leak_makes_its_rate(window: Any) -> None:
    """Assert sum_k clip((n - k) / 2, 0, 1) ON events a pixel after n / leak_hz seconds, from random phases."""
    model = dataclasses.replace(QUIET, leak_hz=10.0)
    still = [[40.0, 40.0]]
    state = start(still, model, window=window, texture=TEXTURE if window else None)
    rng = np.random.default_rng(0)
    parts = [camera.step(state, SliceMotion(still, still, STILL, STILL, 1.0), 1000 * k, rng) for k in range(400)]
    result = concatenate(parts)
    steps = 400 * 1e-3 * 10.0
    expected = sum(np.clip((steps - k) / 2, 0, 1) for k in range(6)) * FRAME[0] * FRAME[1]
    assert (result.p == 1).all()
    assert result.size == pytest.approx(expected, rel=0.01)
    assert total(parts[200:]) / 200 == pytest.approx(FRAME[0] * FRAME[1] * 10.0 * 1e-3, rel=0.02)
    assert np.mean(result.x >= STRIP[0]) == pytest.approx(0.3, abs=0.02)
