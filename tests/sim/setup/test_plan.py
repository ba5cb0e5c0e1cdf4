"""What a trial is made from: which objects, tones and sensors are meant, and what overrides a scene."""

import json

import pytest

from evetac_cli.errors import InputError
from evetac_cli.resources import SCENES
from evetac_cli.sim.setup.plan import first_plan, numbers, one_sensor, plans, read_plan
from evetac_cli.sim.setup.sensor_file import rows


@pytest.mark.parametrize(("text", "listed"), [("8", [8]), ("1-3,10", [1, 2, 3, 10]), ("3, 3,2", [3, 2])])
def test_object_lists(text: str, listed: list[int]) -> None:
    """Assert that lists and ranges of objects are read in their order, each once."""
    assert numbers(text) == listed


def test_which_sensor_is_sampled() -> None:
    """Assert that randomized:N is one sensor wherever it is named, and randomized another for every trial and seed."""
    (slipping,) = plans("slip", "8", "randomized:7", ("ramp",))
    (lifting,) = plans("lift", "11", "randomized:7", ("lift",))
    assert slipping.sensor == lifting.sensor != one_sensor("randomized:8")
    assert slipping.of_trial((0, 8, 1)) == slipping.of_trial()
    assert slipping.of_trial().sensor == slipping.sensor
    (each,) = plans("slip", "8", "randomized", ("ramp",))
    trials = [each.of_trial(seeds) for seeds in ((0, 8, 0), (0, 8, 1), (1, 8, 0), (0, 8, 0))]
    assert trials[0].sensor == trials[3].sensor
    assert len({trial.sensor.seed for trial in trials}) == 3
    assert all(trial.sensor_ranges == rows()["randomized"] for trial in trials)
    assert one_sensor("randomized-narrow:7") != slipping.sensor
    (narrow,) = plans("slip", "8", "randomized-narrow", ("ramp",))
    assert narrow.of_trial((0, 8, 1)).sensor_ranges == rows()["randomized-narrow"]
    for wrong in ("randomized:", "randomized-narrow:", "second:1", "randomized:x", "randomized:-1", "randomized:1.5"):
        with pytest.raises(InputError, match="no such sensor"):
            one_sensor(wrong)


def test_whether_the_window_shows_a_texture() -> None:
    """Assert that --texture overrides what the scene says, and that saying what it says anyway is the same recipe."""
    shown, default = (first_plan("slip", texture=given).parameters() for given in ("on", None))
    assert shown == default
    for name, given, says in (("lift", "on", True), ("slip", "off", False)):
        assert first_plan(name, texture=given).scene.texture.show is says


@pytest.mark.parametrize("name", sorted(path.stem for path in SCENES.glob("*.toml")))
def test_a_header_gives_the_plan_again(name: str) -> None:
    """Assert that what a recording of each scene says of its plan is that plan."""
    planned = first_plan(name, sensor="realistic")
    parameters = json.loads(json.dumps(planned.parameters()))
    assert read_plan(parameters, "here") == planned
    assert read_plan({**parameters, "readout": "ideal"}, "here") == planned  # of a camera that is gone
