"""Slip labels by counting: the onset of known slides, its interval, and when labels abstain."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.events import FRAME_PX, Events, empty
from evetac_cli.kernels.labelling import event_flow, flow
from evetac_cli.kernels.tracking.presets import PRESETS
from tests.quick import few

WINDOW = (565, 0, 640, 480)
DOTS = np.stack(np.meshgrid([120.0, 260.0, 400.0], [100.0, 240.0, 380.0]), axis=-1).reshape(-1, 2)
RADIUS_PX = 15.0
TRACKING = PRESETS["stable"].for_dots(RADIUS_PX)
EDGE_EVENTS = 6.9  # thresholds that a dot's rim crosses
CONSTANTS = event_flow.EventFlowConstants()
RATE = 500  # events of the window a pixel, as long as it has not moved
LOAD_MS = 300  # the object takes the gel along until then


def contact_edges(rng: np.random.Generator, centres: np.ndarray, moved: np.ndarray) -> list[np.ndarray]:
    """x, y, p of the events that dark dots' rims make on a small way: crossings a pixel along the normal."""
    if not moved.any():
        return [np.empty(0)] * 3
    angle = rng.uniform(0, 2 * np.pi, (len(centres), round(2 * np.pi * RADIUS_PX * EDGE_EVENTS)))
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


def slide_of(creep_px_ms: float, slide_px_ms: float, onset: int, slices: int, angle: float = 0.0) -> tuple:
    """Load by 6 px, rest, creep in stick, then the object goes on at another speed and the dots stay."""
    speed = np.zeros(slices)
    speed[100:LOAD_MS] = 6.0 / (LOAD_MS - 100)
    speed[LOAD_MS + 100 : onset] = creep_px_ms
    dots = speed.copy()
    speed[onset:] = slide_px_ms
    object_px, along = (np.concatenate([[0.0], np.cumsum(part)]) for part in (speed, dots))
    direction = np.array([np.cos(angle), np.sin(angle)])
    return np.repeat(along[:, None, None] * direction, len(DOTS), axis=1), object_px


def labels(dot_px: np.ndarray, object_px: Sequence[float], start: int = LOAD_MS, **how: float) -> flow.Labels:
    between = scene(dot_px, object_px, **how)
    return event_flow.label(between, len(object_px) - 1, WINDOW, FRAME_PX, DOTS, TRACKING, CONSTANTS, start)


@pytest.mark.parametrize("block", few([1, 3, 7, 650, 1000], 7, 650))
def test_blocks_do_not_change_a_bit(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that labels are the same however few slices are looked at together."""
    dot_px, object_px = slide_of(0.02, 0.1, 600, 650)
    whole = labels(dot_px, object_px)
    monkeypatch.setattr(event_flow, "BLOCK_SLICES", block)
    for one, other in zip(labels(dot_px, object_px), whole, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("speed", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_onset_is_when_slip_px_are_slid(speed: float, angle: float) -> None:
    """Assert that the onset is where the distance is slid, to 2 ms and a fifth of it, along x or y, and certain."""
    begin = 600
    result = labels(*slide_of(0.02, speed, begin, 700, angle))
    wanted = begin + CONSTANTS.slip_distance_px / speed
    assert abs(result.onset - wanted) <= 2 + 0.2 * CONSTANTS.slip_distance_px / speed
    assert result.earliest <= wanted + 1 and wanted - 1 <= result.latest
    assert result.earliest <= result.onset <= result.latest
    assert (result.label[:LOAD_MS] == -1).all()
    assert (result.label[LOAD_MS : result.onset] == 0).all()
    assert result.label[result.onset] == 1
    assert (result.label[result.onset + CONSTANTS.after_ms :] == -1).all()
    assert result.confidence > 0.9
    assert (result.doubt, result.flow_pairs) == ("", 0)


def test_a_slow_slide_has_an_interval_and_the_labels_abstain() -> None:
    """Assert that of a slide that begins slowly, while dots still creep, the interval holds the onset, and is said."""
    dot_px, object_px = slide_of(0.03, 0.0, 600, 900)
    speed = np.clip(0.05 + 0.001 * np.arange(300), 0.0, 0.3)
    object_px[600:] += np.concatenate([[0.0], np.cumsum(speed)])
    dot_px[600:, 4, 0] += 0.02 * np.minimum(np.arange(301), 60)  # at the edge of the contact
    result = labels(dot_px, object_px)
    true = 600 + int(np.argmax(np.cumsum(speed) > 0.5))
    assert result.earliest <= true <= result.latest
    assert "the onset is uncertain within" in result.doubt
    assert (result.label[result.earliest : result.latest + 1] == -1).all()
    assert result.label[result.earliest - 1] == 0
    assert set(result.label[result.latest + 1 : result.onset + CONSTANTS.after_ms]) <= {0, 1}


def test_a_turning_object_takes_dots_along_each_its_own_way() -> None:
    """Assert that there is no slip while the dots turn with the object, and that there is when they stop."""
    dot_px, object_px = slide_of(0.02, 0.2, 600, 660)
    centre = DOTS.mean(axis=0)
    across = (DOTS - centre)[:, ::-1] * [-1.0, 1.0] / np.hypot(*(DOTS - centre).T).clip(1.0)[:, None]
    turned = np.linalg.norm(dot_px, axis=-1)[..., None] * across
    result = labels(turned, object_px)
    assert abs(result.onset - 602) <= 3
    assert (result.label[LOAD_MS : min(result.onset, result.earliest)] == 0).all()


def test_a_false_onset_that_does_not_last_is_none() -> None:
    """Assert that a slide of 1 px that comes to rest is no onset, and that the slip 100 ms after it is found."""
    dot_px, object_px = slide_of(0.0, 0.0, 600, 800)
    object_px[600:] += np.minimum(0.2 * np.arange(len(object_px) - 600), 1.0)
    assert labels(dot_px, object_px).onset == -1
    object_px[700:] += 0.3 * np.arange(len(object_px) - 700)
    assert abs(labels(dot_px, object_px).onset - 701) <= 2


def test_a_slip_that_comes_to_rest_is_doubted() -> None:
    """Assert that labels abstain where a slide of 3 px is over soon, and say that it came to rest."""
    dot_px, object_px = slide_of(0.0, 0.0, 600, 800)
    object_px[600:] += np.minimum(0.3 * np.arange(len(object_px) - 600), 3.0)
    result = labels(dot_px, object_px)
    assert abs(result.onset - 601) <= 2
    assert result.confidence < CONSTANTS.least_confidence
    assert "the slide stopped" in result.doubt
    assert (result.label[result.earliest : result.latest + 1] == -1).all()


def test_without_load_before_the_slip_labels_abstain() -> None:
    """Assert that labels abstain, and why, where the gel never moved with the object before it slid."""
    dot_px, object_px = np.zeros((301, len(DOTS), 2)), np.maximum(0.3 * (np.arange(301) - 200), 0.0)
    result = labels(dot_px, object_px, start=0)
    assert abs(result.onset - 201) <= 3
    assert "did not drag the gel" in result.doubt


def test_gel_that_snaps_back_under_an_object_slides() -> None:
    """Assert that where all dots jump back by 4 px at once the onset is that slice, though the object hardly moves."""
    dot_px, object_px = slide_of(0.02, 0.02, 600, 700)
    dot_px[601:] -= [1.4, 0.0]
    dot_px[602:] -= [1.3, 0.0]
    dot_px[603:] -= [1.3, 0.0]
    object_px[603:] += 0.4 * np.arange(len(object_px) - 603)
    assert abs(labels(dot_px, object_px).onset - 600) <= 1


def test_an_object_that_rests_goes_nowhere() -> None:
    """Assert that noise of a window at rest, 2 events per slice, is no travel: no relative flow beyond its scatter."""
    dot_px, object_px = slide_of(0.0, 0.0, 2000, 2000)
    quiet = scene(dot_px, object_px)
    rng = np.random.default_rng(1)

    def noisy(first: int, last: int) -> Events:
        t = np.sort(rng.integers(1000 * first, 1000 * last, 2 * (last - first)))
        many = [t, rng.integers(565, 640, len(t)), rng.integers(0, 480, len(t)), rng.integers(0, 2, len(t))]
        columns = [np.concatenate(pair) for pair in zip(quiet(first, last), many, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        return Events(*(c[order].astype(d) for c, d in zip(columns, (np.int64, "u2", "u2", "u1"), strict=True)))

    result = event_flow.label(noisy, 2000, WINDOW, FRAME_PX, DOTS, TRACKING, CONSTANTS, LOAD_MS)
    assert result.onset == -1
    travelled_px = result.relative_flow_px[LOAD_MS + 50 :].sum() / CONSTANTS.look_ahead_ms
    assert abs(travelled_px) < 0.5


def test_relative_flow_is_that_of_the_slide_or_not_given() -> None:
    """Assert that relative flow is the slide over the look-ahead to a fifth, and NaN where the window is no measure."""
    result = labels(*slide_of(0.02, 0.5, 600, 700))
    early = result.relative_flow_px[result.onset : result.onset + 10]
    np.testing.assert_allclose(early, 0.5 * CONSTANTS.look_ahead_ms, rtol=0.2)
    beyond = 600 + int(CONSTANTS.seen_slide_px / 0.5) + 5
    assert np.isnan(result.relative_flow_px[beyond:]).all()
    assert np.isfinite(result.relative_flow_px[: result.onset]).all()


def test_an_object_without_texture_is_refused() -> None:
    """Assert that a window without events while the gel is dragged along is an error that says so."""
    with pytest.raises(ValueError, match="texture: expected at least 20"):
        labels(*slide_of(0.02, 0.1, 600, 650), rate=0.0)


def test_a_frame_in_which_dots_cannot_be_followed_is_refused() -> None:
    """Assert that a frame larger than the tracker's is an error that says so."""
    with pytest.raises(ValueError, match="at most 2048 px, found 2049 x 720"):
        event_flow.label(lambda a, b: empty(), 5, WINDOW, (2049, 720), DOTS, TRACKING, CONSTANTS)


def test_missing_dots_are_left_out() -> None:
    """Assert that dots without a place are no dots."""
    dot_px, object_px = slide_of(0.02, 0.1, 600, 650)
    between, slices = scene(dot_px, object_px), len(object_px) - 1
    with_gap = np.concatenate([DOTS, [[np.nan, np.nan]]])
    whole = event_flow.label(between, slices, WINDOW, FRAME_PX, DOTS, TRACKING, CONSTANTS, LOAD_MS)
    gap = event_flow.label(between, slices, WINDOW, FRAME_PX, with_gap, TRACKING, CONSTANTS, LOAD_MS)
    np.testing.assert_array_equal(whole.label, gap.label)


@pytest.mark.parametrize("slices", [0, 1, 2, 60])
def test_nothing_happens(slices: int) -> None:
    """Assert that recordings without events, however short, have no slip and no onset."""
    result = event_flow.label(lambda first, last: empty(), slices, WINDOW, FRAME_PX, DOTS, TRACKING, CONSTANTS)
    assert result.onset == -1
    assert result.label.tolist() == [0] * slices
    assert np.isfinite(result.relative_flow_px).all()


def test_the_slide_that_is_found_is_the_one_that_lasts() -> None:
    """Assert that of evidence for two slides the one that goes on is found, with an interval that a doubt widens."""
    slices = 400
    log_odds, slide_px = np.full(slices, -3.0), np.zeros(slices)
    for first, last in ((100, 105), (200, 300)):
        log_odds[first:last], slide_px[first:last] = 3.0, 0.1
    constants = replace(CONSTANTS, slip_distance_px=0.4)
    sure = event_flow.find(event_flow.Evidence(log_odds, slide_px), 0, constants, 0.4)
    assert sure is not None
    assert abs(sure.onset - 204) <= 1
    assert sure.width_px <= 0.3
    log_odds[190:200], slide_px[190:200] = -0.1, 0.1  # nearly as good
    doubt = event_flow.find(event_flow.Evidence(log_odds, slide_px), 0, constants, 0.4)
    assert doubt is not None
    assert doubt.earliest < 200 <= doubt.latest <= sure.latest
    assert doubt.width_px > 0.5
    longer = replace(constants, lasting_px=9.0)
    assert event_flow.find(event_flow.Evidence(log_odds, slide_px), 250, longer, 0.4) is None
