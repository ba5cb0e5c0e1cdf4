"""The ideal camera: against closed forms, a reference that shares no code with it, and the scanning camera."""

import copy
import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erfinv

from evetac_cli.evaluate.cost import camera as camera_cost
from evetac_cli.evaluate.cost.camera import Workload
from evetac_cli.evaluate.cost.camera_reference import FineEvents, fine, match, reference_events
from evetac_cli.events import Events, concatenate
from evetac_cli.sim.camera import optics
from evetac_cli.sim.camera.camera_input import SliceMotion
from evetac_cli.sim.camera.ideal import camera as ideal
from evetac_cli.sim.camera.ideal.camera import IdealState
from evetac_cli.sim.camera.scanning import camera
from evetac_cli.sim.camera.scanning.camera import CameraModel
from tests.sim.camera import small_frames
from tests.sim.camera.small_frames import (
    FRAME,
    QUIET,
    STILL,
    STRIP,
    TEXTURE,
    Path,
    before_window,
    crowd,
    line,
    slide,
    waits_us,
)

pytestmark = pytest.mark.slow  # a minute of processor time


def on_gel(model: CameraModel, reference: float) -> IdealState:
    """A camera whose pixels all have one reference and one threshold, before a dot that is still far away."""
    model = dataclasses.replace(model, mismatch=0.0)
    shared = camera.start(model, [[-500.0, 40.0]], None, None, np.random.default_rng(0))
    shared.reference[:] = reference
    return ideal.from_references(shared)


start = partial(small_frames.start, ideal)


def play(state: IdealState, path: Path, slices: int, *, pieces: int = 1) -> Events:
    """Dots that follow a path over time in ms, cut into straight pieces."""
    return concatenate(small_frames.play(ideal, state, path, slices, pieces=pieces))


def radii(model: CameraModel, levels: NDArray[Any]) -> NDArray[np.float64]:
    """The erf edge turned round: at which distances from a dot's centre it has these levels."""
    ink = math.exp(-model.log_contrast)
    lit = (np.exp(levels) - ink) / (1.0 - ink)
    inverse: NDArray[np.float64] = model.dot_radius_px + model.edge_sigma_px * math.sqrt(2.0) * erfinv(2.0 * lit - 1.0)
    return inverse


def columns_equal(a: Events, b: Events) -> bool:
    return all(np.array_equal(a[column], b[column]) for column in range(4))


def test_edge_at_known_times() -> None:
    """Assert that a dot's rim, moving along a row of pixels, fires each of them when it brings the next threshold."""
    state = on_gel(QUIET, reference=0.05)
    speed, from_x = 0.7, -30.0
    result = play(state, line([from_x, 40.0], (speed, 0.0)), 60)
    expected = radii(QUIET, 0.05 - 0.2 * np.arange(1, 9))  # 8 thresholds of 0.2 fit into 1.61 + 0.05
    tested = 0
    for x in range(20):
        here = (result.x == x) & (result.y == 40) & (result.p == 0)
        times_us = (x - expected - from_x) / speed * 1000.0
        assert result.t[here].size == 8
        # Whole microseconds, rounded down; the table adds 1e-3 px where the edge's tails are cut off, else 1e-5 px.
        np.testing.assert_allclose(result.t[here] + 0.5, times_us, atol=0.6)
        tested += 8
    assert tested == 160


def test_dot_in_uniform_motion() -> None:
    """Assert count, polarity and times of every pixel that a dot passes, against the roots of its quadratics."""
    state = on_gel(QUIET, reference=0.05)
    begin, velocity = np.array([-30.3, 22.6]), np.array([2.3, 0.4])
    result = play(state, line(begin, velocity), 75)
    targets = 0.05 - 0.2 * np.arange(1, 9)
    at_radius = radii(QUIET, targets)
    speed2 = velocity @ velocity
    wrong = total = 0
    order = np.lexsort((result.t, result.x, result.y))
    t, x, y, p = (column[order] for column in result)
    bounds = np.searchsorted(y.astype(int) * FRAME[0] + x, np.arange(FRAME[0] * FRAME[1] + 1))
    for row in range(FRAME[1]):
        for column in range(FRAME[0]):
            offset = np.array([column, row]) - begin
            approach = offset @ velocity
            discriminant = approach**2 - speed2 * (offset @ offset - at_radius**2)
            dark = discriminant > 0.0
            root = np.sqrt(discriminant[dark])
            enter, leave = (approach - root) / speed2, ((approach + root) / speed2)[::-1]
            # The way back to the first target, 0.05, is never completed: one event fewer than thresholds passed
            # downwards, each at the level of the one before.
            expected = np.concatenate([enter, leave[1:]]) * 1000.0
            here = slice(bounds[row * FRAME[0] + column], bounds[row * FRAME[0] + column + 1])
            total += expected.size
            if t[here].size != expected.size:
                wrong += max(expected.size, t[here].size)
                continue
            assert p[here].tolist() == [0] * enter.size + [1] * max(0, enter.size - 1)
            wrong += int(np.count_nonzero(np.abs(t[here] + 0.5 - expected) > 0.6))
    assert total > 20_000
    # Grazed pixels, and levels in the tails that the table cuts off at 0.001 log units.
    assert wrong <= 1e-3 * total


def shaken(amplitude: float, frequency_hz: float, xy: Any = ((40.3, 40.6),)) -> Path:
    """A tone, in a direction that is not an axis."""
    return lambda t_ms: (
        np.atleast_2d(xy) + np.array([0.8, 0.6]) * amplitude * math.sin(2e-3 * math.pi * frequency_hz * t_ms)
    )


MOTIONS: dict[str, tuple[Path, int]] = {
    "creep": (line([40.3, 40.6], (0.016, 0.012)), 40),
    "fast": (line([[20.2, 40.7]], (3.1, 0.3)), 12),
    "tone": (shaken(0.5, 200.0), 10),
    "crowd": (crowd, 10),
}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.slow
def test_against_the_reference(motion: str) -> None:
    """Assert the count within 0.1 % and F1 at 10 us of 0.99 against every pixel sampled at 100 kHz, with mismatch."""
    path, slices = MOTIONS[motion]
    state = start(path(0))
    sampled = np.array([path(step / 100) for step in range(slices * 100 + 1)])
    truth = reference_events(state.shared, sampled, 10.0)
    result = fine(play(state, path, slices, pieces=100))
    agreement = match(result, truth, 10.0)
    assert truth.t.size > 200
    assert abs(agreement.count_share) <= max(1e-3, 1.01 / truth.t.size)  # or by a single event
    assert agreement.f1 >= 0.99


def test_error_falls_with_the_square_of_substeps() -> None:
    """Assert a slope of at most -1.8 of log time error over log sub-steps on a smooth path, in median and p95."""
    xy = np.array([[30.3, 40.6]])

    def turning(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        turn = 2.0 * np.pi * times_ms / 8.0
        return 5.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)

    load = Workload("circle", QUIET, xy, turning, 8)
    state = camera.start(QUIET, load.path_px(1)[0], None, None, np.random.default_rng(0))
    truth = reference_events(state, load.path_px(400), 2.5)
    substeps = np.array([1, 2, 4, 8])  # more is finer than the whole microseconds of events
    errors = [match(camera_cost.play_ideal(state, load, n)[0], truth).error_us for n in substeps.tolist()]
    for name, of in (("median", np.median), ("p95", lambda e: np.percentile(e, 95))):
        slope = np.polyfit(np.log(substeps), np.log([of(error) for error in errors]), 1)[0]
        assert -2.3 <= slope <= -1.8, name


def test_camera_cost_rows() -> None:
    """Assert a flat row of plain numbers for every choice of sub-steps and for the scanning camera."""
    load = Workload("tone", QUIET, np.array([[40.3, 40.6]]), lambda t: 0.3 * np.sin(1.2 * t)[:, None] * [0.8, 0.6], 5)
    rows = list(camera_cost.camera_rows(0, [load]))
    assert len(rows) == len(camera_cost.SUBSTEPS) + 1
    for row in rows:
        assert all(type(value) in (float, str) for value in row.values())
        assert all(math.isfinite(value) for value in row.values() if isinstance(value, float))
    assert rows[-1]["setting"].startswith("dvxplorer")
    assert rows[-1]["f1_10us"] < 0.1
    assert rows[5]["f1_10us"] > 0.99
    assert rows[5]["error_us_p95"] < rows[0]["error_us_p95"]


def test_matcher() -> None:
    """Assert that events pair once, of one pixel and polarity only, within the tolerance."""

    def events(*rows: tuple[float, int, int, int]) -> FineEvents:
        t, x, y, p = zip(*rows, strict=True)
        return FineEvents(np.array(t), np.array(x), np.array(y), np.array(p))

    truth = events((0.0, 1, 1, 1), (100.0, 1, 1, 1), (100.0, 1, 1, 0), (100.0, 2, 1, 1))
    assert match(truth, truth).f1 == 1.0
    result = events((9.0, 1, 1, 1), (9.5, 1, 1, 1), (111.0, 1, 1, 0), (100.0, 1, 2, 1))
    agreement = match(result, truth)
    assert agreement.f1 == 2 * 1 / 8
    assert agreement.count_share == 0.0
    assert sorted(agreement.error_us.tolist()) == [9.0, 11.0, 90.5]


LATCHED: dict[str, tuple[Callable[[float], float], int, float, float]] = {
    # Displacement in px over time in ms, pieces a ms, share and its tolerance. The known shares are for references that
    # start at the level. Pixels of bare gel or ink then end each passage at the limit itself, which a scan of the table
    # reaches and an edge never does; where dots come and go, at 100 Hz, that is 3 % of all events, so that case starts
    # from random phases.
    "creep": (lambda t: 0.05 * t, 1, 0.99, 0.01),
    "slip": (lambda t: 0.3 * t + 0.02 * t * t, 8, 0.90, 0.01),
    "100 Hz, 4 px": (lambda t: 4.0 * math.sin(0.2 * math.pi * t), 32, 0.82, 0.015),
    "498 Hz, 0.6 px": (lambda t: 0.6 * math.sin(0.996 * math.pi * t), 32, 0.72, 0.02),
    "498 Hz, 1.5 px": (lambda t: 1.5 * math.sin(0.996 * math.pi * t), 32, 0.72, 0.02),
}


@pytest.mark.parametrize("motion", LATCHED)
def test_scans_lose_a_known_share(motion: str) -> None:
    """Assert the share of the ideal events that 5 scans a ms see: 0.99 creep, 0.90 slip, 0.82 at 100, 0.72 at 498 Hz.

    63 dots, C 0.25, mismatch 0.03, 20 ms. A scan each 0.2 ms of the true path is one slice of
    a camera with one scan a slice.
    """
    travel, pieces, share, tolerance = LATCHED[motion]
    model = CameraModel(noise_rate_hz=0.0, hot_pixels=0, threshold=0.25, scans_per_ms=1)
    xy = np.array([[70 + 62.5 * column, 45 + 62.5 * row] for row in range(7) for column in range(9)])
    direction = np.stack([np.full(63, math.cos(0.3)), math.sin(0.3) * (1 + 0.05 * (xy[:, 0] / 300 - 1))], axis=1)

    def path(t_ms: float) -> NDArray[np.float64]:
        moved: NDArray[np.float64] = xy + travel(t_ms) * direction
        return moved

    shared = camera.start(model, path(0), None, None, np.random.default_rng(1))
    if motion != "100 Hz, 4 px":
        shared.reference[:] = optics.gel_level(model.frame_px, path(0), shared.profile)
    scanning = copy.deepcopy(shared)
    every = play(ideal.from_references(shared), path, 20, pieces=pieces).size
    rng = np.random.default_rng(0)
    seen = sum(
        camera.step(scanning, SliceMotion(path(0.2 * k), path(0.2 * (k + 1)), STILL, STILL, 0.0), 1000 * k, rng).size
        for k in range(101)
    )
    assert seen / every == pytest.approx(share, abs=tolerance)


def test_same_sensor_as_the_scanning_camera() -> None:
    """Assert that equal generators give both cameras the same thresholds, phases, hot pixels and noise."""
    noisy = dataclasses.replace(QUIET, noise_rate_hz=50.0, hot_pixels=5)
    one = start([[40.0, 40.0]], noisy)
    other = camera.start(noisy, [[40.0, 40.0]], None, None, np.random.default_rng(0))
    for name in ("reference", "threshold", "hot_pixel", "hot_cumulative_hz"):
        np.testing.assert_array_equal(getattr(one.shared, name), getattr(other, name))
    still = line([40.0, 40.0], (0.0, 0.0))
    rng = np.random.default_rng(1)
    scanned = [camera.step(other, SliceMotion(still(k), still(k), STILL, STILL, 0.0), 1000 * k, rng) for k in range(20)]
    noise = play(one, still, 20)
    assert noise.size > 100
    assert columns_equal(noise, concatenate(scanned))


def test_several_thresholds_in_a_slice() -> None:
    """Assert several threshold steps of a pixel in one slice, and that its end is seen."""
    state = start([[40.0, 40.0]])
    events = ideal.step(
        state, SliceMotion([[40.0, 40.0]], [[48.0, 44.0]], STILL, STILL, 0.0), 0, np.random.default_rng(0)
    )
    assert np.unique(events.y.astype(int) * 100 + events.x, return_counts=True)[1].max() >= 7
    np.testing.assert_array_equal(state.shared.seen_dot_xy_px, [[48.0, 44.0]])


def test_jump_between_slices() -> None:
    """Assert that what jumps between slices fires at once, a step for every threshold between the two pictures."""
    state = start([[30.0, 40.0]])
    reference, threshold = state.shared.reference.copy(), state.shared.threshold
    result = ideal.step(
        state, SliceMotion([[45.5, 40.0]], [[45.5, 40.0]], STILL, STILL, 0.0), 0, np.random.default_rng(0)
    )
    change = optics.gel_level(FRAME, np.array([[45.5, 40.0]]), state.shared.profile) - reference
    expected = np.floor(np.abs(change) / threshold).astype(int)
    counts = np.zeros(FRAME[::-1], int)
    np.add.at(counts, (result.y, result.x), 1)
    assert (result.t == 0).all()
    assert np.count_nonzero(counts != expected) <= 2  # a change of whole thresholds but for rounding
    assert expected.sum() > 2000


def test_bare_gel_is_never_quite_reached() -> None:
    """Assert that a dot that passes pixels at the level of bare gel ends one threshold short of it everywhere."""
    state = on_gel(QUIET, reference=0.0)
    result = play(state, line([-30.3, 40.2], (5.0, 0.3)), 40)
    darker, brighter = np.count_nonzero(result.p == 0), np.count_nonzero(result.p == 1)
    passed = state.shared.reference[state.shared.reference != 0.0]
    assert passed.size > 2000
    np.testing.assert_allclose(passed, -0.2, atol=1e-6)
    assert darker - brighter == passed.size


def window_truth(state: IdealState, velocity: NDArray[np.float64], slices: int, steps_per_ms: int) -> FineEvents:
    """Every pixel of the strip sampled finely, linear between samples."""
    x0, y0, x1, y1 = STRIP
    level = np.empty((y1 - y0, x1 - x0), np.float32)
    optics.sample_texture(TEXTURE, x0, y0, 0.0, 0.0, 1.0, level)
    before = level.astype(float)
    reference = state.shared.window_reference + before
    threshold = state.shared.window_threshold
    rows = []
    for step in range(1, slices * steps_per_ms + 1):
        at = velocity * step / steps_per_ms
        optics.sample_texture(TEXTURE, x0, y0, at[0], at[1], 1.0, level)
        for y, x in np.argwhere(np.abs(level - reference) >= threshold).tolist():
            while abs(level[y, x] - reference[y, x]) >= threshold[y, x]:
                sign = 1 if level[y, x] > reference[y, x] else -1
                reference[y, x] += sign * threshold[y, x]
                part = (reference[y, x] - before[y, x]) / (level[y, x] - before[y, x])
                rows.append(((step - 1 + part) / steps_per_ms * 1000.0, x + x0, y + y0, int(sign > 0)))
        before = level.astype(float)
    return FineEvents(*(np.array(column) for column in zip(*rows, strict=True)))


@pytest.mark.parametrize("velocity", [(1.3, -0.7), (-0.4, 0.0), (4.1, 2.2)])
def test_window_against_fine_samples(velocity: tuple[float, float]) -> None:
    """Assert the events of a sliding texture sampled 500 times a millisecond: all of them, within 2 us."""
    state = before_window(ideal)
    truth = window_truth(state, np.array(velocity), 10, 500)
    agreement = match(fine(concatenate(slide(ideal, state, velocity, 10))), truth, 2.0)
    assert truth.t.size > 100
    assert agreement.count_share == pytest.approx(0.0, abs=2e-3)
    assert agreement.f1 >= 0.99


def test_contrast_of_the_window() -> None:
    """Assert that an object that fades fires at the start of the slice, and out of sight slides unseen."""
    state, rng = before_window(ideal), np.random.default_rng(1)
    still = [[30.0, 30.0]]
    sizes = []
    for k, contrast in enumerate((1.0, 0.2, 0.2, 0.0, 0.0, 1.0)):
        events = ideal.step(state, SliceMotion(still, still, (1.0 * k, 0.0), (1.0 * k, 0.0), contrast), 1000 * k, rng)
        assert (events.t == 1000 * k).all()
        sizes.append(events.size)
    assert sizes[0] == sizes[4] == 0
    assert min(sizes[1], sizes[5]) > 100


@pytest.mark.parametrize("refractory_us", [150.0, 2500.0])
@pytest.mark.slow
def test_refractory_time(refractory_us: float) -> None:
    """Assert that a pixel is blind after an event, then starts from the level it finds, across slices and at rest."""

    def path(t_ms: float) -> NDArray[np.float64]:
        return np.array([[40.2 + 2.0 * min(max(t_ms - 1.0, 0.0), 6.0), 40.4]])

    state = start(path(0), dataclasses.replace(QUIET, refractory_us=refractory_us))
    reference = state.shared.reference.astype(float)
    threshold = state.shared.threshold.astype(float)
    events = play(state, path, 12)
    result = fine(events)
    y, x = np.mgrid[: FRAME[1], : FRAME[0]]
    release = np.full(reference.shape, -np.inf)
    rows = []
    for step in range(12 * 1000):  # every microsecond
        dot = path((step + 1) / 1000)[0]
        position = (
            np.hypot(x - dot[0], y - dot[1]) - state.shared.profile.inner_px
        ) * state.shared.profile.steps_per_px
        level = np.interp(position, np.arange(optics.PROFILE_STEPS + 1), state.shared.profile.level[:-1])
        waking = (release > step) & (release <= step + 1)
        reference[waking] = level[waking]
        fires = (np.abs(level - reference) >= threshold) & (release <= step)
        for row, column in np.argwhere(fires).tolist():
            rows.append((step + 0.5, column, row, int(level[row, column] > reference[row, column])))
        release[fires] = step + 0.5 + refractory_us
    expected = FineEvents(*(np.array(column) for column in zip(*rows, strict=True)))
    # A pixel's events hang together, and each adds up to a microsecond of this simulation's step.
    agreement = match(result, expected, 12.0)
    assert expected.t.size > 500
    assert agreement.count_share == pytest.approx(0.0, abs=5e-3)
    assert agreement.f1 >= 0.98
    assert waits_us(events).min() >= refractory_us - 1.0


def test_a_million_events() -> None:
    """Assert that a slice of more than 10^6 events is capped there, and the rest counted."""
    model = CameraModel(noise_rate_hz=0.0, hot_pixels=0, threshold=0.02, mismatch=0.0, dot_radius_px=60.0)
    state = start([[-80.0, 240.0]], model)
    events = ideal.step(
        state, SliceMotion([[-80.0, 240.0]], [[150.0, 240.0]], STILL, STILL, 0.0), 0, np.random.default_rng(0)
    )
    assert events.size == 1_000_000
    assert state.dropped > 1_000_000
    assert (np.diff(events.t) >= 0).all()
    assert np.isfinite(state.shared.reference).all()


def test_jump_of_50_px() -> None:
    """Assert that a dot that crosses 50 px in a slice sweeps every pixel between: darker, then brighter again."""
    path = line([25.3, 40.2], (50.0, 0.0))
    state = start(path(0))
    truth = reference_events(state.shared, np.array([path(step / 5000) for step in range(5001)]), 0.2)
    agreement = match(fine(play(state, path, 1)), truth, 2.0)
    assert truth.t.size > 15_000
    assert abs(agreement.count_share) <= 1e-3
    assert agreement.f1 >= 0.99


def test_far_leaps_and_fast_objects_end() -> None:
    """Assert that dots and objects that move by 10^6 px in a slice are followed to their end, references finite."""
    state = start([[40.0, 40.0]], window=STRIP, texture=TEXTURE)
    rng = np.random.default_rng(0)
    far = [[9e5, -9e5]]
    ideal.step(state, SliceMotion([[40.0, 40.0]], far, STILL, (1e6, -1e6), 1.0), 0, rng)
    ideal.step(state, SliceMotion(far, [[40.0, 40.0]], (1e6, -1e6), STILL, 1.0), 1000, rng)
    level = optics.gel_level(FRAME, np.array([[40.0, 40.0]]), state.shared.profile)
    outside = np.isfinite(state.shared.threshold)
    assert (np.abs(level - state.shared.reference) <= state.shared.threshold * (1 + 1e-4))[outside].all()
    assert np.isfinite(state.shared.window_reference).all()


def test_tone_of_498_hz_in_1_ms_steps() -> None:
    """Assert that a tone at two samples a period is followed sample by sample: valid events, fewer than there are."""
    path = shaken(0.6, 498.0)
    coarse, finer = (play(start(path(0)), path, 40, pieces=pieces) for pieces in (1, 64))
    assert 0 < coarse.size < 0.5 * finer.size
    assert (np.diff(coarse.t) >= 0).all()


def test_goes_on_only_from_known_references() -> None:
    """Assert that references of pixels that are still refractory are refused."""
    state = start([[40.0, 40.0]], dataclasses.replace(QUIET, refractory_us=5000.0))
    play(state, line([40.0, 40.0], (0.5, 0.0)), 2)
    with pytest.raises(ValueError, match="reference"):
        ideal.from_references(state.shared)


@pytest.mark.parametrize("line_step_px", [0.0, -1.0, math.nan, 20.0])
def test_start_refuses(line_step_px: float) -> None:
    """Assert that a sub-step of lines out of range is refused."""
    with pytest.raises(ValueError, match="line_step_px"):
        ideal.start(QUIET, [], None, None, np.random.default_rng(0), line_step_px=line_step_px)


def test_squared_radius_inverts_the_profile() -> None:
    """Assert that the radius of a level has that level, and that ink, gel and beyond have none."""
    for radius_px, sigma_px in ((15.0, 1.2), (15.0, 0.01), (0.5, 2.0)):
        profile = optics.dot_profile(radius_px, sigma_px)
        table = (profile.inner_px, profile.steps_per_px, profile.level)
        index = optics.level_index(profile)
        for target in np.random.default_rng(0).uniform(-1.60998, -2e-5, 2000).tolist():
            radius2 = optics.squared_radius(target, *table, index)
            if radius2 >= 0.0:
                assert optics.level_at(math.sqrt(radius2), *table) == pytest.approx(target, abs=1e-9)
            else:
                assert optics.level_at(0.0, *table) > target
        for never, targets in ((-1.0, (-1.62, -1.61, -1.61 + 1e-7)), (math.inf, (1e-9, 0.0, -1e-7))):
            assert all(optics.squared_radius(target, *table, index) == never for target in targets)
        assert math.isnan(optics.squared_radius(math.nan, *table, index))


def test_dots_move_on_after_leak() -> None:
    """Assert that dots whose references have leaked still fire as every pixel's reference and threshold demand."""
    state = start([[40.0, 40.0]], dataclasses.replace(QUIET, leak_hz=5.0))
    play(state, line([40.0, 40.0], (0.0, 0.0)), 50)
    state.shared.model = QUIET
    plain = ideal.from_references(copy.deepcopy(state.shared))
    path = line([40.0, 40.0], (0.7, 0.2))
    assert columns_equal(play(state, path, 10), play(plain, path, 10))
