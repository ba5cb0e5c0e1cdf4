"""Dots that a flash shows: closed forms, before a simulated camera whose dots have moved, and put into a tracker."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.kernels.tracking import tracker
from evetac_cli.kernels.tracking.presets import PRESETS
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.light import LightChange
from tests.sim.camera.small_frames import QUIET, STILL

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from flash import dots_in_flash, place

RADIUS_PX = 9.0
DOTS = np.array([[40.3, 50.7], [100.0, 52.2], [160.6, 49.9]])


def disc_pixels(dots: Floats, radius_px: float = RADIUS_PX) -> tuple[np.ndarray, np.ndarray]:
    """The pixels of a frame that lie in dots, as columns."""
    y, x = np.mgrid[:110, :200]
    inside = np.hypot(x[None] - dots[:, :1, None], y[None] - dots[:, 1:, None]).min(axis=0) < radius_px
    rows, columns = np.nonzero(inside)
    return columns.astype(np.uint16), rows.astype(np.uint16)


def test_the_middle_of_the_pixels_is_the_middle_of_the_dot() -> None:
    """Assert places of whole discs within 0.1 px, also for dots that are thought to be 5 px away."""
    x, y = disc_pixels(DOTS)
    found = dots_in_flash(x, y, DOTS + [4.0, -3.0], RADIUS_PX)
    assert found == pytest.approx(DOTS, abs=0.1)


def test_hidden_and_missing_dots_have_no_place() -> None:
    """Assert NaN for a dot that shows less than half, one that shows nothing, and one that is missing."""
    x, y = disc_pixels(DOTS)
    shown = ~((x < 40) | (np.abs(x.astype(float) - 100) < 20))
    near = DOTS.copy()
    near[2] = np.nan
    found = dots_in_flash(x[shown], y[shown], np.vstack([near, DOTS[2:]]), RADIUS_PX)
    assert np.isnan(found).all(axis=1).tolist() == [True, True, True, False]
    empty = np.empty(0, np.uint16)
    assert np.isnan(dots_in_flash(empty, empty, DOTS, RADIUS_PX)).all()


def test_a_second_pulse_shows_dots_that_have_moved() -> None:
    """Assert that the second pulse shows dots within 0.1 px after they went to and fro, and that the first does not.

    Simulated: what pixels saw on the way decides how much more light makes an event, for the first pulse alone.
    """
    model = dataclasses.replace(QUIET, frame_px=(200, 110), mismatch=0.03, dot_radius_px=RADIUS_PX)
    change = LightChange(flash_every_s=0.05, flash=(0.2, 0.1))
    state = camera.start(model, DOTS, None, None, np.random.default_rng(0), light_change=change)
    rng, at = np.random.default_rng(1), DOTS
    errors = []
    for k in range(54):
        goes_to = DOTS + [1.3 * np.sin(min(k, 45) / 7), 0.0]
        events = camera.step(state, SliceMotion(at, goes_to, STILL, STILL, 0.0), 1000 * k, rng)
        at = goes_to
        if k >= 50:
            wanted = events.p == (k % 2 == 0)
            errors.append(np.abs(dots_in_flash(events.x[wanted], events.y[wanted], at, RADIUS_PX) - at).max())
    assert errors[0] > 0.3
    assert errors[3] < 0.1


def test_dots_are_followed_from_where_they_are_put() -> None:
    """Assert that placed dots lie there, by a share of the way, are no longer lost, and NaN leaves a dot as it is."""
    state = tracker.start(DOTS, PRESETS["stable"].for_dots(RADIUS_PX))
    state.lost[:] = state.record["left_behind"][0, :3] = True
    seen = DOTS + [2.0, 1.0]
    seen[1] = np.nan
    place(state, seen, 0.5)
    assert state.dot_xy_px[[0, 2]] == pytest.approx(DOTS[[0, 2]] + [1.0, 0.5])
    assert state.dot_xy_px[1] == pytest.approx(DOTS[1])
    assert state.lost.tolist() == [False, True, False]
    empty = np.empty(0, np.uint16)
    tracker.step(state, empty, empty, np.empty(0, np.uint8))
    assert state.dot_xy_px[0] == pytest.approx(DOTS[0] + [1.0, 0.5])


def test_refused_places() -> None:
    """Assert that shares beyond 1 are refused."""
    rest = DOTS.copy()
    rest[2] = np.nan
    state = tracker.start(rest, PRESETS["stable"].for_dots(RADIUS_PX))
    with pytest.raises(AssertionError):
        place(state, rest, 1.5)
