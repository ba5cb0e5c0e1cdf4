"""Touch features: hand-made values, live equals whole recording bit for bit, and what a rotation keeps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from evetac_cli.kernels.event_representation import event_image
from evetac_cli.kernels.slip import features
from evetac_cli.kernels.slip.features import DOT_CAPACITY, HISTORY_CAPACITY

REST = np.array([[100.0, 50.0], [200.0, 50.0], [np.nan, np.nan]])


def random_tracks(seed: int, slices: int, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Random rest places (n, 2) with one missing dot, tracks (slices, n, 2) and events per dot (slices, n)."""
    rng = np.random.default_rng(seed)
    rest = rng.uniform(0, 480, (n, 2))
    rest[n // 2] = np.nan
    tracks = rest + np.cumsum(rng.normal(0, 1, (slices, n, 2)), axis=0)
    return rest, tracks, rng.poisson(3, (slices, n)).astype(np.int32)


def test_displacement_by_hand() -> None:
    """Assert that (3, 4) px away is 5 px, that a missing dot is at 0, and that slices are taken one by one."""
    now = REST + (3, 4)
    assert features.displacement(now, REST).tolist() == [5, 5, 0]
    track = np.stack([REST, now, REST - (0, 1)])
    displacement_px = features.displacement(track, REST)
    assert displacement_px.dtype == np.float32
    assert displacement_px.tolist() == [[0, 0, 0], [5, 5, 0], [1, 1, 0]]


def test_directions_by_hand() -> None:
    """Assert that right and down are positive, that a missing dot is at 0, and that their norm is the displacement."""
    now = REST + (3, -4)
    assert features.displacement_xy(now, REST).tolist() == [[3, -4], [3, -4], [0, 0]]
    rest, tracks, _ = random_tracks(4, 20, 56)
    length = np.linalg.norm(features.displacement_xy(tracks, rest), axis=2)
    assert length == pytest.approx(features.displacement(tracks, rest), abs=1e-4)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), history=st.sampled_from([1, 2, 3, 10, 20]), n=st.sampled_from([1, 2, 56, 63]))
def test_live_equals_recording(seed: int, history: int, n: int) -> None:
    """Assert that the last slices taken one by one are the same bits as those of the recording."""
    slices = 2 * history + 3
    rest, tracks, events = random_tracks(seed, slices, n)
    stored = tracks.astype(np.float32)
    distance = features.displacement(stored, rest)
    expected = features.series(distance, events)
    assert expected.shape == (slices, n, 2)
    np.testing.assert_array_equal(expected[..., 0], distance)
    np.testing.assert_array_equal(expected[..., 1], events)
    state = features.start(rest, history)
    for k in range(slices):
        features.step(state, tracks[k], events[k])
        if k >= history - 1:
            windows = features.latest_slices(state.record)
            assert windows.dtype == np.float32
            assert windows.tobytes() == expected[k - history + 1 : k + 1].tobytes()


def test_the_largest_state_fits() -> None:
    """Assert that as many dots and slices as there is room for give what the whole recording gives, to the last bit."""
    rest, tracks, events = random_tracks(7, HISTORY_CAPACITY + 5, DOT_CAPACITY)
    state = features.start(rest, HISTORY_CAPACITY)
    for dot_xy_px, counts in zip(tracks, events, strict=True):
        features.step(state, dot_xy_px, counts)
    expected = features.series(features.displacement(tracks, rest), events)
    assert features.latest_slices(state.record).tobytes() == expected[5:].tobytes()


def test_channels_by_hand() -> None:
    """Assert the order of slices (oldest first) and of channels: distance, events."""
    rest = np.array([[10.0, 10.0], [20.0, 20.0]])
    state = features.start(rest, 2)
    for k in range(5):
        features.step(state, rest + np.array([[k, 0], [0, -10 * k]]), np.array([100 + k, 200 + k], np.int32))
    assert features.latest_slices(state.record).tolist() == [
        [[3, 103], [30, 203]],
        [[4, 104], [40, 204]],
    ]


def numbered(rows: int = 7, columns: int = 8) -> NDArray[np.float32]:
    """Two windows (2, rows, columns, 3) with all values different and none 0."""
    return np.arange(1, 2 * rows * columns * 3 + 1, dtype=np.float32).reshape(2, rows, columns, 3)


def test_quarter_turn_by_hand() -> None:
    """Assert that a quarter turn counter-clockwise brings the last column to the top and the leftmost column out."""
    windows = numbered()
    turned = features.rotate(windows, 1)
    assert turned.shape == windows.shape
    assert (turned[:, 0, 1:] == windows[:, :, 7]).all()
    assert (turned[:, 6, 1:] == windows[:, :, 1]).all()
    assert (turned[:, :, 0] == 0).all()
    back = features.rotate(windows, 3)
    assert (back[:, 6, 1:] == windows[:, ::-1, 7]).all()
    assert (back[:, 0, 1:] == windows[:, ::-1, 1]).all()
    assert (back[:, :, 0] == 0).all()
    assert (features.rotate(windows, -1) == back).all()


def test_quarter_turns_add_up_to_the_crop() -> None:
    """Assert that 1 + 3, 3 + 1 and 1 + 1 + 1 + 1 quarter turns give back all but the leftmost column, in its place."""
    windows = numbered()
    expected = windows.copy()
    expected[:, :, 0] = 0
    for turns in ((1, 3), (3, 1), (1, 1, 1, 1), (3, 3, 3, 3)):
        turned = windows
        for turn in turns:
            turned = features.rotate(turned, turn)
        assert (turned == expected).all()


@pytest.mark.parametrize(("rows", "columns", "first"), [(7, 9, 1), (3, 3, 0), (2, 5, 2), (1, 4, 2)])
def test_quarter_turns_of_other_grids(rows: int, columns: int, first: int) -> None:
    """Assert that the middle square of any grid turns about itself and that nothing is left beside it."""
    windows = numbered(rows, columns)
    for turn in (1, 3):
        turned = features.rotate(windows, turn)
        square = turned[:, :, first : first + rows]
        for r in range(rows):
            for c in range(rows):
                row, column = (c, rows - 1 - r) if turn == 1 else (rows - 1 - c, r)
                assert (square[:, r, c] == windows[:, row, first + column]).all()
        assert np.count_nonzero(turned) == square.size


def test_events_outside_the_window() -> None:
    """Assert that the window's first column and row are inside, its ends outside, and that a gel may have no window."""
    x = np.array([539, 540, 639, 540, 540, 10], np.uint16)
    y = np.array([0, 0, 479, 100, 480, 50], np.uint16)
    whole = np.array([0, 6])
    assert features.events_outside(x, y, whole, (540, 0, 640, 480)) == [3]
    assert features.events_outside(x, y, whole, np.array([540, 100, 640, 480], np.int32)) == [4]
    assert features.events_outside(x, y, whole, (500, 0, 540, 480)) == [5]
    assert features.events_outside(x, y, whole, (540, 0, 640, 100)) == [5]
    assert features.events_outside(x, y, whole, None) == [6]
    slices = np.array([0, 0, 2, 5, 6, 6])
    assert features.events_outside(x, y, slices, (540, 0, 640, 480)).tolist() == [0, 1, 1, 1, 0]
    assert features.events_outside(x, y, slices, None).tolist() == [0, 2, 3, 1, 0]
    assert features.events_outside(x[:0], y[:0], np.zeros(2, np.int64), (540, 0, 640, 480)) == [0]


def test_event_image_shows_the_last_event() -> None:
    """Assert that a pixel shows the sign of its last event, others 0, and that events beyond the frame are left out."""
    x = np.array([3, 3, 5, 5, 640, 0], np.uint16)
    y = np.array([4, 4, 6, 6, 0, 480], np.uint16)
    p = np.array([1, 0, 0, 1, 1, 1], np.uint8)
    image = event_image(x, y, p)
    assert image.shape == (480, 640)
    assert image.dtype == np.int8
    assert (image[4, 3], image[6, 5]) == (-1, 1)
    assert np.count_nonzero(image) == 2
    assert event_image(x, y, p, (4, 5)).tolist() == [[0] * 4] * 4 + [[0, 0, 0, -1]]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), count=st.sampled_from([0, 1, 50, 3000]), window=st.booleans())
def test_gel_image_is_the_event_image_without_the_window(seed: int, count: int, window: bool) -> None:
    """Assert that its pixels put back give the event image of 540 x 480 px, 0 in the window, and none twice."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 640, count, np.uint16), rng.integers(0, 480, count, np.uint16)
    x[: count // 3], y[: count // 3] = x[: count // 3] % 4 + 530, y[: count // 3] % 3  # some pixels often
    p = rng.integers(0, 2, count, np.uint8)
    blank = np.zeros((480, 540), np.int8)
    pixel, sign = features.gel_image(x, y, p, (532, 1, 640, 470) if window else None, blank)
    expected = event_image(x, y, p, (540, 480))
    if window:
        expected[1:470, 532:] = 0
    assert not blank.any()
    assert len(np.unique(pixel)) == len(pixel)
    blank.reshape(-1)[pixel] = sign
    np.testing.assert_array_equal(blank, expected)
