"""The parts of a scene: what is built, what is left out, and the same plan with one part the other way."""

import copy
from typing import Any

import pytest

from evetac_cli.resources import SCENES
from evetac_cli.sim import scene
from evetac_cli.sim.parts import parts, switched

KINDS = ("ramp", "lift", "hold", "press", "rub", "tone")
NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))


def planned(name: str, sensor: str = "evetac", gel: str | None = None, **more: Any) -> dict[str, Any]:
    return scene.plan(name, "8", sensor, KINDS, gel, **more)[0]


def left_out(plan: dict[str, Any]) -> set[str]:
    return {row["part"] for row in parts(plan) if row["left_out"]}


@pytest.mark.parametrize("gel", ["cut", "closed"])
@pytest.mark.parametrize("sensor", ["evetac", "randomized:3"])
@pytest.mark.parametrize("name", NAMES)
def test_one_part_at_a_time(name: str, sensor: str, gel: str) -> None:
    """Assert that a part is either built or left out, and that switching one changes it and what hangs on it alone."""
    plan = planned(name, sensor, gel)
    before = copy.deepcopy(plan)
    assert all((row["built"] is None) != (row["left_out"] is None) for row in parts(plan))
    seen_with = {  # what is there only beside another part
        "window": {"cut edge"} if gel == "closed" else set(),
        "slow pixels": {"bandwidth that falls with light", "uneven light"},
        "bandwidth that falls with light": {"uneven light"},
    }
    for part, other in switched(plan).items():
        changed = left_out(plan) ^ left_out(other)
        assert {part} <= changed <= {part} | seen_with.get(part, set())
    assert plan == before


def test_what_can_be_left_out() -> None:
    """Assert which parts of three scenes can be had otherwise."""
    assert set(switched(planned("slip"))) == {"window", "cut edge", "noise"}
    assert set(switched(planned("data-rate", gel="closed"))) == {"pushes", "window", "noise"}
    assert set(switched(planned("edge"))) == {"contact edges", "cut edge", "noise"}
    assert "slow pixels" in switched(planned("drop-20g", "randomized:3"))


@pytest.mark.parametrize("name", ["lift", "sideways", "drop-20g", "drop-100g"])
def test_grasps_leave_the_window_out(name: str) -> None:
    """Assert that a grasp builds no texture unless it is asked for, and says how to ask."""
    assert "window" in left_out(planned(name))
    assert "window" not in left_out(planned(name, texture="on"))


def test_parts_of_a_sensor() -> None:
    """Assert that what a sensor's row names is a row, and can be left out without what is named beside it."""
    plan = planned("slip")
    plan["sensor_row"]["friction"] = {"kinetic_share": 0.8, "patch_spread": 0.1, "patch_mm": 3.0}
    rows = {row["part"]: row["built"] for row in parts(plan)}
    assert rows["friction that varies over the gel"] == "by 10% over 3 mm"
    plan["sensor_row"]["creep"] = {"share": [0.05, 0.02], "time_s": [0.3, 5.0]}
    (row,) = [row for row in parts(plan) if row["part"] == "slow creep"]
    assert row["built"] == "5% in 0.3 s, 2% in 5 s"
    assert "slow creep" in left_out(switched(plan)["slow creep"])
    other = switched(plan)["friction that varies over the gel"]
    assert other["sensor_row"]["friction"] == {"kinetic_share": 0.8}
    assert "friction that varies over the gel" in left_out(planned("slip"))
    tone = planned("vibration")
    tone["sensor_row"] = plan["sensor_row"]
    assert "friction that varies over the gel" in left_out(tone)


def test_parts_that_only_some_scenes_name() -> None:
    """Assert that what few scenes have is a row where it is named, and can be left out there."""
    plan = planned("slip")
    plan["scene"]["light"] = {"flicker": {"frequency_hz": 100.0, "depth": 0.1}}
    (row,) = [row for row in parts(plan) if row["part"] == "changing light"]
    assert row["built"] == "flickers by 10% at 100 Hz"
    assert "light" not in switched(plan)["changing light"]["scene"]
    (row,) = [row for row in parts(planned("slip")) if row["part"] == "changing light"]
    assert (row["built"], row["left_out"]) == (None, "steady: none named")
    assert "changing light" not in switched(planned("slip"))


def test_how_the_gripper_is_commanded() -> None:
    """Assert that a gripper that follows a current from the start is not said to be in position mode."""
    built = {row["part"]: row["built"] for row in parts(planned("grip-steps"))}
    assert built["gripper"] == "current mode, as the scene names it"
    assert {row["part"]: row["built"] for row in parts(planned("handling"))}["gripper"].startswith("position")


@pytest.mark.parametrize(
    ("part", "built", "named"),
    [
        ("OFF threshold of its own", "0.25, ON 0.2", {"threshold_off": 0.25}),
        ("limit of the readout", "30,000,000 events a second", {"readout": {"events_per_s": 3e7}}),
        (
            "bandwidth that falls with light",
            "proportional to brightness",
            {"bandwidth_hz": 800.0, "bandwidth_by_light": True},
        ),
        (
            "uneven light",
            "30% less in the corners",
            {"bandwidth_hz": 800.0, "bandwidth_by_light": True, "light_gradient": 0.3},
        ),
        ("dots that differ", "radius by 4%, contrast by 0%", {"dot_radius_spread": 0.04}),
        ("lens distortion", "k1 -0.05, k2 0", {"distortion": [-0.05, 0.0]}),
    ],
)
def test_parts_of_a_sensors_camera(part: str, built: str, named: dict[str, Any]) -> None:
    """Assert that each part of the camera is left out unless named, and can be left out alone where it is named."""
    plan = planned("slip")
    assert part in left_out(plan)
    plan["sensor_row"] = plan["sensor_row"] | named
    assert {row["part"]: row["built"] for row in parts(plan)}[part] == built
    other = switched(plan)[part]
    assert left_out(plan) ^ left_out(other) == {part}
    assert all(other["sensor_row"][key] == named[key] for key in list(named)[:-1])


def test_uneven_light_is_seen_only_by_slow_pixels() -> None:
    """Assert that uneven light is left out, in words, where all pixels are equally fast."""
    plan = planned("slip")
    plan["sensor_row"] = plan["sensor_row"] | {"light_gradient": 0.3, "bandwidth_by_light": True}
    (row,) = [row for row in parts(plan) if row["part"] == "uneven light"]
    assert row["left_out"] == "seen only where bandwidth falls with light"
