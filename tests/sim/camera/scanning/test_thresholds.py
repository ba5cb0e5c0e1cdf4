"""A scanning camera whose pixels have two thresholds, one of ON and one of OFF."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel
from tests.sim.camera.scanning.test_camera import table_picture
from tests.sim.camera.small_frames import FRAME, STILL, STRIP, TEXTURE, play

APART = CameraModel(frame_px=FRAME, noise_rate_hz=0.0, hot_pixels=0, threshold=0.1, threshold_off=0.2, mismatch=0.05)


def start(model: CameraModel = APART, *window: Any) -> camera.CameraState:
    return camera.start(model, [[30.0, 40.0]], window or None, np.random.default_rng(0))


def there_and_back(state: camera.CameraState, speed_px_ms: float, slices: int) -> list[Any]:
    """A dot that goes to the right and comes back."""
    return play(state, lambda t: np.array([[30.0 + speed_px_ms * (slices - abs(slices - t)), 40.0]]), 2 * slices)


@pytest.mark.parametrize(("on", "off"), [(0.1, 0.2), (0.2, 0.1), (0.1, 0.1)])
def test_ratio_of_events_follows_the_thresholds(on: float, off: float) -> None:
    """Assert that brightness that falls and rises as far slowly makes ON and OFF events as 1 / threshold."""
    model = dataclasses.replace(APART, threshold=on, threshold_off=off, mismatch=0.0)
    events = there_and_back(start(model), 0.05, 800)
    ons = sum(int(part.p.sum()) for part in events)
    offs = sum(part.size for part in events) - ons
    assert ons > 10_000
    assert ons / offs == pytest.approx(off / on, rel=0.07)  # what is left below a threshold at a turn makes no event


def test_as_every_pixel_compared_with_its_two_thresholds() -> None:
    """Assert that the events are those of all pixels, each compared with its own ON and OFF threshold in every scan."""
    state = start()
    on, off = state.threshold + state.middle_shift, state.threshold - state.middle_shift
    last = state.reference - state.middle_shift
    made = {event for part in there_and_back(state, 0.3, 60) for event in zip(*(c.tolist() for c in part), strict=True)}
    expected, in_doubt = set(), set()
    for scan in range(5 * 120):
        moved_px = 0.3 * (60 - abs(60 - scan / 5))
        level = table_picture(np.array([[30.0 + moved_px, 40.0]]), APART)
        change = level - last
        fires = (change >= on) | (change <= -off)
        for y, x in np.argwhere(fires | (abs(change - on) < 1e-4) | (abs(change + off) < 1e-4)):
            t_us = scan // 5 * 1000 + int(state.readout_us[scan % 5, x])
            event = (t_us, int(x), int(y), int(change[y, x] > 0))
            (expected if abs(change[y, x] - on[y, x]) > 1e-4 < abs(change[y, x] + off[y, x]) else in_doubt).add(event)
        last[fires] = level[fires]
    assert len(expected) > 5000
    in_place = {event[1:3] for event in in_doubt}
    assert all(event[1:3] in in_place for event in made ^ expected)


def test_window_has_both_thresholds() -> None:
    """Assert that the window's ON and OFF events, too, come at their own thresholds."""
    events = []
    for on, off in ((0.05, 0.05), (0.05, 0.1)):
        state = start(dataclasses.replace(APART, threshold=on, threshold_off=off), STRIP, TEXTURE)
        rng = np.random.default_rng(1)
        dots = [[30.0, 40.0]]
        at = [(0.1 * (300 - abs(300 - k)), 0.0) for k in range(601)]
        slices = [camera.step(state, SliceMotion(dots, dots, at[k], at[k + 1], 1.0), k, rng) for k in range(600)]
        ons = sum(int(part.p.sum()) for part in slices)
        events.append((ons, sum(part.size for part in slices) - ons))
    assert events[0][0] == pytest.approx(events[0][1], rel=0.05)
    assert events[1][0] / events[1][1] == pytest.approx(2.0, rel=0.1)


def test_thresholds_are_drawn_independently() -> None:
    """Assert that a pixel's two thresholds spread alike, do not depend on each other, and leave other draws alone."""
    state = start(dataclasses.replace(APART, hot_pixels=50))
    on, off = state.threshold + state.middle_shift, state.threshold - state.middle_shift
    assert on.mean() == pytest.approx(0.1, rel=0.01)
    assert off.mean() == pytest.approx(0.2, rel=0.01)
    assert off.std() / off.mean() == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef(on.ravel(), off.ravel())[0, 1]) < 0.05
    one = start(dataclasses.replace(APART, hot_pixels=50, threshold_off=None))
    np.testing.assert_allclose(one.threshold, on, rtol=1e-6)
    np.testing.assert_array_equal(one.noise.hot_pixel, state.noise.hot_pixel)
    assert one.middle_shift.size == 0


def test_leak_makes_its_rate_with_thresholds_apart() -> None:
    """Assert that leak makes `leak_hz` ON events a second in a pixel, whatever the two thresholds."""
    model = dataclasses.replace(APART, leak_hz=10.0)
    state = camera.start(model, np.empty((0, 2)), None, np.random.default_rng(0))
    nowhere, rng = np.empty((0, 2)), np.random.default_rng(1)
    slices = [camera.step(state, SliceMotion(nowhere, nowhere, STILL, STILL, 0.0), 1000 * k, rng) for k in range(1400)]
    assert all((part.p == 1).all() for part in slices)
    settled = slices[400:]  # at first a pixel may lie below its last event by up to an OFF threshold
    assert sum(part.size for part in settled) == pytest.approx(10.0 * FRAME[0] * FRAME[1], rel=0.02)
