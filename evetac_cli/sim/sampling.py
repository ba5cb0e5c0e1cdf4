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
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.sim.object_file import seed_of

OBJECT_SEED = 15485863  # with the object's number: what one object has in all trials
FLOOR_MM = (250.0, 250.0)
MEMORY_UM = 20.0  # as gel.MEMORY_M, which is not imported here: it loads numba, and a plan does not need it
GRIPPER_FAULTS = ("backlash_ticks", "encoder_noise_ticks", "command_delay_ms", "command_jitter_ms")
DISTRIBUTIONS = ("uniform", "log_uniform", "whole")


@dataclass(frozen=True)
class SampledTrial:
    """What was sampled for one trial from the ranges of its scene."""

    mass_kg: float
    static_friction: float
    kinetic_friction: float
    stribeck_m_s: float
    friction_memory_m: float  # over which friction follows the slip speed: a guess, none is known for this gel
    tilt_rad: float
    gear_friction_factor: float
    start_factor: float
    texture_log_sd: float
    texture_half_correlation_px: float
    touch_m: tuple[float, float]  # middle of the object from that of the pad where it is touched: along gravity, across
    lever_m: float  # centre of mass from there, across gravity
    floor_m: float  # where an object that fell comes to rest, below where it was held

    def as_json(self) -> str:
        """For the truth of a recording."""
        return json.dumps(asdict(self))


def sample_trial(
    scene: Mapping[str, Any],
    object_params: Mapping[str, Any],
    rng: np.random.Generator,
    sensor_row: Mapping[str, Any] | None = None,
    called: int | str | None = None,
) -> SampledTrial:
    """Sample a trial's parameters, always in the same order, so that a key of one scene does not shift another's.

    Where the scene names kinetic_share_spread, an object (by its number or name) has a kinetic share of its own, about
    which its trials spread; else the share is sampled for each trial from the whole range. An object may name its own.
    """
    placement = rng.spawn(1)[0]  # a stream of its own, so that these keys shift no others

    def between(group: str, key: str, default: tuple[float, float]) -> float:
        named = scene.get(group, {}).get(key, default)
        low, high = named if isinstance(named, Sequence) else (named, named)
        return float(rng.uniform(low, high))

    factor = float((sensor_row or {}).get("static_friction_factor", 1.0))
    static = factor * float(object_params["static_friction"]) * between("randomise", "static_friction", (1, 1))
    tilt_deg = between("randomise", "tilt_deg", (0, 0))
    if "tilt_deg" in object_params:  # the shape itself is slanted, so a finger's misalignment hardly matters
        tilt_deg = float(rng.uniform(*object_params["tilt_deg"]))
    mass_g = float(scene.get("object", {}).get("mass_g", object_params["mass_g"]))
    mass_kg = mass_g * 1e-3 * between("randomise", "mass", (1, 1))
    kinetic_share = between("randomise", "kinetic_share", (1, 1))
    varied = scene["randomise"]
    off_share = placement.uniform(-1, 1) * varied.get("kinetic_share_spread", 0.0)
    if "kinetic_share_spread" in varied and called is not None:
        own = np.random.default_rng([OBJECT_SEED, seed_of(called)]).uniform(*varied["kinetic_share"])
        kinetic_share = float(np.clip(own + off_share, 0.0, 1.0))
    own_friction = (sensor_row or {}).get("friction", {})  # of a sensor's gel, in place of what the scene samples
    kinetic_share = float(own_friction.get("kinetic_share", object_params.get("kinetic_share", kinetic_share)))
    stribeck_mm_s = between("randomise", "stribeck_mm_s", (10, 10))
    memory_um = own_friction.get("memory_um", varied.get("memory_um", MEMORY_UM))
    touch_m = placement.uniform(-1e-3, 1e-3, 2) * varied.get("touch_mm", 0.0)
    lever_m = float(placement.normal()) * varied.get("lever_mm", 0.0) * 1e-3
    if object_params.get("shape") != "flat":
        lever_m = 0.0  # the weight of a round object acts on its axis, and there it is touched
    lever_m += float(object_params.get("lever_mm", 0.0)) * 1e-3
    return SampledTrial(
        mass_kg=mass_kg,
        static_friction=static,
        kinetic_friction=static * kinetic_share,
        stribeck_m_s=float(own_friction.get("stribeck_mm_s", stribeck_mm_s)) * 1e-3,
        friction_memory_m=float(memory_um) * 1e-6,
        tilt_rad=float(np.deg2rad(tilt_deg)),
        gear_friction_factor=between("gripper", "friction_factor", (1, 1)),
        start_factor=between("gripper", "start_factor", (2, 2)),
        texture_log_sd=between("texture", "log_sd", (0.06, 0.06)),
        texture_half_correlation_px=between("texture", "half_correlation_px", (12, 12)),
        touch_m=(float(touch_m[0]), float(touch_m[1])),
        lever_m=lever_m,
        floor_m=float(placement.uniform(*scene.get("floor", {}).get("below_mm", FLOOR_MM))) * 1e-3,
    )


def sensor_with_gel(scene: Mapping[str, Any], sensor_row: Mapping[str, Any]) -> Mapping[str, Any]:
    """A sensor with its gel as much stiffer, in shear and under pressure, as the scene says (gel.stiffness_factor)."""
    factor = float(scene["gel"].get("stiffness_factor", 1.0))
    if factor == 1.0:
        return sensor_row
    moduli = ("shear_modulus_pa", "normal_modulus_pa")
    return {**sensor_row, **{name: float(sensor_row[name]) * factor for name in moduli}}


def gripper_faults(scene: Mapping[str, Any], sensor_row: Mapping[str, Any]) -> dict[str, float]:
    """What a gripper does wrong, 0 where nothing is named: as the scene says, else as the sensor's own gripper does."""
    in_scene, own = scene.get("gripper", {}), sensor_row.get("gripper", {})
    return {key: float(in_scene.get(key, own.get(key, 0.0))) for key in GRIPPER_FAULTS}


def sample_sensor(ranges: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A row as of a named sensor, from the row of ranges; InputError on a range that is none or has no own stream.

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
    return row


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
