"""What places of dots say of their gel: room at its borders, the window beside them, and how the sensor is mounted."""

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.calibration import gel_layout

Grid = NDArray[np.float64]
FRAME_PX = (640, 480)
WHOLE = np.stack(np.meshgrid(60.0 + 62.5 * np.arange(9), 41.0 + 62.5 * np.arange(7)), axis=-1)  # x 60..560, y 41..416
CUT = WHOLE[:, :8]


def turned(dots: Grid, quarters: int) -> tuple[Grid, tuple[int, int]]:
    """Dots and frame as seen by a sensor that is turned anticlockwise by quarters of a turn."""
    width, height = FRAME_PX
    for _ in range(quarters):
        dots = np.rot90(dots)[..., ::-1] * (1, -1) + (0, width - 1)
        width, height = height, width
    return dots, (width, height)


def test_margins_in_pitches() -> None:
    """Assert the distances from the outermost dots to the border, also where a whole column is missing."""
    expected = np.array([60, 41, 640 - 560, 480 - 416]) / 62.5
    np.testing.assert_allclose(gel_layout.margins(WHOLE, FRAME_PX), expected)
    worn = WHOLE.copy()
    worn[:, 0] = worn[3, 4] = np.nan
    np.testing.assert_allclose(gel_layout.margins(worn, FRAME_PX), expected)
    stretched = WHOLE * (1.0, 0.8) + (0, 50)
    expected_stretched = np.array([60 / 62.5, 82.8 / 50, 80 / 62.5, (480 - 382.8) / 50])
    np.testing.assert_allclose(gel_layout.margins(stretched, FRAME_PX), expected_stretched)
    in_no_grid = WHOLE.reshape(1, -1, 2)
    np.testing.assert_allclose(gel_layout.margins(in_no_grid, FRAME_PX), expected)


def test_free_sides() -> None:
    """Assert that a whole gel has no room for more dots, and one without a column has it there."""
    assert gel_layout.free_sides(WHOLE, FRAME_PX) == []
    assert gel_layout.free_sides(CUT, FRAME_PX) == ["right"]
    assert gel_layout.free_sides(WHOLE[1:, 1:], FRAME_PX) == ["left", "top"]
    assert gel_layout.free_sides(WHOLE + (80, 60), (800, 600)) == list(gel_layout.SIDES)


@pytest.mark.parametrize(
    ("quarters", "side", "window"),
    [
        (0, "right", (540, 0, 640, 480)),
        (1, "top", (0, 0, 480, 100)),
        (2, "left", (0, 0, 100, 480)),
        (3, "bottom", (0, 540, 480, 640)),
    ],
)
def test_the_window_of_a_cut_gel(quarters: int, side: str, window: tuple[int, int, int, int]) -> None:
    """Assert that the window is found where the column was cut away, however the sensor is turned."""
    dots, frame_px = turned(CUT, quarters)
    assert gel_layout.window(dots, 15.0, frame_px) == (side, window)
    assert not gel_layout.touches(window, dots, 15.0)
    assert gel_layout.window(dots.reshape(1, -1, 2), 15.0, frame_px) == (side, window)


def test_a_window_that_would_touch_dots_is_narrower() -> None:
    """Assert that dots closer than an Evetac's leave a window from half way to the column that was cut away."""
    dots = CUT * (1.06, 1.0)  # x 64..527
    side, (x0, y0, x1, y1) = gel_layout.window(dots, 15.0, FRAME_PX)
    assert (side, y0, x1, y1) == ("right", 0, 640, 480)
    assert x0 == pytest.approx(1.06 * (497.5 + 62.5 / 2), abs=1)
    assert not gel_layout.touches((x0, y0, x1, y1), dots, 15.0)
    assert gel_layout.touches((x0 - 20, y0, x1, y1), dots, 15.0)


@pytest.mark.parametrize(
    ("dots", "words"),
    [
        (WHOLE, "no room"),
        (WHOLE[:, 1:8], "several sides: left, right"),
        (WHOLE[1:6, 1:8], "several sides"),
    ],
    ids=["whole", "two columns", "all around"],
)
def test_where_no_window_can_be_told(dots: Grid, words: str) -> None:
    """Assert that a window is not made up where there is no room for it, or as much on several sides."""
    with pytest.raises(ValueError, match=words):
        gel_layout.window(dots, 15.0, FRAME_PX)


@pytest.mark.parametrize(
    "shown",
    [np.s_[:, 1:], np.s_[:, :-1], np.s_[1:], np.s_[:-1], np.s_[1:, 1:], np.s_[:-1, 1:], np.s_[:, 1:-1], np.s_[:, 2:]],
    ids=str,
)
@pytest.mark.parametrize("quarters", range(4))
def test_rows_and_columns_that_do_not_show(shown: tuple[slice, ...], quarters: int) -> None:
    """Assert that what is missing at the border of a closed gel is put where the gel is, for any mounting."""
    expected = np.full_like(WHOLE, np.nan)
    expected[shown] = WHOLE[shown]
    dots, frame_px = turned(WHOLE[shown], quarters)
    whole, _ = turned(expected, quarters)
    np.testing.assert_array_equal(gel_layout.completed(dots, whole.shape[:2], frame_px), whole)


@pytest.mark.parametrize(
    ("dots", "size", "words"),
    [
        (WHOLE, (7, 8), "more columns"),
        (WHOLE, (6, 9), "more rows"),
        (WHOLE[:, 1:], (7, 10), "which column"),
        (WHOLE, (8, 9), "which row"),
    ],
    ids=["columns", "rows", "more than fit", "one too many"],
)
def test_what_cannot_be_completed(dots: Grid, size: tuple[int, int], words: str) -> None:
    """Assert that a size that does not fit is refused, and no dot is put where there is no room."""
    with pytest.raises(ValueError, match=words):
        gel_layout.completed(dots, size, FRAME_PX)


def test_how_a_closed_gel_is_mounted() -> None:
    """Assert that only a turn by 90 degrees is said of a closed gel, whose dots look the same in other mountings."""
    assert gel_layout.mounting(WHOLE, FRAME_PX, None) == gel_layout.mounting(WHOLE[::-1, ::-1], FRAME_PX, None) == ""
    for quarters in (1, 3):
        assert "turned by 90 degrees" in gel_layout.mounting(*turned(WHOLE, quarters), None)


def test_how_a_cut_gel_is_mounted() -> None:
    """Assert that the place of the window says it for a cut gel."""
    for quarters, words in ((0, ""), (1, "by 90 degrees"), (2, "by 180 degrees"), (3, "by 90 degrees")):
        dots, frame_px = turned(CUT, quarters)
        _, window = gel_layout.window(dots, 15.0, frame_px)
        said = gel_layout.mounting(dots, frame_px, window)
        assert words in said and bool(words) == bool(said)
    mirrored = CUT[:, ::-1] * (-1, 1) + (639, 0)
    assert "mirrored" in gel_layout.mounting(mirrored, FRAME_PX, (0, 0, 100, 480))
