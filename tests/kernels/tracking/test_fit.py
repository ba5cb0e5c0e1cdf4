"""The preset `stable`: a slow reference of its equations, what the paper's cannot follow, lost dots, bounds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.kernels.tracking import buckets, tracker
from evetac_cli.kernels.tracking.presets import PRESETS, TrackerConstants
from evetac_cli.kernels.tracking.tracker import TrackerState

STABLE = PRESETS["stable"]
ROWS, COLUMNS, PITCH_PX = 5, 6, 62.0
DARKER, BRIGHTER = 0, 1

Slice = tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]


def grid() -> NDArray[np.float64]:
    """Dots (30, 2), row by row, on whole pixels."""
    y, x = np.mgrid[:ROWS, :COLUMNS] * PITCH_PX + 50.0
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def contact_edges(
    rng: np.random.Generator,
    before: NDArray[np.float64],
    motion_px: NDArray[np.float64],
    a_px: float = 300.0,
    dot_radius_px: float = 15.0,
) -> Slice:
    """Events of dots (n, 2) that all go the same way within a slice: darker ahead, brighter behind, evenly in time."""
    length = np.linalg.norm(motion_px)
    dot = np.repeat(np.arange(len(before)), rng.poisson(a_px * length, len(before)))
    side = rng.choice([-1.0, 1.0], len(dot))
    sine = rng.uniform(-1, 1, len(dot))
    direction = motion_px / max(length, 1e-12)
    normal = (side * np.sqrt(1 - sine**2))[:, None] * direction + sine[:, None] * np.array(
        [-direction[1], direction[0]]
    )
    lag_px = -STABLE.rim_lag_px * np.sign(side)  # found behind the motion, on either side
    radius_px = dot_radius_px + lag_px + 0.5 * rng.standard_normal(len(dot))
    place = before[dot] + rng.random(len(dot))[:, None] * motion_px + radius_px[:, None] * normal
    x, y = np.round(place).astype(np.uint16).T.copy()
    return x, y, np.where(side > 0, DARKER, BRIGHTER).astype(np.uint8)


def nothing() -> Slice:
    return np.empty(0, np.uint16), np.empty(0, np.uint16), np.empty(0, np.uint8)


def reference(state: TrackerState, slice_: Slice, last: dict[tuple[int, int], set[int]]) -> NDArray[np.float64]:
    """Where the dots are after a slice, by the equations in the module's docstring, in plain loops.

    last: polarities of the last slice in which a pixel had events; it is updated.
    """
    constants, centres = state.constants, state.dot_xy_px.copy()
    n = len(centres)
    half = constants.ring_outer_px - constants.radius_px
    h, s, events = np.zeros((n, 2, 2)), np.zeros((n, 2)), np.zeros(n, int)
    rims_say, weights = np.zeros((2, n, 2)), np.zeros((2, n))
    for x, y, p in zip(*slice_, strict=True):
        leading = 1 if p == DARKER else -1
        for i in range(n):
            away = np.array([x, y]) - centres[i]
            distance = np.linalg.norm(away)
            beyond = distance - constants.radius_px + leading * constants.rim_lag_px
            if abs(beyond) >= half:
                continue
            weight, normal = (1 - (beyond / half) ** 2) ** 2, away / distance
            h[i] += weight * np.outer(normal, normal)
            s[i] += weight * beyond * normal
            shown = {frozenset(): 1.5, frozenset({0, 1}): 1.5, frozenset({p}): 1.0}
            rims_say[p, i] += shown.get(frozenset(last.get((x, y), ())), 2.6) * leading * normal
            weights[p, i] += weight
            events[i] += 1
    last |= {(x, y): set() for x, y, _ in zip(*slice_, strict=True)}
    for x, y, p in zip(*slice_, strict=True):
        last[x, y].add(p)
    total = np.trace(h, axis1=1, axis2=2)
    both = rims_say.sum(axis=0)
    for i in range(n):
        off = rims_say[0, i] - rims_say[1, i]
        most = max(1 - (np.sqrt(total[i]) + 4.0) / max(np.linalg.norm(off), 1e-12), 0)
        both[i] -= np.clip(both[i] @ off / max(off @ off, 1e-12), -most, most) * off
    odd = np.maximum(np.abs(weights[0] - weights[1]) - np.sqrt(total), 0)
    share = 1 - odd / np.maximum(total, 1e-12)
    seen = constants.event_px * both
    seen /= np.maximum(1 - constants.unseen_per_px * np.linalg.norm(seen, axis=1), 0.4)[:, None]
    seen *= np.minimum(1, constants.trust_px / np.maximum(np.linalg.norm(seen, axis=1), 1e-12))[:, None]
    correction = np.zeros((n, 2))
    for _ in range(constants.sweeps):
        for i in range(n):
            near = state.neighbours[i][state.neighbours[i] >= 0]
            pull = 8 * constants.regulariser_weight / max(len(near), 1)
            scale = share[i] * min(1, constants.most_events / max(total[i], 1e-12))
            matrix = scale * h[i] + (0.5 / constants.step_size + pull * len(near)) * np.eye(2)
            right = scale * (s[i] - h[i] @ seen[i] / 2) + pull * correction[near].sum(axis=0)
            correction[i] = np.linalg.solve(matrix, right)
    correction *= np.minimum(1, constants.trust_px / np.maximum(np.linalg.norm(correction, axis=1), 1e-12))[:, None]
    centres[events > constants.min_events] += (seen + correction)[events > constants.min_events]
    return centres


@pytest.mark.parametrize("changes", [{}, {"min_events": 7}, {"most_events": 3.0, "regulariser_weight": 2.0}])
def test_agrees_with_plain_reference(changes: dict[str, float]) -> None:
    """Assert that positions equal the equations in plain loops to 1e-6 px (the damping has a floor of 1e-9)."""
    rng = np.random.default_rng(1)
    state = tracker.start(grid(), replace(STABLE, **changes))  # type: ignore[arg-type]
    last: dict[tuple[int, int], set[int]] = {}
    for turn in range(6):
        motion_px = np.array([0.3, -0.2]) * (-1) ** turn  # so that pixels reverse
        slice_ = contact_edges(rng, state.dot_xy_px + rng.uniform(-2, 2, (30, 2)), motion_px, 250.0)
        expected = reference(state, slice_, last)
        assert np.abs(expected - state.dot_xy_px).max() > 1e-3
        tracker.step(state, *slice_)
        assert np.abs(state.dot_xy_px - expected).max() < 1e-6


def test_events_of_hot_pixels_are_left_out() -> None:
    """Assert that events of hot pixels anywhere among the others, and some outside the frame, change no bit."""
    rng = np.random.default_rng(8)
    cool = contact_edges(rng, grid() + rng.uniform(-1, 1, (30, 2)), np.array([0.05, 0.02]))
    hot_xy = np.round(grid()[:20] + (15, 4)).astype(np.uint16)
    more_x, more_y = np.concatenate([hot_xy, [(640, 100), (300, 480), (65535, 65535)]]).astype(np.uint16).T
    apart = ~(np.stack(cool[:2], axis=1)[:, None] == hot_xy).all(axis=2).any(axis=1)
    cool = tuple(column[apart] for column in cool)  # type: ignore[assignment]
    order = rng.permutation(len(cool[0]) + len(more_x))
    more = more_x, more_y, rng.integers(0, 2, len(more_x), dtype=np.uint8)
    mixed = [np.concatenate(columns)[order] for columns in zip(cool, more, strict=True)]
    places = []
    for x, y, p in (cool, mixed):
        state = tracker.start(grid(), STABLE)
        buckets.pixel_counts.py_func(state.record[0])[hot_xy[:, 1] + 1, hot_xy[:, 0] + 1] = 0xFFFF
        tracker.step(state, x, y, p)
        places.append((state.dot_xy_px.tobytes(), state.events_per_dot.tobytes()))
    assert np.frombuffer(places[0][1], np.int32).sum() == len(cool[0])
    assert places[0] == places[1]


def follow(
    constants: TrackerConstants,
    way_px: NDArray[np.float64],
    seed: int = 2,
    a_px: float = 300.0,
    dot_radius_px: float = 15.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of tracking, and of standing still, (slices, dots, 2), for dots that go along way_px (slices + 1, 2)."""
    rng = np.random.default_rng(seed)
    state = tracker.start(grid(), constants)
    errors, still = [], []
    for before, after in zip(way_px, way_px[1:], strict=False):
        tracker.step(state, *contact_edges(rng, grid() + before, after - before, a_px, dot_radius_px))
        errors.append(state.dot_xy_px - grid() - after)
        still.append(np.broadcast_to(-after, (30, 2)))
    return np.array(errors), np.array(still)


def rms(errors: NDArray[np.float64]) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def shaken(amplitude_px: float, frequency_hz: float, slices: int) -> NDArray[np.float64]:
    motion_px = amplitude_px * np.sin(2e-3 * np.pi * frequency_hz * np.arange(slices + 1))
    return np.stack([0.8 * motion_px, 0.6 * motion_px], axis=1)


def test_creep_below_the_papers_gate() -> None:
    """Assert that dots with one and a half events a slice are followed, where the paper's preset does not move."""
    motion_px = np.outer(np.arange(401), [0.004, -0.003])
    errors, still = follow(STABLE, motion_px)
    assert rms(errors) < 0.15 * rms(still)
    unmoved, _ = follow(PRESETS["paper"], motion_px)
    assert rms(unmoved) == pytest.approx(rms(still), rel=1e-12)


@pytest.mark.parametrize(("amplitude_px", "frequency_hz", "share"), [(3.0, 5.0, 0.1), (0.3, 200.0, 0.7)])
def test_shear_and_tone(amplitude_px: float, frequency_hz: float, share: float) -> None:
    """Assert that a shear and a tone are followed with a tenth, and with less than, the error of standing still."""
    errors, still = follow(STABLE, shaken(amplitude_px, frequency_hz, 300))
    assert rms(errors) < share * rms(still)


@pytest.mark.parametrize("dot_radius_px", [8.0, 13.0, 15.0, 17.0])
def test_dots_of_any_radius(dot_radius_px: float) -> None:
    """Assert that dots of a stated radius are followed as well as those of 15 px, and worse with the wrong radius."""
    motion_px = shaken(3.0, 5.0, 300)
    a_px = 20.0 * dot_radius_px  # a longer rim makes more events
    tracked, still = follow(STABLE.for_dots(dot_radius_px), motion_px, a_px=a_px, dot_radius_px=dot_radius_px)
    assert rms(tracked) < 0.1 * rms(still)
    mistaken, _ = follow(STABLE, motion_px, a_px=a_px, dot_radius_px=dot_radius_px)
    assert dot_radius_px == 15.0 or rms(mistaken) > 2 * rms(tracked)


def test_the_constants_for_a_radius() -> None:
    """Assert that ring, count and motion an event go with the radius, that 15 px change no bit, and others never."""
    small = STABLE.for_dots(8.0)
    assert (small.radius_px, small.ring_inner_px, small.ring_outer_px, small.count_radius_px) == (8.0, 4.0, 12.0, 13.0)
    assert small.event_px == pytest.approx(STABLE.event_px * 15 / 8)
    assert replace(small, radius_px=15.0, ring_inner_px=11.0, ring_outer_px=19.0, count_radius_px=20.0) == replace(
        STABLE, event_px=small.event_px
    )
    assert STABLE.for_dots(15.0) == STABLE
    for name in ("paper", "official", "unregularised"):
        assert PRESETS[name].for_dots(8.0) == PRESETS[name]
    for wrong in (3.9, 124.1, np.nan, -1.0):
        with pytest.raises(ValueError, match="dot_radius_px: expected 4 to 124, found"):
            STABLE.for_dots(wrong)


def test_a_still_dot_among_moving_ones_stays() -> None:
    """Assert that a dot without events does not move, however its neighbours do."""
    rng = np.random.default_rng(3)
    state = tracker.start(grid(), STABLE)
    others = np.delete(np.arange(30), 14)
    for k in range(30):
        tracker.step(state, *contact_edges(rng, grid()[others] + (0.1 * k, 0), np.array([0.1, 0.0])))
    assert state.dot_xy_px[14].tolist() == grid()[14].tolist()
    assert np.abs(state.dot_xy_px[others] - grid()[others] - (3.0, 0)).max() < 0.5


def test_a_flood_on_one_dot_is_outvoted() -> None:
    """Assert that 1,000 events of a passing edge move a dot by a quarter of what they would if each weighed."""
    place = grid()[14]
    moved = []
    y = np.round(place[1] + np.linspace(-5, 5, 1000)).astype(np.uint16)
    x = np.full(1000, int(place[0]) + 18, np.uint16)
    for most in (20.0, 1e6):
        state = tracker.start(grid(), replace(STABLE, hot_pixel_events=0, event_px=0.0))
        state.record["most_events"] = most
        tracker.step(state, x, y, np.full(1000, BRIGHTER, np.uint8))
        moved.append(np.linalg.norm(state.dot_xy_px[14] - place))
    assert 0 < moved[0] < moved[1] / 4


def edge_over(x_px: int, p: int) -> Slice:
    """A line across the frame, 4 px wide, in which every pixel has an event of the one polarity."""
    y, x = np.mgrid[0:480, x_px : x_px + 4]
    inside = x.ravel() < 640
    return x.ravel()[inside].astype(np.uint16), y.ravel()[inside].astype(np.uint16), np.full(inside.sum(), p, np.uint8)


@pytest.mark.parametrize("stops_px", [108, 112, 115])
def test_an_edge_of_one_polarity_does_not_take_dots_along(stops_px: int) -> None:
    """Assert that edges which stop on still dots move them by less than half of what they would without polarity."""
    moved_px = []
    for darker_before in (1e5, 0.0):  # without any before, the camera is taken to send brighter events only
        state = tracker.start(grid(), replace(STABLE, hot_pixel_events=0))
        state.record["polarity_weight"][0, 0] = darker_before
        for _ in range(4):
            for x_px in range(0, stops_px, 4):
                tracker.step(state, *edge_over(x_px, BRIGHTER))
        moved_px.append(np.linalg.norm(state.dot_xy_px - grid(), axis=1).max())
    assert moved_px[0] < 0.5 * moved_px[1]


def test_a_step_is_bounded_by_trust() -> None:
    """Assert that motion seen and correction move a dot by no more than trust_px each."""
    alone = tracker.start(np.array([[300.0, 200.0]]), replace(STABLE, hot_pixel_events=0, step_size=1e3))
    side = np.full(10_000, 318, np.uint16), np.full(10_000, 200, np.uint16), np.zeros(10_000, np.uint8)
    tracker.step(alone, *side)
    moved = np.linalg.norm(alone.dot_xy_px[0] - [300, 200])
    assert STABLE.trust_px < moved <= 2 * STABLE.trust_px + 1e-9


def lose(state: TrackerState, dot: int) -> None:
    """Take a dot 50 px away, and let the tracker notice."""
    state.dot_xy_px[dot] += (50.0, 0.0)
    x, y = (np.array([value], np.uint16) for value in state.dot_xy_px[0] + (15, 0))
    tracker.step(state, x, y, np.zeros(1, np.uint8))
    assert np.flatnonzero(state.lost).tolist() == [dot]


def test_a_lost_dot_is_found_again_at_rest() -> None:
    """Assert that a lost dot is where its neighbours place it after rest_slices slices without events, and not lost."""
    state = tracker.start(grid(), STABLE)
    state.dot_xy_px[:] += (1.0, -0.5)  # at rest again, but for a little
    lose(state, 14)
    for _ in range(STABLE.rest_slices - int(state.record["slices_at_rest"][0]) - 1):
        tracker.step(state, *nothing())
        assert state.lost[14]
    tracker.step(state, *nothing())
    assert not state.lost.any()
    assert state.dot_xy_px[14] == pytest.approx(grid()[14] + (1.0, -0.5), abs=0.01)


@pytest.mark.parametrize("why", ["events", "held", "paper"])
def test_a_lost_dot_stays_lost(why: str) -> None:
    """Assert that it stays lost while there are events, while the gel is held away from rest, and with `paper`."""
    rng = np.random.default_rng(4)
    state = tracker.start(grid(), PRESETS["paper"] if why == "paper" else STABLE)
    if why == "held":
        state.dot_xy_px[:] += (10.0, 0.0)
    if why == "paper":
        state.dot_xy_px[14] += (50.0, 0.0)
        x, y = np.round(grid()[0] + np.array([(15, 0), (-15, 0)] * 8)).astype(np.uint16).T.copy()
        tracker.step(state, x, y)
        assert np.flatnonzero(state.lost).tolist() == [14]
    else:
        lose(state, 14)
    others = np.delete(grid(), 14, axis=0)
    for k in range(3 * STABLE.rest_slices):
        motion_px = np.array([0.02 * (-1) ** k, 0.0])
        slice_ = contact_edges(rng, others, motion_px) if why == "events" else nothing()
        tracker.step(state, *slice_)
    assert np.flatnonzero(state.lost).tolist() == [14]


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 3000),
    step_size=st.sampled_from([1e-300, 0.003, 0.1, 1e3, 1e300]),
    weight=st.sampled_from([0.0, 1e-6, 30.0, 1e6, 1e300]),
    most=st.sampled_from([1e-300, 20.0, 1e300]),
    sweeps=st.sampled_from([1, 8, 50]),
    lag_px=st.sampled_from([0.0, 0.2, 100.0]),
)
def test_any_constants_keep_the_state_finite(
    seed: int, count: int, step_size: float, weight: float, most: float, sweeps: int, lag_px: float
) -> None:
    """Assert that no events and no constants make a step longer than twice trust_px, or leave the frame."""
    rng = np.random.default_rng(seed)
    wild = {"step_size": step_size, "regulariser_weight": weight, "most_events": most}
    wild |= {"sweeps": sweeps, "rim_lag_px": lag_px}
    state = tracker.start(grid(), STABLE)
    for name, value in wild.items():  # some of which `start` would refuse: nothing may go wrong in spite of that
        state.record[name] = value
    for _ in range(3):
        before = state.dot_xy_px.copy()
        dot, angle = rng.integers(0, 30, count), rng.integers(0, 4, count) * np.pi / 2
        place = grid()[dot] + rng.uniform(10, 20, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        x, y = np.round(place).astype(np.uint16).T.copy()
        tracker.step(state, x, y, rng.integers(0, 2, count, dtype=np.uint8))
        assert np.isfinite(state.dot_xy_px).all()
        assert np.linalg.norm(state.dot_xy_px - before, axis=1).max() <= 2 * STABLE.trust_px + 1e-9


def test_polarities_are_needed() -> None:
    """Assert that missing polarities, of another type or number, are refused."""
    state = tracker.start(grid(), STABLE)
    x = np.zeros(3, np.uint16)
    for wrong in (None, np.zeros(3, np.int64), np.zeros(2, np.uint8)):
        with pytest.raises(ValueError, match=r"p: expected uint8 polarities.* found"):
            tracker.step(state, x, x, wrong)  # type: ignore[arg-type]


def without(slice_: Slice, centre: NDArray[np.float64], hidden: int | None) -> Slice:
    """A slice without the events of the dot about a centre: of one polarity, or of either where `hidden` is None."""
    x, y, p = slice_
    near = np.hypot(x - centre[0], y - centre[1]) < PITCH_PX / 2
    seen = ~(near & ((p == hidden) | (hidden is None)))
    return x[seen], y[seen], p[seen]


def lost_on_the_way(
    way_px: NDArray[np.float64], dot: int | None, hidden: int | None = None, since: int = 10
) -> tuple[NDArray[np.bool_], NDArray[np.float64], TrackerState]:
    """Which dots are lost after each slice of a way, one of them without events, and how far off they all are."""
    rng = np.random.default_rng(5)
    state = tracker.start(grid(), STABLE)
    lost, off_px = [], []
    for k, (before, after) in enumerate(zip(way_px, way_px[1:], strict=False)):
        slice_ = contact_edges(rng, grid() + before, after - before)
        if dot is not None and k >= since:
            slice_ = without(slice_, grid()[dot] + after, hidden)
        tracker.step(state, *slice_)
        lost.append(state.lost.copy())
        off_px.append(np.linalg.norm(state.dot_xy_px - grid() - after, axis=1))
    return np.array(lost), np.array(off_px), state


STEADY_PX = np.outer(np.arange(120), [0.1, 0.0])
MIDDLE, EDGE = 14, 17  # of eight neighbours, and of five


@pytest.mark.parametrize("dot", [MIDDLE, EDGE])
@pytest.mark.parametrize("hidden", [DARKER, BRIGHTER])
def test_a_dot_with_a_hidden_rim_is_flagged_before_it_is_far(dot: int, hidden: int) -> None:
    """Assert that a dot of which one rim alone is seen is lost, it alone, before it is 5 px behind the others."""
    lost, off_px, _ = lost_on_the_way(STEADY_PX, dot, hidden)
    assert np.flatnonzero(lost.any(axis=0)).tolist() == [dot]
    assert off_px[:, dot].max() > 5.0
    assert off_px[~lost[:, dot], dot].max() < 5.0


def test_a_dot_that_vanishes_is_flagged() -> None:
    """Assert that a dot without events amid others that go on is lost; at the edge of the grid gel may stay."""
    lost, off_px, _ = lost_on_the_way(STEADY_PX, MIDDLE)
    assert np.flatnonzero(lost.any(axis=0)).tolist() == [MIDDLE]
    assert off_px[~lost[:, MIDDLE], MIDDLE].max() < 5.0
    assert not lost_on_the_way(STEADY_PX, EDGE)[0].any()


def test_a_dot_left_behind_is_put_back_at_rest() -> None:
    """Assert that it is where its neighbours place it, and not lost, once they are back and there was rest."""
    there_and_back = np.concatenate([STEADY_PX[:60], STEADY_PX[60:4:-1]])
    lost, off_px, state = lost_on_the_way(there_and_back, MIDDLE)
    assert lost[-1, MIDDLE]
    for _ in range(STABLE.rest_slices):
        tracker.step(state, *nothing())
    assert not state.lost.any()
    assert np.linalg.norm(state.dot_xy_px[MIDDLE] - grid()[MIDDLE] - there_and_back[-1]) < 0.5


@pytest.mark.parametrize(
    ("way_px", "flagged"), [(shaken(1.0, 498.0, 60), False), (np.outer(range(12), [5.0, 0]), True)]
)
def test_dots_that_jump_out_of_their_rings_are_flagged(way_px: NDArray[np.float64], flagged: bool) -> None:
    """Assert that dots which go 5 px a slice are lost after a few, and that those that swing by 2 px are not."""
    lost, _, _ = lost_on_the_way(way_px, None)
    assert lost[4:].all() if flagged else not lost.any()


def test_a_flood_on_one_side_of_a_dot_is_flagged() -> None:
    """Assert that a dot with 10,000 events on one side is lost, it alone."""
    state = tracker.start(grid(), STABLE)
    place = np.round(grid()[MIDDLE] + (16.0, 0.0) + np.random.default_rng(1).uniform(-1, 1, (10_000, 2)))
    tracker.step(state, *place.astype(np.uint16).T.copy(), np.zeros(10_000, np.uint8))
    assert np.flatnonzero(state.lost).tolist() == [MIDDLE]


def test_flickering_light_is_flagged_while_it_lasts() -> None:
    """Assert that all dots are lost while their whole rims flash, and none after, nor where the light changes once."""
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rims = (grid()[:, None] + 15.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)).reshape(-1, 2)
    x, y = np.round(rims).astype(np.uint16).T.copy()
    rng = np.random.default_rng(2)
    state = tracker.start(grid(), STABLE)
    lost = []
    for k in range(300):
        flashes = k == 5 or 40 <= k < 160
        flash = x, y, np.full(len(x), k // 5 % 2, np.uint8)
        tracker.step(state, *(flash if flashes else contact_edges(rng, grid(), np.array([0.01, 0.0]))))
        lost.append(state.lost.copy())
    flagged = np.array(lost)
    assert not flagged[:40].any()
    assert flagged[60:160].all()
    assert not flagged[-1].any()


def noise(rng: np.random.Generator, rate: float = 30.0) -> Slice:
    """Events anywhere in the frame, of either polarity."""
    count = rng.poisson(rate)
    x, y = rng.integers(0, 640, count), rng.integers(0, 480, count)
    return x.astype(np.uint16), y.astype(np.uint16), rng.integers(0, 2, count).astype(np.uint8)


def test_noise_does_not_move_dots() -> None:
    """Assert that 20 s of noise move dots by less than 0.03 px rms; they then follow a motion of 1 px in a second."""
    rng = np.random.default_rng(3)
    state = tracker.start(grid(), STABLE)
    for _ in range(20_000):
        tracker.step(state, *noise(rng))
    assert np.abs(state.dot_xy_px - grid()).max() < 0.1
    assert np.sqrt(np.mean((state.dot_xy_px - grid()) ** 2)) < 0.03
    before = state.dot_xy_px.copy()
    step_px = np.array([1e-3, 0.0])
    for k in range(1000):
        parts = contact_edges(rng, grid() + k * step_px, step_px, 377.0), noise(rng)
        tracker.step(state, *(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    assert np.abs((state.dot_xy_px - before).mean(axis=0) - [1.0, 0.0]).max() < 0.2
