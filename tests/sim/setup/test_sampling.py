"""What is sampled for a trial: values within their ranges, each from a random stream of its own."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evetac_cli.sim.setup import object_file, sampling, scene_file
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.sensor import GelFriction, Sensor
from evetac_cli.sim.setup.sensor_file import rows

SLIP = scene_file.load("slip")
EVETAC = one_sensor("evetac")


def slip(**ranges: Any) -> Scene:
    """The scene `slip` with other ranges."""
    return replace(SLIP, randomise=replace(SLIP.randomise, **ranges))


def random(seed: int) -> np.random.Generator:
    """A generator of random numbers."""
    return np.random.default_rng(seed)


def test_samples_stay_in_their_ranges() -> None:
    """Assert that 200 samples lie in the scene's ranges and fill them."""
    object, rng = object_file.of_number(8), random(0)
    sampled = [sampling.sample_trial(SLIP, object, EVETAC, rng) for _ in range(200)]
    friction = np.array([one.static_friction for one in sampled]) / object.static_friction
    low, high = SLIP.randomise.static_friction
    assert low <= friction.min() < low + 0.02
    assert high - 0.02 < friction.max() <= high
    assert all(one.kinetic_friction < one.static_friction for one in sampled)


def test_keys_of_a_scene_leave_other_samples() -> None:
    """Assert that touch, lever and kinetic spread change nothing else that is sampled, and lie in their ranges."""
    plain, more = slip(touch_mm=0.0, kinetic_share_spread=None), slip(touch_mm=3.0, lever_mm=3.0)
    flat, round_ = object_file.of_number(16), object_file.of_number(8)
    for seed in range(50):
        old, new = (sampling.sample_trial(scene, flat, EVETAC, random(seed)) for scene in (plain, more))
        assert old.touch_m == (0.0, 0.0)
        assert old.lever_m == 0.0
        assert {**vars(old), "touch_m": 0, "lever_m": 0} == {**vars(new), "touch_m": 0, "lever_m": 0}
        assert np.abs(new.touch_m).max() <= 3e-3
    sampled = [sampling.sample_trial(more, flat, EVETAC, random(seed)) for seed in range(400)]
    assert np.std([one.lever_m for one in sampled]) == pytest.approx(3e-3, rel=0.15)
    assert np.std([one.touch_m for one in sampled]) == pytest.approx(3e-3 / math.sqrt(3), rel=0.1)
    assert sampling.sample_trial(more, round_, EVETAC, random(0)).lever_m == 0.0  # object on its axis


def test_objects_keep_their_kinetic_share() -> None:
    """Assert that with a spread the kinetic share of an object stays within it, and objects differ by more."""
    spread = slip(kinetic_share_spread=0.03)

    def shares(number: int) -> list[float]:
        object = object_file.of_number(number)
        sampled = [sampling.sample_trial(spread, object, EVETAC, random(seed), number) for seed in range(30)]
        return [one.kinetic_friction / one.static_friction for one in sampled]

    by_object = [shares(number) for number in range(1, 9)]
    assert all(0.04 < max(own) - min(own) <= 0.06 + 1e-12 for own in by_object)
    middles = [np.mean(own) for own in by_object]
    low, high = SLIP.randomise.kinetic_share
    assert max(middles) - min(middles) > 0.4 * (high - low)


@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_a_gels_kinetic_share_keeps_objects_apart(spread: float) -> None:
    """Assert that a sensor's own share moves that of all objects alike, and stands for all where none has its own.

    By as much as it is off the middle of the scene's range.
    """
    low, high = SLIP.randomise.kinetic_share
    soft = replace(EVETAC, friction=GelFriction(kinetic_share=0.35))

    def share(scene: Scene, sensor: Sensor, number: int, seed: int) -> float:
        object = object_file.of_number(number)
        sampled = sampling.sample_trial(scene, object, sensor, random(seed), number)
        return sampled.kinetic_friction / sampled.static_friction

    own = slip(kinetic_share_spread=spread)
    for number in range(1, 9):
        shares = [share(own, sensor, number, number) for sensor in (EVETAC, soft)]
        assert shares[1] == pytest.approx(shares[0] + 0.35 - (low + high) / 2, abs=1e-12)
    assert share(slip(kinetic_share_spread=None), soft, 1, 0) == pytest.approx(0.35)


def test_a_gels_kinetic_share_stays_within_1() -> None:
    """Assert that objects on a gel that hardly loses friction have at most what is static."""
    slippery = replace(EVETAC, friction=GelFriction(kinetic_share=1.0))
    sampled = [
        sampling.sample_trial(SLIP, object_file.of_number(number), slippery, random(0), number)
        for number in range(1, 21)
    ]
    shares = [one.kinetic_friction / one.static_friction for one in sampled]
    assert max(shares) == pytest.approx(1.0)
    assert min(shares) < 0.98


def test_friction_of_a_scene_and_of_a_sensor() -> None:
    """Assert that memory and pressure law are drawn from the ranges, alone, and that those of a sensor come first."""
    ranges = slip(memory_um=(60.0, 130.0), pressure_exponent=(0.2, 0.8))
    object = object_file.of_number(8)
    for seed in range(20):
        plain, drawn = (sampling.sample_trial(scene, object, EVETAC, random(seed), 8) for scene in (SLIP, ranges))
        assert (plain.friction_memory_m, plain.pressure_exponent) == (pytest.approx(50e-6), 0.67)
        assert 60e-6 <= drawn.friction_memory_m <= 130e-6
        assert 0.2 <= drawn.pressure_exponent <= 0.8
        same = {"friction_memory_m": 0, "pressure_exponent": 0}
        assert {**vars(plain), **same} == {**vars(drawn), **same}
    many = [sampling.sample_trial(ranges, object, EVETAC, random(seed), 8) for seed in range(200)]
    values = np.array([(one.friction_memory_m, one.pressure_exponent) for one in many])
    assert np.ptp(values, axis=0) == pytest.approx([70e-6, 0.6], rel=0.05)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.2
    own = replace(EVETAC, friction=GelFriction(memory_um=20.0, pressure_exponent=0.9, stribeck_mm_s=2.0))
    named = sampling.sample_trial(ranges, object, own, random(0), 8)
    assert (named.friction_memory_m, named.stribeck_m_s) == pytest.approx((20e-6, 2e-3))
    assert named.pressure_exponent == 0.9


def test_sampled_sensors_lie_in_their_ranges() -> None:
    """Assert that 300 sampled sensors fill the ranges of the table, log-uniform ones evenly in the logarithm."""
    ranges = rows()["randomized"]
    sensors = [sampling.sample_sensor(ranges, random(seed)) for seed in range(300)]
    for name, low, high in (("mm_per_px", 0.029, 0.034), ("hot_pixels", 0, 400), ("loss_tangent", 0.06, 0.24)):
        values = np.array([getattr(sensor, name) for sensor in sensors])
        assert low <= values.min() <= low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) <= values.max() <= high
    moduli = np.log([sensor.normal_modulus_pa for sensor in sensors])
    assert moduli.mean() == pytest.approx(np.log([0.33e6, 2.0e6]).mean(), abs=0.06)
    assert {type(sensor.hot_pixels) for sensor in sensors} == {int}
    shifts = np.array([np.subtract(sensor.dot_columns_px, ranges["dot_columns_px"]) for sensor in sensors])
    assert np.ptp(shifts, axis=1).max() < 1e-9
    assert 5 < np.abs(shifts).max() <= 6


def test_a_range_more_leaves_the_others() -> None:
    """Assert that a range added at the front of the table, or a table turned round, changes no other value."""
    ranges = rows()["randomized"]
    sensor = sampling.sample_sensor(ranges, random(3))
    turned = {"leak_hz": {"uniform": [0.5, 1], "stream": 3}, **dict(reversed(ranges.items()))}
    more = sampling.sample_sensor(turned, random(3))
    assert 0.5 <= more.leak_hz <= 1
    assert replace(more, leak_hz=sensor.leak_hz) == sensor
