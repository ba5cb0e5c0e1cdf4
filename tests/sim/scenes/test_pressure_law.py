"""Trials whose friction grows less than in proportion to pressure: what they hold, when they slip, and what costs 0."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.sim.scenes.gripped import GraspSimulation
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.sim.setup.scene import Randomised
from evetac_cli.sim.setup.sensor import GelFriction
from evetac_cli.sim.touch_sensor import TouchSensor
from tests.sim.scenes.trials import grasp_of, quiet_plan

COARSE = {"node_pitch_mm": 1.667}
PART = "friction over pressure"


def with_exponent(exponent: float, changes: dict[str, Any] | None = None, **more: float) -> Plan:
    """A quiet slip trial on a gel with a pressure law of its own, whatever that of the scene."""
    planned = quiet_plan("slip", changes or {})
    return replace(planned, sensor=replace(planned.sensor, friction=GelFriction(pressure_exponent=exponent, **more)))


def let_go(trial: GraspSimulation, slices: int = 700) -> Iterator[dict[str, Any]]:
    """The truth of each slice, while the current falls once the object hangs."""
    held_ma = trial.finger.command[1]
    for k in range(slices):
        trial.finger.command = ("current", held_ma - max(0, k - 500) * 0.1)
        trial.step()
        yield trial.truth()


def test_a_law_of_exponent_0_is_that_without_one() -> None:
    """Assert the same bits, forces and dots alike, where the sensor names 0, and where the scene does."""
    assert Randomised.pressure_exponent == (0.67, 0.67)
    of_scene = quiet_plan("slip", {"randomise": {"pressure_exponent": 0.0}})
    plain, zero = (let_go(grasp_of(planned)) for planned in (of_scene, with_exponent(0.0)))
    for one, other in zip(plain, zero, strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])


def test_all_nodes_together_hold_as_before() -> None:
    """Assert that shares of the friction sum to 1 as the grip opens, and that the slip limit is that of Coulomb."""
    coulomb, trial = (grasp_of(with_exponent(exponent)) for exponent in (0.0, 0.67))
    assert trial.pads.slip_limit_n == pytest.approx(coulomb.pads.slip_limit_n, rel=1e-12)
    factors = set()
    for row in let_go(trial, 1100):
        if row["truth/normal_force_n"] > 0.0:
            assert trial.pads.first.gripping(trial.pads.shares).sum() == pytest.approx(1.0, rel=1e-12)
            assert trial.pads.first.friction_factor is not None
            factors.add(float(trial.pads.first.friction_factor.max()))
    assert len(factors) > 100
    assert max(factors) > 1.5


def test_the_contact_slips_later_and_faster() -> None:
    """Assert that less of the visible contact slips while half the way to slip, the less pressure counts."""
    shares = []
    for exponent in (0.0, 0.67, 1.0):
        rows = list(let_go(grasp_of(with_exponent(exponent)), 1100))
        onset = next(k for k, row in enumerate(rows) if row["truth/slip"])
        shares.append(np.mean([row["truth/visible_slip_share"] for row in rows[onset - 150 : onset - 20]]))
    assert shares[0] > shares[1] > shares[2]


@pytest.mark.slow
def test_it_multiplies_what_the_gel_and_the_second_finger_have() -> None:
    """Assert that patches of friction and a second finger's factor stay, and that the slip limit knows them."""
    second = {"gripper": {"second_finger": {"friction_factor": 0.5, "stiffness_factor": 2.0}}}
    patchy = {"patch_spread": 0.2, "patch_mm": 3.0}
    plain, trial = (grasp_of(with_exponent(exponent, second, **patchy)) for exponent in (0.0, 0.67))
    assert trial.pads.second is not None
    for state, own, shares in (
        (trial.pads.first, plain.pads.friction_factor, trial.pads.shares),
        (trial.pads.second.state, trial.pads.second.friction_factor, trial.pads.second.shares),
    ):
        assert state.friction_factor is not None
        assert own is not None
        assert shares is not None
        law = state.friction_factor / own
        assert (law * shares).sum() == pytest.approx(1.0, rel=1e-12)
        assert law[shares > 0].max() > 1.1
    assert trial.pads.slip_limit_n == pytest.approx(plain.pads.slip_limit_n, rel=0.05)
    assert trial.pads.slip_limit_n != plain.pads.slip_limit_n


@pytest.mark.parametrize("exponent", [0.0, 0.67, 1.0])
def test_a_ball_that_slides_drags_with_mu_n(exponent: float, tmp_path: Path) -> None:
    """Assert that a ball dragged over the gel of a touch sensor meets the kinetic friction of its normal force."""
    own = tmp_path / "mine.sensor.toml"
    own.write_text(f'like = "evetac"\n[friction]\nkinetic_share = 0.8\npressure_exponent = {exponent}\n')
    ball = {"shape": "sphere", "width_mm": 40.0, "static_friction": 0.5}
    sensor = TouchSensor(str(own), ball, rng=np.random.default_rng(0), solver=COARSE)
    assert sensor.sampled.pressure_exponent == exponent
    sensor.step(0.02, normal_n=2.0)
    for k in range(20):
        touch = sensor.step(0.01, place_m=(-1e-3 * (k + 1) * 0.25, 0.0))
    assert touch.slip
    assert np.hypot(*touch.shear_n) == pytest.approx(0.8 * 0.5 * 2.0, rel=0.01)
