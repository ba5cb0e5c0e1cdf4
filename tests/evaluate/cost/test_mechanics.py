"""Error against run time where friction falls with speed: onset by hand, rows of one shape, errors that fall."""

import math

import numpy as np
import pytest

from evetac_cli.evaluate.cost import simulator as cost
from evetac_cli.evaluate.cost.simulator import draw_trial, onset_ms, solve
from evetac_cli.sim.setup.scene import Solver


def test_onset_by_hand() -> None:
    """Assert that the onset is interpolated between slices, from the very first one on, and may be missing."""
    assert onset_ms(np.array([0.0, 0.25, 0.75])) == pytest.approx(2.5)
    assert onset_ms(np.array([1.0])) == pytest.approx(0.5)
    assert math.isnan(onset_ms(np.array([0.0, 0.5])))


def test_loads_of_both_unloadings() -> None:
    """Assert the grip and weight of the two unloadings at their corners in time."""
    fast, slow = (unload(draw_trial(1)) for unload in cost.unloadings().values())
    assert (fast.load(0.0), fast.load(0.1)) == pytest.approx((2.0, 1.1))
    assert fast.force_at(0.0)[0] == pytest.approx(0.981)
    assert (slow.load(0.1), slow.load(0.2), slow.load(0.36)) == pytest.approx((1.1, 0.9, 0.58))
    assert (slow.force_at(0.04)[0], slow.force_at(0.3)[0]) == pytest.approx((0.4905, 0.981))


def test_errors_fall_with_the_step() -> None:
    """Assert that with constant friction a tenth of the step has at most a third of the error, by onset and object."""
    trial = draw_trial(0)
    finest = solve(trial, Solver(step_ms=0.02, theta=0.51, residual=1e-8, node_pitch_mm=1.67))
    coarse, fine = (
        cost._errors(solve(trial, Solver(step_ms=step_ms, node_pitch_mm=1.67)), finest) for step_ms in (1.0, 0.1)
    )
    assert 0 < onset_ms(finest.slid_px) < 200
    assert abs(fine[0]) < abs(coarse[0]) / 3
    assert fine[1] < coarse[1] / 3
