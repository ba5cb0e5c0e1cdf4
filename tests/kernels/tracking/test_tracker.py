"""The dot tracker's descent against closed forms, a slow reference of the paper's formulas, invariances, extremes.

What only the preset `stable` does is in test_fit.py.
"""

import copy
import itertools
import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from evetac_cli.kernels.tracking import buckets, presets, tracker
from evetac_cli.kernels.tracking.presets import PRESETS, TrackerConstants
from evetac_cli.kernels.tracking.tracker import STATE, TrackerState

PAPER = PRESETS["paper"]
DESCENTS = [name for name, constants in PRESETS.items() if not constants.fit and constants.slices_per_step == 1]
ROWS, COLUMNS, PITCH_PX = 7, 9, 62.0

Column = NDArray[np.uint16]


def grid(rows: int = ROWS, columns: int = COLUMNS) -> NDArray[np.float64]:
    """Dots (rows * columns, 2), row by row, on whole pixels."""
    y, x = np.mgrid[:rows, :columns] * PITCH_PX + 50.0
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def columns(xy_px: NDArray[np.float64] | Sequence[tuple[float, float]]) -> tuple[Column, Column]:
    """Events at places given as (events, 2), to the nearest pixel."""
    pixels = np.round(np.asarray(xy_px, np.float64).reshape(-1, 2)).astype(np.uint16)
    return pixels[:, 0].copy(), pixels[:, 1].copy()


def on_edge(centres_px: NDArray[np.float64], times: int = 3) -> tuple[Column, Column]:
    """Events 15 px right, left, below and above every centre: they pull nowhere if the centre is a whole pixel."""
    cross = np.array([(15, 0), (-15, 0), (0, 15), (0, -15)] * times)
    return columns((centres_px[:, None] + cross).reshape(-1, 2))


def random_events(rng: np.random.Generator, centres_px: NDArray[np.float64], count: int) -> tuple[Column, Column]:
    """Events around the dots' edges, a third anywhere, and some outside the frame."""
    dot = rng.integers(0, len(centres_px), count)
    angle = rng.uniform(0, 2 * np.pi, count)
    radius_px = 15 + 3 * rng.standard_normal(count)
    places = centres_px[dot] + radius_px[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    anywhere = rng.random(count) < 1 / 3
    places[anywhere] = rng.uniform(0, (700, 500), (anywhere.sum(), 2))
    return columns(np.abs(places))


def step(state: TrackerState, x: Column, y: Column) -> None:
    """A step with polarities that any preset takes: even columns brighter."""
    tracker.step(state, x, y, (x % 2).astype(np.uint8))


def single(offset_px: tuple[float, float] = (0.0, 0.0), constants: TrackerConstants = PAPER) -> TrackerState:
    """A tracker of one dot that takes itself to be at (300, 200) + offset."""
    return tracker.start(np.array([[300.0, 200.0]]) + offset_px, constants)


def exact_step(
    centres: list[tuple[float, float]],
    rest: list[tuple[float, float]],
    neighbours: list[list[int]],
    constants: TrackerConstants,
    events: list[tuple[int, int]],
) -> list[tuple[float, float]]:
    """The paper's step in plain Python numbers, sums as integers of 2**-36: centres after it, to the last bit."""
    one = 2.0**36

    def clip(value: float, bound: float) -> float:
        return min(max(value, -bound), bound)

    result = []
    for i, (cx, cy) in enumerate(centres):
        pull_x = pull_y = ring_events = 0
        for x, y in events:
            dx, dy = x - cx, y - cy
            square = dx * dx + dy * dy
            if x < 640 and y < 480 and constants.ring_inner_px**2 < square < constants.ring_outer_px**2:
                stretch = (1.0 - constants.radius_px / math.sqrt(square)) * one
                pull_x, pull_y, ring_events = pull_x + int(stretch * dx), pull_y + int(stretch * dy), ring_events + 1
        if ring_events <= constants.min_events:
            result.append((cx, cy))
            continue
        elastic_x = elastic_y = 0.0
        for j in neighbours[i]:
            dx, dy = cx - centres[j][0], cy - centres[j][1]
            (ax, ay), (bx, by) = rest[i], rest[j]
            stretch = 4.0 * (dx * dx + dy * dy - ((ax - bx) * (ax - bx) + (ay - by) * (ay - by)))
            elastic_x, elastic_y = elastic_x + stretch * dx, elastic_y + stretch * dy
        scale, weight = 8 / max(len(neighbours[i]), 1), constants.regulariser_weight
        sign = 2.0 if constants.ascend else -2.0
        shift_x = -constants.step_size * (
            clip(sign / one * pull_x, constants.gradient_clip) + weight * (scale * elastic_x)
        )
        shift_y = -constants.step_size * (
            clip(sign / one * pull_y, constants.gradient_clip) + weight * (scale * elastic_y)
        )
        new_x = min(max(cx + clip(shift_x, constants.radius_px), 0.0), 639.0)
        new_y = min(max(cy + clip(shift_y, constants.radius_px), 0.0), 479.0)
        result.append((new_x, new_y))
    return result


class Reference:
    """The paper's equations in plain loops, events one by one; knows the neighbours from rows and columns."""

    def __init__(self, rows: int, columns: int, rest_px: NDArray[np.float64], constants: TrackerConstants) -> None:
        self.constants = constants
        self.rest = rest_px.copy()
        self.centres = rest_px.copy()
        self.gradient = np.zeros_like(rest_px)
        self.ring_events = np.zeros(len(rest_px), np.int64)
        self.neighbours: list[list[int]] = []
        for row in range(rows):
            for column in range(columns):
                near = [(row + dr, column + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
                inside = [(r, c) for r, c in near if 0 <= r < rows and 0 <= c < columns]
                self.neighbours.append([r * columns + c for r, c in inside])

    def distance_term(self, i: int, centre: NDArray[np.float64]) -> float:
        """(8 / n) sum over the neighbours of (|c_i - c_j|^2 - |c_i0 - c_j0|^2)^2."""
        near = self.neighbours[i]
        now = np.sum((centre - self.centres[near]) ** 2, axis=1)
        rest = np.sum((self.rest[i] - self.rest[near]) ** 2, axis=1)
        return float(8 / len(near) * np.sum((now - rest) ** 2))

    def step(self, x: Column, y: Column) -> NDArray[np.int64]:
        """Move the dots; returns the events per dot."""
        constants = self.constants
        events = np.zeros(len(self.centres), np.int64)
        self.gradient[:] = 0
        self.ring_events[:] = 0
        for event in np.stack([x, y], axis=1).astype(float):
            if event[0] >= 640 or event[1] >= 480:
                continue
            away = event - self.centres
            norm = np.linalg.norm(away, axis=1)
            events += norm < 20
            ring = (norm > constants.ring_inner_px) & (norm < constants.ring_outer_px)
            self.gradient[ring] += -2 * (away - constants.radius_px * away / norm[:, None])[ring]
            self.ring_events += ring
        moved = self.centres.copy()
        for i in np.flatnonzero(self.ring_events > constants.min_events):
            regulariser = np.zeros(2)
            for j in self.neighbours[i]:
                apart = self.centres[i] - self.centres[j]
                rest = self.rest[i] - self.rest[j]
                regulariser += 8 / len(self.neighbours[i]) * 4 * apart * (apart @ apart - rest @ rest)
            data = np.clip(-self.gradient[i] if constants.ascend else self.gradient[i], -400, 400)
            moved[i] -= 0.003 * (data + constants.regulariser_weight * regulariser)
        self.centres = np.clip(moved, 0, (639, 479))
        return events


@pytest.mark.parametrize(("offset_px", "slope"), [((1.0, 0.0), 4 / 3), ((0.0, 1.0), 2 / 3)])
def test_one_step_corrects_an_offset_by_the_theoretical_slope(offset_px: tuple[float, float], slope: float) -> None:
    """Assert that N edge events of a dot moving along x take back step_size * slope * N of an offset."""
    rng = np.random.default_rng(1)
    constants = replace(PAPER, step_size=1e-6)  # so that the offset stays what it is
    axis = int(np.argmax(offset_px))
    corrected = ring_events = 0.0
    for _ in range(400):
        true_px = np.array([300.0, 200.0]) + rng.random(2)  # every position of the edge against the pixels
        sine = rng.uniform(-1, 1, 100)  # events of a moving edge: density proportional to |cos|
        side = rng.choice([-1.0, 1.0], 100)
        events = true_px + 15 * np.stack([side * np.sqrt(1 - sine**2), sine], axis=1)
        state = tracker.start((true_px + offset_px)[None], constants)
        step(state, *columns(events))
        corrected += (true_px + offset_px - state.dot_xy_px[0])[axis]
        ring_events += state.events_per_dot[0]  # none is nearer than 10 px
    assert corrected / (constants.step_size * ring_events) == pytest.approx(slope, rel=0.03)


@pytest.mark.parametrize("preset", DESCENTS)
def test_agrees_with_plain_reference(preset: str) -> None:
    """Assert that positions equal the formulas in plain loops to 1e-9 px, whatever the sign; event counts exactly."""
    rng = np.random.default_rng(2)
    rest = grid(3, 3) + rng.uniform(-3, 3, (9, 2))
    state = tracker.start(rest, PRESETS[preset])
    reference = Reference(3, 3, rest, PRESETS[preset])
    for k in range(80):
        x, y = random_events(rng, rest + 0.1 * k, 300)
        step(state, x, y)
        events = reference.step(x, y)
        assert np.abs(state.dot_xy_px - reference.centres).max() < 1e-9
        assert state.events_per_dot.dtype == np.int32
        assert (state.events_per_dot == events).all()
    if not PRESETS[preset].ascend:  # which these dots are too large for
        assert (np.abs(state.dot_xy_px - rest).max(axis=0) > 4).all()  # far enough to fill the buckets anew


def test_a_step_for_five_slices() -> None:
    """Assert that `official-5ms` moves every fifth slice, and then as one slice with all of their events would."""
    rng = np.random.default_rng(5)
    rest = grid(3, 3)
    constants = replace(PRESETS["official-5ms"], hot_pixel_events=0)  # which are counted slice by slice
    gathers, at_once = (tracker.start(rest, one) for one in (constants, replace(constants, slices_per_step=1)))
    for k in range(12):
        slices = [random_events(rng, rest + 0.1 * k, 100) for _ in range(5)]
        for number, (x, y) in enumerate(slices):
            before_px = gathers.dot_xy_px.copy()
            step(gathers, x, y)
            assert (gathers.dot_xy_px == before_px).all() == (number < 4)
        step(at_once, *(np.concatenate(column) for column in zip(*slices, strict=True)))
        np.testing.assert_array_equal(gathers.dot_xy_px, at_once.dot_xy_px)
    assert (gathers.dot_xy_px != rest).any(axis=1).all()


def test_regulariser_is_the_gradient_of_its_energy() -> None:
    """Assert that dots without any data pull move down the finite-difference gradient of the distance term."""
    rng = np.random.default_rng(3)
    rest = grid()
    state = tracker.start(rest, PAPER)
    reference = Reference(ROWS, COLUMNS, rest, PAPER)
    reference.centres = rest + rng.integers(-3, 4, rest.shape)
    state.dot_xy_px[:] = reference.centres
    step(state, *on_edge(reference.centres))
    h = 0.25
    for i, centre in enumerate(reference.centres):
        gradient = np.zeros(2)
        for axis in range(2):
            unit = np.eye(2)[axis]
            e = {k: reference.distance_term(i, centre + k * h * unit) for k in (-2, -1, 1, 2)}
            gradient[axis] = (8 * (e[1] - e[-1]) - (e[2] - e[-2])) / (12 * h)  # exact for this quartic
        expected = centre - PAPER.step_size * PAPER.regulariser_weight * gradient
        assert state.dot_xy_px[i] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("preset", list(PRESETS))
def test_order_of_events_does_not_matter(preset: str) -> None:
    """Assert that the order of a slice's events changes no bit of the positions."""
    rng = np.random.default_rng(5)
    states = [tracker.start(grid(), PRESETS[preset]) for _ in range(3)]
    for _ in range(20):
        x, y = random_events(rng, grid(), 3000)
        forward = np.arange(len(x))
        for state, order in zip(states, (forward, forward[::-1], rng.permutation(forward)), strict=True):
            step(state, x[order], y[order])
    assert states[0].dot_xy_px.tobytes() == states[1].dot_xy_px.tobytes() == states[2].dot_xy_px.tobytes()


def test_order_of_dots_does_not_matter() -> None:
    """Assert that each dot's track does not depend on its place in the list of dots."""
    rng = np.random.default_rng(6)
    order = rng.permutation(ROWS * COLUMNS)
    state, other = tracker.start(grid(), PAPER), tracker.start(grid()[order], PAPER)
    for _ in range(10):
        x, y = random_events(rng, grid() + 1, 3000)
        step(state, x, y)
        step(other, x, y)
    assert np.abs(state.dot_xy_px[order] - other.dot_xy_px).max() < 1e-9


@pytest.mark.parametrize(("preset", "least"), [("paper", 11), ("paper-5-events", 5)])
def test_gate_opens_at_so_many_ring_events(preset: str, least: int) -> None:
    """Assert that a dot moves if and only if enough events in its ring pull it; events inside do not count."""
    for ring, inside in ((least - 1, 0), (least, 0), (least - 1, 5)):
        state = single(constants=PRESETS[preset])
        step(state, *columns([(318, 200)] * ring + [(302, 200)] * inside))
        assert state.events_per_dot.tolist() == [ring + inside]
        expected_x = 300 + 0.003 * 2 * 3 * ring if ring == least else 300
        assert state.dot_xy_px[0] == pytest.approx([expected_x, 200], abs=1e-10)


def test_dots_stay_in_the_frame() -> None:
    """Assert that a dot pushed out of the frame at any of its four corners stops at the last pixel."""
    corners = np.array([[0, 0], [639, 0], [0, 479], [639, 479]])
    inwards = np.sign(np.array([320, 240]) - corners)
    state = tracker.start(corners + 3.0 * inwards, replace(PRESETS["unregularised"], step_size=0.13))
    # Events 12 px off, inside the dot's edge, push it away from them.
    events = corners[:, None] + 3 * inwards[:, None] + inwards[:, None] * np.array([(12, 0), (0, 12)] * 6)
    step(state, *columns(events.reshape(-1, 2)))
    assert state.dot_xy_px.tolist() == corners.tolist()


def test_missing_dot_takes_no_part() -> None:
    """Assert that a NaN dot stays NaN, has no events and no neighbours, and that its neighbours do without it."""
    rest = grid()
    missing = 3 * COLUMNS + 4
    rest[missing] = np.nan
    state = tracker.start(rest, PAPER)
    rng = np.random.default_rng(7)
    for _ in range(10):
        step(state, *random_events(rng, grid() + 1, 5000))
    assert np.isnan(state.dot_xy_px[missing]).all()
    assert np.isfinite(np.delete(state.dot_xy_px, missing, axis=0)).all()
    assert state.events_per_dot[missing] == 0
    assert not state.lost.any()
    counts = (state.neighbours >= 0).sum(axis=1)
    assert counts[missing] == 0
    assert counts[[missing - 1, missing + 1, missing - COLUMNS, missing + COLUMNS + 1]].tolist() == [7, 7, 7, 7]
    assert missing not in state.neighbours
    assert (np.delete(state.events_per_dot, missing) > 0).all()


@pytest.mark.parametrize("preset", ["paper", "unregularised"])
def test_follows_moving_dots(preset: str) -> None:
    """Assert that dots on a circle of 3.2 px are followed with less than a quarter of the error of standing still."""
    rng = np.random.default_rng(11)
    state = tracker.start(grid(), PRESETS[preset])
    slices = 400
    place = grid()
    errors, standing = [], []
    for k in range(slices):
        direction = 2 * np.pi * k / slices
        place = place + 0.05 * np.array([np.cos(direction), np.sin(direction)])
        dots = np.repeat(place, rng.poisson(20, len(place)), axis=0)
        angle = np.arcsin(rng.uniform(-1, 1, len(dots))) + np.pi * rng.integers(0, 2, len(dots)) + direction
        radius_px = 15 + 0.8 * rng.standard_normal(len(dots))
        step(state, *columns(dots + radius_px[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)))
        errors.append(state.dot_xy_px - place)
        standing.append(grid() - place)
    assert np.sqrt(np.mean(np.square(errors))) < 0.25 * np.sqrt(np.mean(np.square(standing)))
    assert not state.lost.any()


@pytest.mark.parametrize("preset", list(PRESETS))
def test_bounded_under_floods(preset: str) -> None:
    """Assert that 1e6 events a slice, then 1e4 on one dot, leave all dots finite, in the frame and slow."""
    rng = np.random.default_rng(13)
    state = tracker.start(grid(), PRESETS[preset])
    for _ in range(5):
        before = state.dot_xy_px.copy()
        flood = rng.random((1_000_000, 2)) ** (2, 0.5) * (639, 479)
        step(state, *columns(flood))
        assert np.abs(state.dot_xy_px - before).max() <= PAPER.radius_px
        assert state.events_per_dot.sum() > 100_000
    for _ in range(200):
        step(state, *columns(state.dot_xy_px[[0]] + rng.uniform(-19, 19, (10_000, 2))))
    assert np.isfinite(state.dot_xy_px).all()
    assert ((state.dot_xy_px >= 0) & (state.dot_xy_px <= (639, 479))).all()


@settings(max_examples=60, deadline=None)
@given(
    events=arrays(np.uint16, st.tuples(st.integers(0, 60), st.just(2))),
    repeat=st.integers(1, 500),
    preset=st.sampled_from(list(PRESETS)),
    weight=st.sampled_from([0.0, 7.5e-5, 1.0, 1e300]),
    step_size=st.sampled_from([0.003, 1.0, 1e300]),
    clip=st.sampled_from([400.0, 1e300]),
)
def test_any_events_keep_the_state_finite(
    events: NDArray[np.uint16], repeat: int, preset: str, weight: float, step_size: float, clip: float
) -> None:
    """Assert that no events and no constants make a position leave the frame or stop being a number."""
    wild = {"regulariser_weight": weight, "step_size": step_size, "gradient_clip": clip}
    rest = grid(3, 3)
    state = tracker.start(rest, PRESETS[preset])
    for name, value in wild.items():  # which `start` would refuse: nothing may go wrong in spite of that
        state.record[name] = value
    x = np.tile(events[:, 0] % np.uint16(700), repeat)
    y = np.tile(events[:, 1] % np.uint16(500), repeat)
    for _ in range(4):
        step(state, *on_edge(np.round(rest + 2)))
        step(state, x, y)
        step(state, np.tile(events[:, 0], 3), np.tile(events[:, 1], 3))
        assert np.isfinite(state.dot_xy_px).all()
        assert ((state.dot_xy_px >= 0) & (state.dot_xy_px <= (639, 479))).all()
        assert (state.events_per_dot >= 0).all()


@pytest.mark.parametrize("preset", presets.PRESETS)
def test_fold_is_step_after_step(preset: str) -> None:
    """Assert that many slices at once, also empty ones, leave the same state and tracks as one after the other."""
    rng = np.random.default_rng(3)
    starts = np.concatenate([[0], np.cumsum(rng.choice([0, 3, 900], 40))])
    x, y = random_events(rng, grid(), int(starts[-1]))
    p = rng.integers(0, 2, len(x)).astype(np.uint8)
    one, other = (tracker.start(grid(), presets.PRESETS[preset]) for _ in range(2))
    tracks = tracker.fold(one, x, y, p, starts)
    for k, (first, last) in enumerate(itertools.pairwise(starts)):
        tracker.step(other, x[first:last], y[first:last], p[first:last])
        np.testing.assert_array_equal(tracks.dot_xy_px[k], other.dot_xy_px.astype(np.float32))
        np.testing.assert_array_equal(tracks.events_per_dot[k], other.events_per_dot)
        np.testing.assert_array_equal(tracks.lost[k], other.lost)
    assert one.record.tobytes() == other.record.tobytes()


def test_lost_dots_are_flagged() -> None:
    """Assert that a dot is lost when over 40 px from where its neighbours place it, but not by motion in common."""
    state = tracker.start(grid(), PAPER)
    strayed = 3 * COLUMNS + 4
    wake = on_edge(grid()[[0]] + 20)  # events for one dot: flags are looked at when something moved
    for away_px, lost in ((41.0, True), (39.0, False)):
        state.dot_xy_px[:] = grid() + 20
        state.dot_xy_px[strayed, 0] += away_px
        step(state, *wake)
        assert np.flatnonzero(state.lost).tolist() == ([strayed] if lost else [])


@pytest.mark.parametrize(
    "constants",
    [
        {"step_size": 0.0},
        {"step_size": np.inf},
        {"regulariser_weight": -1e-9},
        {"regulariser_weight": np.nan},
        {"min_events": -1},
        {"min_events": 2.5},
    ],
)
def test_impossible_constants_are_refused(constants: dict[str, float]) -> None:
    """Assert that a constant of a user out of range is refused by name, with what was expected and found."""
    with pytest.raises(ValueError, match=f"{next(iter(constants))}: expected .* found"):
        TrackerConstants(**constants)  # type: ignore[arg-type]


def test_wrong_columns_are_refused() -> None:
    """Assert that columns of another type or of unequal length are refused."""
    state = single()
    with pytest.raises(ValueError, match="expected two uint16 columns"):
        step(state, np.zeros(3, np.int64), np.zeros(3, np.int64))
    with pytest.raises(ValueError, match="expected two uint16 columns"):
        step(state, np.zeros(3, np.uint16), np.zeros(2, np.uint16))


@pytest.mark.parametrize("preset", DESCENTS)
def test_descent_is_exact(preset: str) -> None:
    """Assert that every step gives the very bits of the equations in plain Python, also where dots share events."""
    rng = np.random.default_rng(21)
    rest = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2) * 27.0 + 40.0
    constants = replace(PRESETS[preset], hot_pixel_events=0)
    state = tracker.start(rest, constants)
    neighbours = [[int(j) for j in row if j >= 0] for row in state.neighbours]
    expected = [(float(x), float(y)) for x, y in rest]
    places = list(expected)
    for count in (0, 5, 300, 1000, 700, 2):
        x, y = random_events(rng, rest + 1.5, count)
        expected = exact_step(expected, places, neighbours, constants, list(zip(x.tolist(), y.tolist(), strict=True)))
        step(state, x, y)
        assert state.dot_xy_px.tobytes() == np.array(expected).tobytes()
    assert np.abs(state.dot_xy_px - rest).max() > 0.1


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("make", [copy.copy, copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))])
def test_a_copy_goes_on_alike_and_alone(preset: str, make: Callable[[TrackerState], TrackerState]) -> None:
    """Assert that a copy has the same bytes and goes on with the same bits, and that neither changes the other."""
    rng = np.random.default_rng(15)
    state = tracker.start(grid(), PRESETS[preset])
    for _ in range(4):  # `official-5ms` moves in the next
        step(state, *random_events(rng, grid() + 1, 2000))
    other = make(state)
    assert other.constants == state.constants == PRESETS[preset]
    assert other.record.tobytes() == state.record.tobytes()
    before, slice_ = state.record.tobytes(), random_events(rng, grid() + 2, 2000)
    step(other, *slice_)
    assert state.record.tobytes() == before != other.record.tobytes()
    assert (other.dot_xy_px != state.dot_xy_px).any()
    step(state, *slice_)
    assert state.record.tobytes() == other.record.tobytes()


def test_the_reach_of_every_dot_at_once_fits() -> None:
    """Assert that as many dots as there is room for, each in reach of as much as it may, have room in the lists."""
    middle = np.stack(np.meshgrid(np.arange(16), np.arange(16)), axis=-1).reshape(-1, 2) * 1.0 + (312.5, 232.5)
    wide = replace(PRESETS["unregularised"], ring_outer_px=presets.MAX_REACH_PX)
    state = tracker.start(middle, wide)
    step(state, *columns([(320, 240)]))
    listed = int(state.record["bucket_start"][0, buckets.COLUMNS * 480 // buckets.SIZE_PX])
    assert 16 * 16 * 16 * 16 < listed <= STATE["bucket_dots"].shape[0]


def test_start_copies_and_step_works_in_place() -> None:
    """Assert that the caller's grid is left alone and that a step keeps the state's arrays where they are."""
    rest = grid()
    state = tracker.start(rest, PAPER)
    dots, events = state.dot_xy_px, state.events_per_dot
    step(state, *columns(np.repeat(grid() + (18, 0), 11, axis=0)))
    assert (rest == grid()).all()
    assert (dots == state.dot_xy_px).all()
    assert (dots[:, 0] > rest[:, 0]).all()
    assert (events == 11).all()


def test_mean_displacement_is_that_of_the_dots_present() -> None:
    """Assert so to the last bit, with a missing dot and without."""
    rng = np.random.default_rng(5)
    for dots in (grid(), np.where(np.arange(63)[:, None] == 20, np.nan, grid())):
        state = tracker.start(dots, PRESETS["stable"])
        for _ in range(20):
            step(state, *random_events(rng, grid(), 400))
        displacement_px = (state.dot_xy_px - state.rest_xy_px)[~np.isnan(dots[:, 0])]
        assert tracker.mean_displacement_px(state.record) == tuple(displacement_px.mean(axis=0).tolist())
        assert np.abs(displacement_px).max() > 0.01


def test_a_hot_pixel_does_not_pull() -> None:
    """Assert that a pixel firing 2000 times a second in a ring moves its dot by 0.5 px at most, unfiltered by 2."""
    moved = {}
    for limit in (0, 16):
        state = single(constants=replace(PAPER, min_events=0, regulariser_weight=0.0, hot_pixel_events=limit))
        for _ in range(3000):
            step(state, *columns([(319, 200)] * 2))
        moved[limit] = abs(state.dot_xy_px - [300, 200]).max()
    assert moved[16] < 0.5
    assert moved[0] > 2


def test_the_step_limit_is_where_steps_begin_to_grow() -> None:
    """Assert that dots pushed off their grid come back with nine tenths of the limit, and with a tenth more do not."""
    grows = {}
    for share in (0.9, 1.1):
        weight = 2.0 * share / (PAPER.step_size * tracker.STIFFNESS * PITCH_PX**2)
        state = tracker.start(grid(), replace(PAPER, hot_pixel_events=0, min_events=0))
        state.record["regulariser_weight"] = weight
        rest = state.dot_xy_px.copy()
        state.dot_xy_px[:] += 1e-3 * np.random.default_rng(3).standard_normal(rest.shape)
        before = np.abs(state.dot_xy_px - rest).max()
        state.record["gradient_clip"] = 1e-12  # the data term is silent: events only let the dots move
        for _ in range(200):
            step(state, *on_edge(rest, 1))
        grows[share] = np.abs(state.dot_xy_px - rest - (state.dot_xy_px - rest).mean(axis=0)).max() / before
    assert grows[0.9] < 1.0 < grows[1.1]


def test_one_dot_closed_form() -> None:
    """Assert that a dot 0.4 px beside the centre of its edge moves by the sum of pulls worked out by hand."""
    state = single(offset_px=(0.4, 0.0))
    step(state, *on_edge(np.array([[300.0, 200.0]])))
    # Right and left pull by -0.4 each, above and below by -0.4 (1 - 15 / sqrt(15^2 + 0.4^2)); three times.
    pulls = 3 * (-0.4 - 0.4 - 0.8 * (1 - 15 / np.hypot(15, 0.4)))
    assert state.dot_xy_px[0] == pytest.approx([300.4 + 2 * 0.003 * pulls, 200.0], abs=1e-11)
    assert state.events_per_dot.tolist() == [12]


def test_ring_bounds_are_exclusive() -> None:
    """Assert that events exactly 10 or 20 px away do not pull, and that one exactly 20 px away is not the dot's."""
    state = single()
    step(state, *columns([(310, 200)] * 12 + [(320, 200)] * 12))
    assert state.events_per_dot.tolist() == [12]
    assert state.dot_xy_px.tolist() == [[300, 200]]


def test_gradient_clip_bounds_the_speed() -> None:
    """Assert that 10,000 events on one side of a dot move it by 1.2 px and not further."""
    state = single(constants=replace(PAPER, hot_pixel_events=0))
    step(state, *columns([(318, 200)] * 10_000))
    assert state.dot_xy_px[0] == pytest.approx([301.2, 200], abs=1e-12)
