"""What is sampled for one trial: an object's mass, friction and place in the gripper, and a whole sensor.

A trial's values are uniform in the ranges that its scene names. Sensors and grippers are sampled from the ranges of the
row `randomized` of sensors.toml. An entry of that row is a plain value, which all sensors have in common, or a range:
`{uniform = [low, high], stream = 1}`, `{log_uniform = ...}` (uniform in the logarithm) or `{whole = ...}` (a whole
number, both ends included). A list may hold ranges.

Why so: each range draws from a random stream of its own, numbered by its `stream`, so that a range added to the table,
moved in it or renamed leaves all other values as they were.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.sim.setup.object_file import TouchedObject, seed_of
from evetac_cli.sim.setup.scene import Scene, Texture
from evetac_cli.sim.setup.sensor import Sensor, SensorRanges
from evetac_cli.sim.setup.tables import build

OBJECT_SEED = 15485863  # with the object's number: what one object has in all trials
DISTRIBUTIONS = ("uniform", "log_uniform", "whole")


@dataclass(frozen=True)
class SampledTrial:
    """What was sampled for one trial from the ranges of its scene."""

    mass_kg: float
    static_friction: float
    kinetic_friction: float
    stribeck_m_s: float
    friction_memory_m: float  # over which friction follows the slip speed: a guess, none is known for this gel
    pressure_exponent: float  # friction under a pressure p goes with p^(1 - this): 0 is Coulomb's law
    tilt_rad: float
    gear_friction_factor: float
    start_factor: float
    fall_factor: float  # on how fast the ramp lets the current fall
    texture_log_sd: float
    texture_half_correlation_px: float
    touch_m: tuple[float, float]  # middle of the object from that of the pad where it is touched: along gravity, across
    lever_m: float  # centre of mass from there, across gravity
    floor_m: float  # where an object that fell comes to rest, below where it was held

    def as_json(self) -> str:
        """For the truth of a recording."""
        return json.dumps(asdict(self))


def sample_trial(
    scene: Scene, touched: TouchedObject, sensor: Sensor, rng: np.random.Generator, called: int | str | None = None
) -> SampledTrial:
    """Sample a trial's parameters, always in the same order, so that a key of one scene does not shift another's.

    Where the scene names kinetic_share_spread, an object (by its number or name) has a kinetic share of its own, about
    which its trials spread; else the share is sampled for each trial from the whole range. An object may name its own.
    Where the sensor's gel names one, it moves the middle of the range, and objects still differ.
    """
    placement = rng.spawn(1)[0]  # a stream of its own, so that these keys shift no others
    of_memory, of_pressure, of_fall = placement.spawn(3)
    varied, texture, own_friction = scene.randomise, scene.texture or Texture(), sensor.friction

    def drawn(ends: tuple[float, float]) -> float:
        return float(rng.uniform(*ends))

    static = sensor.static_friction_factor * touched.static_friction * drawn(varied.static_friction)
    tilt_deg = drawn(varied.tilt_deg)
    if touched.tilt_deg is not None:  # the shape itself is slanted, so a finger's misalignment hardly matters
        tilt_deg = drawn(touched.tilt_deg)
    mass_g = touched.mass_g if scene.object is None else scene.object.mass_g
    mass_kg = mass_g * 1e-3 * drawn(varied.mass)
    kinetic_share = drawn(varied.kinetic_share)
    spread, of_gel, of_object = varied.kinetic_share_spread, own_friction.kinetic_share, touched.kinetic_share
    off_share = placement.uniform(-1, 1) * (spread or 0.0)
    if spread is not None and called is not None:
        own = np.random.default_rng([OBJECT_SEED, seed_of(called)]).uniform(*varied.kinetic_share)
        if of_gel is not None and of_object is None:  # objects differ on this gel as on any, about its own share
            own += of_gel - sum(varied.kinetic_share) / 2
            of_gel = None
        kinetic_share = float(np.clip(own + off_share, 0.0, 1.0))
    # the sensor's gel comes first, then the object, then what the scene samples
    kinetic_share = _first(of_gel, of_object, kinetic_share)
    stribeck_mm_s = drawn(varied.stribeck_mm_s)
    memory_um = float(of_memory.uniform(*varied.memory_um))
    pressure_exponent = float(of_pressure.uniform(*varied.pressure_exponent))
    touch_m = placement.uniform(-1e-3, 1e-3, 2) * varied.touch_mm
    lever_m = float(placement.normal()) * varied.lever_mm * 1e-3
    if touched.shape != "flat":
        lever_m = 0.0  # the weight of a round object acts on its axis, and there it is touched
    lever_m += touched.lever_mm * 1e-3
    slowest, fastest = scene.gripper.fall_factor
    return SampledTrial(
        mass_kg=mass_kg,
        static_friction=static,
        kinetic_friction=static * kinetic_share,
        stribeck_m_s=_first(own_friction.stribeck_mm_s, stribeck_mm_s) * 1e-3,
        friction_memory_m=_first(own_friction.memory_um, memory_um) * 1e-6,
        pressure_exponent=_first(own_friction.pressure_exponent, pressure_exponent),
        tilt_rad=float(np.deg2rad(tilt_deg)),
        gear_friction_factor=drawn(scene.gripper.friction_factor),
        start_factor=drawn(scene.gripper.start_factor),
        fall_factor=slowest * (fastest / slowest) ** float(of_fall.random()),
        texture_log_sd=drawn(texture.log_sd),
        texture_half_correlation_px=drawn(texture.half_correlation_px),
        touch_m=(float(touch_m[0]), float(touch_m[1])),
        lever_m=lever_m,
        floor_m=float(placement.uniform(*scene.floor.below_mm)) * 1e-3,
    )


def _first(*values: float | None) -> float:
    """The first value that is named."""
    return next(value for value in values if value is not None)


def sensor_with_gel(scene: Scene, sensor: Sensor) -> Sensor:
    """A sensor with its gel as much stiffer, in shear and under pressure, as the scene says (gel.stiffness_factor)."""
    factor = scene.gel.stiffness_factor
    if factor == 1.0:
        return sensor
    return replace(
        sensor,
        shear_modulus_pa=sensor.shear_modulus_pa * factor,
        normal_modulus_pa=sensor.normal_modulus_pa * factor,
    )


class GripperFaults(NamedTuple):
    """What a gripper does wrong, 0 where nothing is named."""

    backlash_ticks: float = 0.0
    encoder_noise_ticks: float = 0.0
    command_delay_ms: float = 0.0
    command_jitter_ms: float = 0.0


def gripper_faults(scene: Scene, sensor: Sensor) -> GripperFaults:
    """What the gripper of a trial does wrong: as the scene says, else as the sensor's own gripper does."""
    return GripperFaults(
        *(_first(getattr(scene.gripper, name), getattr(sensor.gripper, name)) for name in GripperFaults._fields)
    )


def sample_sensor(ranges: SensorRanges, rng: np.random.Generator) -> Sensor:
    """A sensor from the row of ranges; InputError on a range that is none or has no stream of its own.

    `dot_shift_x_px` and `dot_shift_y_px` move the columns and rows of dots, and `threshold_off_factor` is that of OFF
    over that of ON; they do not appear in the result.
    """
    _check_streams(ranges, "", {})
    row: dict[str, Any] = _sample(ranges, int(rng.integers(2**63)), "")
    for axis, lines in (("x", "dot_columns_px"), ("y", "dot_rows_px")):
        shift_px = row.pop(f"dot_shift_{axis}_px", 0.0)
        row[lines] = [line + shift_px for line in row[lines]]
    if "threshold_off_factor" in row:
        row["threshold_off"] = row["threshold"] * row.pop("threshold_off_factor")
    return build(Sensor, row)


def _is_range(entry: Any) -> bool:
    return isinstance(entry, Mapping) and ("stream" in entry or any(name in entry for name in DISTRIBUTIONS))


def _check_streams(entry: Any, place: str, owners: dict[int, str]) -> None:
    """Refuse a range without a stream, or with one that belongs to another; `owners` gets each stream's range."""
    if not _is_range(entry):
        for inner, below in _entries(entry, place):
            _check_streams(inner, below, owners)
        return
    stream = entry.get("stream")
    if type(stream) is not int or stream < 0:
        raise InputError(
            f"{place}: a range needs a random stream of its own",
            where="sensors.toml",
            expected="`stream`, a whole number that no other range has",
            found="no stream" if stream is None else str(stream),
        )
    if stream in owners:
        raise InputError(
            f"{place}: the same random stream as {owners[stream]}",
            where="sensors.toml",
            expected="`stream`, a whole number that no other range has",
            found=str(stream),
        )
    owners[stream] = place


def _entries(entry: Any, place: str) -> list[tuple[Any, str]]:
    """What a table or a list holds, with its place; nothing for a plain value."""
    if isinstance(entry, Mapping):
        return [(inner, f"{place}.{key}" if place else key) for key, inner in entry.items()]
    if isinstance(entry, list):
        return [(inner, f"{place}[{number}]") for number, inner in enumerate(entry)]
    return []


def _sample(entry: Any, seed: int, place: str) -> Any:
    """An entry with each range within it replaced by a value."""
    if _is_range(entry):
        return _sample_range(entry, seed, place)
    sampled = [_sample(inner, seed, below) for inner, below in _entries(entry, place)]
    if isinstance(entry, Mapping):
        return dict(zip(entry, sampled, strict=True))
    return sampled if isinstance(entry, list) else entry


def _sample_range(entry: Mapping[str, Any], seed: int, place: str) -> float | int:
    names = [name for name in entry if name != "stream"]
    if len(names) != 1 or names[0] not in DISTRIBUTIONS:
        expected = f"one of {', '.join(DISTRIBUTIONS)}"
        raise InputError(f"{place}: not a range", where="sensors.toml", expected=expected, found=", ".join(names))
    distribution, ends = names[0], entry[names[0]]
    low, high = ends if isinstance(ends, list) and len(ends) == 2 else (math.nan, math.nan)
    lowest = 0.0 if distribution == "log_uniform" else -math.inf
    if not lowest < low <= high < math.inf:
        expected = "[low, high]" + (", both above 0" if distribution == "log_uniform" else "")
        raise InputError(f"{place}: not a range", where="sensors.toml", expected=expected, found=str(ends))
    rng = np.random.default_rng([seed, entry["stream"]])
    if distribution == "whole":
        return int(rng.integers(int(low), int(high) + 1))
    if distribution == "log_uniform":
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return float(rng.uniform(low, high))
