"""Dots that are not all alike: against every pixel compared in every scan, and what a sensor makes of its spreads."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from evetac_cli.sim.camera import contact_edges, optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.gel_camera import dots_differ
from evetac_cli.sim.camera.optics import shaped_level
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.scene import Flicker, LightSettings
from tests.sim.camera.gel_cameras import gel_camera
from tests.sim.camera.small_frames import FRAME, STILL, Path, play

MODEL = CameraModel(frame_px=FRAME, noise_rate_hz=0.0, hot_pixels=0, mismatch=0.05, dot_radius_px=8.0)
APART = np.array([[25.0, 25.0], [65.0, 50.0]])
FACTORS = (np.array([0.7, 1.4]), np.array([1.2, 0.6]))
UNSURE = 1e-4  # log units: single precision of both


def start(dots: Any = APART, model: CameraModel = MODEL, factors: Any = FACTORS, **more: Any) -> CameraState:
    return camera.start(model, dots, None, np.random.default_rng(0), dots_differ=factors, **more)


def misfits(state: CameraState, path: Path, slices: int) -> tuple[int, int]:
    """Events that a camera should not have made, or should have, and their number if every pixel is compared.

    A pixel is left out as soon as a level is too near to its threshold to say.
    """
    on = np.where(np.isinf(state.threshold), np.inf, state.threshold)
    last, unsure = state.reference.copy(), np.zeros(state.reference.shape, bool)
    profile = optics.dot_profile(MODEL.dot_radius_px, MODEL.edge_sigma_px, MODEL.log_contrast)
    shapes = state.shapes
    expected: set[tuple[int, int, int, int]] = set()
    made: set[tuple[int, int, int, int]] = set()
    for k, events in enumerate(play(state, path, slices)):
        made |= set(zip(*(column.tolist() for column in events), strict=True))
        start_xy, end_xy = path(k), path(k + 1)
        for scan in range(5):
            level = shaped_level(FRAME, start_xy + scan / 5 * (end_xy - start_xy), profile, shapes)
            change = level - last
            unsure |= abs(abs(change) - on) < UNSURE
            fires = abs(change) >= on
            for y, x in np.argwhere(fires):
                when = 1000 * k + int(state.readout_us[scan, x])
                expected.add((when, int(x), int(y), int(change[y, x] > 0)))
            last[fires] = level[fires]
    wrong = [event for event in made ^ expected if not unsure[event[2], event[1]]]
    return len(wrong), len(expected)


@pytest.mark.parametrize("speed", [0.01, 0.05, 0.4, 3.0])
def test_as_every_pixel_of_dots_apart(speed: float) -> None:
    """Assert that dots of two sizes and contrasts make the events of all pixels, however fast they move."""
    slices = 12 if speed > 1 else 60
    wrong, made = misfits(start(), lambda t: APART + speed * t * np.array([[0.8, 0.6], [-0.6, 0.3]]), slices)
    assert wrong == 0
    assert made > 50


def test_as_every_pixel_where_dots_come_after_each_other() -> None:
    """Assert that what was found for one dot does not hold for another that comes to where it was."""

    def path(t: float) -> Any:  # slowly at first, so that radii are remembered, and the other slowly enough to use them
        away = 2.0 * max(t - 20.0, 0.0)
        return np.array([[25.0 + 0.05 * t - away, 40.0], [85.0 - 0.4 * t, 40.0]])

    wrong, made = misfits(start(path(0)), path, 160)
    assert wrong == 0
    assert made > 5000


def test_equal_factors_are_dots_alike() -> None:
    """Assert that dots whose factors are all 1 make the events of dots that are alike."""
    alike = start(factors=None)
    equal = start(factors=(np.ones(2), np.ones(2)))
    path = lambda t: APART + 0.1 * t  # noqa: E731
    for one, other in zip(play(alike, path, 60), play(equal, path, 60), strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
    assert alike.shapes.inner_px.size == 0


def place(x_px: float) -> contact_edges.EdgePlace:
    return contact_edges.EdgePlace(np.zeros(2), 0.0, np.full(FRAME[1], x_px))


def test_lines_leak_and_light_see_each_dot_as_it_is() -> None:
    """Assert that a line that moves, leak and light over resting dots of two kinds make no event of their rims."""
    model = dataclasses.replace(MODEL, leak_hz=0.01)
    edges = contact_edges.start(FRAME, place(60.0), None, 0.02)
    change = LightSettings(flicker=Flicker(frequency_hz=100.0, depth=0.01))
    state = start(model=model, contact_edges=edges, light_change=change)
    state.reference[:] = shaped_level(FRAME, APART, state.profile, state.shapes)
    rng, events = np.random.default_rng(1), 0
    for k in range(100):
        ends = place(60.0 + 0.05 * k), place(60.05 + 0.05 * k)
        events += camera.step(state, SliceMotion(APART, APART, STILL, STILL, 0.0, None, *ends), 1000 * k, rng).size
    assert events == 0


def test_spreads_of_a_sensor() -> None:
    """Assert that a sensor's dots differ by its spreads, are the same behind a cut, and alike without them."""
    plain = one_sensor("evetac")
    spread = dataclasses.replace(plain, dot_radius_spread=0.1, dot_contrast_spread=0.05)
    drawn, cut = dots_differ(spread, cut=False), dots_differ(spread, cut=True)
    assert drawn is not None
    assert cut is not None
    assert drawn[0].std() == pytest.approx(0.1, rel=0.3)
    assert drawn[1].std() == pytest.approx(0.05, rel=0.3)
    np.testing.assert_array_equal(drawn[0].reshape(7, 9)[:, :8].ravel(), cut[0])
    assert dots_differ(plain, cut=True) is None
    camera_of = gel_camera(spread, cut=True)
    assert len(camera_of._camera.shapes.inner_px) == 56
