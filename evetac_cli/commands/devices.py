"""Devices by name, and how a gripper is kept safe: flags of `record` and `grasp` alike."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import Capability

DEVICES = "Devices"  # panel of --help


@dataclass(frozen=True)
class Devices:
    """Camera and gripper, and what both commands ask of them."""

    camera: str = parameter(
        "sim",
        f"Camera: {names.words(names.CAMERAS, ', ')}; or a plug-in's; A,B: two.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        f"Gripper: {names.words(names.GRIPPERS, ', ')}; or a plug-in's; default: that of the camera.",
        recipe=False,
        needs=(Capability.SCENE, Capability.DEVICE),
    )
    arm: bool = parameter(
        False,
        "Move a real gripper. Torque goes off at the end and at any failure: what is held falls.",
        recipe=False,
        consent=True,
        needs=(Capability.MOVED, Capability.GRASPED),
    )
    calibration: Path | None = parameter(
        None,
        "Dot grid (JSON) of the sensor, or A,B of two; a grasp with a real camera needs it, and a recording that is"
        " imported or from a device stores it.",
        recipe=False,
        panel=DEVICES,
        needs=(Capability.IMPORT, Capability.RECORDED, Capability.PREVIEW, Capability.GRASPED),
    )
    watchdog_ms: int | None = parameter(
        None,
        "The gripper lets go if it gets no command for so long, or the program hangs; a multiple of 20; default: 100"
        " to record, 60 to grasp, more for a virtual gripper.",
        unit="ms",
        low=20,
        high=500,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.MOVED, Capability.GRASPED),
    )

    listen: bool = parameter(
        False,
        "A robot's program starts, marks and stops each trial, by the address in evetac.listen of the folder -o"
        " (docs/hardware.md).",
        recipe=False,
        panel=DEVICES,
        needs=(Capability.RECORDED, Capability.GRASPED),
    )
    listen_port: int = parameter(
        0,
        "Port of 127.0.0.1 at which it listens; 0: one that the system chooses.",
        low=0,
        high=65535,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.LISTENING,),
    )

    def gripper_flag(self) -> str:
        """`, --gripper NAME` where one is named, for errors."""
        return f", --gripper {self.gripper}" if self.gripper is not None else ""
