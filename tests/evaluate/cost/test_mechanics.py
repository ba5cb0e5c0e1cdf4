"""Error against run time where friction falls with speed: onset by hand, rows of one shape, errors that fall."""

import json
import math

import numpy as np
import pytest

from evetac_cli.evaluate.common.rows import Extent
from evetac_cli.evaluate.cost import simulator as cost
from evetac_cli.evaluate.cost.simulator import draw_trial, onset_ms, solve
from evetac_cli.sim.setup.solver import Solver


def test_onset_by_hand() -> None:
    """Assert that the onset is interpolated between slices, from the very first one on, and may be missing."""
    assert onset_ms(np.array([0.0, 0.25, 0.75])) == pytest.approx(2.5)
    assert onset_ms(np.array([1.0])) == pytest.approx(0.5)
    assert math.isnan(onset_ms(np.array([0.0, 0.5])))


def test_loads_of_both_unloadings() -> None:
    """Assert the grip and weight of the two unloadings at their corners in time."""
    fast, slow = (unload(draw_trial(1)) for unload in cost.unloadings().values())
    assert (fast.grip_n(0.0), fast.grip_n(0.1)) == pytest.approx((2.0, 1.1))
    assert fast.weight_n(0.0)[0] == pytest.approx(0.981)
    assert (slow.grip_n(0.1), slow.grip_n(0.2), slow.grip_n(0.36)) == pytest.approx((1.1, 0.9, 0.58))
    assert (slow.weight_n(0.04)[0], slow.weight_n(0.3)[0]) == pytest.approx((0.4905, 0.981))


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
    assert fine[2] < coarse[2] / 3


@pytest.mark.slow
def test_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert as many rows as announced, of one shape, each with its flags, which JSON can hold."""
    for name, amount in {
        "STEPS_MS": (1.0, 0.5), "REFERENCE_STEP_MS": 0.25, "REFERENCE_PITCH_MM": 1.67, "PITCHES_MM": (2.5,),
        "TRIALS": 2, "TOLERANCES_UM": (5.0,),
    }.items():  # fmt: skip
        monkeypatch.setattr(cost, name, Extent(amount, amount))
    rows = list(cost.mechanics_rows(5, False))
    assert len(rows) == 2 * 3 * len(cost.choices(False))
    assert len({row["part"] for row in rows}) == 6
    assert len({tuple(row) for row in rows}) == 1
    json.dumps(rows, allow_nan=False)
    assert {"--step-ms 0.5", "--tolerance 5", "--node-pitch-mm 2.5 --step-ms 0.25"} <= {row["flags"] for row in rows}
    assert all(0 < row["time_us_median"] <= row["time_us_p99"] for row in rows)
    assert all(row["error_px_before"] == pytest.approx(row["error_um_before"] / 32.9) for row in rows)
    assert list(cost.mechanics_rows(5, False, trials=1))[0]["trials"] == 1
