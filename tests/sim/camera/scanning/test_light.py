"""Light that flickers or steps: against every pixel compared after every change, and against closed forms."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.sim.camera import contact_edges
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.contact_edges import EdgePlace
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState
from evetac_cli.sim.setup.scene import Flicker, LightSettings, LightStep
from tests.sim.camera.scanning.test_camera import table_picture
from tests.sim.camera.small_frames import FRAME, QUIET, STILL, STRIP, TEXTURE

DOTS = np.array([[30.0, 30.0], [52.0, 60.0]])
FineEvents = list[tuple[int, int, int, int]]


def start(change: LightSettings | None, model: CameraModel = QUIET, dots: Any = DOTS, **more: Any) -> CameraState:
    corners = more.pop("window", None)
    window = (corners, TEXTURE) if corners else None
    return camera.start(model, dots, window, np.random.default_rng(0), light_change=change, **more)


def stand(state: CameraState, slices: int, first: int = 0) -> list[Events]:
    """Slices in which nothing moves."""
    rng, dots = np.random.default_rng(1), state.seen_dot_xy_px.copy()
    return [
        camera.step(state, SliceMotion(dots, dots, STILL, STILL, 1.0), 1000 * k, rng)
        for k in range(first, first + slices)
    ]


def listed(slices: list[Events]) -> FineEvents:
    return sorted(event for part in slices for event in zip(*(column.tolist() for column in part), strict=True))


def walk(slices: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Dots (slices + 1, dots, 2) that rest, creep, shake and jump."""
    speeds = np.repeat(10.0 ** rng.uniform(-2.3, 0.5, (slices // 10, 2)), 10, axis=0)
    speeds[rng.random((slices, 2)) < 0.3] = 0.0
    speeds[rng.random((slices, 2)) < 0.02] = 20.0
    angle = 2 * math.pi * rng.random((slices, 2))
    travel = speeds[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return DOTS + np.concatenate([np.zeros((1, 2, 2)), np.cumsum(travel, axis=0)])


def log_of_light(change: LightSettings, now: float) -> float:
    """Log brightness of bare gel."""
    return change.flicker_level(now) + change.step_level(now)


@pytest.mark.parametrize("refractory_us", [0.0, 1500.0])
@pytest.mark.parametrize(
    "change",
    [
        LightSettings(flicker=Flicker(frequency_hz=100.0, depth=0.05)),
        LightSettings(flicker=Flicker(frequency_hz=120.0, depth=0.4)),
        LightSettings(flicker=Flicker(frequency_hz=100.0, depth=0.1), step=LightStep(at_s=0.02, factor=1.2)),
    ],
    ids=["shallow", "deep", "flicker and step"],
)
@pytest.mark.slow
def test_light_against_every_pixel(change: LightSettings, refractory_us: float) -> None:
    """Assert the very events of a camera that compares all pixels in every scan, and again when the light changed."""
    rng = np.random.default_rng(4)
    model = dataclasses.replace(QUIET, mismatch=0.2, refractory_us=refractory_us)
    slices = 100
    at = walk(slices, rng)
    state = start(change, model, at[0])
    reference, threshold, release = state.reference.copy(), state.threshold, np.zeros(state.reference.shape)
    result, expected = [], []
    seen = log_of_light(change, 0.0)

    def compare(level: NDArray[np.float32], now: float) -> None:
        if refractory_us:
            reference[release > now] = level[release > now]
        off = level - reference
        fired = np.abs(off) >= threshold
        reference[fired] = level[fired]
        release[fired] = now + refractory_us
        for y, x in np.argwhere(fired).tolist():
            expected.append((int(now) + x * 200 // FRAME[0], x, y, int(off[y, x] > 0)))

    for k in range(slices):
        result.append(camera.step(state, SliceMotion(at[k], at[k + 1], STILL, STILL, 0.0), 1000 * k, rng))
        for scan in range(5):
            print_level = table_picture(at[k] + scan / 5 * (at[k + 1] - at[k]), model)
            compare(print_level, 1000.0 * k + 200 * scan)
        now = 1000.0 * k + 800
        reference -= np.float32(log_of_light(change, now) - seen)
        seen = log_of_light(change, now)
        compare(print_level, now)
    assert len(expected) > 3000
    assert listed(result) == sorted(expected)


def cut_place(t_ms: float) -> EdgePlace:
    """A cut edge that moves to and fro beside the window."""
    return EdgePlace(np.zeros(2), 0.0, np.full(FRAME[1], 68.0 + 0.5 * math.sin(t_ms / 15)))


@pytest.mark.slow
@pytest.mark.parametrize("refractory_us", [0.0, 1500.0])
@pytest.mark.parametrize("leak_hz", [0.0, 10.0])
def test_bounds_may_be_forgotten(leak_hz: float, refractory_us: float) -> None:
    """Assert equal events of a camera that keeps its bounds and one that looks at all pixels in every slice.

    Before a window with a texture, with a cut edge that moves, leak, and pixels that are blind for a while.
    """
    change = LightSettings(flicker=Flicker(frequency_hz=100.0, depth=0.12))
    model = dataclasses.replace(QUIET, mismatch=0.2, leak_hz=leak_hz, refractory_us=refractory_us)
    states = [
        start(change, model, window=STRIP, contact_edges=contact_edges.start(FRAME, cut_place(0), None, 0.3))
        for _ in range(2)
    ]
    shaken = 2.0 * np.exp(-np.arange(201) / 40)[:, None] * np.array([0.8, 0.6]) * np.sin(np.arange(201) / 6)[:, None]
    shaken[150:] = shaken[150]
    events = 0
    for k in range(200):
        states[0].light._bounds[1][:] = -np.inf
        states[0].light._bounds[3][:] = -np.inf
        states[0].light._bounds[5][:] = -np.inf
        states[0].candidates.lower2_px2[:] = np.inf
        states[0].candidates.list_box[:] = np.nan
        dots = DOTS + shaken[k : k + 2, None]
        places = (cut_place(min(k, 100)), cut_place(min(k + 1, 100)))
        motion = SliceMotion(*dots, *shaken[k : k + 2], 1.0, None, *places)
        parts = [camera.step(one, motion, 1000 * k, np.random.default_rng(k)) for one in states]
        assert listed(parts[:1]) == listed(parts[1:]), k
        events += parts[0].size
    assert events > 3000
    np.testing.assert_array_equal(states[0].reference, states[1].reference)
    np.testing.assert_array_equal(states[0].window_reference, states[1].window_reference)


@pytest.mark.parametrize("share", [0.25, -0.5, 1.0, -2.5])
def test_a_step_fires_the_closed_share(share: float) -> None:
    """Assert that a step by s thresholds fires |s| / 2 of all pixels once, at most all, with one polarity.

    References are uniform within a threshold to either side of the level, so |s| / 2 of them are passed, in the
    window, too. Before and after the step nothing happens.
    """
    model = dataclasses.replace(QUIET, frame_px=(400, 300), mismatch=0.0)
    change = LightSettings(step=LightStep(at_s=0.0045, factor=math.exp(share * model.threshold)))
    state = camera.start(model, DOTS, ((300, 0, 400, 300), TEXTURE), np.random.default_rng(0), light_change=change)
    parts = stand(state, 10)
    sizes = [part.size for part in parts]
    assert sizes[:4] == [0] * 4
    assert sizes[5:] == [0] * 5
    assert set(parts[4].p.tolist()) == {int(share > 0)}
    assert (parts[4].t >= 4800).all()
    expected = min(abs(share) / 2, 1.0) * 120_000
    assert sizes[4] == pytest.approx(expected, abs=4 * math.sqrt(120_000) / 2 if abs(share) < 2 else 0)


def test_a_deep_flicker_fires_its_crossings() -> None:
    """Assert that each pixel reports the swing of every half period: floor(swing / threshold) events, one a slice."""
    depth = 0.3
    swing = math.log(1 + depth) - math.log(1 - depth)
    model = dataclasses.replace(QUIET, mismatch=0.0, threshold=0.21)
    state = start(LightSettings(flicker=Flicker(frequency_hz=50.0, depth=depth)), model)
    stand(state, 40)
    period = stand(state, 20, first=40)
    ups = sum(int(part.p.sum()) for part in period) / (FRAME[0] * FRAME[1])
    downs = sum(int((part.p == 0).sum()) for part in period) / (FRAME[0] * FRAME[1])
    assert ups == pytest.approx(downs, rel=0.01)
    assert 1.0 <= ups <= swing / 0.21


def test_one_factor_tells_nothing_of_the_print() -> None:
    """Assert that light that flickers as one factor makes the same events in the middle of dots and on bare gel.

    The swing is ln(1.3 / 0.7), three thresholds.
    """
    model = dataclasses.replace(QUIET, frame_px=(200, 120), mismatch=0.03)
    dots = np.array([[40.0, 60.0], [100.0, 60.0], [160.0, 60.0]])
    y, x = np.mgrid[:120, :200]
    in_print = np.hypot(x[None] - dots[:, :1, None], y[None] - dots[:, 1:, None]).min(axis=0) < 10
    means = []
    for at in (dots, dots + [0.0, 1000.0]):
        state = start(LightSettings(flicker=Flicker(frequency_hz=100.0, depth=0.3)), model, at)
        stand(state, 10)
        counts = np.zeros((120, 200))
        for part in stand(state, 100, 10):
            np.add.at(counts, (part.y, part.x), 1)
        means.append(float(counts[in_print].mean()))
    assert means[0] == means[1]
    assert 2.5 < means[1] / 10 < 3.0  # in a period
