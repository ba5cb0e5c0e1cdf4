"""The parts of a scene: what is built, what is left out, and the same plan with one part the other way."""

import itertools
from dataclasses import replace
from typing import Any

import pytest

from evetac_cli.resources import SCENES
from evetac_cli.sim.setup.parts import rows_of, switched
from evetac_cli.sim.setup.plan import Plan, first_plan
from evetac_cli.sim.setup.sensor import NoiseFilterSettings, ReadoutLimit

PRESSURE, ROUGH = "friction over pressure", "roughness of the object"
NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))


def built(planned: Plan) -> dict[str, str | None]:
    """What is built of each part."""
    return {row["part"]: row["built"] for row in rows_of(planned)}


def left_out(planned: Plan) -> set[str]:
    return {row["part"] for row in rows_of(planned) if row["built"] is None}


def with_sensor(planned: Plan, **changes: Any) -> Plan:
    """The same plan with another sensor."""
    return replace(planned, sensor=replace(planned.sensor, **changes))


def test_one_part_at_a_time() -> None:
    """Assert of every scene, on two sensors and gels, that switching one part changes it and what hangs on it alone."""
    for name, sensor, gel in itertools.product(NAMES, ("evetac", "randomized:3"), ("cut", "closed")):
        planned = first_plan(name, "8", sensor, gel=gel)
        seen_with = {  # what is there only beside another part
            "window": {"cut edge"} if gel == "closed" else set(),
            "slow pixels": {"bandwidth that falls with light", "uneven light"},
            "bandwidth that falls with light": {"uneven light"},
        }
        for part, other in switched(planned).items():
            changed = left_out(planned) ^ left_out(other)
            assert {part} <= changed <= {part} | seen_with.get(part, set()), (name, sensor, gel)


def test_what_can_be_left_out() -> None:
    """Assert which parts of three scenes can be had otherwise."""
    assert set(switched(first_plan("slip"))) == {PRESSURE, ROUGH, "window", "cut edge", "noise", "hot pixels"}
    held = {PRESSURE, ROUGH, "pushes", "window", "noise", "hot pixels"}
    assert set(switched(first_plan("data-rate", gel="closed"))) == held
    assert set(switched(first_plan("edge"))) == {"contact edges", "cut edge", "noise", "hot pixels"}
    assert "slow pixels" in switched(first_plan("drop-20g", sensor="randomized:3"))


@pytest.mark.parametrize("name", ["lift", "sideways", "drop-20g", "drop-100g"])
def test_grasps_leave_the_window_out(name: str) -> None:
    """Assert that a grasp builds no texture unless it is asked for."""
    assert "window" in left_out(first_plan(name))
    assert "window" not in left_out(first_plan(name, texture="on"))


@pytest.mark.parametrize(
    ("part", "words", "named"),
    [
        ("OFF threshold of its own", "threshold_off 0.25", {"threshold_off": 0.25}),
        ("limit of the readout", "events_per_s 3e+07", {"readout": ReadoutLimit(events_per_s=3e7)}),
        (
            "bandwidth that falls with light",
            "bandwidth_by_light True",
            {"bandwidth_hz": 800.0, "bandwidth_by_light": True},
        ),
        (
            "uneven light",
            "light_gradient 0.3",
            {"bandwidth_hz": 800.0, "bandwidth_by_light": True, "light_gradient": 0.3},
        ),
        ("dots that differ", "dot_radius_spread 0.04", {"dot_radius_spread": 0.04}),
        ("lens distortion", "distortion [-0.05, 0]", {"distortion": (-0.05, 0.0)}),
        ("noise filter", "support_ms 100", {"noise_filter": NoiseFilterSettings(support_ms=100.0)}),
    ],
)
def test_parts_of_a_sensors_camera(part: str, words: str, named: dict[str, Any]) -> None:
    """Assert that each part of the camera is left out unless named, and can be left out alone where it is named."""
    assert part in left_out(first_plan("slip"))
    planned = with_sensor(first_plan("slip"), **named)
    assert built(planned)[part] == words
    other = switched(planned)[part]
    assert left_out(planned) ^ left_out(other) == {part}
    assert all(getattr(other.sensor, key) == named[key] for key in list(named)[:-1])


def test_uneven_light_is_seen_only_by_slow_pixels() -> None:
    """Assert that uneven light is left out where all pixels are equally fast."""
    planned = with_sensor(first_plan("slip"), light_gradient=0.3, bandwidth_by_light=True)
    assert "uneven light" in left_out(planned)
