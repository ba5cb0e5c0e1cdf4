"""Scenes as TOML: what is accepted, and how what is wrong is said."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evetac_cli.errors import SceneError
from evetac_cli.resources import SCENES
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.driven import Face
from evetac_cli.sim.setup.parts import PARTS
from evetac_cli.sim.setup.plan import first_plan
from evetac_cli.sim.setup.scene import LightSettings, LightStep, Solver, with_given
from evetac_cli.sim.setup.tables import as_table
from evetac_cli.text_files import as_toml


def named(name: str) -> dict[str, Any]:
    return tomllib.loads((SCENES / f"{name}.toml").read_text())


def written(folder: Path, table: dict[str, Any]) -> str:
    """The file of a scene."""
    path = folder / "own.toml"
    path.write_text(as_toml(table))
    return str(path)


OPTIONAL_PARTS: list[tuple[str, str, dict[str, Any]]] = [
    ("slip", "light", {"flicker": {"frequency_hz": 120.0, "depth": 0.1}, "step": {"at_s": 2.0, "factor": 0.5}}),
    ("slip", "calibration", {"offset_px": [2.0, 0.0], "turned_deg": 1.0}),
    ("slip", "vanishing_dots", {"dots": [[3, 4], [0, 0]], "at_s": 1.0}),
    ("slip", "friction_change", {"at_s": 1.0, "factor": 0.1}),
    ("slip", "object", {"mass_g": 5.0}),
    ("slip", "gripper", {"backlash_ticks": 2.0, "friction_factor": 0.7}),
    ("slip", "gripper", {"encoder_noise_ticks": 0.5}),
    ("lift", "gripper", {"second_finger": {"friction_factor": 0.7, "stiffness_factor": 1.3}}),
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
    """Assert that each part is accepted, is one of the plan's and none of the shipped scene's, and can be left out."""
    more = named(name)
    more[group] = {**more.get(group, {}), **keys}
    plans = first_plan(written(tmp_path, more)), first_plan(name)
    (part,) = (part for part in PARTS if [part.is_in(one) for one in plans] == [True, False])
    assert not part.is_in(part.without(plans[0]))


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


def test_a_step_takes_the_place_of_a_tolerance_and_the_other_way() -> None:
    """Assert that of a tolerance and a fixed step the one that is given holds, whatever the scene names."""
    fixed = with_given(Solver(tolerance_um=0.05), {"step_ms": 0.5}, "here")
    assert fixed.step_ms == 0.5
    assert "tolerance_um" not in as_table(fixed)
    adaptive = with_given(Solver(step_ms=0.5, theta=0.6), {"tolerance_um": 0.05}, "here")
    assert (adaptive.tolerance_um, adaptive.theta) == (0.05, 0.6)
    assert "step_ms" not in as_table(adaptive)


@pytest.mark.parametrize(("tolerance_um", "halvings"), [(0.2, 3), (0.1, 4), (0.05, 5), (1e-9, 7), (0.4, 2), (1e3, 0)])
def test_a_smaller_tolerance_may_halve_more_often(tolerance_um: float, halvings: int) -> None:
    """Assert how often a slice may be halved at a tolerance."""
    assert Solver(tolerance_um=tolerance_um).halvings == halvings
