"""Where a gel ends: as typed, of a simulated sensor, and at the window of a cut one."""

import math

import numpy as np
import pytest

from evetac_cli.commands.predict_touch import PredictTouch
from evetac_cli.errors import InputError
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM
from evetac_cli.stages.touch.known_gel import GelShape, KnownGel, at_window, known_of

DOTS_MM = np.stack(np.meshgrid(np.arange(-8.0, 7.0, 2), np.arange(-6.0, 7.0, 2)), -1).reshape(-1, 2)


def test_typed_edges_count_before_those_of_a_sensor() -> None:
    """Assert that --gel-mm gives the edges, else a named sensor, whose are those of its simulated pad, else none."""
    evetac = known_of("evetac")
    assert evetac.edges_mm == pytest.approx((-12.762, -7.5, 10.528, 7.5))
    assert GelShape.of(PredictTouch(), evetac).edges_mm == evetac.edges_mm
    assert GelShape.of(PredictTouch(), KnownGel()).edges_mm == ENDLESS_MM
    assert GelShape.of(PredictTouch(gel_mm="-9,-8,9.5,8"), evetac).edges_mm == (-9.0, -8.0, 9.5, 8.0)


@pytest.mark.parametrize("typed", ["1", "1,2,3", "a,b,c,d", "9,-8,-9,8", "-9,8,9,8", "nan,0,1,1", "1,2,3,4,5"])
def test_what_are_no_edges_is_refused(typed: str) -> None:
    """Assert an error in words for other than four numbers in order."""
    with pytest.raises(InputError, match="--gel-mm"):
        GelShape.of(PredictTouch(gel_mm=typed), KnownGel())


def test_a_cut_gel_ends_at_its_window() -> None:
    """Assert that a strip beside the dots is an edge, on whichever side, and that a window amid them is none."""
    scale = 0.0329
    cut = at_window(GelShape(), (540, 0, 640, 480), (640, 480), scale, DOTS_MM)
    assert cut.edges_mm == pytest.approx((-math.inf, -math.inf, 220 * scale, math.inf))
    above = at_window(GelShape(), (0, 0, 640, 40), (640, 480), scale, DOTS_MM)
    assert above.edges_mm == pytest.approx((-math.inf, -200 * scale, math.inf, math.inf))
    nearer = GelShape(edges_mm=(-9.0, -9.0, 6.5, 9.0))
    assert at_window(nearer, (540, 0, 640, 480), (640, 480), scale, DOTS_MM) == nearer
    assert at_window(nearer, (300, 200, 340, 240), (640, 480), scale, DOTS_MM) == nearer
    assert at_window(nearer, None, (640, 480), scale, DOTS_MM) == nearer
