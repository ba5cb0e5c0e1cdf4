"""Bandwidth as a low pass of motion: its closed form, and its error against a low pass of every pixel's level."""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.arrays import Floats
from evetac_cli.events import concatenate
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.low_pass import SETTLED_PX, LowPass, light_at, rim_bandwidth
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.setup.plan import one_sensor
from tests.sim.camera.exact_events import reference_events
from tests.sim.camera.gel_cameras import gel_camera

Motion = Callable[[Floats], Floats]
Fired = defaultdict[tuple[int, int, int], list[float]]
FINE_US = 5
MODEL = camera.CameraModel(frame_px=(48, 40), mismatch=0.0, noise_rate_hz=0.0, hot_pixels=0, dot_radius_px=10.0)


def tau_us(bandwidth_hz: float) -> float:
    return 1e6 / (2 * math.pi * bandwidth_hz)


@pytest.mark.parametrize("bandwidth_hz", [100.0, 1000.0, 20000.0])
def test_lag_behind_a_ramp_and_after_a_jump(bandwidth_hz: float) -> None:
    """Assert that a ramp is followed by v tau (1 - exp(-t/tau)) behind, and that a jump dies away as exp(-t/tau)."""
    low_pass = LowPass(bandwidth_hz, np.zeros((2, 2)))
    end = np.array([[2.0, 0.0], [0.0, 0.0]])
    begin = np.array([[0.0, 0.0], [1.0, -1.0]])
    seen = low_pass.follow(np.stack([np.where(begin, 0.0, begin), end]))
    part = np.linspace(0.0, 1.0, len(seen))
    tau = tau_us(bandwidth_hz) / 1000
    assert seen[:, 0, 0] == pytest.approx(2.0 * (part - tau * (1 - np.exp(-part / tau))), abs=1e-12)
    low_pass = LowPass(bandwidth_hz, begin)
    seen = low_pass.follow(np.zeros((2, 2, 2)))
    expected = np.where(np.exp(-part / tau) < SETTLED_PX, 0.0, np.exp(-part / tau))
    assert seen[:, 1, 0] == pytest.approx(expected, abs=1.01 * SETTLED_PX)
    assert (seen[:, 1, 0] == -seen[:, 1, 1]).all()


def test_however_cut_and_in_the_end_at_rest() -> None:
    """Assert that more vertices change nothing at common times, slices join, and a point comes to rest exactly."""
    path = np.cumsum(np.random.default_rng(0).normal(size=(6, 3, 2)), axis=0)
    finer = np.stack([np.interp(np.arange(21) / 4, np.arange(6), line) for line in path.reshape(6, -1).T], axis=1)
    coarse, fine = (LowPass(700.0, path[0]) for _ in range(2))
    one, other = coarse.follow(path), fine.follow(finer.reshape(21, 3, 2))
    common = np.linspace(0, len(one) - 1, 6).round().astype(int), np.linspace(0, len(other) - 1, 6).round().astype(int)
    assert one[common[0]] == pytest.approx(other[common[1]], abs=1e-12)
    after = coarse.follow(path[[-1, -1]])
    assert (after[0] == one[-1]).all()
    for _ in range(20):
        after = coarse.follow(path[[-1, -1]])
    assert (after == path[-1]).all()


def straight(time_us: Floats) -> Floats:
    """1 px/ms from 2 ms on, on a slant."""
    travel = np.maximum(time_us - 2000.0, 0.0) / 1000.0
    return np.array([20.0, 19.5]) + travel[:, None] * np.array([0.8, 0.6])


def shaken(time_us: Floats) -> Floats:
    """0.35 px at 200 Hz, from 2 ms on."""
    travel = 0.35 * np.sin(2 * np.pi * 200e-6 * np.maximum(time_us - 2000.0, 0.0))
    return np.array([23.3, 19.5]) + travel[:, None] * np.array([0.8, 0.6])


def by_motion(motion: Motion, bandwidth_hz: float | None, slices: int) -> tuple[Fired, Floats]:
    """Event times of each pixel and polarity, exact for filtered motion; and the first references."""
    begin = motion(np.zeros(1))
    state = camera.start(MODEL, begin, None, np.random.default_rng(4))
    path = motion(np.arange(0.0, slices * 1000.0 + FINE_US, FINE_US))[:, None]
    if bandwidth_hz:
        low_pass, steps = LowPass(bandwidth_hz, begin), 1000 // FINE_US
        seen = [low_pass.follow(path[k * steps : (k + 1) * steps + 1]) for k in range(slices)]
        path = np.concatenate([seen[0][:1], *(piece[1:] for piece in seen)])
    fired: Fired = defaultdict(list)
    events = reference_events(state, path, slices * 1000.0 / (len(path) - 1))
    for t, x, y, p in zip(*(column.tolist() for column in events), strict=True):
        fired[x, y, p].append(t)
    return fired, state.reference.astype(np.float64)


def by_level(motion: Motion, bandwidth_hz: float, slices: int, reference: Floats, *, by_light: bool = False) -> Fired:
    """The same from the definition: every pixel's level is low-passed, in steps so short that it runs straight.

    With `by_light` each pixel has the time constant of the brightness that it is shown.
    """
    tau = tau_us(bandwidth_hz)
    inner, _, steps_per_px, profile = optics.dot_profile(MODEL.dot_radius_px)
    y, x = np.mgrid[: MODEL.frame_px[1], : MODEL.frame_px[0]]
    time_us = np.arange(0.0, slices * 1000.0 + FINE_US, FINE_US)
    place = motion(time_us)
    fired: Fired = defaultdict(list)
    for k in range(len(time_us)):
        radius = np.hypot(x - place[k, 0], y - place[k, 1])
        level = np.interp((radius - inner) * steps_per_px, np.arange(len(profile)), profile)
        if k == 0:
            before, seen = level, level
            continue
        pixel_tau = tau / np.exp(0.5 * (level + before)) if by_light else np.full_like(level, tau)
        lag = (level - before) / FINE_US * pixel_tau
        was, seen, before = seen, level - lag + (seen - before + lag) * np.exp(-FINE_US / pixel_tau), level
        while (far := np.abs(seen - reference) >= MODEL.threshold).any():
            towards = np.sign(seen - reference)
            target = reference + towards * MODEL.threshold
            for row, column in zip(*far.nonzero(), strict=True):
                part = (target[row, column] - was[row, column]) / (seen[row, column] - was[row, column])
                key = (int(column), int(row), int(towards[row, column] > 0))
                fired[key].append(float(time_us[k - 1] + part * FINE_US))
            reference = np.where(far, target, reference)
    return fired


def compare(one: Fired, other: Fired) -> tuple[float, float]:
    """Relative difference of the event count, and median time error in us over pixels with equally many events."""
    counts = [sum(map(len, fired.values())) for fired in (one, other)]
    errors = [np.subtract(times, other[key]) for key, times in one.items() if len(times) == len(other[key])]
    return abs(counts[0] / counts[1] - 1), float(np.median(np.abs(np.concatenate(errors))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "slices", "bandwidth_hz", "count_within", "median_us"),
    [
        pytest.param(
            straight, 12, 300.0, 0.005, 55.0, marks=pytest.mark.slow
        ),  # the edge moves by half its own width within tau, 531 us
        pytest.param(straight, 12, 1000.0, 0.001, 6.0, marks=pytest.mark.slow),
        (shaken, 22, 300.0, 0.01, 12.0),
        (shaken, 22, 1000.0, 0.005, 2.0),
    ],
)
def test_motion_stands_for_levels(
    motion: Motion, slices: int, bandwidth_hz: float, count_within: float, median_us: float
) -> None:
    """Assert that filtered motion makes the events of filtered levels, where unfiltered motion is early by tau."""
    filtered, reference = by_motion(motion, bandwidth_hz, slices)
    plain, _ = by_motion(motion, None, slices)
    wanted = by_level(motion, bandwidth_hz, slices, reference)
    count, late_us = compare(filtered, wanted)
    assert count <= count_within
    assert late_us <= median_us
    assert compare(plain, wanted)[1] > 0.9 * tau_us(bandwidth_hz)


@pytest.mark.slow
@pytest.mark.parametrize("bandwidth_hz", [1000.0, 3000.0])
def test_dots_lag_by_the_mean_of_their_levels(bandwidth_hz: float) -> None:
    """Assert that a dot whose pixels are slower where it is dark makes its events as late, in the mean, as they do."""
    filtered, reference = by_motion(straight, bandwidth_hz * rim_bandwidth(MODEL.log_contrast), 12)
    plain, _ = by_motion(straight, None, 12)
    wanted = by_level(straight, bandwidth_hz, 12, reference, by_light=True)
    late_us = [
        np.mean(np.concatenate([np.subtract(other[key], plain[key]) for key in plain if is_like(key, plain, other)]))
        for other in (filtered, wanted)
    ]
    assert late_us[0] == pytest.approx(late_us[1], rel=0.1)
    assert late_us[0] > 2.0 * tau_us(bandwidth_hz)
    assert compare(filtered, wanted)[0] < 0.01


def is_like(key: tuple[int, int, int], one: Fired, other: Fired) -> bool:
    return len(one[key]) == len(other[key])


def test_light_falls_to_the_corners() -> None:
    """Assert that light is 1 in the mean over the frame, and by its gradient less in a corner than in the middle."""
    assert rim_bandwidth(1e-9) == pytest.approx(1.0)
    y, x = np.mgrid[:480, :640] + 0.5
    light = light_at(np.stack([x, y], axis=-1), (640, 480), 0.4)
    assert light.mean() == pytest.approx(1.0, rel=1e-3)
    middle, corner = light_at(np.array([[320.0, 240.0], [0.0, 480.0]]), (640, 480), 0.4)
    assert corner / middle == pytest.approx(0.6)


def test_bandwidth_by_light_delays_dark_dots_and_dark_corners() -> None:
    """Assert that a sensor's dots come later by the brightness of their rims, and later still where light is less."""
    sensor = replace(one_sensor("evetac"), noise_hz=0.0, hot_pixels=0, bandwidth_hz=500.0)
    late_us = {}
    for name, more in {
        "all alike": {},
        "by light": {"bandwidth_by_light": True},
        "uneven": {"bandwidth_by_light": True, "light_gradient": 0.6},
        "no effect": {"light_gradient": 0.6},
    }.items():
        seen_by = gel_camera(replace(sensor, **more), cut=False)
        at_m, slices = np.zeros_like(seen_by.rest_m), []
        for k in range(30):
            at_m = at_m + [1e-5, 0.0] if k < 3 else at_m
            slices.append(seen_by.render(at_m, np.zeros(2), 0.0, k * 1000))
        events = concatenate(slices)
        corner = (events.x < 100) & ((events.y < 80) | (events.y > 380))
        late_us[name] = events.t.mean(), events.t[corner].mean()
    assert late_us["no effect"] == late_us["all alike"]
    behind_us = late_us["by light"][0] - late_us["all alike"][0]
    assert behind_us == pytest.approx(tau_us(500.0) * (1 / rim_bandwidth(1.61) - 1), rel=0.25)
    assert late_us["uneven"][1] > late_us["by light"][1] + 0.3 * tau_us(500.0)
