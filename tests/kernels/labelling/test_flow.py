"""Slip labels from flow: pictures, flow of known motion, and the search for the onset."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.events import Events
from evetac_cli.kernels.labelling import flow

WINDOW, GEL = (540, 0, 640, 480), (0, 0, 540, 480)
CONSTANTS = flow.FlowConstants(0.3, 4, 3, 20, 5, 20, 12)


def columns(x: np.ndarray, y: np.ndarray, p: np.ndarray | None = None) -> Events:
    p = np.ones(len(x)) if p is None else p
    return Events(np.zeros(len(x), np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def moving(start: int, window_px_ms: float, gel_px_ms: float, after: int = 10**9) -> flow.Between:
    """Edges that move along x in the window and in the gel from slice `start` to `after`, seen in every slice."""
    rng = np.random.default_rng(1)
    places = {region: (rng.uniform(region[0], region[2], 60), rng.uniform(0, 460, 60)) for region in (WINDOW, GEL)}

    def between(first: int, last: int) -> Events:
        parts = []
        for region, speed in ((WINDOW, window_px_ms), (GEL, gel_px_ms)):
            x, y = places[region]
            for slice_ in range(max(first, start), min(last, after)):
                at = region[0] + (x - region[0] + speed * (slice_ - start)) % (region[2] - region[0])
                parts += [columns(at, y + down, np.arange(60) % 2) for down in range(12)]
        if not parts:
            return columns(np.empty(0), np.empty(0))
        return Events(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    return between


def test_picture_shows_the_balance_of_polarities() -> None:
    """Assert that a pixel is white, black or grey by its events, and that events outside the region are left out."""
    events = columns(
        np.array([541, 541, 542, 543, 543, 10]), np.array([0, 0, 1, 2, 2, 2]), np.array([1, 1, 0, 1, 0, 1])
    )
    drawn = flow.event_picture(events, WINDOW)
    assert drawn.shape == (480, 100)
    assert drawn[0, 1] == 255
    assert drawn[1, 2] == 1
    assert drawn[2, 3] == flow.GREY
    assert np.count_nonzero(drawn != flow.GREY) == 2


@pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, 2.0), (-2.0, 1.0)])
def test_flow_of_a_shifted_picture(shift: tuple[float, float]) -> None:
    """Assert that a picture shifted by whole pixels has that flow, within 20 %."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(560, 620, 300), rng.uniform(20, 460, 300)
    now = flow.event_picture(columns(x, y), WINDOW)
    later = flow.event_picture(columns(x + shift[0], y + shift[1]), WINDOW)
    assert flow.region_flow(now, later) == pytest.approx(shift, abs=0.2 * np.hypot(*shift))


@pytest.mark.parametrize("start", [83, 100, 117])
def test_onset_is_found_to_the_slice(start: int) -> None:
    """Assert that motion of the window alone is labelled where it begins, within the summed slices, and then holds."""
    labels = flow.label(moving(start, 0.5, 0.0), 200, WINDOW, GEL, CONSTANTS)
    assert start - CONSTANTS.accumulate_ms <= labels.onset <= start + 1
    assert labels.label[: labels.onset].max() == 0
    assert (labels.label[labels.onset : labels.onset + 12] == 1).mean() > 0.9
    assert (labels.label[labels.onset + 12 :] == -1).all()
    assert labels.confidence > 0.9


def test_common_motion_is_no_slip() -> None:
    """Assert that window and gel moving alike are not slip, whatever the speed."""
    labels = flow.label(moving(50, 0.5, 0.5), 150, WINDOW, GEL, CONSTANTS)
    assert labels.onset == -1
    assert labels.label.max() == 0
    assert np.isnan(labels.confidence)


def test_a_short_twitch_is_no_onset() -> None:
    """Assert that motion that does not hold for confirm_ms is not taken for the onset."""
    labels = flow.label(moving(100, 0.5, 0.0, after=103), 200, WINDOW, GEL, CONSTANTS)
    assert labels.onset == -1


def test_slices_before_the_start_are_not_examined() -> None:
    """Assert that a search from slice 60 on leaves the slices before unlabelled and finds nothing in them."""
    labels = flow.label(moving(20, 0.5, 0.0, after=50), 150, WINDOW, GEL, CONSTANTS, start=60)
    assert labels.onset == -1
    assert (labels.label[:60] == -1).all()
    assert (labels.label[60:] == 0).all()
    assert labels.flow_pairs == 0


@pytest.mark.parametrize("threshold", [100, 3000])
def test_event_count(threshold: int) -> None:
    """Assert that counting finds motion where the window's events over the look-ahead pass the threshold, and only."""
    constants = replace(CONSTANTS, method="event-count", threshold_events=threshold)
    labels = flow.label(moving(100, 0.5, 0.0), 200, WINDOW, GEL, constants)
    per_slice = 60 * 12
    first = 100 - constants.look_ahead_ms + threshold // per_slice + 1
    assert labels.onset == (first if threshold < constants.look_ahead_ms * per_slice else -1)
    assert labels.flow_pairs == 0


def test_plain_computes_more_for_the_same_labels() -> None:
    """Assert that computing every pair changes no onset, and that it is more work."""
    given = (moving(60, 0.5, 0.2), 90, WINDOW, GEL)
    short = replace(CONSTANTS, after_ms=0, coarse_ms=5)
    quick = flow.label(*given, short, 45)
    plain = flow.label(*given, replace(short, plain=True, coarse_ms=1), 45)
    assert quick.onset == plain.onset > 45
    assert quick.flow_pairs < plain.flow_pairs


@pytest.mark.parametrize(("window_px_ms", "gel_px_ms"), [(0.5, 0.0), (0.5, 0.45), (0.12, 0.0)])
@pytest.mark.slow
def test_smaller_pictures_do_not_change_the_labels(window_px_ms: float, gel_px_ms: float) -> None:
    """Assert that clear slip told from smaller pictures gives the labels of whole ones, for slip, creep and neither."""
    given = (moving(20, window_px_ms, gel_px_ms), 45, WINDOW, GEL)
    reported = flow.label(*given, CONSTANTS, 15)
    whole = flow.label(*given, replace(CONSTANTS, clear_px=np.inf), 15)
    assert reported.onset == whole.onset
    np.testing.assert_array_equal(reported.label, whole.label)


def test_a_window_without_texture_is_refused() -> None:
    """Assert that a gel full of events beside an empty window is an error that says so."""

    def between(first: int, last: int) -> Events:
        x = np.arange(2000) % 500
        return columns(x, np.arange(2000) // 5)

    with pytest.raises(ValueError, match="texture: expected 20"):
        flow.label(between, 50, WINDOW, GEL, CONSTANTS)


def test_an_interval_follows_from_threshold_and_look_ahead() -> None:
    """Assert that 0.5 px below the threshold may go unseen before, and motion lies anywhere in the images after."""
    labels = flow.label(moving(100, 0.5, 0.0), 160, WINDOW, GEL, CONSTANTS)
    assert (labels.earliest, labels.latest) == (labels.onset - 7, labels.onset + 6)  # 4 * 0.5 / 0.3; 4 + 3 - 1
    assert labels.earliest <= 100 <= labels.latest
    assert labels.doubt == ""
    late = flow.label(moving(100, 0.5, 0.0), 160, WINDOW, GEL, CONSTANTS, start=98)
    assert late.earliest >= 98
    none = flow.label(moving(100, 0.5, 0.5), 160, WINDOW, GEL, CONSTANTS)
    assert (none.onset, none.earliest, none.latest) == (-1, -1, -1)


def test_a_slide_that_comes_to_rest_is_doubted() -> None:
    """Assert that labels abstain where fewer than half of the slices after the onset slip."""
    constants = replace(CONSTANTS, after_ms=60)
    labels = flow.label(moving(100, 0.5, 0.0, after=115), 200, WINDOW, GEL, constants)
    assert labels.onset > 0
    assert labels.confidence < flow.LEAST_CONFIDENCE
    assert "the slide stopped" in labels.doubt
    assert (labels.label[labels.earliest : labels.latest + 1] == -1).all()
