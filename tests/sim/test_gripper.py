"""The drive of a finger: friction band, rest, hysteresis, limits, quantisation, stiff cases."""

import dataclasses

import numpy as np
import pytest

from evetac_cli.sim.gel.contact import cell_area, closing_at, force_curve, gap_profile, lookup, pad_nodes
from evetac_cli.sim.gripper import (
    Drive,
    closed_with,
    closing_push_n,
    gap_m,
    metres_per_tick,
    opening_push_n,
    start,
    step,
    ticks_at_gap,
)

TOUCH_TICKS = 437.0


def make_curve(shape="cylinder", width_m=0.048, finger_n_m=1.8e3, modulus_pa=1e6):
    nodes = pad_nodes(10, 14, (-10e-3, 10e-3), (-7.5e-3, 7.5e-3))
    gap = gap_profile(nodes, shape, width_m / 2, 3e-3)
    return force_curve(gap, modulus_pa / 4e-3 * cell_area(nodes), 4e-3, finger_n_m, metres_per_tick(width_m))


CURVE = make_curve()
DRIVE = Drive()


def settle(state, mode, command, seconds, dt_s=1e-3, drive=DRIVE, curve=CURVE):
    """Step under a command, or a function of the state; returns all forces and speeds on the way."""
    trace = []
    for _ in range(round(seconds / dt_s)):
        wanted = command(state) if callable(command) else command
        trace.append((step(state, drive, curve, mode, wanted, dt_s), state.speed_m_s))
    return np.array(trace)


def rest_n(current_ma, drive=DRIVE):
    """N at rest after closing with a current."""
    return (drive.force_per_current_n_ma * current_ma - drive.friction_n) / (1 + drive.friction_share)


@pytest.mark.parametrize("force_n", [0.2, 1.0, 3.0])
def test_stays_at_rest_inside_the_friction_band(force_n):
    """Assert that a finger at rest does not move by a hair while |kF I - N| <= Fc + fl N, and does just outside."""
    band_n = DRIVE.friction_n + DRIVE.friction_share * force_n
    for current_ma in range(-20, 40):
        state = start(DRIVE, CURVE, TOUCH_TICKS, closing_at(CURVE, force_n))
        before = state.closing_ticks
        settle(state, "current", current_ma, 0.02)
        surplus_n = DRIVE.force_per_current_n_ma * current_ma - force_n
        assert (state.closing_ticks == before) == (abs(surplus_n) <= band_n), current_ma


@pytest.mark.parametrize("current_ma", [10, 12, 14, 20, 40])
def test_rests_at_the_force_of_the_current(current_ma):
    """Assert that a finger closed with I rests at N = (kF I - Fc) / (1 + fl), within 0.1 % of overshoot."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -3.0)
    settle(state, "current", current_ma, 6.0)
    assert state.force_n == pytest.approx(rest_n(current_ma), rel=1e-3)
    assert abs(state.speed_m_s) < 1e-12
    assert state.force_n == lookup(CURVE.force_n, CURVE.step_ticks, state.closing_ticks)
    assert state.indentation_m == lookup(CURVE.indentation_m, CURVE.step_ticks, state.closing_ticks)


def test_closed_with_is_the_rest_of_closing():
    """Assert that closed_with starts where closing ends, that it stays there, and at touch with too little current."""
    for current_ma in (10, 14, 23):
        state = closed_with(DRIVE, CURVE, TOUCH_TICKS, current_ma)
        assert state.force_n == pytest.approx(rest_n(current_ma), rel=1e-9)
        assert state.current_ma == current_ma
        before = state.closing_ticks
        settle(state, "current", current_ma, 0.5)
        assert state.closing_ticks == pytest.approx(before, abs=1e-9)
    weak = closed_with(DRIVE, CURVE, TOUCH_TICKS, 5)
    assert (weak.force_n, weak.closing_ticks) == (0.0, 0.0)


@pytest.mark.parametrize("current_ma", [15, 17, 30])
def test_force_stays_until_the_current_fell_by_twice_the_band(current_ma):
    """Assert that N is constant on a falling ramp until the current has lost 2 (Fc + fl N) / kF, about 2 Fc / kF."""
    state = closed_with(DRIVE, CURVE, TOUCH_TICKS, current_ma)
    held_n = state.force_n
    expected_ma = 2 * (DRIVE.friction_n + DRIVE.friction_share * held_n) / DRIVE.force_per_current_n_ma
    assert expected_ma == pytest.approx(2 * DRIVE.friction_n / DRIVE.force_per_current_n_ma, rel=0.1)
    for lost_ma in range(60):
        settle(state, "current", current_ma - lost_ma, 0.1)
        if state.force_n < held_n - 1e-9:
            break
    assert lost_ma == np.ceil(expected_ma)
    settle(state, "current", current_ma - lost_ma - 1, 1.0)
    following_n = state.force_n
    settle(state, "current", current_ma - lost_ma - 2, 1.0)
    share = DRIVE.force_per_current_n_ma / (1 - DRIVE.friction_share)
    assert following_n - state.force_n == pytest.approx(share, rel=0.02)


@pytest.mark.parametrize(("ahead_ticks", "about_n"), [(1, 0.0), (2, 0.13), (3, 2.1), (4, 4.1), (5, 6.1)])
def test_push_of_a_goal_ahead(ahead_ticks, about_n):
    """Assert that a goal c ticks ahead of the finger pushes with (c a - Fc) / (1 + fl), 0.13 N at 2 ticks."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -2.0)
    settle(state, "position", lambda finger: finger.position_ticks + ahead_ticks, 6.0)
    push_n = ahead_ticks * DRIVE.gain_ma_tick * DRIVE.force_per_current_n_ma - DRIVE.friction_n
    assert state.force_n == pytest.approx(max(push_n, 0.0) / (1 + DRIVE.friction_share), rel=1e-3)
    assert state.force_n == pytest.approx(about_n, rel=0.05, abs=0.01)


def test_speed_limit_holds():
    """Assert that the finger never exceeds the limit in either direction, reaches it, and keeps it until it touches."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -100.0)
    closing = settle(state, "current", 300.0, 1.0)[:, 1]
    opening = settle(state, "current", -300.0, 0.15)[:, 1]
    for speeds, sign in ((closing, 1.0), (opening, -1.0)):
        assert np.abs(speeds).max() <= DRIVE.speed_limit_m_s
        assert (sign * speeds).max() == DRIVE.speed_limit_m_s
    ticks_s = 2 * DRIVE.speed_limit_m_s / CURVE.metres_per_tick  # both fingers close the gap
    state = start(DRIVE, CURVE, TOUCH_TICKS, -100.0)
    settle(state, "current", 300.0, 0.02)
    before = state.closing_ticks
    settle(state, "current", 300.0, 0.1)
    assert state.closing_ticks - before == pytest.approx(0.1 * ticks_s, rel=1e-9)


def test_current_limit_and_rounding():
    """Assert that currents are whole mA and goals whole ticks, and that no current exceeds the limit."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -2.25)
    assert state.position_ticks == 434
    step(state, DRIVE, CURVE, "current", 3.4, 1e-3)
    assert state.current_ma == 3.0
    step(state, DRIVE, CURVE, "position", 436.4, 1e-3)
    assert state.current_ma == 10.0
    step(state, DRIVE, CURVE, "position", 1e6, 1e-3)
    assert state.current_ma == DRIVE.current_limit_ma
    step(state, DRIVE, CURVE, "current", -1e6, 1e-3)
    assert state.current_ma == -DRIVE.current_limit_ma


def test_stops_of_the_gripper_and_of_the_curve():
    """Assert that the finger stops fully open, and where the curve of the object ends."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -10.0)
    settle(state, "current", -100.0, 3.0)
    assert state.touch_ticks + state.closing_ticks == pytest.approx(DRIVE.open_ticks, abs=1e-9)
    settle(state, "current", 600.0, 3.0)
    assert state.closing_ticks == pytest.approx(CURVE.reach_ticks, abs=1e-9)
    assert state.force_n == pytest.approx(CURVE.force_n[-1], rel=1e-9)


@pytest.mark.parametrize("dt_s", [1e-6, 1e-3, 0.1, 10.0])
@pytest.mark.parametrize(
    "drive",
    [
        Drive(damping_n_s_m=0.0),
        Drive(mass_kg=0.0),
        Drive(damping_n_s_m=0.0, mass_kg=0.0),
        Drive(friction_n=0.0, friction_share=0.0, damping_n_s_m=0.0),
        Drive(damping_n_s_m=1e9),
        Drive(mass_kg=1e6),
        Drive(kinetic_share=0.5),
        Drive(damping_n_s_m=0.0, mass_kg=0.0, kinetic_share=0.0),
        Drive(mass_kg=1e6, kinetic_share=0.5),
    ],
)
def test_stiff_and_undamped_drives_stay_finite(drive, dt_s):
    """Assert that no damping, no mass, no friction, and stiff contacts end in finite numbers within all limits."""
    for curve in (CURVE, make_curve("flat", finger_n_m=1e9, modulus_pa=1e10)):
        state = start(drive, curve, TOUCH_TICKS, -2.0)
        for current_ma in (20.0, -5.0, 40.0, 0.0, 15.0):
            trace = settle(state, "current", current_ma, 20 * dt_s, dt_s, drive, curve)
            assert np.isfinite(trace).all()
            assert (trace[:, 0] >= 0).all()
            assert np.abs(trace[:, 1]).max() <= drive.speed_limit_m_s
            assert np.isfinite(state.closing_ticks)


@pytest.mark.parametrize("dt_s", [1e-4, 1e-3, 1e-2])
def test_rest_without_damping_lies_in_the_friction_band(dt_s):
    """Assert that a drive without damping and mass comes to rest on a stiff contact exactly where the law says."""
    drive = Drive(damping_n_s_m=0.0, mass_kg=0.0)
    curve = make_curve("flat", finger_n_m=1e7, modulus_pa=1e9)
    state = start(drive, curve, TOUCH_TICKS, -0.2)
    settle(state, "current", 20.0, 100 * dt_s, dt_s, drive, curve)
    assert state.force_n == pytest.approx(rest_n(20.0), rel=1e-9)


def test_geometry_of_the_fingers():
    """Assert that gap and ticks are inverse, that metres_per_tick is the slope, and the maker's stroke of 106 mm."""
    for width_m in (0.0, 0.010, 0.048, 0.074, 0.104):
        assert gap_m(ticks_at_gap(width_m)) == pytest.approx(width_m, abs=1e-12)
        ticks = ticks_at_gap(width_m)
        slope = gap_m(ticks - 0.5) - gap_m(ticks + 0.5)
        assert metres_per_tick(width_m) == pytest.approx(slope, rel=1e-5)
    assert gap_m(0) == pytest.approx(0.106, abs=0.0015)
    for width_mm, tick_mm in ((74, 0.141), (60, 0.154), (35, 0.169), (26, 0.172)):
        assert metres_per_tick(width_mm * 1e-3) == pytest.approx(tick_mm * 1e-3, abs=0.6e-6)
    for width_m in (-1e-3, 0.105, np.nan):
        with pytest.raises(ValueError, match="width_m"):
            ticks_at_gap(width_m)


REFUSED = [
    *(({"drive": {field.name: value}}, field.name) for field in dataclasses.fields(Drive) for value in (np.nan, -1.0)),
    *(({"drive": {name: 0.0}}, name) for name in ("force_per_current_n_ma", "speed_limit_m_s")),
    ({"drive": {"friction_share": 1.0}}, "friction_share"),
    ({"drive": {"open_ticks": 740.0}}, "open_ticks"),
    *(({"start": place}, "must start within") for place in ((1.0, -2.0), (739.0, 2.0), (np.nan, 0.0))),
    *(({"step": ("current", command, 1e-3)}, "command") for command in (np.nan, np.inf)),
    *(({"step": ("position", 400.0, dt_s)}, "dt_s") for dt_s in (0.0, -1e-3, np.nan)),
]


@pytest.mark.parametrize(("given", "named"), REFUSED)
def test_refusals(given, named):
    """Assert that drives without a solution, starts out of reach and steps of nonsense are refused; nothing moves."""
    state = start(DRIVE, CURVE, TOUCH_TICKS, -1.0)
    before = dataclasses.replace(state)
    with pytest.raises(ValueError, match=named):
        if "drive" in given:
            Drive(**given["drive"])
        if "start" in given:
            start(DRIVE, CURVE, *given["start"])
        step(state, DRIVE, CURVE, *given["step"])
    assert state == before


@pytest.mark.parametrize("backlash_ticks", [0.5, 3.0])
def test_lost_motion(backlash_ticks):
    """Assert that N stays for b ticks of the motor m after a reversal, and then is that of the curve at m + b / 2.

    Before, N = (kF I - Fc) / (1 + fl). The encoder shows the motor: after closing it is b / 2 ahead of the finger.
    """
    drive = dataclasses.replace(DRIVE, backlash_ticks=backlash_ticks)
    state = start(drive, CURVE, TOUCH_TICKS)
    settle(state, "current", 14, 3.0, drive=drive)
    closed_n, turned_ticks = state.force_n, state.motor_ticks
    assert closed_n == pytest.approx(rest_n(14), rel=1e-3)
    assert turned_ticks - state.closing_ticks == pytest.approx(backlash_ticks / 2, abs=1e-9)
    assert state.position_ticks == np.floor(TOUCH_TICKS + turned_ticks)
    within, beyond = 0, 0
    for _ in range(1000):
        if state.force_n < 1.0:
            break
        step(state, drive, CURVE, "current", -8, 1e-3)
        if state.motor_ticks >= turned_ticks - backlash_ticks:
            assert state.force_n == closed_n
            within += 1
        else:
            place = state.motor_ticks + backlash_ticks / 2
            assert state.force_n == pytest.approx(lookup(CURVE.force_n, CURVE.step_ticks, place), rel=1e-9, abs=1e-12)
            beyond += 1
    assert within >= 3
    assert beyond >= 10


def test_a_finger_closed_with_a_current_has_taken_up_its_lost_motion():
    """Assert that a start under a constant current is where closing with it leads."""
    drive = dataclasses.replace(DRIVE, backlash_ticks=3.0)
    slowly = start(drive, CURVE, TOUCH_TICKS)
    settle(slowly, "current", 14, 3.0, drive=drive)
    at_once = closed_with(drive, CURVE, TOUCH_TICKS, 14)
    assert at_once.motor_ticks == pytest.approx(slowly.motor_ticks, abs=0.01)
    assert at_once.force_n == pytest.approx(slowly.force_n, rel=1e-3)


def test_a_finger_may_change_its_drive():
    """Assert that a step with another drive or curve is that of a finger which has known no other."""
    state = closed_with(DRIVE, CURVE, 300.0, 60.0)
    step(state, DRIVE, CURVE, "current", 40.0, 1e-3)
    for drive, curve in ((dataclasses.replace(DRIVE, friction_n=1.0), CURVE), (DRIVE, make_curve(modulus_pa=5e5))):
        fresh = dataclasses.replace(state, _cached_law=None)
        assert step(state, drive, curve, "current", 20.0, 1e-3) == step(fresh, drive, curve, "current", 20.0, 1e-3)
        assert state == fresh


LOOSE = dataclasses.replace(DRIVE, kinetic_share=0.75)


@pytest.mark.parametrize("current_ma", [15, 17, 30])
def test_a_gear_breaks_loose(current_ma):
    """Assert that N stays until the friction at rest is exceeded, and falls at once to where that of motion holds it.

    Closing ended at N = (kF I - k Fc) / (1 + k fl), so the current has to fall by (1 + k) (Fc + fl N) / kF.
    """
    state, share = closed_with(LOOSE, CURVE, TOUCH_TICKS, current_ma), LOOSE.kinetic_share
    held_n = state.force_n
    assert closing_push_n(LOOSE, held_n) == pytest.approx(LOOSE.force_per_current_n_ma * current_ma, rel=1e-9)
    band_n = (1 + share) * (LOOSE.friction_n + LOOSE.friction_share * held_n)
    loses_ma = int(np.ceil(band_n / LOOSE.force_per_current_n_ma))
    settle(state, "current", current_ma - loses_ma + 1, 0.5, drive=LOOSE)
    assert state.force_n == held_n
    push_n = LOOSE.force_per_current_n_ma * (current_ma - loses_ma)
    assert push_n < opening_push_n(LOOSE, held_n, rests=True) < push_n + LOOSE.force_per_current_n_ma
    settle(state, "current", current_ma - loses_ma, 1.0, drive=LOOSE)
    loose_n = (push_n + share * LOOSE.friction_n) / (1 - share * LOOSE.friction_share)
    assert state.force_n == pytest.approx(loose_n, rel=1e-3)
    assert opening_push_n(LOOSE, state.force_n) == pytest.approx(push_n, abs=2e-3)
    assert held_n - loose_n > (1 - share) * LOOSE.friction_n


def test_a_loose_gear_goes_on_unless_it_rests():
    """Assert that a finger follows each mA that comes before it rests, and once at rest is held until more come."""
    state = closed_with(LOOSE, CURVE, TOUCH_TICKS, 30)
    settle(state, "current", 10, 0.1, drive=LOOSE)
    forces = [settle(state, "current", current_ma, 0.145, drive=LOOSE)[-1, 0] for current_ma in range(9, 3, -1)]
    assert np.diff(forces) == pytest.approx(-LOOSE.force_per_current_n_ma, rel=0.1)
    settle(state, "current", 4, 1.0, drive=LOOSE)
    rested_n = state.force_n
    more_n = (1 - LOOSE.kinetic_share) * (LOOSE.friction_n + LOOSE.friction_share * rested_n)
    within = int(more_n / LOOSE.force_per_current_n_ma)
    assert within >= 2
    settle(state, "current", 4 - within, 1.0, drive=LOOSE)
    assert state.force_n == rested_n
    settle(state, "current", 3 - within, 1.0, drive=LOOSE)
    assert state.force_n < rested_n - more_n


@pytest.mark.parametrize("breaks_loose", [False, True])
def test_trajectory_converges_with_the_time_step(breaks_loose):
    """Assert that the error of the force, while closing or after a gear broke loose, falls with the time step."""
    forces = {}
    for dt_s in (1e-3, 5e-4, 2.5e-4, 2e-5):
        if breaks_loose:
            state = closed_with(LOOSE, CURVE, TOUCH_TICKS, 20)
            forces[dt_s] = settle(state, "current", -3, 0.03, dt_s, drive=LOOSE)[-1, 0]
        else:
            state = start(DRIVE, CURVE, TOUCH_TICKS, -0.5)
            forces[dt_s] = settle(state, "current", 20.0, 0.06, dt_s)[-1, 0]
    errors = [abs(forces[dt_s] - forces[2e-5]) for dt_s in (1e-3, 5e-4, 2.5e-4)]
    begins_n = closed_with(LOOSE, CURVE, TOUCH_TICKS, 20).force_n if breaks_loose else 0.0
    assert abs(begins_n - forces[2e-5]) > 0.5
    assert errors[0] / errors[2] > 3.2
