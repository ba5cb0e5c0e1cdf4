"""Check that this package keeps evetac's contracts."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli import testing
from evetac_cli.errors import InputError
from evetac_cli.formats.imports import read_events


def test_camera() -> None:
    """Assert that the camera returns slices as evetac expects them."""
    testing.check_camera("stripe")
    testing.check_camera("stripe:3")


def test_gripper() -> None:
    """Assert that the gripper accepts evetac's commands."""
    testing.check_gripper("still")


def test_formats(tmp_path: Path) -> None:
    """Assert that events read from a file equal the events written to it."""
    path = testing.check_exporter("toy", tmp_path)
    read = testing.check_importer("toy", path)
    written = testing.small_events()
    assert np.array_equal(read.events.t, written.t - written.t[0])
    assert all(np.array_equal(one, other) for one, other in zip(read.events[1:], written[1:], strict=True))


def test_a_wrong_file_is_refused(tmp_path: Path) -> None:
    """Assert that a malformed event line is reported."""
    path = tmp_path / "wrong.toy"
    path.write_text("toy events 640x480\n1,2,3\n1,2\n")
    with pytest.raises(InputError, match="not a line of an event"):
        list(read_events(path).events)


def test_controller() -> None:
    """Assert that the controller answers every step."""
    testing.check_controller("firm")


def test_network() -> None:
    """Assert that each network computes the same in torch and in ONNX."""
    testing.check_network("mean-of-dots")
    testing.check_network("mean-of-picture")


def test_files() -> None:
    """Assert that evetac reads this package's scenes, sensor and object like its own."""
    assert testing.check_scene("short-slip").kind == "ramp"
    assert testing.check_scene("short-lift").kind == "lift"
    assert testing.check_sensor("noisy").noise_hz == 0.3
    assert testing.check_object("can").mass_g == 350
