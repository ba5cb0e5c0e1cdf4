"""Scenes as TOML: what is accepted, and how what is wrong is said."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.simulated import rig
from evetac_cli.errors import SceneError
from evetac_cli.resources import SCENES
from evetac_cli.sim.parts import rows_of
from evetac_cli.sim.scenes.pressing import Pressing
from evetac_cli.sim.scenes.rubbing import Rubbing
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.driven import Face
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.scene import LightSettings, LightStep
from evetac_cli.text_files import as_toml


def named(name: str) -> dict[str, Any]:
    return tomllib.loads((SCENES / f"{name}.toml").read_text())


def written(folder: Path, table: dict[str, Any]) -> str:
    """The file of a scene."""
    path = folder / "own.toml"
    path.write_text(as_toml(table))
    return str(path)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenes_are_valid(path: Path) -> None:
    """Assert that every scene of the package passes its schema and is named as its file."""
    assert scene_file.load(path.stem).name == path.stem


@pytest.mark.parametrize(
    ("group", "key", "value", "says"),
    [
        ("time", "restt_s", 0.1, "rest_s"),
        ("solver", "node_pitch_mm", 0.0, "solver.node_pitch_mm"),
        ("gripper", "start_factor", [3.0, 2.0], "lower end"),
        ("randomise", "mass", "heavy", "randomise.mass"),
        ("texture", "focus_mm", -1.0, "focus_mm"),
        ("solver", "step_ms", float("nan"), "step_ms"),
        ("randomise", "touch_mm", -1.0, "touch_mm"),
        ("push", "force_n", [1.0], "force_n"),
        ("floor", "below_mm", [50.0, 40.0], "lower end"),
    ],
)
def test_what_is_wrong_is_said(group: str, key: str, value: Any, says: str, tmp_path: Path) -> None:
    """Assert that an unknown key, or a value of the wrong kind or range, is refused with its place."""
    odd = named("data-rate")
    odd.setdefault(group, {})[key] = value
    with pytest.raises(SceneError, match=says):
        scene_file.load(written(tmp_path, odd))


def test_a_misspelt_key_that_is_needed(tmp_path: Path) -> None:
    """Assert that a misspelling is named rather than the key that it stands for."""
    odd = named("data-rate")
    odd["randomise"]["masss"] = odd["randomise"].pop("mass")
    with pytest.raises(SceneError, match="masss") as caught:
        scene_file.load(written(tmp_path, odd))
    assert "did you mean mass?" in str(caught.value)


def test_files_that_are_no_scene(tmp_path: Path) -> None:
    """Assert that a missing file, a folder, broken TOML and binary are refused; a misspelt name gets the nearest."""
    (tmp_path / "broken.toml").write_text("name = ")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "folder.toml").mkdir()
    for name in ("broken", "binary", "folder", "absent"):
        with pytest.raises(SceneError):
            scene_file.load(str(tmp_path / f"{name}.toml"))
    with pytest.raises(SceneError, match="did you mean slip"):
        scene_file.load("slipp")


# What a scene cannot do without beyond its schema: (scene of that kind, key).
CANNOT_DO_WITHOUT = [
    *(("slip", f"time.{key}") for key in ("rest_s", "load_s", "hold_s", "longest_s")),
    *(("data-rate", key) for key in ("time.rest_s", "time.load_s", "time.longest_s", "gripper", "gripper.open_ticks")),
    *(("lift", key) for key in ("time.touch_s", "hand", "hand.height_mm", "hand.speed_mm_s")),
    *(("edge", key) for key in ("time.rest_s", "rub")),
    *(("shear", key) for key in ("time.rest_s", "face", "motion")),
    *(("shear", f"motion.{key}") for key in ("shear_n", "offset_mm", "count", "move_s", "pause_s")),
    *(("press", key) for key in ("time.rest_s", "face", "motion")),
    *(("press", f"motion.{key}") for key in ("lines", "speed_mm_s", "approach_s")),
]


@pytest.mark.parametrize(("name", "key"), CANNOT_DO_WITHOUT)
def test_m4_a_part_that_is_missing_is_said(name: str, key: str, tmp_path: Path) -> None:
    """Assert that a scene without what its kind is made of is refused with the key, before anything is built."""
    odd = named(name)
    group, _, inner = key.partition(".")
    if inner:
        del odd[group][inner]
    else:
        del odd[group]
    with pytest.raises(SceneError, match=f"{key} is missing"):
        scene_file.load(written(tmp_path, odd))


@pytest.mark.parametrize(
    ("name", "group", "key", "value"),
    [
        ("press", "motion", "speed_mm_s", 1e-300),
        ("press", "motion", "approach_s", 10_000.0),
        ("shear", "motion", "count", 100_000),
        ("edge", "rub", "speed_mm_s", [1e-300, 1e-300]),
    ],
)
def test_m4_a_motion_without_end_is_refused(name: str, group: str, key: str, value: Any, tmp_path: Path) -> None:
    """Assert that a face that would take more than a day is refused, and not recorded for ever."""
    odd = named(name)
    odd.setdefault(group, {})[key] = value
    endless = first_plan(written(tmp_path, odd), kinds=("press", "rub"))
    simulation = {"press": Pressing, "rub": Rubbing}[endless.scene.kind]
    with pytest.raises(SceneError, match="too long"):
        simulation(endless, np.random.default_rng(0), np.random.default_rng(1))


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("shear", "randomise.kinetic_share", [5.0, 5.0]),
        ("vibration", "tone.radius_mm", 1e-300),
        ("slip", "gripper.start_factor", [1000.0, 1000.0]),
        ("slip", "randomise.mass", [1000.0, 1000.0]),
        ("slip", "texture.half_correlation_px", [1000.0, 1000.0]),
    ],
)
def test_m4_a_scene_that_cannot_be_simulated_is_said(name: str, key: str, value: Any, tmp_path: Path) -> None:
    """Assert that values within their ranges that no simulation can be made of are refused with the scene's name."""
    odd = named(name)
    group, inner = key.split(".")
    odd[group][inner] = value
    planned = first_plan(written(tmp_path, odd), kinds=("ramp", "press", "tone"))
    with pytest.raises(SceneError, match=odd["name"]):
        rig(planned, np.random.SeedSequence(0))


def test_an_edge_blurred_over_the_whole_view_is_refused(tmp_path: Path) -> None:
    """Assert that a blur so wide that drawing the edge takes many seconds is refused with its place and its limit."""
    odd = named("edge")
    odd["rub"]["edge_blur_px"] = [1000.0, 1000.0]
    with pytest.raises(SceneError, match=r"rub\.edge_blur_px\.0: out of range\n  expected: more than 0 to 50\n"):
        scene_file.load(written(tmp_path, odd))


SHAKES = {"frequency_hz": [20.0], "acceleration_m_s2": [0.5]}
OPTIONAL_PARTS: list[tuple[str, str, dict[str, Any]]] = [
    ("slip", "light", {"flicker": {"frequency_hz": 120.0, "depth": 0.1}, "step": {"at_s": 2.0, "factor": 0.5}}),
    ("slip", "calibration", {"offset_px": [2.0, 0.0], "turned_deg": 1.0}),
    ("slip", "vanishing_dots", {"dots": [[3, 4], [0, 0]], "at_s": 1.0}),
    ("slip", "friction_change", {"at_s": 1.0, "factor": 0.1}),
    ("slip", "object", {"mass_g": 5.0}),
    ("slip", "gripper", {"backlash_ticks": 2.0, "friction_factor": 0.7}),
    ("slip", "gripper", {"encoder_noise_ticks": 0.5}),
    ("slip", "gripper", {"second_finger": {"friction_factor": 0.7, "stiffness_factor": 1.3}}),
    ("lift", "gripper", {"second_finger": {"friction_factor": 0.7}}),
    ("slip", "gripper", {"command_delay_ms": 4.0}),
    ("lift", "gripper", {"command_delay_ms": 1.5, "command_jitter_ms": 4.0}),
    ("lift", "gripper", {"command_jitter_ms": 4.0}),
    ("slip", "gel", {"cut": True, "stiffness_factor": 10.0}),
    ("lift", "hand", {"jerk": {"at_s": 4.0, "speed_mm_s": 100.0, "lasts_s": 0.05}}),
    ("lift", "hand", {"profile": "s-curve"}),
    ("lift", "hand", {"profile": "steps"}),
    ("lift", "hand", {"vibration": {"frequency_hz": [20.0], "acceleration_m_s2": [0.5], "only_moving": True}}),
    ("slip", "hand", {"vibration": {"frequency_hz": [20.0, 31.0], "acceleration_m_s2": [0.5, 0.2]}}),
]


@pytest.mark.parametrize(("name", "group", "keys"), OPTIONAL_PARTS)
def test_optional_parts_are_read_and_named(name: str, group: str, keys: dict[str, Any], tmp_path: Path) -> None:
    """Assert that each part is accepted, said to be built, and said to be left out by the shipped scene."""
    more = named(name)
    more[group] = {**more.get(group, {}), **keys}
    plans = first_plan(written(tmp_path, more)), first_plan(name)
    built, as_shipped = ({row["part"] for row in rows_of(one) if row["built"]} for one in plans)
    assert len(built - as_shipped) == 1


@pytest.mark.parametrize(
    ("name", "group", "keys", "says"),
    [
        ("slip", "hand", {"jerk": {"at_s": 1.0, "speed_mm_s": 1.0, "lasts_s": 0.1}}, "hand.jerk"),
        ("slip", "hand", {"height_mm": 1.0}, "hand.height_mm"),
        ("slip", "hand", {"profile": "steps"}, "hand.profile"),
        ("slip", "hand", {"vibration": {**SHAKES, "only_moving": True}}, "hand.vibration.only_moving"),
        ("shear", "hand", {"vibration": SHAKES}, "hand"),
        ("shear", "gripper", {"backlash_ticks": 1.0}, "backlash_ticks"),
        ("shear", "gripper", {"encoder_noise_ticks": 1.0}, "encoder_noise_ticks"),
        ("shear", "gripper", {"second_finger": {"friction_factor": 0.7}}, "second_finger"),
        ("shear", "gripper", {"command_delay_ms": 1.0}, "command_delay_ms"),
        ("shear", "gripper", {"command_jitter_ms": 1.0}, "command_jitter_ms"),
        ("shear", "object", {"mass_g": 5.0}, "object"),
        ("vibration", "friction_change", {"at_s": 1.0, "factor": 0.1}, "friction_change"),
    ],
)
def test_parts_of_other_kinds_are_refused(
    name: str, group: str, keys: dict[str, Any], says: str, tmp_path: Path
) -> None:
    """Assert that a part that this kind of scene cannot have is refused rather than left out in silence."""
    odd = named(name)
    odd[group] = {**odd.get(group, {}), **keys}
    with pytest.raises(SceneError, match=f"{says}.*another kind"):
        scene_file.load(written(tmp_path, odd))


@pytest.mark.parametrize(
    ("group", "keys", "says"),
    [
        ("light", {}, "light"),
        ("light", {"flicker": {"frequency_hz": 100.0}}, "depth"),
        ("light", {"flicker": {"frequency_hz": 1000.0, "depth": 0.1}}, "frequency_hz"),
        ("calibration", {"offset": [1.0, 1.0]}, "offset_px"),
        ("vanishing_dots", {"dots": [], "at_s": 1.0}, "dots"),
        ("object", {"mass_g": 0.0}, "mass_g"),
        ("randomise", {"pressure_exponent": 1.5}, "pressure_exponent"),
        ("randomise", {"pressure_exponent": [0.8, 0.2]}, "pressure_exponent"),
        ("randomise", {"memory_um": [50.0, 20.0]}, "memory_um"),
        ("randomise", {"memory_um": -1.0}, "memory_um"),
        ("gripper", {"friction_factor": -0.5}, "friction_factor"),
        ("gripper", {"encoder_noise_ticks": -0.5}, "encoder_noise_ticks"),
        ("gripper", {"encoder_noise_ticks": math.nan}, "encoder_noise_ticks"),
        ("gripper", {"command_delay_ms": -1.0}, "command_delay_ms"),
        ("gripper", {"second_finger": {}}, "second_finger"),
        ("gripper", {"second_finger": {"friction_factor": -1.0}}, "friction_factor"),
        ("gripper", {"second_finger": {"stiffness_factor": math.nan}}, "stiffness_factor"),
        ("gripper", {"command_jitter_ms": 1e9}, "command_jitter_ms"),
        ("hand", {}, "hand"),
        ("hand", {"vibration": {"frequency_hz": [20.0]}}, "acceleration_m_s2"),
        ("hand", {"vibration": {"frequency_hz": [20.0], "acceleration_m_s2": [-1.0]}}, "acceleration_m_s2"),
        ("hand", {"vibration": {"frequency_hz": [20.0], "acceleration_m_s2": [math.nan]}}, "acceleration_m_s2"),
        (
            "hand",
            {"vibration": {"frequency_hz": [20.0], "acceleration_m_s2": [1.0, 1.0]}},
            "lists of different lengths",
        ),
        ("hand", {"vibration": {"frequency_hz": [1000.0], "acceleration_m_s2": [1.0]}}, "frequency_hz"),
        ("hand", {"vibration": {"frequency_hz": [20.0] * 17, "acceleration_m_s2": [1.0] * 17}}, "hand.vibration"),
        ("hand", {"profile": "square"}, "profile"),
    ],
)
def test_optional_parts_that_are_wrong(group: str, keys: dict[str, Any], says: str, tmp_path: Path) -> None:
    """Assert that a key that is missing, misspelt or out of range is said."""
    odd = named("slip")
    odd[group] = {**odd.get(group, {}), **keys}
    with pytest.raises(SceneError, match=says):
        scene_file.load(written(tmp_path, odd))


@pytest.mark.parametrize(
    ("group", "keys", "says"),
    [
        ("gripper", {"close_s": 0.1}, "gripper.close_s has no effect with gripper.current"),
        ("gripper", {"start_factor": [2.0, 3.0]}, "gripper.start_factor has no effect"),
        ("gripper", {"start_n": 20.0}, "gripper.start_n has no effect with gripper.current"),
        ("gripper", {"open_s": 30.0}, "gripper.open_s has no effect with gripper.current"),
        ("gripper", {"current": {"at_s": [0.0, 0.0], "ma": [1.0, 2.0]}}, "expected strictly rising values"),
        ("gripper", {"current": {"at_s": [0.0, 1.0], "ma": [1.0]}}, "lists of different lengths"),
        ("time", {"longest_s": 35.0}, "after the end of the scene"),
        ("square", {"from_s": 12.0}, "square: not within the times"),
        ("square", {"to_s": 36.0}, "square: not within the times"),
    ],
)
def test_a_gripper_current_that_is_wrong(group: str, keys: dict[str, Any], says: str, tmp_path: Path) -> None:
    """Assert that a current is refused that does not fit the scene, or beside which a key would have no effect."""
    odd = named("grip-steps")
    changed = odd["gripper"]["current"]["square"] if group == "square" else odd[group]
    changed |= keys
    with pytest.raises(SceneError, match=says):
        scene_file.load(written(tmp_path, odd))


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"start_factor": [2.0, 2.0]}, "gripper.start_factor has no effect with gripper.start_n"),
        ({"start_more_n": 1.0}, "gripper.start_more_n has no effect with gripper.start_n"),
        ({"ramp_s": 13.0}, "gripper.ramp_s has no effect with gripper.open_s"),
        (
            {"open_s": 5.0},
            "gripper.open_s: before the gripper has gripped\n.*expected: after gripper.grip_s, 5 s\n.*found: +5 s",
        ),
        ({"start_n": 0.0}, "gripper.start_n"),
    ],
)
def test_a_grip_that_is_named_twice(keys: dict[str, Any], says: str, tmp_path: Path) -> None:
    """Assert that a key is refused beside the one that takes its place, and a gripper that opens before it grips."""
    odd = named("data-rate")
    odd["gripper"] |= keys
    with pytest.raises(SceneError, match=says):
        scene_file.load(written(tmp_path, odd))


def test_a_packaged_scene_that_is_changed(tmp_path: Path) -> None:
    """Assert that values change key by key, None takes one away, the rest stays, and nonsense is said when read."""
    path, shear = tmp_path / "own.toml", scene_file.load("shear")
    path.write_text(scene_file.changed("shear", {}))
    assert scene_file.load(str(path)) == shear
    path.write_text(
        scene_file.changed(
            "shear", {"face": {"size_mm": None, "radius_mm": 8.0}, "light": {"step": {"at_s": 1.0, "factor": 0.5}}}
        )
    )
    own = scene_file.load(str(path))
    assert own.light == LightSettings(step=LightStep(at_s=1.0, factor=0.5))
    assert own.face == Face(static_friction=shear.face.static_friction, radius_mm=8.0)
    assert replace(own, light=None, face=shear.face) == shear
    path.write_text(scene_file.changed("shear", {"motion": {"shear_nn": 4.0}}))
    with pytest.raises(SceneError, match="did you mean"):
        scene_file.load(str(path))
