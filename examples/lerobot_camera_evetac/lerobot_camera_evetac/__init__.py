"""Event frames of an Evetac as a camera of LeRobot; importing it makes the camera type `evetac` known."""

from .camera_evetac import EvetacCamera
from .configuration_evetac import EvetacCameraConfig

__all__ = ["EvetacCamera", "EvetacCameraConfig"]
