"""Sample one trial: the object's mass, friction and position in the gripper, and a whole sensor.

A trial's values are uniform in the ranges of its scene. Sensors and grippers are sampled from the ranges in the row
`randomized` of sensors.toml. An entry of that row is either a plain value, which all sensors share, or a range:
`{uniform = [low, high], stream = 1}`, `{log_uniform = ...}` (uniform in the logarithm) or `{whole = ...}` (a whole
number, both ends included). A list may contain ranges.

Each range has its own random stream, numbered by `stream`. So adding, moving or renaming a range changes no other
value.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evetac_cli.sim.setup.object_file import TouchedObject, seed_of
from evetac_cli.sim.setup.scene import Scene, Texture
from evetac_cli.sim.setup.sensor import Sensor, SensorRanges
from evetac_cli.sim.setup.tables import read_table

OBJECT_SEED = 15485863  # with the object's number, seeds the values that an object keeps in all trials


@dataclass(frozen=True)
class SampledTrial:
    """Values that were sampled for one trial from the ranges of its scene."""

    mass_kg: float
    static_friction: float
    kinetic_friction: float
    stribeck_m_s: float
    friction_memory_m: float  # slip distance over which friction adapts to slip speed: a guess, unknown for this gel
    pressure_exponent: float  # friction grows as p^(1 - this) with the pressure p; 0 is Coulomb's law
    tilt_rad: float
    gear_friction_factor: float
    start_factor: float
    fall_factor: float  # factor on the rate at which the ramp lowers the current
    texture_log_sd: float
    texture_half_correlation_px: float
    touch_m: tuple[float, float]  # object's middle relative to the middle of the pad: along gravity, across gravity
    lever_m: float  # distance, across gravity, from the touched point to the centre of mass
    floor_m: float  # distance from the object, as held, down to the floor


def sample_trial(
    scene: Scene, object: TouchedObject, sensor: Sensor, rng: np.random.Generator, object_name: int | str | None = None
) -> SampledTrial:
    """Sample a trial's parameters, always in the same order, so that a scene's keys do not shift other values.

    The ratio of kinetic to static friction is sampled for each trial from the scene's whole range. If the scene sets
    kinetic_share_spread, each object (by its number or name) has its own ratio, and its trials spread about that ratio.
    An object may set its own ratio. A ratio of the sensor's gel moves the middle of the range; objects still differ.
    """
    placement = rng.spawn(1)[0]  # a separate stream, so that these keys shift no other values
    of_memory, of_pressure, of_fall = placement.spawn(3)
    varied, texture, own_friction = scene.randomise, scene.texture or Texture(), sensor.friction

    def draw(ends: tuple[float, float]) -> float:
        return float(rng.uniform(*ends))

    static = sensor.static_friction_factor * object.static_friction * draw(varied.static_friction)
    tilt_deg = draw(varied.tilt_deg)
    if object.tilt_deg is not None:  # the shape itself is slanted, so the misalignment of a finger hardly matters
        tilt_deg = draw(object.tilt_deg)
    mass_g = object.mass_g if scene.object is None else scene.object.mass_g
    mass_kg = mass_g * 1e-3 * draw(varied.mass)
    kinetic_share = draw(varied.kinetic_share)
    spread, of_gel, of_object = varied.kinetic_share_spread, own_friction.kinetic_share, object.kinetic_share
    off_share = placement.uniform(-1, 1) * (spread or 0.0)
    if spread is not None and object_name is not None:
        own = np.random.default_rng([OBJECT_SEED, seed_of(object_name)]).uniform(*varied.kinetic_share)
        if (
            of_gel is not None and of_object is None
        ):  # objects differ on this gel as on any other, about the gel's own ratio
            own += of_gel - sum(varied.kinetic_share) / 2
            of_gel = None
        kinetic_share = float(np.clip(own + off_share, 0.0, 1.0))
    # the sensor's gel comes first, then the object, then the scene's sample
    kinetic_share = _first(of_gel, of_object, kinetic_share)
    stribeck_mm_s = draw(varied.stribeck_mm_s)
    memory_um = float(of_memory.uniform(*varied.memory_um))
    pressure_exponent = float(of_pressure.uniform(*varied.pressure_exponent))
    touch_m = placement.uniform(-1e-3, 1e-3, 2) * varied.touch_mm
    lever_m = float(placement.normal()) * varied.lever_mm * 1e-3
    if object.shape != "flat":
        lever_m = 0.0  # the weight of a round object acts on its axis, and it is touched there
    lever_m += object.lever_mm * 1e-3
    slowest, fastest = scene.gripper.fall_factor
    return SampledTrial(
        mass_kg=mass_kg,
        static_friction=static,
        kinetic_friction=static * kinetic_share,
        stribeck_m_s=_first(own_friction.stribeck_mm_s, stribeck_mm_s) * 1e-3,
        friction_memory_m=_first(own_friction.memory_um, memory_um) * 1e-6,
        pressure_exponent=_first(own_friction.pressure_exponent, pressure_exponent),
        tilt_rad=float(np.deg2rad(tilt_deg)),
        gear_friction_factor=draw(scene.gripper.friction_factor),
        start_factor=draw(scene.gripper.start_factor),
        fall_factor=slowest * (fastest / slowest) ** float(of_fall.random()),
        texture_log_sd=draw(texture.log_sd),
        texture_half_correlation_px=draw(texture.half_correlation_px),
        touch_m=(float(touch_m[0]), float(touch_m[1])),
        lever_m=lever_m,
        floor_m=float(placement.uniform(*scene.floor.below_mm)) * 1e-3,
    )


def _first(*values: float | None) -> float:
    """Return the first value that is not None."""
    return next(value for value in values if value is not None)


def sample_sensor(ranges: SensorRanges, rng: np.random.Generator) -> Sensor:
    """Sample a sensor from a row of ranges of sensors.toml.

    `dot_shift_x_px` and `dot_shift_y_px` move the columns and rows of dots. `threshold_off_factor` is the threshold of
    OFF events divided by that of ON events. These three keys do not appear in the result.
    """
    row: dict[str, Any] = _sample(ranges, int(rng.integers(2**63)))
    for axis, lines in (("x", "dot_columns_px"), ("y", "dot_rows_px")):
        shift_px = row.pop(f"dot_shift_{axis}_px", 0.0)
        row[lines] = [line + shift_px for line in row[lines]]
    if "threshold_off_factor" in row:
        row["threshold_off"] = row["threshold"] * row.pop("threshold_off_factor")
    return read_table(Sensor, row, "sensors.toml")


def _sample(entry: Any, seed: int) -> Any:
    """Return an entry in which each range is replaced by a sampled value."""
    if isinstance(entry, Mapping) and "stream" in entry:
        return _sample_range(entry, seed)
    if isinstance(entry, Mapping):
        return {key: _sample(inner, seed) for key, inner in entry.items()}
    return [_sample(inner, seed) for inner in entry] if isinstance(entry, list) else entry


def _sample_range(entry: Mapping[str, Any], seed: int) -> float | int:
    rng = np.random.default_rng([seed, entry["stream"]])
    distribution, (low, high) = next(item for item in entry.items() if item[0] != "stream")
    if distribution == "whole":
        return int(rng.integers(int(low), int(high) + 1))
    if distribution == "log_uniform":
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))
