"""Reads scenes: those that come with evetac (data/scenes/), and one's own TOML files, checked in words."""

import shlex
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from evetac_cli import plugins
from evetac_cli.errors import SceneError
from evetac_cli.resources import SCENES
from evetac_cli.sim.setup.driven import Speaker
from evetac_cli.sim.setup.held import GripperCurrent, GripperSettings
from evetac_cli.sim.setup.scene import Scene
from evetac_cli.sim.setup.tables import as_table, build, check
from evetac_cli.text_files import as_toml, read_toml

SUFFIX = ".toml"
# What gripper.current stands in place of.
NOT_WITH_CURRENT = ("close_s", "grip_s", "ramp_s", "open_s", "start_factor", "start_more_n", "start_n")
# What other keys of the gripper stand in place of.
IN_PLACE_OF = {"start_n": ("start_factor", "start_more_n"), "open_s": ("ramp_s",)}


def load(name_or_path: str) -> Scene:
    """A scene: by the name of one that comes with evetac or a plug-in, or a TOML file; SceneError if it is wrong."""
    path = Path(name_or_path) if name_or_path.endswith(SUFFIX) else _named(name_or_path)
    return of_table(read_toml(path, SceneError), str(path))


def _named(name: str) -> Path:
    """The file of a scene by its name; SceneError if there is no such scene."""
    if name in plugins.OURS[plugins.SCENES]:
        return SCENES / f"{name}{SUFFIX}"
    path = plugins.find_file(plugins.SCENES, name)
    if path is None:
        every = sorted((*plugins.OURS[plugins.SCENES], *plugins.usable(plugins.SCENES)))
        near = get_close_matches(name, every, n=1)
        raise SceneError(
            "no such scene",
            where="--scene",
            expected=", ".join(every) + ", or a TOML file",
            found=name,
            hint=f"did you mean {near[0]}?" if near else "",
        )
    return path


def load_of_kind(name_or_path: str, kinds: tuple[str, ...]) -> Scene:
    """A scene of one of these kinds, as `load`; SceneError if it is of another."""
    scene = load(name_or_path)
    if scene.kind not in kinds:
        expected, found = f"kind {' or '.join(kinds)}", f"kind {scene.kind}"
        if "lift" in (scene.kind, *kinds):
            message, hint = "this scene is for another command", "lift scenes are grasped, all others are recorded"
        else:
            message = "virtual devices do not show this scene, in which no gripper holds an object"
            hint = f"leave out --camera virtual: evetac record --scene {shlex.quote(name_or_path)} simulates it"
        raise SceneError(message, where=name_or_path, expected=expected, found=found, hint=hint)
    return scene


def of_table(table: Mapping[str, Any], where: str) -> Scene:
    """A scene from its table; SceneError where it is no scene, or its values do not fit together."""
    check(Scene, table, where, error=SceneError)
    try:
        scene = build(Scene, table)
    except ValueError as error:  # a fixed step that does not divide a slice
        raise SceneError(f"solver: {error}", where=where) from None
    _check_gripper(scene.gripper, table.get("gripper", {}), where)
    if scene.gripper.current is not None:
        _check_current(scene, scene.gripper.current, table["gripper"], where)
    if scene.tone is not None:
        _check_tone(scene.tone, where)
    return scene


def changed(name: str, changes: Mapping[str, Any]) -> str:
    """The text of a packaged scene with other values, tables key by key; a key whose value is None is left out.

    It is a scene of one's own, to be written to a file for --scene; what is wrong with it is said when it is loaded.
    """
    return as_toml(merged(as_table(load(name)), changes))


def merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A table with other values, tables within key by key; a key whose value is None is left out."""
    new = {
        key: merged(table.get(key, {}), value) if isinstance(value, Mapping) else value
        for key, value in changes.items()
    }
    return {key: value for key, value in {**table, **new}.items() if value is not None}


def _check_gripper(gripper: GripperSettings, named: Mapping[str, Any], where: str) -> None:
    """No key is named beside the one that takes its place, and the gripper opens after it has gripped."""
    for key, others in IN_PLACE_OF.items():
        beside = [other for other in others if other in named]
        if key in named and beside:
            no_effect = f"gripper.{beside[0]} has no effect with gripper.{key}"
            raise SceneError(no_effect, where=where, expected="one of the two")
    if gripper.open_s is not None and gripper.open_s <= gripper.grip_s:
        expected, found = f"after gripper.grip_s, {gripper.grip_s:g} s", f"{gripper.open_s:g} s"
        raise SceneError("gripper.open_s: before it has gripped", where=where, expected=expected, found=found)


def _check_current(scene: Scene, current: GripperCurrent, named: Mapping[str, Any], where: str) -> None:
    """Nothing stands beside the gripper's current, and it and its square wave lie within the scene."""
    beside = [key for key in NOT_WITH_CURRENT if key in named]
    if beside:
        raise SceneError(
            f"gripper.{beside[0]} has no effect with gripper.current",
            where=where,
            expected="one of the two: the gripper follows the current from the first ms to the last",
        )
    longest_s, at_s = scene.time.longest_s, list(current.at_s)
    if current.ends_s > longest_s:
        expected = f"times up to time.longest_s, {longest_s:g} s"
        raise SceneError("gripper.current.at_s: after the scene ends", where=where, expected=expected, found=str(at_s))
    square = current.square
    if square is not None and not square.from_s < square.to_s <= current.ends_s:
        expected = f"from_s < to_s, and to_s up to the last of at_s, {current.ends_s:g} s"
        times = f"{square.from_s:g} to {square.to_s:g} s"
        raise SceneError(
            "gripper.current.square: not within the current's times", where=where, expected=expected, found=times
        )


def _check_tone(tone: Speaker, where: str) -> None:
    """The least of the second harmonic is not above its most."""
    if any(low > high for low, high in zip(tone.second_harmonic_least, tone.second_harmonic_most, strict=True)):
        raise SceneError("tone.second_harmonic_least: above its most", where=where)
