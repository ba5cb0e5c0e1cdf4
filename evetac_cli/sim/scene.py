"""Scenes: what is simulated, in TOML, and the plan of each trial that follows from it.

A scene names the parts that exist and the ranges from which a trial's parameters are sampled (scenes/*.toml, checked
against schemas/scene.v1.json). Objects are rows of the paper's table (objects.toml), sensors rows of sensors.toml
or files like them (sensor_file.py).
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jsonschema
import numpy as np

from evetac_cli.errors import InputError, SceneError
from evetac_cli.kernels.sensitivity import Sensitivity
from evetac_cli.resources import SCENES, schemas, table
from evetac_cli.sim import object_file, sampling, sensor_file
from evetac_cli.sim.solver import resolve
from evetac_cli.text_files import as_toml, read_toml

FOR_EACH_TRIAL = "randomized"  # the row of sensors.toml that names ranges, not one sensor
SENSOR_SEED = 104729  # with the seeds of a trial: keeps what samples its sensor apart from what samples the trial
NUMBERED_SEED = 1299709  # with the number of a sensor
LOWEST_TONE_HZ = 1.0
HIGHEST_TONE_HZ = 2500.0  # half the scan rate of the camera

# What a kind of scene, and a kind of motion in it, cannot do without; the schema says the rest.
HELD = ("time.rest_s", "time.load_s", "time.longest_s")
NEEDED = {
    "ramp": (*HELD, "time.hold_s"),
    "hold": (*HELD, "gripper.open_ticks"),
    "lift": ("time.touch_s", "hand.height_mm", "hand.speed_mm_s", "hand.acceleration_mm_s2"),
    "press": ("time.rest_s", "face", "motion"),
    "rub": ("time.rest_s", "rub"),
    "tone": (),
}
NEEDED_OF_MOTION = {
    "waypoints": ("shear_n", "offset_mm", "count", "move_s", "pause_s"),
    "strokes": ("lines", "speed_mm_s", "approach_s"),
}
# What only some kinds of scene can have; the schema allows it in all.
GRIPPED = ("ramp", "lift", "hold")
ONLY_IN = {
    "hand": GRIPPED,
    "hand.height_mm": ("lift",),
    "hand.speed_mm_s": ("lift",),
    "hand.acceleration_mm_s2": ("lift",),
    "hand.profile": ("lift",),
    "hand.jerk": ("lift",),
    "gripper.backlash_ticks": GRIPPED,
    "gripper.second_finger": GRIPPED,
    "gripper.encoder_noise_ticks": GRIPPED,
    "gripper.current": ("hold",),
    "gripper.command_delay_ms": GRIPPED,
    "gripper.command_jitter_ms": GRIPPED,
    "object": GRIPPED,
    "friction_change": (*GRIPPED, "press", "rub"),
}
# What gripper.current stands in place of.
NOT_WITH_CURRENT = ("close_s", "grip_s", "ramp_s", "start_factor", "start_more_n")


def load(name_or_path: str) -> dict[str, Any]:
    """Read and check a scene: the name of one that comes with evetac, or a TOML file; SceneError if it is wrong."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = SCENES / f"{name_or_path}.toml"
        names = sorted(file.stem for file in SCENES.glob("*.toml"))
        if name_or_path not in names:
            near = get_close_matches(name_or_path, names, n=1)
            raise SceneError(
                "no such scene",
                where="--scene",
                expected=", ".join(names) + ", or a TOML file",
                found=name_or_path,
                hint=f"did you mean {near[0]}?" if near else "",
            )
    scene = read_toml(path, SceneError)
    _check(scene, str(path))
    return scene


def changed(name: str, changes: Mapping[str, Any]) -> str:
    """The text of a packaged scene with other values, tables key by key; a key whose value is None is left out.

    It is a scene of one's own, to be written to a file for --scene; what is wrong with it is said when it is loaded.
    """
    return as_toml(_merged(load(name), changes))


def _merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    new = {
        key: _merged(table.get(key, {}), value) if isinstance(value, Mapping) else value
        for key, value in changes.items()
    }
    return {key: value for key, value in {**table, **new}.items() if value is not None}


def _check(scene: dict[str, Any], where: str) -> None:
    rules = json.loads((schemas() / "scene.v1.json").read_text())
    errors = list(jsonschema.Draft202012Validator(rules).iter_errors(scene))
    misspelt = [error for error in errors if error.validator == "additionalProperties"]  # also why another is missing
    error = jsonschema.exceptions.best_match(misspelt or errors)
    if error is None:
        _check_needed(scene, where)
        return _check_ranges(scene, where)
    place = ".".join(str(step) for step in error.absolute_path) or "the scene"
    hint = ""
    if error.validator == "additionalProperties":
        known = list(error.schema["properties"])
        unknown = [key for key in error.instance if key not in known]
        near = get_close_matches(unknown[0], known, n=1)
        hint = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(known)}"
    raise SceneError(f"{place}: {error.message}", where=where, hint=hint)


def _check_needed(scene: dict[str, Any], where: str) -> None:
    """Check that what the kind of scene is made of is there, and nothing that it cannot have."""
    needed = list(NEEDED[scene["kind"]])
    if scene["kind"] == "press" and "motion" in scene:
        needed += [f"motion.{key}" for key in NEEDED_OF_MOTION[scene["motion"]["kind"]]]
    for name in needed:
        group, _, key = name.partition(".")
        if group not in scene or (key and key not in scene[group]):
            raise SceneError(
                f"{name} is missing", where=where, expected=", ".join(needed), found=f"kind {scene['kind']}"
            )
    for name, kinds in ONLY_IN.items():
        group, _, key = name.partition(".")
        if group in scene and (not key or key in scene[group]) and scene["kind"] not in kinds:
            raise SceneError(
                f"{name} is for another kind of scene",
                where=where,
                expected=f"kind {', '.join(kinds)}",
                found=f"kind {scene['kind']}",
            )


def _check_ranges(scene: dict[str, Any], where: str) -> None:
    """Check what JSON Schema cannot: a range's ends are in order."""
    for group in ("gripper", "randomise", "texture", "floor", "rub"):
        for key, value in scene.get(group, {}).items():
            if isinstance(value, list) and not isinstance(value[0], str) and value[0] > value[1]:
                raise SceneError(f"{group}.{key}: the lower end comes first", where=where, found=str(value))
    current = scene.get("gripper", {}).get("current")
    if current is not None:
        _check_current(scene, where)
    push = scene.get("push")
    if push is not None and len(push["at_s"]) != len(push["force_n"]):
        expected = f"one force for each of the {len(push['at_s'])} in at_s"
        raise SceneError("push.force_n: of another length", where=where, expected=expected, found=str(push["force_n"]))
    _check_vibration(scene, where)
    _check_tone(scene.get("tone", {}), where)


def _check_current(scene: dict[str, Any], where: str) -> None:
    """The gripper's current has one value at each of its times, which rise until the scene ends, and nothing beside it.

    Its square wave lies within these times.
    """
    gripper = scene["gripper"]
    current, at_s = gripper["current"], gripper["current"]["at_s"]
    beside = [key for key in NOT_WITH_CURRENT if key in gripper]
    if beside:
        raise SceneError(
            f"gripper.{beside[0]} has no effect with gripper.current",
            where=where,
            expected="one of the two: the gripper follows the current from the first ms to the last",
        )
    if any(after <= before for before, after in zip(at_s, at_s[1:], strict=False)):
        raise SceneError("gripper.current.at_s: expected rising times", where=where, found=str(at_s))
    if len(current["ma"]) != len(at_s):
        expected = f"one current for each of the {len(at_s)} in at_s"
        raise SceneError(
            "gripper.current.ma: of another length", where=where, expected=expected, found=str(current["ma"])
        )
    longest_s = scene["time"]["longest_s"]
    if at_s[-1] > longest_s:
        expected = f"times up to time.longest_s, {longest_s:g} s"
        raise SceneError("gripper.current.at_s: after the scene ends", where=where, expected=expected, found=str(at_s))
    square = current.get("square")
    if square is not None and not square["from_s"] < square["to_s"] <= at_s[-1]:
        expected = f"from_s < to_s, and to_s up to the last of at_s, {at_s[-1]:g} s"
        times = f"{square['from_s']:g} to {square['to_s']:g} s"
        raise SceneError(
            "gripper.current.square: not within the current's times", where=where, expected=expected, found=times
        )


def _check_vibration(scene: dict[str, Any], where: str) -> None:
    """Each sine wave of the hand's vibration has a frequency and an acceleration, and only a hand that rises moves."""
    vibration = scene.get("hand", {}).get("vibration")
    if vibration is None:
        return
    waves, accelerations = len(vibration["frequency_hz"]), vibration["acceleration_m_s2"]
    if len(accelerations) != waves:
        expected = f"one acceleration for each of the {waves} in frequency_hz"
        place = "hand.vibration.acceleration_m_s2: of another length"
        raise SceneError(place, where=where, expected=expected, found=str(accelerations))
    if vibration.get("only_moving", False) and scene["kind"] != "lift":
        raise SceneError(
            "hand.vibration.only_moving is for another kind of scene: in this one the hand does not rise",
            where=where,
            expected="kind lift",
            found=f"kind {scene['kind']}",
        )


def _check_tone(tone: dict[str, Any], where: str) -> None:
    """The table over frequency has columns of one length, rising frequencies, and h2's least is not above its most."""
    for key in ("tangential_share", "amplitude_factor", "drift_s"):
        if key in tone and tone[key][0] > tone[key][1]:
            raise SceneError(f"tone.{key}: the lower end comes first", where=where, found=str(tone[key]))
    if "at_hz" not in tone:
        return
    at_hz = tone["at_hz"]
    if any(after <= before for before, after in zip(at_hz, at_hz[1:], strict=False)):
        raise SceneError("tone.at_hz: expected rising frequencies", where=where, found=str(at_hz))
    for key in ("dot_motion_px", "second_harmonic_least", "second_harmonic_most", "modulation_most"):
        if len(tone[key]) != len(at_hz):
            expected = f"one value for each of the {len(at_hz)} in at_hz"
            raise SceneError(f"tone.{key}: of another length", where=where, expected=expected, found=str(tone[key]))
    if any(low > high for low, high in zip(tone["second_harmonic_least"], tone["second_harmonic_most"], strict=True)):
        raise SceneError("tone.second_harmonic_least: above its most", where=where)


def plan(
    scene_name: str,
    objects: str,
    sensor: str,
    kinds: tuple[str, ...],
    gel: str | None = None,
    readout: str = "dvxplorer",
    tones: str | None = None,
    solver: Mapping[str, Any] = MappingProxyType({}),
    *,
    texture: str | None = None,
) -> list[dict[str, Any]]:
    """What trials are made from, resolved, one plan an object or tone (one in all where the scene has neither).

    It goes into the header, so that a changed table is another recipe. `gel` cut or closed, `texture` on or off and
    settings of the `solver` override the scene's, and `tones` (as in 200,300) picks from them.
    """
    resolved = load(scene_name)
    try:
        resolved["solver"] = resolve(resolved, solver)
    except ValueError as error:
        raise SceneError(f"[solver]: {error}", where=scene_name) from error
    if gel is not None:
        resolved["gel"]["cut"] = gel == "cut"
    if texture is not None:
        _show_texture(resolved, texture == "on", scene_name)
    if resolved["kind"] not in kinds:
        raise SceneError(
            "this scene is for another command",
            where=scene_name,
            expected=f"kind {' or '.join(kinds)}",
            found=f"kind {resolved['kind']}",
            hint="lift scenes are grasped, all others are recorded",
        )
    sensor, row = named_sensor(sensor)
    named = {"sensor": sensor, "sensor_row": row, "readout": readout}
    common = {"scene": resolved, **named}
    if resolved["kind"] not in GRIPPED and object_file.SUFFIX in objects:
        expected = "a scene in which an object is held, as slip or lift"
        raise InputError("this scene holds no object", where="--object", expected=expected, found=scene_name)
    if resolved["kind"] == "tone":
        wanted = resolved["tone"].pop("frequency_hz")
        picked = wanted if tones is None else tones_hz(tones)
        return [{**common, "object": None, "tone_hz": float(tone)} for tone in picked]
    if tones is not None:
        raise InputError("this scene has no tones", where="--tone", expected="--scene vibration", found=scene_name)
    if resolved["kind"] in ("press", "rub"):
        driven = resolved["face" if resolved["kind"] == "press" else "rub"]
        face = {"static_friction": driven["static_friction"], "mass_g": 1.0}
        return [{**common, "object": None, "object_row": face}]
    return [{**common, "object": called, "object_row": row} for called, row in named_objects(objects).items()]


def _show_texture(resolved: dict[str, Any], shown: bool, scene_name: str) -> None:
    """Have the window show the texture of the object, or not; InputError where there is none to show."""
    named = resolved.get("texture")
    if named is None or (shown and not resolved["gel"]["cut"]):
        lacking = f"{scene_name}, which names no texture" if named is None else "a closed gel, which has no window"
        expected = "a scene with a texture and a cut gel"
        raise InputError("nothing to show", where="--texture", expected=expected, found=lacking)
    if shown != named.get("show", True):
        named["show"] = shown


def named_objects(text: str) -> dict[int | str, dict[str, Any]]:
    """Objects from `8`, `1-3,10` or `can.toml,8`: what recordings call each, and its row; InputError for others."""
    listed: dict[int | str, dict[str, Any]] = {}
    for part in text.split(","):
        if not part.strip().endswith(object_file.SUFFIX):
            listed |= {number: object_row(number) for number in numbers(part)}
            continue
        called, row = object_file.read(Path(part.strip()))
        if called in listed:
            expected = "a `name` of its own in each file"
            raise InputError("two objects of one name", where=part.strip(), expected=expected, found=called)
        listed[called] = row
    return listed


def object_row(number: int) -> dict[str, Any]:
    """The row of an object; InputError if there is no such object."""
    row = table("objects").get(str(number))
    if row is None:
        raise InputError("no such object", where="--object", expected="1 to 20", found=str(number))
    return dict(row)


def named_sensor(name_or_path: str) -> tuple[str, dict[str, Any]]:
    """What recordings call a sensor, and its row, of a named one or of a TOML file; InputError for anything else."""
    if name_or_path.endswith(sensor_file.SUFFIX):
        return sensor_file.read(Path(name_or_path), sensor_row)
    return name_or_path, sensor_row(name_or_path)


def sensor_row(name: str) -> dict[str, Any]:
    """The row of a sensor, `randomized:7` sampled by its number; InputError if there is no such sensor."""
    rows = table("sensors")
    number = re.fullmatch(f"{FOR_EACH_TRIAL}:([0-9]{{1,9}})", name)
    if number is not None:
        rng = np.random.default_rng([NUMBERED_SEED, int(number[1])])
        return sampling.sample_sensor(rows[FOR_EACH_TRIAL], rng)
    if name not in rows:
        near = get_close_matches(name, rows, n=1)
        raise InputError(
            "no such sensor",
            where="--sensor",
            expected=", ".join(rows) + ", randomized:NUMBER (0 to 999,999,999), or a TOML file",
            found=name,
            hint=f"did you mean {near[0]}?" if near and ":" not in name else "",
        )
    return dict(rows[name])


def sensitivity(sensor_row: Mapping[str, Any]) -> Sensitivity:
    """What a sensor's row says of how strongly it answers contact; ON and OFF thresholds averaged."""
    on = float(sensor_row["threshold"])
    off = float(sensor_row.get("threshold_off", on))
    ratio = float(sensor_row["log_contrast"]) * (1.0 / on + 1.0 / off) / 2.0
    return Sensitivity(ratio, float(sensor_row["shear_modulus_pa"]))


def for_trial(plan: dict[str, Any], seeds: Sequence[int]) -> dict[str, Any]:
    """The plan of one trial: where each has a sensor of its own, that is sampled; its ranges stay beside it."""
    if plan["sensor"] != FOR_EACH_TRIAL:
        return plan
    ranges = plan["sensor_row"]
    row = sampling.sample_sensor(ranges, np.random.default_rng([SENSOR_SEED, *seeds]))
    return {**plan, "sensor_row": row, "sensor_ranges": ranges}


def numbers(text: str) -> list[int]:
    """Object numbers from `8` or `1-3,10`, in their order, each once; InputError if it is anything else."""
    listed: list[int] = []
    for part in text.split(","):
        match = re.fullmatch("([0-9]{1,2})(?:-([0-9]{1,2}))?", part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            expected = "as in 8, 1-3,10 or can.toml"
            raise InputError("not a list of objects", where="--object", expected=expected, found=text[:60])
        listed += range(first, last + 1)
    return list(dict.fromkeys(listed))


def tones_hz(text: str) -> list[float]:
    """Frequencies from `200` or `200,300`, in their order, each once; InputError if it is anything else."""
    listed: list[float] = []
    for part in text.split(","):
        try:
            tone = float(part)
        except ValueError:
            tone = math.nan
        if not LOWEST_TONE_HZ <= tone <= HIGHEST_TONE_HZ:
            expected = f"{LOWEST_TONE_HZ:g} to {HIGHEST_TONE_HZ:g} Hz, as in 200 or 200,300"
            raise InputError("not a list of tones", where="--tone", expected=expected, found=text[:60])
        listed.append(tone)
    return list(dict.fromkeys(listed))
