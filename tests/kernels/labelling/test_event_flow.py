"""Slip labels by counting: motion of dots and window from events of known motion, and the onset of known slides."""

from collections.abc import Sequence

import numpy as np
import pytest

from evetac_cli.events import Events, empty
from evetac_cli.kernels.labelling import event_flow, flow

WINDOW, GEL = (565, 0, 640, 480), (0, 0, 530, 480)
DOTS = np.stack(np.meshgrid([120.0, 260.0, 400.0], [100.0, 240.0, 380.0]), axis=-1).reshape(-1, 2)
RADIUS_PX = 15.0
CONSTANTS = event_flow.EventFlowConstants()
RATE = 500  # events of the window a pixel, as long as it has not moved
LOAD_MS = 300  # the object takes the gel along until then


def contact_edges(rng: np.random.Generator, centres: np.ndarray, moved: np.ndarray) -> list[np.ndarray]:
    """x, y, p of the events that dark dots' rims make on a small way: crossings a pixel along the normal."""
    if not moved.any():
        return [np.empty(0)] * 3
    angle = rng.uniform(0, 2 * np.pi, (len(centres), round(2 * np.pi * RADIUS_PX * CONSTANTS.edge_events)))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    along = (normal * moved[:, None]).sum(axis=-1)
    seen = rng.random(along.shape) < np.abs(along)
    at = (centres[:, None] + RADIUS_PX * normal)[seen]
    return [np.round(at[:, 0]), np.round(at[:, 1]), (along[seen] < 0).astype(float)]


def scene(dot_px: np.ndarray, object_px: Sequence[float], rate: float = RATE, seed: int = 0) -> flow.Between:
    """Events of dots displaced by dot_px (slices + 1, dots, 2), and of a window that shows an object moving along x."""
    rng = np.random.default_rng(seed)
    slices = []
    gone = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(object_px)))])
    for k, travelled in enumerate(CONSTANTS.fading_px * np.diff(np.log1p(gone / CONSTANTS.fading_px))):
        parts = [contact_edges(rng, DOTS + dot_px[k], dot_px[k + 1] - dot_px[k])]
        many = rng.poisson(rate * travelled)
        parts.append([rng.integers(565, 640, many), rng.integers(0, 480, many), rng.integers(0, 2, many)])
        x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
        slices.append(Events(np.full(len(x), 1000 * k), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)))

    def between(first: int, last: int) -> Events:
        chosen = slices[first:last]
        return Events(*(np.concatenate(c) for c in zip(*chosen, strict=True))) if chosen else empty()

    return between


def slide(creep_px_ms: float, slide_px_ms: float, onset: int, slices: int, angle: float = 0.0) -> tuple:
    """Load by 6 px, rest, creep in stick, then the object goes on at another speed and the dots stay."""
    speed = np.zeros(slices)
    speed[100:LOAD_MS] = 6.0 / (LOAD_MS - 100)
    speed[LOAD_MS + 100 : onset] = creep_px_ms
    dots = speed.copy()
    speed[onset:] = slide_px_ms
    object_px, along = (np.concatenate([[0.0], np.cumsum(part)]) for part in (speed, dots))
    direction = np.array([np.cos(angle), np.sin(angle)])
    return np.repeat(along[:, None, None] * direction, len(DOTS), axis=1), object_px


def followed(between: flow.Between, slices: int) -> event_flow.ImageMotion:
    """The motion of all slices, in one."""
    part = event_flow.pixel_parts(between, slices, WINDOW, GEL, DOTS)
    given = between, slices, part, DOTS, RADIUS_PX, CONSTANTS.edge_events
    blocks = [motion for _, motion in event_flow.follow(*given)]
    first = [blocks[0].dot_px[:1], blocks[0].window_events[:1]]
    return event_flow.ImageMotion(
        np.concatenate([first[0], *(block.dot_px[1:] for block in blocks)]),
        np.concatenate([first[1], *(block.window_events[1:] for block in blocks)]),
    )


def labels(dot_px: np.ndarray, object_px: Sequence[float], start: int = LOAD_MS, **how: float) -> flow.Labels:
    between = scene(dot_px, object_px, **how)
    return event_flow.label(between, len(object_px) - 1, WINDOW, GEL, DOTS, RADIUS_PX, CONSTANTS, start)


@pytest.mark.parametrize("path_px", [(4.0, 0.0), (0.0, -7.0), (-5.0, 3.0)])
def test_dots_are_followed_both_ways(path_px: tuple[float, float]) -> None:
    """Assert that dots that go and come back are followed to 5 % and twice the noise of counting, at both ends."""
    out = np.linspace(0, 1, 101)[:, None] * np.array(path_px)
    path = np.concatenate([out, out[-2::-1]])
    dot_px = np.repeat(path[:, None], len(DOTS), axis=1)
    between = scene(dot_px, np.zeros(len(path)))
    motion = followed(between, len(path) - 1)
    error = np.hypot(*(motion.dot_px - dot_px).transpose(2, 0, 1))
    per_px = np.pi * RADIUS_PX * CONSTANTS.edge_events
    assert error[100].mean() < 0.05 * np.hypot(*path_px) + 2 * np.sqrt(np.hypot(*path_px) / per_px)
    assert error[-1].mean() < 2 * np.sqrt(2 * np.hypot(*path_px) / per_px)
    assert motion.window_events.max() == 0


@pytest.mark.parametrize("block", [1, 3, 7, 650, 1000])
def test_blocks_do_not_change_a_bit(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that labels are the same however few slices are looked at together."""
    dot_px, object_px = slide(0.02, 0.1, 600, 650)
    whole = labels(dot_px, object_px)
    monkeypatch.setattr(event_flow, "BLOCK_SLICES", block)
    for one, other in zip(labels(dot_px, object_px), whole, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("speed", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_onset_is_when_half_a_pixel_is_slid(speed: float, angle: float) -> None:
    """Assert that the onset is where 0.5 px is slid, to 2 ms and a fifth of the way, however slow, along x or y."""
    begin = 600
    result = labels(*slide(0.02, speed, begin, 700, angle))
    wanted = begin + CONSTANTS.slip_distance_px / speed
    assert abs(result.onset - wanted) <= 2 + 0.2 * CONSTANTS.slip_distance_px / speed
    assert (result.label[:LOAD_MS] == -1).all()
    assert (result.label[LOAD_MS : result.onset] == 0).all()
    assert result.label[result.onset] == 1
    assert (result.label[result.onset + CONSTANTS.after_ms :] == -1).all()
    assert result.confidence > 0.9
    assert result.flow_pairs == 0


def test_a_turning_object_takes_dots_along_each_its_own_way() -> None:
    """Assert that there is no slip while the dots turn with the object, and that there is when they stop."""
    dot_px, object_px = slide(0.02, 0.2, 600, 660)
    centre = DOTS.mean(axis=0)
    across = (DOTS - centre)[:, ::-1] * [-1.0, 1.0] / np.hypot(*(DOTS - centre).T).clip(1.0)[:, None]
    turned = np.linalg.norm(dot_px, axis=-1)[..., None] * across
    result = labels(turned, object_px)
    assert abs(result.onset - 602.5) <= 3
    assert (result.label[LOAD_MS : result.onset] == 0).all()


@pytest.mark.parametrize("path_px", [0.5, 5.0, 50.0, 400.0])
def test_travel_follows_from_events_that_fade(path_px: float) -> None:
    """Assert that events fading as the module says give back the distance, to the step of the sum, short or long."""
    object_px = np.linspace(0, path_px, 4001)
    moved = RATE * CONSTANTS.fading_px * np.log1p(object_px / CONSTANTS.fading_px)
    reported = event_flow.travel(moved, np.full(4000, float(RATE)), CONSTANTS.fading_px)
    np.testing.assert_allclose(reported, object_px, rtol=0.01, atol=0.01)


@pytest.mark.parametrize("creep", [0.0, 0.02, 0.1])
def test_creep_together_is_no_slip(creep: float) -> None:
    """Assert that an object which takes the gel along never slips, at any speed."""
    result = labels(*slide(creep, 0.0, 520, 520))
    assert result.onset == -1
    assert set(result.label[LOAD_MS:]) == {0}
    assert np.isnan(result.confidence)


def test_one_dot_that_follows_is_no_slip() -> None:
    """Assert that the object does not slip while a single dot still goes with it."""
    dot_px, object_px = slide(0.02, 0.1, 600, 680)
    assert labels(dot_px, object_px).onset > 0
    dot_px[600:, 4] += 0.1 * np.arange(len(object_px) - 600)[:, None] * [1.0, 0.0]
    assert labels(dot_px, object_px).onset == -1


def test_a_short_slide_is_no_onset() -> None:
    """Assert that slides of 0.3 px, with rests in stick between them, do not add up."""
    dot_px, object_px = slide(0.0, 0.0, 600, 900)
    for begin in (600, 700, 800):
        object_px[begin:] += np.minimum(0.1 * np.arange(len(object_px) - begin), 0.3)
    assert labels(dot_px, object_px).onset == -1


def test_an_object_without_texture_is_refused() -> None:
    """Assert that a window without events while the gel is dragged along is an error that says so."""
    with pytest.raises(ValueError, match="texture: expected at least 20 events a pixel"):
        labels(*slide(0.02, 0.1, 600, 650), rate=0.0)


def test_hot_pixels_change_nothing() -> None:
    """Assert that pixels which never stop, beside a dot and in the window, are left out of motion and count."""
    dot_px, object_px = slide(0.02, 0.1, 600, 650)
    quiet = scene(dot_px, object_px)

    def hot(first: int, last: int) -> Events:
        more = np.repeat(np.arange(first, last), 2) * 1000
        x, y = np.tile([275, 600], last - first), np.tile([240, 100], last - first)
        columns = zip(quiet(first, last), (more, x, y, np.ones(len(more))), strict=True)
        joined = [np.concatenate(pair) for pair in columns]
        order = np.argsort(joined[0], kind="stable")
        return Events(*(c[order].astype(d) for c, d in zip(joined, (np.int64, "u2", "u2", "u1"), strict=True)))

    plain = followed(quiet, len(object_px) - 1)
    noisy = followed(hot, len(object_px) - 1)
    assert abs(int(noisy.window_events[-1]) - int(plain.window_events[-1])) < 5
    assert np.abs(noisy.dot_px - plain.dot_px).max() < 0.2


def test_missing_dots_are_left_out() -> None:
    """Assert that dots without a place are no dots, and that at least one is wanted."""
    dot_px, object_px = slide(0.02, 0.1, 600, 650)
    between, slices = scene(dot_px, object_px), len(object_px) - 1
    with_gap = np.concatenate([DOTS, [[np.nan, np.nan]]])
    whole = event_flow.label(between, slices, WINDOW, GEL, DOTS, RADIUS_PX, CONSTANTS, LOAD_MS)
    gap = event_flow.label(between, slices, WINDOW, GEL, with_gap, RADIUS_PX, CONSTANTS, LOAD_MS)
    np.testing.assert_array_equal(whole.label, gap.label)
    with pytest.raises(ValueError, match="dots: expected some with a radius > 0, found 0"):
        event_flow.label(between, slices, WINDOW, GEL, with_gap[-1:], RADIUS_PX, CONSTANTS)


@pytest.mark.parametrize("slices", [0, 1, 2, 60])
def test_nothing_happens(slices: int) -> None:
    """Assert that recordings without events, however short, have no slip and no onset."""
    result = event_flow.label(lambda first, last: empty(), slices, WINDOW, GEL, DOTS, RADIUS_PX, CONSTANTS)
    assert result.onset == -1
    assert result.label.tolist() == [0] * slices
    assert np.isfinite(result.relative_flow_px).all()


@pytest.mark.parametrize(
    "wrong", [{"slip_distance_px": 0.0}, {"edge_events": float("nan")}, {"hidden_px": -1.0}, {"follow_share": 1.0}]
)
def test_impossible_constants(wrong: dict[str, float]) -> None:
    """Assert that constants out of range are refused by name."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        event_flow.EventFlowConstants(**wrong)  # type: ignore[arg-type]


def test_medians_are_those_of_all_values_so_far() -> None:
    """Assert that each weighted median is that of a sorted list of the values up to it, also where values are equal."""
    rng = np.random.default_rng(0)
    rates, weights = np.round(rng.random(300), 1), 0.1 * rng.integers(1, 9, 300)
    for count, median in enumerate(event_flow._medians(rates, weights), 1):
        ordered, by = np.array(sorted(zip(rates[:count], weights[:count], strict=True))).T
        reached = np.cumsum(by)
        assert median == ordered[np.searchsorted(reached, 0.5 * reached[-1])]
