"""Event frames of an Evetac as a LeRobot camera; importing this package registers the camera type `evetac`."""

from .camera_evetac import EvetacCamera
from .configuration_evetac import EvetacCameraConfig

__all__ = ["EvetacCamera", "EvetacCameraConfig"]
