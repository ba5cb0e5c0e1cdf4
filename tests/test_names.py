"""The tables of names are those of the code."""

import pytest

from evetac_cli import names, resources
from evetac_cli.devices import cameras, grippers
from evetac_cli.formats import exports, imports
from evetac_cli.kernels.grip import control
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.tracking import presets
from evetac_cli.sim.setup import scene_file
from evetac_cli.trials.record import SCENE_KINDS


def test_devices() -> None:
    """Assert that the tables name every kind of camera and gripper; a port is named by its parts."""
    assert names.without_placeholders(names.CAMERAS) == tuple(cameras.KINDS)
    assert names.without_placeholders(names.GRIPPERS) == tuple(grippers.KINDS)
    assert list(names.GRIPPERS)[-1] == "PORT[:ID][@BAUD]"


def test_formats() -> None:
    """Assert that the tables name every format that is read or written, the text that is tried last among them."""
    assert tuple(names.IMPORTS) == tuple(imports.FORMATS)
    assert tuple(names.EXPORTS) == tuple(exports.FORMATS)


def test_methods() -> None:
    """Assert that the tables name every controller, network and preset of the tracker."""
    assert list(names.CONTROLLERS) == [*control.LAWS, "none", "fixed:N"]
    assert tuple(ARCHITECTURES) == names.NETWORKS
    assert set(names.TRACKERS) == set(presets.PRESETS)


@pytest.mark.parametrize(("table", "kinds"), [(names.RECORDED_SCENES, SCENE_KINDS), (names.GRASPED_SCENES, ("lift",))])
def test_scenes(table: tuple[str, ...], kinds: tuple[str, ...]) -> None:
    """Assert that the tables name every scene that is recorded, and every one that is grasped."""
    every = sorted(path.stem for path in resources.SCENES.glob("*.toml"))
    assert sorted(table) == [name for name in every if scene_file.load(name).kind in kinds]


def test_sensors() -> None:
    """Assert that the table names every sensor, and the ranges from which others are sampled."""
    assert tuple(resources.table("sensors")) == names.SENSORS
