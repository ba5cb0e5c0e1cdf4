"""The plan of a trial: the scene, sensor and object that are simulated and recorded in its recipe.

A scene names the parts that exist and the ranges from which a trial's parameters are sampled. Objects are rows of the
paper's table or files. Sensors are rows of sensors.toml or files.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from evetac_cli import plugins
from evetac_cli.errors import InputError, did_you_mean
from evetac_cli.sim.setup import object_file, sampling, scene_file, sensor_file
from evetac_cli.sim.setup.object_file import TouchedObject
from evetac_cli.sim.setup.scene import KINDS, Scene, Texture, with_given
from evetac_cli.sim.setup.sensor import Sensor, SensorRanges
from evetac_cli.sim.setup.sensor_file import FOR_EACH_TRIAL, rows
from evetac_cli.sim.setup.tables import as_table, read_table

READOUT = "dvxplorer"  # scans; in every recipe since there was a second readout, so that ids stay the same
SENSOR_SEED = 104729  # with the seeds of a trial: separates the sampling of its sensor from that of the trial
NUMBERED_SEED = 1299709  # with the number of a sensor: seeds the sampling of randomized:NUMBER
LOWEST_TONE_HZ = 1.0
HIGHEST_TONE_HZ = 2500.0  # half the scan rate of the camera

SECOND_SENSOR, SECOND_ROW = "second_sensor", "second_sensor_row"  # header keys of a grasp with two cameras
SECOND = 1  # with the seeds of a trial: seeds the sampling of the second finger's sensor

ObjectName = int | str | None  # an object's number or name; None if the scene has no object
# Header keys that describe the plan of a simulated recording, besides those of its sensor.
OF_HEADER: dict[str, Any] = {
    "scene": dict,
    "sensor": str,
    "object": ObjectName,
    "object_row": dict | None,
    "tone_hz": float | None,
    "sensor_ranges": dict | None,
}


class NamedSensor(NamedTuple):
    """A sensor and its name in recordings."""

    name: str
    sensor: Sensor


@dataclass(frozen=True)
class Plan:
    """The scene, sensor and object of one trial.

    sensor_ranges: the ranges from which the sensor was sampled, if it was sampled for this trial.

    tone_hz: the speaker's frequency, in scenes of kind tone.

    second: the sensor of the gripper's second finger, if that has a camera.
    """

    scene: Scene
    sensor_name: str
    sensor: Sensor
    object_name: ObjectName = None
    object: TouchedObject | None = None
    tone_hz: float | None = None
    sensor_ranges: SensorRanges | None = None
    second: "NamedSensor | None" = None

    @property
    def fingers_differ(self) -> bool:
        """Whether the second finger differs from the first, or has a camera."""
        return self.second is not None or self.scene.gripper.second_finger is not None

    def of_gripper(self, key: str) -> float:
        """Return a value of the gripper: the scene's, or that of the sensor's gripper if the scene leaves it out."""
        of_scene = getattr(self.scene.gripper, key)
        return float(getattr(self.sensor.gripper, key) if of_scene is None else of_scene)

    def with_gel_of_scene(self) -> "Plan":
        """Return the plan with sensors whose gel is stiffer by the scene's gel.stiffness_factor."""
        factor, second = self.scene.gel.stiffness_factor, self.second
        if factor == 1.0:
            return self
        second = None if second is None else second._replace(sensor=second.sensor.stiffer(factor))
        return replace(self, sensor=self.sensor.stiffer(factor), second=second)

    def parameters(self) -> dict[str, Any]:
        """Return the plan as it enters a recipe, so that a changed table gives another recipe."""
        values: dict[str, Any] = {
            "scene": as_table(self.scene),
            "sensor": self.sensor_name,
            "sensor_row": as_table(self.sensor),
            "readout": READOUT,
            "object": self.object_name,
        }
        if self.object is not None:
            values["object_row"] = as_table(self.object)
        if self.tone_hz is not None:
            values["tone_hz"] = self.tone_hz
        if self.sensor_ranges is not None:
            values["sensor_ranges"] = dict(self.sensor_ranges)
        if self.second is not None:
            values |= {SECOND_SENSOR: self.second.name, SECOND_ROW: as_table(self.second.sensor)}
        return values


def read_plan(parameters: Mapping[str, Any], where: str) -> Plan:
    """Read the plan of a recording from the parameters of its header; InputError if they contain none."""
    for key, type_ in OF_HEADER.items():
        if not isinstance(parameters.get(key), type_):
            found = f"{parameters.get(key)}"[:100]
            raise InputError("the header has no plan of a simulated trial", where=where, expected=key, found=found)
    scene, row, tone_hz = parameters["scene"], parameters.get("object_row"), parameters.get("tone_hz")
    second = parameters.get(SECOND_ROW)
    if second is not None:
        second = read_table(Sensor, second, f"{where}: second sensor in the header")
        second = NamedSensor(str(parameters.get(SECOND_SENSOR)), second)
    if isinstance(scene.get("tone"), dict):
        scene = {**scene, "tone": {"frequency_hz": [tone_hz], **scene["tone"]}}
    if row is not None:
        row = read_table(TouchedObject, {"shape": "flat", **row}, f"{where}: object in the header")  # a face is flat
    return Plan(
        read_table(Scene, scene, f"{where}: scene in the header"),
        parameters["sensor"],
        read_sensor(parameters, where),
        parameters.get("object"),
        row,
        tone_hz,
        parameters.get("sensor_ranges"),
        second,
    )


def read_sensor(parameters: Mapping[str, Any], where: str) -> Sensor:
    """Read the simulated sensor from the parameters of a recording; InputError if they do not contain it."""
    if "sensor_row" not in parameters:
        raise InputError("the recording does not describe its sensor", where=where)
    return read_table(Sensor, parameters["sensor_row"], f"{where}: sensor in the header")


@dataclass(frozen=True)
class PlanTemplate:
    """The plans of all trials with one object or tone.

    sensor: one sensor, or the ranges from which each trial samples a sensor.

    second: name in recordings of the second finger's sensor, and that sensor or its ranges; None if it has no camera.
    """

    scene: Scene
    sensor_name: str
    sensor: Sensor | SensorRanges
    object_name: ObjectName = None
    object: TouchedObject | None = None
    tone_hz: float | None = None
    second: tuple[str, Sensor | SensorRanges] | None = None

    def of_trial(self, seeds: Sequence[int] = ()) -> Plan:
        """Return the plan of the trial with these seeds, which matter only if each trial samples its own sensor."""
        of_scene = (self.scene, self.sensor_name, _sampled(self.sensor, *seeds))
        ranges = None if isinstance(self.sensor, Sensor) else self.sensor
        second = self.second and NamedSensor(self.second[0], _sampled(self.second[1], *seeds, SECOND))
        return Plan(*of_scene, self.object_name, self.object, self.tone_hz, ranges, second)


def _sampled(sensor: Sensor | SensorRanges, *seeds: int) -> Sensor:
    if isinstance(sensor, Sensor):
        return sensor
    return sampling.sample_sensor(sensor, np.random.default_rng([SENSOR_SEED, *seeds]))


def plans(
    scene_name: str,
    objects: str,
    sensor: str,
    kinds: tuple[str, ...],
    gel: str | None = None,
    tones: str | None = None,
    solver: Mapping[str, Any] = MappingProxyType({}),
    *,
    texture: str | None = None,
) -> list[PlanTemplate]:
    """Return the plans of trials, one per object or tone (a single one if the scene has neither).

    `gel` (cut or closed), `texture` (on or off) and settings of the `solver` override the scene's. `tones` replaces the
    scene's tones, for example 200,300. InputError if they contradict the scene, or the scene is not of one of `kinds`.
    """
    scene = scene_file.load_of_kind(scene_name, kinds)
    scene = replace(scene, solver=with_given(scene.solver, solver, scene_name))
    if gel is not None:
        scene = replace(scene, gel=replace(scene.gel, cut=gel == "cut"))
    if texture is not None:
        scene = replace(scene, texture=_shown(scene, texture == "on", scene_name))
    seen_by = named_sensor(sensor)
    if not scene.is_gripped and object_file.SUFFIX in objects:
        expected = "a scene in which a gripper holds an object, for example slip or lift"
        raise InputError("this scene holds no object", where="--object", expected=expected, found=scene_name)
    if scene.tone is not None:
        picked = scene.tone.frequency_hz if tones is None else tones_hz(tones)
        # A recording depends only on its own tone, not on the scene's other tones.
        alone = [replace(scene, tone=replace(scene.tone, frequency_hz=(tone,))) for tone in picked]
        return [PlanTemplate(one, *seen_by, tone_hz=tone) for one, tone in zip(alone, picked, strict=True)]
    if tones is not None:
        raise InputError("this scene has no tones", where="--tone", expected="--scene vibration", found=scene_name)
    driven = scene.face or scene.rub
    if driven is not None:
        surface = TouchedObject(shape="flat", static_friction=driven.static_friction)
        return [PlanTemplate(scene, *seen_by, object=surface)]
    return [PlanTemplate(scene, *seen_by, name, object) for name, object in named_objects(objects).items()]


def with_second(plan: PlanTemplate, sensor: str) -> PlanTemplate:
    """Return the plan with a camera of this sensor at the second finger; InputError if the scene has none."""
    if not plan.scene.is_gripped:
        found = plan.scene.name
        raise InputError("this scene has no second finger", where="--camera", expected="one camera", found=found)
    return replace(plan, second=named_sensor(sensor))


def first_plan(scene_name: str, objects: str = "8", sensor: str = "evetac", **more: Any) -> Plan:
    """Return the plan of one trial with the first of the objects or tones, for a scene of any kind."""
    kinds = more.pop("kinds", KINDS)
    return plans(scene_name, objects, sensor, kinds, **more)[0].of_trial()


def _shown(scene: Scene, shown: bool, scene_name: str) -> Texture:
    """Return the texture of a scene, shown in the window or not; InputError if there is no texture or no window."""
    if scene.texture is None or (shown and not scene.gel.cut):
        lacking = (
            f"{scene_name}, which has no texture" if scene.texture is None else "a closed gel, which has no window"
        )
        expected = "a scene with a texture and a cut gel"
        raise InputError("no texture can be shown", where="--texture", expected=expected, found=lacking)
    return replace(scene.texture, show=shown)


def named_objects(text: str) -> dict[int | str, TouchedObject]:
    """Return objects from `8`, `1-3,10`, `can.toml,8` or a plug-in's name, by their names in recordings.

    InputError if there is no such object.
    """
    listed: dict[int | str, TouchedObject] = {}
    for part in map(str.strip, text.split(",")):
        file = Path(part) if part.endswith(object_file.SUFFIX) else plugins.find_file(plugins.OBJECTS, part)
        if file is None:
            listed |= {number: object_file.of_number(number) for number in numbers(part)}
            continue
        object_name, object = object_file.read(file)
        object_name = object_name if part.endswith(object_file.SUFFIX) else part
        if object_name in listed:
            expected = "a different `name` in each file"
            raise InputError("two objects have the same name", where=part, expected=expected, found=object_name)
        listed[object_name] = object
    return listed


def named_sensor(name_or_path: str) -> tuple[str, Sensor | SensorRanges]:
    """Return a sensor's name in recordings and the sensor, by name or from a TOML file; InputError if there is none.

    For `randomized` and `randomized-narrow`, which sample a sensor for each trial, return the ranges.
    """
    if "," in name_or_path and not Path(name_or_path).exists():
        raise InputError(
            "no such sensor",
            where="--sensor",
            expected="one sensor, or one per camera, as in --camera sim,sim",
            found=name_or_path,
            hint="run the command once for each sensor",
        )
    if name_or_path.endswith(sensor_file.SUFFIX):
        return sensor_file.read(Path(name_or_path), one_sensor)
    return name_or_path, sensor_ranges(name_or_path) if name_or_path in FOR_EACH_TRIAL else one_sensor(name_or_path)


def sensor_ranges(name: str = FOR_EACH_TRIAL[0]) -> SensorRanges:
    """Return the ranges from which sensors of this name are sampled."""
    return rows()[name]


def one_sensor(name: str) -> Sensor:
    """Return a sensor of evetac or a plug-in by name; InputError if there is none.

    `randomized:7` is sampled with the number as its seed.
    """
    file = plugins.find_file(plugins.SENSORS, name)
    return _sensor_of_ours(name) if file is None else sensor_file.read(file, _sensor_of_ours)[1]


def _sensor_of_ours(name: str) -> Sensor:
    row_by_name = rows()
    number = re.fullmatch(f"({'|'.join(FOR_EACH_TRIAL)}):([0-9]{{1,9}})", name)
    if number is not None:
        rng = np.random.default_rng([NUMBERED_SEED, int(number[2])])
        return sampling.sample_sensor(sensor_ranges(number[1]), rng)
    if name not in row_by_name or name in FOR_EACH_TRIAL:
        raise InputError(
            "no such sensor",
            where="--sensor",
            expected=", ".join((*row_by_name, *plugins.usable(plugins.SENSORS)))
            + ", randomized:NUMBER (0 to 999,999,999), or a TOML file",
            found=name,
            hint="" if ":" in name else did_you_mean(name, row_by_name),
        )
    return read_table(Sensor, row_by_name[name], "sensors.toml")


def numbers(text: str) -> list[int]:
    """Return object numbers from `8` or `1-3,10`, in the given order, each once; InputError for other text."""
    listed: list[int] = []
    for part in text.split(","):
        match = re.fullmatch("([0-9]{1,2})(?:-([0-9]{1,2}))?", part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            expected = "for example 8, 1-3,10 or can.toml"
            raise InputError("not a list of objects", where="--object", expected=expected, found=text[:60])
        listed += range(first, last + 1)
    return list(dict.fromkeys(listed))


def tones_hz(text: str) -> list[float]:
    """Return frequencies in Hz from `200` or `200,300`, in the given order, each once; InputError for other text."""
    listed: list[float] = []
    for part in text.split(","):
        try:
            tone = float(part)
        except ValueError:
            tone = math.nan
        if not LOWEST_TONE_HZ <= tone <= HIGHEST_TONE_HZ:
            expected = f"{LOWEST_TONE_HZ:g} to {HIGHEST_TONE_HZ:g} Hz, for example 200 or 200,300"
            raise InputError("not a list of tones", where="--tone", expected=expected, found=text[:60])
        listed.append(tone)
    return list(dict.fromkeys(listed))
