"""Scenes: what is simulated, in TOML, and what is drawn from their ranges for one trajectory.

A scene names the parts that exist and the ranges from which a trajectory's parameters are drawn (scenes/*.toml, checked
against schemas/scene.v1.json). Objects are rows of the paper's table (objects.toml), individuals built sensors.
"""

import json
import math
import re
import tomllib
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np

from evetac_cli.errors import InputError, SceneError
from evetac_cli.resources import PACKAGE, schemas, table


def load(name_or_path: str) -> dict[str, Any]:
    """Read and check a scene: the name of one that comes with evetac, or a TOML file; SceneError if it is wrong."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = PACKAGE / "scenes" / f"{name_or_path}.toml"
        names = sorted(file.stem for file in (PACKAGE / "scenes").glob("*.toml"))
        if name_or_path not in names:
            near = get_close_matches(name_or_path, names, n=1)
            raise SceneError(
                "no such scene",
                where="--scene",
                expected=", ".join(names) + ", or a TOML file",
                found=name_or_path,
                hint=f"did you mean {near[0]}?" if near else "",
            )
    try:
        scene = tomllib.loads(path.read_text())
    except OSError as error:
        raise SceneError(f"cannot be read: {error.strerror}", where=str(path)) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SceneError(f"not valid TOML: {error}", where=str(path)) from None
    _check_finite(scene, str(path), "")
    _check(scene, str(path))
    return scene


def _check(scene: dict[str, Any], where: str) -> None:
    rules = json.loads((schemas() / "scene.v1.json").read_text())
    error = jsonschema.exceptions.best_match(jsonschema.Draft202012Validator(rules).iter_errors(scene))
    if error is None:
        return _check_ranges(scene, where)
    place = ".".join(str(step) for step in error.absolute_path) or "the scene"
    hint = ""
    if error.validator == "additionalProperties":
        known = list(error.schema["properties"])
        unknown = [key for key in error.instance if key not in known]
        near = get_close_matches(unknown[0], known, n=1)
        hint = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(known)}"
    raise SceneError(f"{place}: {error.message}", where=where, hint=hint)


def _check_finite(value: Any, where: str, place: str) -> None:
    """Refuse nan and inf, which TOML can write and JSON Schema does not see."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check_finite(item, where, f"{place}.{key}" if place else key)
    elif isinstance(value, list):
        for item in value:
            _check_finite(item, where, place)
    elif isinstance(value, float) and not math.isfinite(value):
        raise SceneError(f"{place}: not a finite number", where=where, found=str(value))


def _check_ranges(scene: dict[str, Any], where: str) -> None:
    """What JSON Schema cannot say: a range's ends are in order."""
    for group in ("gripper", "randomise", "texture"):
        for key, value in scene.get(group, {}).items():
            if isinstance(value, list) and value[0] > value[1]:
                raise SceneError(f"{group}.{key}: the lower end comes first", where=where, found=str(value))


def plan(
    scene_name: str,
    objects: str,
    individual: str,
    kinds: tuple[str, ...],
    gel: str | None = None,
    readout: str = "dvxplorer",
) -> list[dict[str, Any]]:
    """What trials are made from, resolved, one plan an object (one in all where the scene has none).

    It goes into the header, so that a changed table is another recipe. `gel` cut or closed overrides the scene's.
    """
    resolved = load(scene_name)
    if gel is not None:
        resolved["gel"]["cut"] = gel == "cut"
    if resolved["kind"] not in kinds:
        raise SceneError(
            "this scene is for another command",
            where=scene_name,
            expected=f"kind {' or '.join(kinds)}",
            found=f"kind {resolved['kind']}",
            hint="lift scenes are grasped, all others are recorded",
        )
    named = {"individual": individual, "individual_row": individual_row(individual), "readout": readout}
    common = {"scene": resolved, **named}
    if resolved["kind"] == "press":
        face = {"static_friction": resolved["face"]["static_friction"], "mass_g": 1.0}
        return [{**common, "object": None, "object_row": face}]
    return [{**common, "object": number, "object_row": object_row(number)} for number in numbers(objects)]


def object_row(number: int) -> dict[str, Any]:
    """The row of an object; InputError if there is no such object."""
    row = table("objects").get(str(number))
    if row is None:
        raise InputError("no such object", where="--object", expected="1 to 20", found=str(number))
    return dict(row)


def individual_row(name: str) -> dict[str, Any]:
    """The row of a sensor individual; InputError if there is no such individual."""
    rows = table("individuals")
    if name not in rows:
        near = get_close_matches(name, rows, n=1)
        raise InputError(
            "no such individual",
            where="--individual",
            expected=", ".join(rows),
            found=name,
            hint=f"did you mean {near[0]}?" if near else "",
        )
    return dict(rows[name])


def numbers(text: str) -> list[int]:
    """Object numbers from `8` or `1-3,10`, in their order, each once; InputError if it is anything else."""
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch("([0-9]{1,2})(?:-([0-9]{1,2}))?", part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last:
            raise InputError("not a list of objects", where="--object", expected="as in 8 or 1-3,10", found=text[:60])
        found += range(first, last + 1)
    return list(dict.fromkeys(found))


@dataclass(frozen=True)
class Drawn:
    """What was drawn for one trajectory from the ranges of its scene."""

    mass_kg: float
    static_friction: float
    kinetic_friction: float
    stribeck_m_s: float
    tilt_rad: float
    gear_friction_factor: float
    start_factor: float
    texture_log_sd: float
    texture_half_correlation_px: float

    def as_json(self) -> str:
        """For the truth of a recording."""
        return json.dumps(asdict(self))


def draw(scene: dict[str, Any], thing: dict[str, Any], rng: np.random.Generator) -> Drawn:
    """Draw a trajectory's parameters; always in the same order, so that a key of one scene does not shift another's."""

    def between(group: str, key: str, default: tuple[float, float]) -> float:
        low, high = scene.get(group, {}).get(key, default)
        return float(rng.uniform(low, high))

    static = float(thing["static_friction"]) * between("randomise", "static_friction", (1, 1))
    tilt_deg = between("randomise", "tilt_deg", (0, 0))
    if "tilt_deg" in thing:  # the shape itself is slanted, so a finger's misalignment hardly matters
        tilt_deg = float(rng.uniform(*thing["tilt_deg"]))
    return Drawn(
        mass_kg=float(thing["mass_g"]) * 1e-3 * between("randomise", "mass", (1, 1)),
        static_friction=static,
        kinetic_friction=static * between("randomise", "kinetic_share", (1, 1)),
        stribeck_m_s=between("randomise", "stribeck_mm_s", (10, 10)) * 1e-3,
        tilt_rad=float(np.deg2rad(tilt_deg)),
        gear_friction_factor=between("gripper", "friction_factor", (1, 1)),
        start_factor=between("gripper", "start_factor", (2, 2)),
        texture_log_sd=between("texture", "log_sd", (0.06, 0.06)),
        texture_half_correlation_px=between("texture", "half_correlation_px", (12, 12)),
    )


def parts(plan: dict[str, Any]) -> list[dict[str, Any]]:
    """What a plan builds and what it leaves out, a row a part: a scene pays only for what it names."""
    resolved, individual = plan["scene"], plan["individual_row"]
    cut, kind = resolved["gel"]["cut"], resolved["kind"]
    columns, rows = resolved["gel"]["nodes"]
    gripped = kind != "press"
    dots = len(individual["dot_rows_px"]) * (len(individual["dot_columns_px"]) - cut)
    pressed = f"a face, {resolved['motion']['kind']}" if kind == "press" else f"object {plan['object']}"
    mode = {"ramp": "current", "hold": "position, then current", "lift": "position"}.get(kind, "")
    readout = {"dvxplorer": "5000 scans/s, global hold", "ideal": "every event to the us"}[plan["readout"]]
    noise = f"{individual['noise_hz']:g} Hz a pixel, {individual['hot_pixels']} hot pixels"
    window = "texture of the object, moved with it" if cut and "texture" in resolved else ""
    left_out = "closed gel: the gel is there" if not cut else "nothing behind it has texture"
    table = [
        ("gel and friction", f"{columns} x {rows} nodes, 1 ms steps", ""),
        ("what touches", pressed, ""),
        ("gripper", f"{mode} mode" if gripped else "", "a hand drives the face"),
        ("free object", "mass, weight, rotation" if gripped else "", "its motion is prescribed"),
        ("table and hand", "lift" if kind == "lift" else "", "nothing is lifted"),
        ("pushes", f"{len(resolved['push']['at_s'])} half sines" if "push" in resolved else "", "none named"),
        ("falling weight", f"{resolved['drop']['mass_g']} g" if "drop" in resolved else "", "none named"),
        ("dots", f"{dots}, evaluated while they move", ""),
        ("window", window, left_out),
        ("camera", readout, ""),
        ("noise", noise, ""),
    ]
    return [{"part": part, "built": built or None, "left_out": None if built else why} for part, built, why in table]
