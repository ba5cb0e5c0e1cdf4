"""The contracts of evetac, kept by this package."""

from evetac_cli import testing


def test_camera() -> None:
    """Assert that the camera hands out slices as evetac wants them."""
    testing.check_camera("stripe")
    testing.check_camera("stripe:3")


def test_gripper() -> None:
    """Assert that the gripper takes commands as evetac gives them."""
    testing.check_gripper("still")
