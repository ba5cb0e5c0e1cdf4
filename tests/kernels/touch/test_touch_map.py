"""Touch maps slice by slice: what they tell of a contact, and what of hostile dots."""

import copy
import math
import pickle

import numpy as np
import pytest

from evetac_cli.kernels.touch import touch_map
from evetac_cli.kernels.touch.dot_motion import ENDLESS_MM, DotNoise, GelLayer
from evetac_cli.kernels.touch.touch_map import LEAST_DOTS, RENEWAL_SLICES, TouchReading, TouchState
from scripts.studies.touch.contact_maker import ContactMaker, KnownContact

DOTS = np.stack(np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-6, 6, 7)), -1).reshape(-1, 2)
LENS_MM = 25.0


@pytest.fixture(scope="module")
def ball() -> KnownContact:
    return ContactMaker(DOTS).make("ball", 6000)


def places(contact: KnownContact, loaded: float = 1.0) -> np.ndarray:
    """Where dots are seen, from only pressed (0) to moved (1), without noise."""
    motion = contact.pressed_motion_mm + loaded * (contact.dot_motion_mm - contact.pressed_motion_mm)
    return DOTS + motion[:, :2] + DOTS * motion[:, 2:] / LENS_MM


def same(one: TouchReading, other: TouchReading) -> bool:
    """Whether two readings have the same bits, NaN included."""
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def test_a_ball_is_told(ball: KnownContact) -> None:
    """Assert the errors that the study of such contacts has: force 5 %, place 0.3 mm, patch, normal force 10 %."""
    told = touch_map.step(touch_map.start(DOTS), places(ball))
    assert told.known and told.touches
    assert np.hypot(*(told.shear_n - ball.net_shear_n)) < 0.05 * np.hypot(*ball.net_shear_n)
    assert np.hypot(*(told.centre_mm - ball.centre_mm)) < 0.3
    assert told.normal_n == pytest.approx(ball.normal_n, rel=0.1)
    assert abs(told.torsion_n_mm - ball.torsion_n_mm(told.centre_mm)) < 0.1
    assert told.area_mm2 == told.patch.sum() == pytest.approx(math.pi * 4.5**2, rel=0.2)
    assert told.shear_pa.sum(axis=(1, 2)) * 1e-6 == pytest.approx(told.shear_n, abs=1e-4)
    assert told.pressure_pa.sum() * 1e-6 == pytest.approx(told.normal_n, rel=1e-4)
    deviations = (told.shear_sd_n, told.centre_sd_mm, told.normal_sd_n, told.torsion_sd_n_mm)
    assert all(np.all(np.asarray(each) > 0) and np.all(np.isfinite(each)) for each in deviations)
    assert (told.shear_sd_pa[:, told.patch] > 0).all() and (told.pressure_sd_pa[told.patch] > 0).all()
    assert np.isnan(told.shear_since_n).all() and np.isnan(told.shear_since_pa).all()


def test_shear_since_it_was_held(ball: KnownContact) -> None:
    """Assert that what is since counts from `hold`: nothing at once, then the change of shear, and less of the half."""
    state = touch_map.start(DOTS, renews=False)
    touch_map.step(state, places(ball, 0.0))
    touch_map.renew(state)
    touch_map.hold(state)
    touch_map.renew(state)
    assert np.abs(touch_map.step(state, places(ball, 0.0)).shear_since_n).max() < 1e-6
    touch_map.step(state, places(ball))
    touch_map.renew(state)
    whole, half = (touch_map.step(state, places(ball, part)) for part in (1.0, 0.5))
    true_n = ball.net_since_pressed_n
    assert np.hypot(*(whole.shear_since_n - true_n)) < 0.05 * np.hypot(*true_n)
    assert half.shear_since_n == pytest.approx(whole.shear_since_n / 2, rel=1e-3, abs=1e-4)


def test_dots_that_do_not_move_tell_of_no_touch(ball: KnownContact) -> None:
    """Assert that dots at rest, with noise or moved all alike, are no touch: 0, no deviation, no place."""
    state = touch_map.start(DOTS)
    rng = np.random.default_rng(0)
    touch_map.step(state, places(ball))
    for dots in (DOTS, DOTS + rng.normal(size=DOTS.shape) * 0.05 * 0.0329, DOTS + [0.05, -0.02]):
        told = touch_map.step(state, dots)
        assert told.known and not told.touches and not told.patch.any()
        assert told.normal_n == told.torsion_n_mm == told.area_mm2 == 0 and not told.shear_n.any()
        assert not told.pressure_pa.any() and not told.shear_pa.any()
        assert np.isnan(told.centre_mm).all() and math.isnan(told.normal_sd_n) and np.isnan(told.shear_sd_n).all()


def test_a_place_is_in_the_patch_though_nothing_tells_pressure() -> None:
    """Assert that dots that shear without pressure, as no contact does, have a centre inside the cells of the patch."""
    pulled = 0.4 * np.exp(-((DOTS - [2.0, -1.0]) ** 2).sum(axis=1) / (2 * 3.3**2))
    state = touch_map.start(DOTS)
    told = touch_map.step(state, DOTS + pulled[:, None] * [1, 0])
    assert told.touches and told.patch.any()
    row, column = np.nonzero(told.patch)
    assert state.cells.x_mm[column.min()] <= told.centre_mm[0] <= state.cells.x_mm[column.max()]
    assert state.cells.y_mm[row.min()] <= told.centre_mm[1] <= state.cells.y_mm[row.max()]
    assert np.hypot(*(told.centre_mm - [2.0, -1.0])) < 4.0
    assert told.centre_sd_mm.min() > 1.0


def test_a_touch_neither_flickers_nor_stays(ball: KnownContact) -> None:
    """Assert that a touch begins at more motion than that at which it ends."""
    state = touch_map.start(DOTS)
    whole_mm = touch_map.apart_rms(places(ball) - DOTS)
    between = 0.5 * (touch_map.BEGINS + touch_map.ENDS) * DotNoise().own_mm / whole_mm
    light = DOTS + between * (places(ball) - DOTS)
    assert not touch_map.step(state, light).touches
    assert touch_map.step(state, places(ball)).touches
    assert touch_map.step(state, light).touches
    assert not touch_map.step(state, DOTS).touches
    assert not touch_map.step(state, light).touches


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_dots_that_are_lost_or_not_finite_are_left_out(bad: float, ball: KnownContact) -> None:
    """Assert that a tenth of the dots flagged lost, or NaN or infinite, tell as the others do, whatever they say."""
    gone = np.zeros(len(DOTS), np.bool_)
    gone[::10] = True
    wrong, absurd = places(ball), places(ball)
    wrong[gone], absurd[gone] = bad, 1e6
    by_value = touch_map.step(touch_map.start(DOTS), wrong)
    assert same(by_value, touch_map.step(touch_map.start(DOTS), absurd, gone))
    assert np.hypot(*(by_value.shear_n - ball.net_shear_n)) < 0.08 * np.hypot(*ball.net_shear_n)
    missing = np.where(gone[:, None], np.nan, DOTS)
    assert same(by_value, touch_map.step(touch_map.start(missing), wrong))


def test_a_dot_that_is_lost_between_renewals_keeps_its_motion(ball: KnownContact) -> None:
    """Assert that a dot lost after a patch was found changes nothing until the next, which is found without it.

    That is three slices in the making: dots, patch, fit.
    """
    state = touch_map.start(DOTS)
    before = touch_map.step(state, places(ball))
    gone = np.arange(len(DOTS)) == 30
    wrong = places(ball)
    wrong[30] = np.nan
    for _ in range(RENEWAL_SLICES + 1):
        assert same(touch_map.step(state, wrong, gone), before)
    after = touch_map.step(state, wrong, gone)
    assert not same(after, before) and state.dots.used.sum() == len(DOTS) - 1
    assert after.shear_n == pytest.approx(before.shear_n, abs=0.05 * np.hypot(*before.shear_n))


def test_fewer_than_four_dots_tell_nothing(ball: KnownContact) -> None:
    """Assert that 3 dots, or none, make everything unknown, that 4 do not, and that it recovers."""
    state = touch_map.start(DOTS)
    whole = touch_map.step(state, places(ball))
    for left in (0, LEAST_DOTS - 1):
        told = touch_map.step(state, places(ball), np.arange(len(DOTS)) >= left)
        assert not told.known and not told.touches and not told.patch.any()
        assert np.isnan(told.shear_n).all() and math.isnan(told.normal_n) and np.isnan(told.pressure_pa).all()
        assert np.isnan(told.area_mm2) and np.isnan(told.centre_mm).all()
    few = touch_map.step(state, places(ball), ~np.isin(np.arange(len(DOTS)), [20, 24, 38, 42]))
    assert few.known and np.isfinite(few.shear_n).all()
    again = touch_map.step(state, places(ball))
    assert again.known
    for _ in range(3 * RENEWAL_SLICES):
        again = touch_map.step(state, places(ball))
    assert again.shear_n == pytest.approx(whole.shear_n, abs=0.03 * np.hypot(*whole.shear_n))


def test_the_same_dots_make_the_same_readings(ball: KnownContact) -> None:
    """Assert that two states, a copy, and one that was pickled on the way give the same bits."""
    rng = np.random.default_rng(4)
    slices = [
        places(ball, part) + rng.normal(size=DOTS.shape) * 0.002 for part in np.linspace(0, 1, RENEWAL_SLICES + 5)
    ]
    one, other = touch_map.start(DOTS), touch_map.start(DOTS.copy())
    copied: TouchState | None = None
    for number, dots in enumerate(slices):
        if number == 3:
            touch_map.hold(one)
            touch_map.hold(other)
        if number == 7:
            copied, other = copy.deepcopy(one), pickle.loads(pickle.dumps(other))
        told = touch_map.step(one, dots)
        assert same(told, touch_map.step(other, dots))
        assert copied is None or same(told, touch_map.step(copied, dots))


def test_stiffness_scales_forces_alone(ball: KnownContact) -> None:
    """Assert that twice the stiffness is twice the force in the same place, and that not knowing it adds its share."""
    soft = touch_map.step(touch_map.start(DOTS), places(ball))
    stiff = touch_map.step(touch_map.start(DOTS, GelLayer(shear_modulus_pa=290e3)), places(ball))
    assert stiff.shear_n == pytest.approx(2 * soft.shear_n, rel=0.03)
    assert stiff.centre_mm == pytest.approx(soft.centre_mm, abs=0.05)
    unsure = touch_map.step(touch_map.start(DOTS, stiffness_error=0.4), places(ball))
    assert unsure.shear_n == pytest.approx(soft.shear_n)
    assert unsure.shear_sd_n == pytest.approx(np.hypot(soft.shear_sd_n, 0.4 * soft.shear_n), rel=1e-6)
    assert unsure.normal_sd_n == pytest.approx(math.hypot(soft.normal_sd_n, 0.4 * soft.normal_n), rel=1e-6)
    assert unsure.centre_sd_mm == pytest.approx(soft.centre_sd_mm)


def test_a_caller_may_renew_when_it_has_the_time(ball: KnownContact) -> None:
    """Assert that without renewals of its own a map tells nothing until it is renewed, and keeps the patch after."""
    state = touch_map.start(DOTS, renews=False)
    touch_map.renew(state)
    assert not touch_map.step(state, places(ball)).patch.any()
    touch_map.renew(state)
    first = touch_map.step(state, places(ball))
    for _ in range(2 * RENEWAL_SLICES):
        last = touch_map.step(state, places(ball))
    assert first.patch.any() and same(first, last)


def test_a_renewal_in_parts_is_that_at_once(ball: KnownContact) -> None:
    """Assert equal readings whether a patch is renewed at once or part by part, and the old one until it is done."""
    at_once, in_parts = (touch_map.start(DOTS, renews=False) for _ in range(2))
    gone = np.arange(len(DOTS)) == 12
    for state in (at_once, in_parts):
        touch_map.step(state, places(ball, 0.0))
        touch_map.renew(state)
        touch_map.hold(state)
        touch_map.step(state, places(ball), gone)
    touch_map.renew(at_once)
    before, parts = touch_map.step(in_parts, places(ball), gone), 0
    while not touch_map.renew_part(in_parts):
        parts += 1
        if parts < 3:
            assert same(touch_map.step(in_parts, places(ball), gone), before)
    assert parts == 3
    assert same(touch_map.step(in_parts, places(ball), gone), touch_map.step(at_once, places(ball), gone))


def test_a_face_wider_than_the_view_says_that_it_is_told_badly() -> None:
    """Assert that shear of a face over a whole gel is told where its edges are, and deviations hold where not.

    Its normal force is as good as unknown, and told as that.
    """
    layer = GelLayer(lens_mm=math.inf, edges_mm=(-12.0, -9.0, 12.0, 9.0))
    moved = DOTS + [20e3 * layer.height_mm / layer.shear_modulus_pa, 0.0]
    moved[:, 0] += 0.01 * DOTS[:, 0]  # it bulges out
    true_n = 20e3 * 24 * 18 * 1e-6
    told, without = (
        touch_map.step(touch_map.start(DOTS, one), moved) for one in (layer, layer._replace(edges_mm=ENDLESS_MM))
    )
    assert told.shear_n[0] == pytest.approx(true_n, rel=0.15)
    assert abs(without.shear_n[0] - true_n) < 2 * without.shear_sd_n[0]
    assert without.shear_sd_n[0] > 0.2 * without.shear_n[0]
    for one in (told, without):
        assert one.normal_sd_n > abs(one.normal_n)


def test_a_dot_that_is_wrong_and_not_lost_is_left_out(ball: KnownContact) -> None:
    """Assert that a dot 5 px off, and not reported lost, is left out where dots are compared, and it alone."""
    wrong = places(ball)
    wrong[8, 1] += 5 * 0.0329
    compared, trusting = (touch_map.start(DOTS, compares=compares) for compares in (True, False))
    for state in (compared, trusting):
        touch_map.step(state, wrong)
        touch_map.renew(state)
    assert np.flatnonzero(~compared.dots.used).tolist() == [8] and trusting.dots.used.all()
    with pytest.raises(ValueError, match="to compare"):
        touch_map.start(np.stack(np.meshgrid(np.arange(-5.0, 5), np.arange(-5.0, 5)), -1).reshape(-1, 2), compares=True)
