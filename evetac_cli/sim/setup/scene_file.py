"""Read and check scenes: those that come with evetac (data/scenes/), and your own TOML files."""

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from evetac_cli import plugins
from evetac_cli.errors import SceneError, did_you_mean
from evetac_cli.resources import SCENES
from evetac_cli.sim.setup.scene import LIFT_PITCH_MM, Scene
from evetac_cli.sim.setup.tables import as_table, read_table
from evetac_cli.text_files import as_toml, read_toml

SUFFIX = ".toml"
# Keys of [gripper] that another key replaces.
IN_PLACE_OF = {
    "start_n": ("start_factor", "start_more_n"),
    "open_s": ("ramp_s",),
    "current": ("close_s", "grip_s", "ramp_s", "open_s", "start_factor", "start_more_n", "start_n"),
}


def load(name_or_path: str) -> Scene:
    """Read a scene by its name (from evetac or a plug-in) or from a TOML file; SceneError if it is invalid."""
    path = _path_of(name_or_path)
    return of_table(read_toml(path, SceneError), str(path))


def states_pitch(name_or_path: str) -> bool:
    """Return whether the file of a scene states the distance of the gel's nodes; SceneError as for `load`."""
    return "node_pitch_mm" in read_toml(_path_of(name_or_path), SceneError).get("solver", {})


def _path_of(name: str) -> Path:
    """Return the file of a scene by its name or path; SceneError if there is no scene of this name."""
    if name.endswith(SUFFIX):
        return Path(name)
    if name in plugins.OURS[plugins.SCENES]:
        return SCENES / f"{name}{SUFFIX}"
    path = plugins.find_file(plugins.SCENES, name)
    if path is None:
        every = sorted((*plugins.OURS[plugins.SCENES], *plugins.usable(plugins.SCENES)))
        raise SceneError(
            "no such scene",
            where="--scene",
            expected=", ".join(every) + ", or a TOML file",
            found=name,
            hint=did_you_mean(name, every),
        )
    return path


def load_of_kind(name_or_path: str, kinds: tuple[str, ...]) -> Scene:
    """Read a scene, as `load` does; SceneError if it is of a different kind."""
    scene = load(name_or_path)
    if scene.kind not in kinds:
        expected, found = f"kind {' or '.join(kinds)}", f"kind {scene.kind}"
        if "lift" in (scene.kind, *kinds):
            message = "this scene is for another command"
            hint = "`evetac grasp` simulates lift scenes, `evetac record` all others"
        else:
            message = "virtual devices cannot show this scene, in which no gripper holds an object"
            hint = f"leave out --camera virtual: evetac record --scene {shlex.quote(name_or_path)} simulates it"
        raise SceneError(message, where=name_or_path, expected=expected, found=found, hint=hint)
    return scene


def of_table(table: Mapping[str, Any], where: str) -> Scene:
    """Build a scene from its table; SceneError if it is not a scene or its values contradict each other."""
    scene = read_table(Scene, table, where, error=SceneError)
    if scene.kind == "lift" and "node_pitch_mm" not in table.get("solver", {}):
        scene = replace(scene, solver=replace(scene.solver, node_pitch_mm=LIFT_PITCH_MM))
    for key, others in IN_PLACE_OF.items():
        given = table.get("gripper", {})
        beside = [other for other in others if other in given]
        if key in given and beside:
            no_effect = f"gripper.{beside[0]} has no effect with gripper.{key}"
            raise SceneError(no_effect, where=where, expected="only one of the two")
    current, longest_s = scene.gripper.current, scene.time.longest_s
    if current is not None and current.ends_s > longest_s:
        expected = f"times up to time.longest_s, {longest_s:g} s"
        message = "gripper.current.at_s: a time is after the end of the scene"
        raise SceneError(message, where=where, expected=expected, found=f"{current.ends_s:g} s")
    return scene


def changed(name: str, changes: Mapping[str, Any]) -> str:
    """Return the TOML text of one of evetac's scenes with changed values; a key whose value is None is left out.

    Tables are merged key by key. The text is meant for your own scene file for --scene; it is checked when loaded.
    """
    return as_toml(merged(as_table(load(name)), changes))


def merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with changed values, inner tables merged key by key; a key whose value is None is left out."""
    new = {
        key: merged(table.get(key, {}), value) if isinstance(value, Mapping) else value
        for key, value in changes.items()
    }
    return {key: value for key, value in {**table, **new}.items() if value is not None}
