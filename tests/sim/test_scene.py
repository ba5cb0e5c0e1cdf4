"""Scenes as TOML: what is accepted, and how what is wrong is said."""

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.errors import InputError, SceneError
from evetac_cli.resources import SCENES, table
from evetac_cli.sim import randomized, scene
from tests.conftest import as_toml


def named(name: str) -> dict[str, Any]:
    return tomllib.loads((SCENES / f"{name}.toml").read_text())


def slip() -> dict[str, Any]:
    return named("slip")


def random(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
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
        ("randomise", "touch_mm", -1.0, "touch_mm"),
        ("push", "force_n", [1.0], "force_n"),
        ("floor", "below_mm", [50.0, 40.0], "lower end"),
    ],
)
def test_what_is_wrong_is_said(group: str, key: str, value: Any, says: str, tmp_path: Path) -> None:
    """Assert that an unknown key, or a value of the wrong kind or range, is refused with its place."""
    odd = named("data-rate")
    odd[group][key] = value
    path = tmp_path / "odd.toml"
    path.write_text(as_toml(odd))
    with pytest.raises(SceneError, match=says):
        scene.load(str(path))


def test_a_misspelt_key_that_is_needed(tmp_path: Path) -> None:
    """Assert that a misspelling is named rather than the key that it stands for."""
    odd = named("data-rate")
    odd["randomise"]["masss"] = odd["randomise"].pop("mass")
    path = tmp_path / "odd.toml"
    path.write_text(as_toml(odd))
    with pytest.raises(SceneError, match="masss") as caught:
        scene.load(str(path))
    assert "did you mean `mass`" in str(caught.value)


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
        scene.sensor_row("evtac")


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
    ramp, object_params = slip(), scene.object_row(8)
    rng = np.random.default_rng(0)
    drawn = [scene.draw(ramp, object_params, rng) for _ in range(200)]
    friction = np.array([one.static_friction for one in drawn]) / object_params["static_friction"]
    low, high = ramp["randomise"]["static_friction"]
    assert low <= friction.min() < low + 0.02
    assert high - 0.02 < friction.max() <= high
    assert all(one.kinetic_friction < one.static_friction for one in drawn)


def test_new_keys_leave_old_draws() -> None:
    """Assert that touch, lever and kinetic spread change nothing else that is drawn, and are drawn in their ranges."""
    plain, more, flat = slip(), slip(), scene.object_row(16)
    for key in ("touch_mm", "kinetic_share_spread"):
        del plain["randomise"][key]
    more["randomise"] |= {"touch_mm": 3.0, "lever_mm": 3.0}
    for seed in range(50):
        old, new = scene.draw(plain, flat, random(seed)), scene.draw(more, flat, random(seed))
        assert old.touch_m == (0.0, 0.0)
        assert old.lever_m == 0.0
        assert {**vars(old), "touch_m": 0, "lever_m": 0} == {**vars(new), "touch_m": 0, "lever_m": 0}
        assert np.abs(new.touch_m).max() <= 3e-3
    drawn = [scene.draw(more, flat, random(seed)) for seed in range(400)]
    assert np.std([one.lever_m for one in drawn]) == pytest.approx(3e-3, rel=0.15)
    assert np.std([one.touch_m for one in drawn]) == pytest.approx(3e-3 / math.sqrt(3), rel=0.1)
    assert scene.draw(more, scene.object_row(8), random(0)).lever_m == 0.0  # round: touched on its axis


def test_objects_keep_their_kinetic_share() -> None:
    """Assert that with a spread the kinetic share of an object stays within it, and objects differ by more."""
    spread = slip()
    spread["randomise"]["kinetic_share_spread"] = 0.03

    def shares(number: int) -> list[float]:
        drawn = [scene.draw(spread, scene.object_row(number), random(seed), None, number) for seed in range(30)]
        return [one.kinetic_friction / one.static_friction for one in drawn]

    by_object = [shares(number) for number in range(1, 9)]
    assert all(0.04 < max(own) - min(own) <= 0.06 + 1e-12 for own in by_object)
    middles = [np.mean(own) for own in by_object]
    assert max(middles) - min(middles) > 0.08


def test_drawn_individuals_lie_in_their_ranges() -> None:
    """Assert that 300 drawn individuals fill the ranges of the table, log-uniform ones evenly in the logarithm."""
    ranges = table("sensors")["randomized"]
    rows = [randomized.draw(ranges, random(seed)) for seed in range(300)]
    for group, low, high in (("mm_per_px", 0.029, 0.034), ("hot_pixels", 0, 20), ("loss_tangent", 0.08, 0.2)):
        values = np.array([row[group] for row in rows])
        assert low <= values.min() <= low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) <= values.max() <= high
    moduli = np.log([row["normal_modulus_pa"] for row in rows])
    assert moduli.mean() == pytest.approx(np.log([0.6e6, 1.7e6]).mean(), abs=0.06)
    assert len({type(row["hot_pixels"]) for row in rows} | {int}) == 1
    shifts = np.array([np.subtract(row["dot_columns_px"], ranges["dot_columns_px"]) for row in rows])
    assert np.ptp(shifts, axis=1).max() < 1e-9
    assert 5 < np.abs(shifts).max() <= 6


def test_a_range_more_leaves_the_others() -> None:
    """Assert that a range added at the front of the table, or a table turned round, changes no other value."""
    ranges = table("sensors")["randomized"]
    row = randomized.draw(ranges, random(3))
    more = randomized.draw({"another": {"uniform": [0, 1]}, **dict(reversed(ranges.items()))}, random(3))
    assert 0 <= more.pop("another") <= 1
    assert more == row


def test_who_is_drawn() -> None:
    """Assert that randomized:N is one sensor wherever it is named, and randomized another for every trial and seed."""
    (slipping,) = scene.plan("slip", "8", "randomized:7", ("ramp",))
    (lifting,) = scene.plan("lift", "11", "randomized:7", ("lift",))
    assert slipping["sensor_row"] == lifting["sensor_row"] != scene.sensor_row("randomized:8")
    assert scene.for_trial(slipping, (0, 8, 1)) is slipping
    (each,) = scene.plan("slip", "8", "randomized", ("ramp",))
    trials = [scene.for_trial(each, seeds) for seeds in ((0, 8, 0), (0, 8, 1), (1, 8, 0), (0, 8, 0))]
    rows = [trial["sensor_row"] for trial in trials]
    assert rows[0] == rows[3]
    assert len({row["seed"] for row in rows}) == 3
    assert all(trial["sensor_ranges"] == table("sensors")["randomized"] for trial in trials)
    for wrong in ("randomized:", "randomized:x", "randomized:-1", "randomized:1.5"):
        with pytest.raises(InputError, match="no such sensor"):
            scene.sensor_row(wrong)


@given(
    ends=st.one_of(
        st.tuples(st.floats(1, 10), st.floats(-10, 0.5)).map(list),
        st.lists(st.floats(0, 1), max_size=1),
        st.just([0.0, math.inf]),
        st.just([math.nan, 1.0]),
        st.just("much"),
    )
)
def test_ranges_that_are_none(ends: Any) -> None:
    """Assert that a range with its ends turned round, missing or not finite is refused with its key."""
    with pytest.raises(InputError, match=r"gripper\.mass_kg"):
        randomized.draw({"gripper": {"mass_kg": {"uniform": ends}}}, random(0))
