"""What a press tells, as rows and keys: from estimates that are given."""

from dataclasses import replace

import numpy as np
import pytest

from evetac_cli.kernels.estimates import Estimate
from evetac_cli.kernels.identify.dots import Optics, RimProfile
from evetac_cli.sim.camera.gel_camera import Lens
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages.identify import pressed

FRAME_PX = (640, 480)
GRID = np.stack(np.meshgrid(np.linspace(60, 560, 9), np.linspace(40, 420, 7)), axis=-1)
LIKE = replace(one_sensor("evetac"), log_contrast=1.6)
SURE, NONE = Estimate(0.05, 0.04, 0.06), Estimate(0.0, 0.0, 0.01)


def press(**changed: object) -> pressed.Press:
    """A press that tells everything of dots that are alike, before a flat lens, with one threshold."""
    optics = Optics(Estimate(15.0, 14.9, 15.1), Estimate(1.2, 1.1, 1.3), Estimate(8.0, 7.5, 8.5), NONE, NONE)
    usual = pressed.Press(
        dot_xy_px=GRID,
        jitter_px=0.1,
        optics=optics,
        lens_k1=Estimate(0.001, -0.006, 0.008),
        off_over_on=Estimate(1.0, 0.98, 1.02),
        mismatch=SURE,
        is_apart=False,
        profile=RimProfile(np.zeros(1), np.zeros(1)),
        frame_px=FRAME_PX,
        source="press.recording.h5",
    )
    return replace(usual, **changed)


def test_what_may_not_be_there_is_not_written() -> None:
    """Assert that spreads, lens and second threshold are rows of the table, but no keys where they may be nothing."""
    rows, values = pressed.rows(press(), LIKE)
    assert {row.parameter for row in rows} >= set(pressed.UNITS)
    absent = {"threshold_off", "distortion", "dot_radius_spread", "dot_contrast_spread"}
    assert not absent & set(values)
    assert values["threshold"].value == pytest.approx(0.2)
    np.testing.assert_array_equal(values["dot_xy_px"].value, GRID)


def test_what_the_named_sensor_has_and_the_press_does_not_show_is_taken_away() -> None:
    """Assert that dots as seen are not moved by the lens of `--like` too, nor thresholds told apart by its own."""
    like = replace(LIKE, distortion=(-0.03, 0.0), threshold_off=0.3, dot_radius_spread=0.04)
    _, values = pressed.rows(press(), like)
    assert values["distortion"].value.tolist() == [0.0, 0.0]
    assert values["threshold_off"].value == values["threshold"].value
    assert values["dot_radius_spread"].value == 0.0
    assert "dot_contrast_spread" not in values
    few = GRID.copy()
    few[:, :4] = np.nan
    _, values = pressed.rows(press(dot_xy_px=few), like)
    assert not {"dot_xy_px", "distortion"} & set(values)  # both as of `--like`


def test_what_is_there_is_written() -> None:
    """Assert that all of them are keys where they surely are there, and that dots then lie where no lens moves them."""
    lens = Lens(FRAME_PX, -0.04, 0.0)
    optics = press().optics._replace(dot_radius_spread=SURE, dot_contrast_spread=SURE)
    _, values = pressed.rows(
        press(
            optics=optics,
            dot_xy_px=lens.seen(GRID),
            lens_k1=Estimate(-0.04, -0.048, -0.032),
            off_over_on=Estimate(1.2, 1.18, 1.22),
            is_apart=True,
        ),
        LIKE,
    )
    assert values["threshold_off"].value == pytest.approx(0.24)
    assert values["distortion"].value.tolist() == [-0.04, 0.0]
    assert values["dot_radius_spread"].value == values["dot_contrast_spread"].value == 0.05
    np.testing.assert_allclose(values["dot_xy_px"].value, GRID, atol=1e-6)


def test_dots_that_are_not_seen() -> None:
    """Assert that a few missing dots lie where the others let expect them, and that with many no places are told."""
    few, many = GRID.copy(), GRID.copy()
    few[[0, 3, 6], [0, 4, 8]] = np.nan
    many[:, :4] = np.nan
    _, values = pressed.rows(press(dot_xy_px=few), LIKE)
    np.testing.assert_allclose(values["dot_xy_px"].value, GRID, atol=0.01)
    assert "3 that were not seen" in values["dot_xy_px"].source
    rows, values = pressed.rows(press(dot_xy_px=many), LIKE)
    place = next(row for row in rows if row.parameter == pressed.PLACE)
    assert "dot_xy_px" not in values and place.estimate is None and "press on the whole gel" in place.source


def test_what_a_press_cannot_tell() -> None:
    """Assert that bandwidth and leak, and a lens before another grid, say which recording would tell them."""
    rows = {row.parameter: row for row in pressed.rows(press(lens_k1=None), LIKE)[0]}
    for name in ("bandwidth_hz", "leak_hz", "distortion", "log_contrast"):
        assert rows[name].estimate is None and rows[name].source.startswith("cannot be estimated"), name


def test_a_lens_that_uneven_dots_hide() -> None:
    """Assert the stated rule: a lens whose interval is wider than WIDEST_LENS is neither a row's estimate nor a key."""
    vague = Estimate(-0.04, -0.04 - 0.6 * pressed.WIDEST_LENS, -0.04 + 0.6 * pressed.WIDEST_LENS)
    listed, values = pressed.rows(press(lens_k1=vague), LIKE)
    row = next(row for row in listed if row.parameter == "distortion")
    assert row.estimate is None and "unevenly" in row.source and "distortion" not in values
