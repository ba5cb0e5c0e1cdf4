"""scripts/studies/grip/trials.py: what a seed draws, and that rows are not made twice; grip/oracle.py."""

import itertools

import pytest

from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector
from scripts.studies.grip import trials
from tests.quick import few


def test_a_seed_is_a_grasp() -> None:
    """Assert that a seed draws the same grasp again, within the ranges that are told, and another seed another."""
    for seed in (0, 3):
        one = trials.drawn(seed)
        assert one == trials.drawn(seed)
        object = one.plan.object
        assert trials.MASS_G[0] <= object.mass_g <= trials.MASS_G[1]
        assert abs(object.lever_mm) <= trials.LEVER_MM
        assert 0 <= one.latency_ms <= trials.LATENCY_MS
        devices = one.rig(camera=False)
        simulation = devices.gripper.simulation
        assert trials.FRICTION[0] <= simulation.sampled.static_friction <= trials.FRICTION[1] + 1e-9
        assert simulation.holding_n <= trials.MOST_HOLDING_N
        devices.close()
    assert trials.drawn(0) != trials.drawn(3)


def test_the_oracle_holds_by_its_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a light object is kept with little more than 1.5 times what just holds it; margins are refused."""
    monkeypatch.setattr(trials, "LIFT_S", 4.0)
    monkeypatch.setattr(trials, "BALANCE_S", 0.5)
    _, row = trials.play("oracle:1.5", 23)
    assert row["balanced"]
    assert row["over_holding_end"] == pytest.approx(1.5, rel=0.1)
    assert row["force_end_n"] == pytest.approx(1.5 * row["holding_end_n"], rel=0.1)
    with pytest.raises(ValueError, match="margin"):
        trials.grip_oracle.of_name("oracle:0.5", None)


@pytest.mark.slow
@pytest.mark.parametrize("cries", few([False, True], False))
def test_the_grip_is_safe_without_a_detector(monkeypatch: pytest.MonkeyPatch, cries: bool) -> None:
    """Assert that an object is lifted and held where no slip is ever told, and where it always is, within a bound."""
    counts = itertools.count(0, int(cries))
    monkeypatch.setattr(OnlineSlipDetector, "count", property(lambda detector: next(counts)))
    monkeypatch.setattr(trials, "LIFT_S", 3.5)
    monkeypatch.setattr(trials, "BALANCE_S", 0.5)
    arrays, row = trials.play("load-proportional", 116)
    assert row["balanced"], row["failure"]
    assert (arrays["control/slip"][10:] == cries).all()
    assert 1.0 < row["over_holding_end"] < (12.0 if cries else 4.0)
