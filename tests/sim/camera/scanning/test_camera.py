"""The simulated camera: against every pixel compared in every scan, and against what geometry and chance demand."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel, CameraState
from tests.sim.camera.exact_events import reference_events
from tests.sim.camera.small_frames import (
    FRAME,
    QUIET,
    STILL,
    STRIP,
    TEXTURE,
    Path,
    as_set,
    before_window,
    line,
    play,
    slide,
    start,
    texture_level,
    total,
)


def formula_picture(dots: NDArray[np.float64], model: CameraModel) -> Any:
    """The erf edge in closed form, in double precision, for the whole frame."""
    y, x = np.mgrid[: model.frame_px[1], : model.frame_px[0]]
    distance = np.min([np.hypot(x - dot[0], y - dot[1]) for dot in dots], axis=0) - model.dot_radius_px
    ink = math.exp(-model.log_contrast)
    return np.log(ink + (1 - ink) * 0.5 * (1 + erf(distance / model.edge_sigma_px / math.sqrt(2))))


def table_picture(dots: NDArray[np.float64], model: CameraModel) -> Any:
    """The tabulated edge in numpy, in single precision as the camera has it."""
    profile = optics.dot_profile(model.dot_radius_px, model.edge_sigma_px, model.log_contrast)
    y, x = np.mgrid[: model.frame_px[1], : model.frame_px[0]]
    distance2 = np.full(x.shape, np.inf, np.float32)
    for dot in dots:
        across, down = (x - dot[0]).astype(np.float32), (y - dot[1]).astype(np.float32)
        distance2 = np.minimum(distance2, across * across + down * down)
    position = (np.sqrt(distance2) - np.float32(profile.inner_px)) * np.float32(profile.steps_per_px)
    position = np.clip(position, np.float32(0), np.float32(optics.PROFILE_STEPS))
    index = position.astype(np.int32)
    below = profile.level[index]
    return below + (position - index.astype(np.float32)) * (profile.level[index + 1] - below)


def every_pixel(
    state: CameraState, path: Path, slices: int, picture: Callable[..., NDArray[Any]]
) -> set[tuple[int, int, int, int]]:
    """Events of a camera that compares the whole frame in every scan; the level at an event is the new reference.

    A pixel is blind for the refractory time after its event, then goes on from the level that it is shown.
    """
    model, width = state.model, state.model.frame_px[0]
    reference, threshold = state.reference.astype(picture(path(0), model).dtype), state.threshold
    release, events = np.zeros(reference.shape), set()
    for k in range(slices):
        for scan in range(model.scans_per_ms):
            part = scan / model.scans_per_ms
            now = 1000 * k + 1000 * scan / model.scans_per_ms
            level = picture(path(k) + part * (path(k + 1) - path(k)), model)
            reference = np.where(release > now, level, reference) if model.refractory_us else reference
            change = level - reference
            fired = np.abs(change) >= threshold
            reference[fired] = level[fired]
            release[fired] = now + model.refractory_us
            for y, x in np.argwhere(fired).tolist():
                t_us = 1000 * k + math.floor((scan + x / width) * 1000 / model.scans_per_ms + 1e-9)
                events.add((t_us, x, y, int(change[y, x] > 0)))
    return events


def zigzag(t_ms: float) -> NDArray[np.float64]:
    """Three dots that never rest: one shakes, one circles through it, one crosses the frame's corner."""
    turn = 2 * math.pi * t_ms / 12
    return np.array(
        [
            [40 + 4 * math.sin(2 * math.pi * t_ms / 7.3), 40.0 + 0.4 * t_ms],
            [50 + 9 * math.cos(turn), 40 + 9 * math.sin(turn)],
            [-10.0 + 1.1 * t_ms, 85.0 - 0.7 * t_ms],
        ]
    )


def leap(t_ms: float) -> NDArray[np.float64]:
    """50 px to and fro every ms, once over the frame's edge and once far away."""
    far = {3: 60.0, 6: 9e5}.get(int(t_ms), 0.0)
    return np.array([[25.3 + 50 * (t_ms % 2) + far, 40.2], [30.0, 20.0 + 0.3 * t_ms]])


MOTIONS: dict[str, tuple[Path, int]] = {
    "slow": (line([50.2, 40.7], (0.06, 0.02)), 40),
    "fast": (line([[20.2, 40.7]], (2.1, 0.3)), 25),
    "overlapping and leaving": (zigzag, 24),
    "leaping": (leap, 8),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_nothing_is_lost(motion: str) -> None:
    """Assert that looking at rings only gives the very events of every pixel in every scan, where dots move enough."""
    path, slices = MOTIONS[motion]
    state = start(path(0))
    expected = every_pixel(state, path, slices, table_picture)
    result = as_set(play(state, path, slices))
    assert len(result) > 500
    assert result == expected


@pytest.mark.parametrize("refractory_us", [0.0, 900.0])
@pytest.mark.parametrize("seed", range(4))
def test_sleeping_pixels_against_every_pixel(seed: int, refractory_us: float) -> None:
    """Assert the very events of every pixel in every scan for random walks of dots that rest, creep, shake and jump.

    Rings cross, dots come from beyond the frame and go, thresholds differ much: sleep must never lose an event.
    """
    rng = np.random.default_rng(seed)
    model = dataclasses.replace(QUIET, mismatch=0.3, refractory_us=refractory_us)
    slices, dots = 60, 5
    speeds = np.repeat(10.0 ** rng.uniform(-2.3, 0.6, (slices // 10, dots)), 10, axis=0)
    speeds[rng.random((slices, dots)) < 0.1] = 0.0
    speeds[rng.random((slices, dots)) < 0.02] = 60.0
    angle = 2 * math.pi * rng.random((slices, dots))
    angle[rng.random((slices, dots)) < 0.7] = 0.4
    travel = speeds[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    home = rng.uniform((5, 5), (95, 75), (dots, 2))
    at = home + np.concatenate([np.zeros((1, dots, 2)), np.cumsum(travel, axis=0)])
    at = 50 - np.abs((at - 50) % 240 - 120) + 40  # comes back in the end
    state = start(at[0], model)
    expected = every_pixel(state, lambda k: at[int(k)], slices, table_picture)
    assert len(expected) > 1000
    assert as_set(play(state, lambda k: at[int(k)], slices)) == expected


@pytest.mark.parametrize(
    ("speed", "missing", "same"),
    [(0.005, 0.005, 0.0), (0.02, 0.005, 0.0), (0.3, 0.002, 0.99), (2.0, 0.002, 0.99)],
)
def test_against_the_closed_form(speed: float, missing: float, same: float) -> None:
    """Assert the count of the erf formula: within 0.2 %, in a creep, where RESOLUTION_PX counts, 0.5 %."""
    path, slices = line([40.2, 40.7], (0.8 * speed, 0.6 * speed)), max(10, int(2 / speed))
    state = start(path(0))
    expected = every_pixel(state, path, slices, formula_picture)
    result = as_set(play(state, path, slices))
    assert len(result) == pytest.approx(len(expected), rel=missing)
    assert len(result & expected) >= same * len(expected)


def test_scans_follow_a_curved_path() -> None:
    """Assert that a dot's path between start and end is seen at the scans: a tone of one period a slice is not lost."""
    turn = 2 * math.pi * np.arange(6) / 5
    cut = np.array([40.3, 40.6]) + 3.0 * np.stack([np.sin(turn), np.sin(turn)], axis=1)
    cut[-1] = cut[0]
    state, by_scans = start(cut[:1]), start(cut[:1], dataclasses.replace(QUIET, scans_per_ms=1))
    rng = np.random.default_rng(0)
    whole = camera.step(state, SliceMotion(cut[:1], cut[-1:], STILL, STILL, 0.0, cut[:, None]), 0, rng)
    single = [
        camera.step(by_scans, SliceMotion(cut[k : k + 1], cut[k : k + 1], STILL, STILL, 0.0), 0, rng) for k in range(5)
    ]
    assert whole.size == total(single) > 200
    np.testing.assert_array_equal(state.reference, by_scans.reference)


def test_expected_count_from_random_phase() -> None:
    """Assert the closed form: a slow change of n thresholds gives sum_k clip((n - k) / 2, 0, 1) events in the mean.

    The first event comes where the level has used up the phase, uniform in (0, 2C), each further one after C.
    """
    xy = np.array([[x, y] for x in (80, 160, 240) for y in (60, 120, 180)]) + 0.3
    model = dataclasses.replace(QUIET, frame_px=(320, 240))
    state = start(xy, model)
    before, after = (formula_picture(xy + [shift, 0.0], model) for shift in (0.0, 1.0))
    steps = np.abs(after - before) / state.threshold
    expected = sum(np.clip((steps - k) / 2, 0, 1).sum() for k in range(8))
    result = total(play(state, lambda t_ms: xy + [min(t_ms * 0.05, 1.0), 0.0], 21))
    # Counting noise is 1 %; the rest is overshoot, which at 0.01 px a look lengthens every step by 1 %.
    assert result == pytest.approx(expected, rel=0.03)


def test_thresholds_and_phases() -> None:
    """Assert thresholds of the asked mean and spread, never below a quarter, and phases uniform within them."""
    model = CameraModel(threshold=0.2, mismatch=0.03)
    state = start(np.empty((0, 2)), model)
    assert state.threshold.mean() == pytest.approx(0.2, rel=1e-3)
    assert state.threshold.std() == pytest.approx(0.006, rel=0.01)
    phase = state.reference / state.threshold
    assert np.abs(phase).max() <= 1.0
    np.testing.assert_allclose(np.quantile(phase, [0.1, 0.25, 0.5, 0.75, 0.9]), [-0.8, -0.5, 0, 0.5, 0.8], atol=0.01)
    assert start(np.empty((0, 2)), dataclasses.replace(model, mismatch=1.0)).threshold.min() == np.float32(0.05)


@pytest.mark.parametrize(("velocity", "slices"), [((1.3, -0.7), 12), ((0.11, 0.05), 120), ((0.02, -0.03), 400)])
def test_window_against_every_pixel(velocity: tuple[float, float], slices: int) -> None:
    """Assert that a sliding texture gives the events of its level in every scan, in the strip only."""
    x0, y0, x1, y1 = STRIP
    result = as_set(slide(before_window(), velocity, slices))
    fresh = before_window()
    strip = (y1 - y0, x1 - x0), (x0, y0)
    reference, expected = fresh.window_reference + texture_level(TEXTURE, *strip, STILL), set()
    for k in range(slices):
        for scan in range(5):
            at = [k * v + scan / 5 * ((k + 1) * v - k * v) for v in velocity]
            level = texture_level(TEXTURE, *strip, at)
            change = level - reference
            fired = np.abs(change) >= fresh.window_threshold
            reference[fired] = level[fired]
            for y, x in np.argwhere(fired).tolist():
                t_us = 1000 * k + 200 * scan + (x + x0) * 200 // FRAME[0]
                expected.add((t_us, x + x0, y + y0, int(change[y, x] > 0)))
    assert len(result) > 300
    assert result == expected
    assert all(x0 <= x < x1 and y0 <= y < y1 for _, x, y, _ in result)


@pytest.mark.parametrize("leak_hz", [0.0, 10.0])
@pytest.mark.parametrize("refractory_us", [0.0, 1500.0])
@pytest.mark.slow
def test_sleep_may_be_forgotten(leak_hz: float, refractory_us: float) -> None:
    """Assert equal events and references of a camera that is woken before every slice and of one that sleeps on."""
    model = dataclasses.replace(QUIET, leak_hz=leak_hz, refractory_us=refractory_us, mismatch=0.1)
    states = [start([[30.0, 30.0], [52.0, 60.0]], model, window=STRIP, texture=TEXTURE) for _ in range(2)]
    turn = 2 * math.pi * np.arange(401) / 37
    shaken = 3.0 * np.exp(-np.arange(401) / 60)[:, None] * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    events = 0
    for k in range(400):
        states[0].candidates.lower2_px2[:] = np.inf
        states[0].candidates.list_box[:] = np.nan
        states[0].candidate_runs.due_at[:] = -np.inf
        states[0].candidate_runs.row_due_at[:] = -np.inf
        dots = np.array([[30.0, 30.0], [52.0, 60.0]]) + shaken[k : k + 2, None]
        parts = [
            camera.step(state, SliceMotion(*dots, *shaken[k : k + 2], 1.0), 1000 * k, np.random.default_rng(k))
            for state in states
        ]
        for woken, asleep in zip(*parts, strict=True):
            np.testing.assert_array_equal(woken, asleep)
        events += parts[0].size
    assert events > 3000
    np.testing.assert_array_equal(states[0].reference, states[1].reference)
    np.testing.assert_array_equal(states[0].window_reference, states[1].window_reference)


def test_noise_leaves_the_picture_alone() -> None:
    """Assert that noise only adds events: those of the moving dot are the same with it and without."""
    noisy = dataclasses.replace(QUIET, noise_rate_hz=50.0, hot_pixels=5)
    path = line([40.0, 40.0], (0.4, 0.1))
    clean = play(start([[40.0, 40.0]]), path, 10)
    full = play(start([[40.0, 40.0]], noisy), path, 10)
    for few, many in zip(clean, full, strict=True):
        assert many.size > few.size
        assert as_set([few]) <= set(zip(*(column.tolist() for column in many), strict=True))


def test_noise_counts_towards_the_limit() -> None:
    """Assert that noise that does not fit is dropped and counted too."""
    model = dataclasses.replace(QUIET, noise_rate_hz=1000.0, max_events=50)
    state = start([], model)
    result = camera.step(state, SliceMotion([], [], STILL, STILL, 0.0), 0, np.random.default_rng(0))
    assert result.size == 50
    assert state.dropped + 50 == pytest.approx(8000, abs=4 * math.sqrt(8000))


LATCHED: dict[str, tuple[Callable[[float], float], float, float]] = {
    # Displacement in px over time in ms, share and its tolerance. The known shares are for references that start at the
    # level. Pixels of bare gel or ink then end each passage at the limit itself, which a scan of the table reaches and
    # an edge never does; where dots come and go, at 100 Hz, that is 3 % of all events, so that case starts from random
    # phases.
    "creep": (lambda t: 0.05 * t, 0.99, 0.01),
    "slip": (lambda t: 0.3 * t + 0.02 * t * t, 0.90, 0.01),
    "100 Hz, 4 px": (lambda t: 4.0 * math.sin(0.2 * math.pi * t), 0.82, 0.015),
    "498 Hz, 0.6 px": (lambda t: 0.6 * math.sin(0.996 * math.pi * t), 0.72, 0.02),
    "498 Hz, 1.5 px": (lambda t: 1.5 * math.sin(0.996 * math.pi * t), 0.72, 0.02),
}


@pytest.mark.slow
@pytest.mark.parametrize("motion", LATCHED)
def test_scans_lose_a_known_share(motion: str) -> None:
    """Assert the share of all crossings that 5 scans a ms see: 0.99 creep, 0.90 slip, 0.82 at 100, 0.72 at 498 Hz.

    9 dots, C 0.25, mismatch 0.03, 20 ms. A scan each 0.2 ms of the true path is one slice of a camera with one scan a
    slice.
    """
    travel, share, tolerance = LATCHED[motion]
    model = CameraModel((640, 96), noise_rate_hz=0.0, hot_pixels=0, threshold=0.25, scans_per_ms=1)
    xy = np.array([[70 + 62.5 * column, 45] for column in range(9)])
    direction = np.stack([np.full(9, math.cos(0.3)), math.sin(0.3) * (1 + 0.05 * (xy[:, 0] / 300 - 1))], axis=1)
    path = xy + np.array([travel(step / 50) for step in range(1001)])[:, None, None] * direction
    state = start(path[0], model, seed=1)
    if motion != "100 Hz, 4 px":
        state.reference[:] = optics.gel_level(model.frame_px, path[0], state.profile)
    every = reference_events(state, path, 20.0).size
    rng = np.random.default_rng(0)
    scans = [path[min(10 * k, 1000)] for k in range(102)]
    seen = sum(
        camera.step(state, SliceMotion(scans[k], scans[k + 1], STILL, STILL, 0.0), 1000 * k, rng).size
        for k in range(101)
    )
    assert seen / every == pytest.approx(share, abs=tolerance)
