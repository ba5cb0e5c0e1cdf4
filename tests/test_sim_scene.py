"""Scenes as TOML: what is accepted, and how what is wrong is said."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import as_toml

from evetac_cli.errors import InputError, SceneError
from evetac_cli.resources import PACKAGE
from evetac_cli.sim import scene


def slip() -> dict[str, Any]:
    return tomllib.loads((PACKAGE / "scenes" / "slip.toml").read_text())


@pytest.mark.parametrize("path", sorted((PACKAGE / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenes_are_valid(path: Path) -> None:
    """Assert that every scene of the package passes its schema and is named as its file."""
    assert scene.load(path.stem)["name"] == path.stem


def test_objects_are_the_papers() -> None:
    """Assert that the table has 20 objects with the paper's masses."""
    masses = [scene.object_row(number)["mass_g"] for number in range(1, 21)]
    assert masses == [341, 325, 70, 102, 236, 273, 100, 114, 119, 72, 108, 38, 116, 166, 56, 74, 248, 550, 96, 374]


@pytest.mark.parametrize(
    ("group", "key", "value", "says"),
    [
        ("time", "restt_s", 0.1, "rest_s"),
        ("gel", "nodes", [0, 5], "gel.nodes"),
        ("gripper", "start_factor", [3.0, 2.0], "lower end"),
        ("randomise", "mass", "heavy", "randomise.mass"),
        ("texture", "focus_mm", -1.0, "focus_mm"),
        ("time", "step_ms", float("nan"), "step_ms"),
    ],
)
def test_what_is_wrong_is_said(group: str, key: str, value: Any, says: str, tmp_path: Path) -> None:
    """Assert that an unknown key, or a value of the wrong kind or range, is refused with its place."""
    table = slip()
    table[group][key] = value
    path = tmp_path / "odd.toml"
    path.write_text(as_toml(table))
    with pytest.raises(SceneError, match=says):
        scene.load(str(path))


def test_files_that_are_no_scene(tmp_path: Path) -> None:
    """Assert that a missing file, a folder, broken TOML and binary are refused; a misspelt name gets the nearest."""
    (tmp_path / "broken.toml").write_text("name = ")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "folder.toml").mkdir()
    for name in ("broken", "binary", "folder", "absent"):
        with pytest.raises(SceneError):
            scene.load(str(tmp_path / f"{name}.toml"))
    with pytest.raises(SceneError, match="did you mean slip"):
        scene.load("slipp")
    with pytest.raises(InputError, match="did you mean evetac"):
        scene.individual_row("evtac")


@pytest.mark.parametrize(("text", "numbers"), [("8", [8]), ("1-3,10", [1, 2, 3, 10]), ("3, 3,2", [3, 2])])
def test_object_lists(text: str, numbers: list[int]) -> None:
    """Assert that lists and ranges of objects are read in their order, each once."""
    assert scene.numbers(text) == numbers


@pytest.mark.parametrize("text", ["", "a", "3-", "5-3", "1;2", "-1"])
def test_bad_object_lists(text: str) -> None:
    """Assert that anything else is refused."""
    with pytest.raises(InputError):
        scene.numbers(text)


def test_draws_stay_in_their_ranges() -> None:
    """Assert that 200 draws lie in the scene's ranges and fill them."""
    table, thing = slip(), scene.object_row(8)
    rng = np.random.default_rng(0)
    drawn = [scene.draw(table, thing, rng) for _ in range(200)]
    friction = np.array([one.static_friction for one in drawn]) / thing["static_friction"]
    low, high = table["randomise"]["static_friction"]
    assert low <= friction.min() < low + 0.02
    assert high - 0.02 < friction.max() <= high
    assert all(one.kinetic_friction < one.static_friction for one in drawn)
