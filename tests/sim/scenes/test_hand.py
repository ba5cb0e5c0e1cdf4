"""The hand's motion: closed forms of its profiles, and its vibration as the object feels it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.sim.scenes.held_object import FADE_S, Hand
from evetac_cli.sim.scenes.shared import GRAVITY_M_S2, STEP_S
from evetac_cli.sim.setup.held import HandSettings
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.tables import read_table
from tests.sim.scenes.trials import grasp_of, quiet_plan

LIFT = {"height_mm": 60.0, "speed_mm_s": 100.0, "acceleration_mm_s2": 500.0}
SHAKES = {"frequency_hz": [18.0, 41.0], "acceleration_m_s2": [0.6, 0.3]}


def speeds(hand: dict[str, Any], slices: int = 1500) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speed at the end of each slice, and acceleration within it, of a hand that rises from 0.2 s on."""
    planned = first_plan("lift")
    time = replace(planned.scene.time, touch_s=0.2, before_rise_s=0.0)
    scene = replace(planned.scene, time=time, hand=read_table(HandSettings, hand, "here"))
    one = Hand(replace(planned, scene=scene), np.random.default_rng(1))
    rows = [(one.accelerate(k), one.speed_m_s) for k in range(slices)]
    acceleration, speed = np.array(rows).T
    return speed, acceleration


@pytest.mark.parametrize("profile", ["trapezoid", "s-curve", "steps"])
def test_profiles_rise_by_the_height(profile: str) -> None:
    """Assert height, speed and largest acceleration as named, and speeds in steps of 8 ms only in that profile."""
    speed, acceleration = speeds({**LIFT, "profile": profile})
    assert speed.sum() * STEP_S == pytest.approx(60e-3, rel=1e-9)
    assert speed.max() == pytest.approx(0.1, rel=1e-12)
    assert np.flatnonzero(speed)[0] == pytest.approx(200, abs=8)
    np.testing.assert_allclose(np.cumsum(acceleration) * STEP_S, speed, atol=1e-12)
    if profile == "steps":
        changes = np.flatnonzero(acceleration)
        assert set(np.diff(changes[changes < 400])) == {8}
        assert acceleration.max() == pytest.approx(0.5 * 8, rel=1e-9)  # a step of 8 ms within 1 ms
    else:
        assert acceleration.max() == pytest.approx(0.5, rel=1e-3)
        assert -acceleration.min() == pytest.approx(0.5, rel=1e-3)
    largest_change = np.abs(np.diff(acceleration)).max()
    assert largest_change == pytest.approx({"trapezoid": 0.5, "s-curve": 5e-3, "steps": 4.0}[profile], rel=0.01)


def test_a_vibration_has_the_amplitudes_named() -> None:
    """Assert that a fit of sine waves finds the named accelerations, and that phases are random but of their stream."""
    acceleration = speeds({"vibration": SHAKES})[1]
    times = (np.arange(1500) + 0.5) * STEP_S
    whole = times > FADE_S
    waves = np.concatenate([[np.sin(2 * np.pi * f * times), np.cos(2 * np.pi * f * times)] for f in (18.0, 41.0)])
    parts = np.linalg.lstsq(waves[:, whole].T, acceleration[whole], rcond=None)[0].reshape(2, 2)
    np.testing.assert_allclose(np.hypot(*parts.T), [0.6, 0.3], rtol=0.005)  # 1 ms takes 0.3 % off 41 Hz
    assert np.abs(acceleration).max() < 0.95
    angles = np.arctan2(parts[:, 1], parts[:, 0])
    drawn = np.random.default_rng(1).uniform(0, 2 * np.pi, 2)
    np.testing.assert_allclose(np.cos(angles - drawn), 1.0, atol=1e-4)


def test_only_while_it_moves() -> None:
    """Assert that such a vibration is there while the hand rises, and before and after it nothing is."""
    plain = speeds(LIFT)[0]
    shaken = speeds({**LIFT, "vibration": {**SHAKES, "only_moving": True}})[0]
    moves = plain > 0.0
    assert np.array_equal(plain[~moves], shaken[~moves])
    assert np.abs((shaken - plain)[moves]).max() > 3e-3
    always = speeds({**LIFT, "vibration": SHAKES})[0]
    middle = slice(450, 600)
    np.testing.assert_allclose(always[middle], shaken[middle], atol=1e-15)
    assert np.abs((always - plain)[:200]).max() > 3e-3


def test_a_held_object_is_shaken() -> None:
    """Assert m dv/dt = m (g + a) - 2 F in each slice, with a the acceleration of the hand, and equal samples."""
    shakes = {"vibration": SHAKES}
    planned = quiet_plan("slip", {"hand": shakes})
    held, still = grasp_of(planned), grasp_of(quiet_plan("slip"))
    assert held.sampled == still.sampled
    mass_kg, fall_m_s, friction_n, moved = held.sampled.mass_kg, [], [], []
    for one in (held, still):
        for _ in range(900):
            one.step()
            if one is held:
                fall_m_s.append(one.pads.first.twist[0])
                friction_n.append(one.truth()["truth/shear_force_n"][0])
        moved.append(one.truth()["truth/object_xy_px"][0])
    hand = Hand(planned, np.random.default_rng(0).spawn(2)[1])
    expected = np.array([hand.accelerate(k) for k in range(900)])
    acting = np.diff(fall_m_s, prepend=0.0) / STEP_S + 2 * np.array(friction_n) / mass_kg - GRAVITY_M_S2
    loaded = slice(600, 900)
    np.testing.assert_allclose(acting[loaded], expected[loaded], atol=2e-3)
    assert np.abs(acting[loaded]).max() > 0.5
    assert moved[0] != moved[1]


def test_an_object_on_a_table_goes_with_the_table() -> None:
    """Assert that, seen from a hand that vibrates, what stands on the table swings by A / w^2."""
    vibration = {"frequency_hz": [10.0], "acceleration_m_s2": [1.0]}
    shaken = grasp_of(quiet_plan("lift", {"hand": {"vibration": vibration}}), lift_s=2.0)
    swing_m = []
    for k in range(700):
        shaken.step()
        if k >= 100:
            swing_m.append(shaken.held.fallen_m)
            assert abs(shaken.truth()["truth/table_gap_mm"]) < 0.01
    assert np.ptp(swing_m) / 2 == pytest.approx(1.0 / (2 * np.pi * 10.0) ** 2, rel=0.02)
