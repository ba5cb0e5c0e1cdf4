"""Flags that `record` and `grasp` share: the names of devices, and the safety of the gripper."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import parameter
from evetac_cli.names import Capability

DEVICES = "Devices"  # panel of --help


@dataclass(frozen=True)
class Devices:
    """Flags for camera and gripper that both commands share."""

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
        "Move a real gripper. Torque goes off at the end and on any failure: a held object falls.",
        recipe=False,
        consent=True,
        needs=(Capability.MOVED, Capability.GRASPED),
    )
    calibration: Path | None = parameter(
        None,
        "Dot grid (JSON) of the sensor, or A,B for two sensors. Required for a grasp with a real camera; stored in"
        " recordings that are imported or made with a device.",
        recipe=False,
        panel=DEVICES,
        needs=(Capability.IMPORT, Capability.RECORDED, Capability.PREVIEW, Capability.GRASPED),
    )
    watchdog_ms: int | None = parameter(
        None,
        "The gripper releases the object if it receives no command for this long, e.g. because the program hangs. A"
        " multiple of 20; default: 100 to record, 60 to grasp, more for a virtual gripper.",
        unit="ms",
        low=20,
        high=500,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.MOVED, Capability.GRASPED),
    )

    listen: bool = parameter(
        False,
        "Let a robot's program start, mark and stop each trial, through the address in the file evetac.listen in the"
        " folder -o (docs/hardware.md).",
        recipe=False,
        panel=DEVICES,
        needs=(Capability.RECORDED, Capability.GRASPED),
    )
    listen_port: int = parameter(
        0,
        "Port on 127.0.0.1 for --listen; 0: the operating system chooses one.",
        low=0,
        high=65535,
        recipe=False,
        panel=DEVICES,
        needs=(Capability.LISTENING,),
    )

    def gripper_flag(self) -> str:
        """Return `, --gripper NAME` for error messages, or an empty text if no gripper was named."""
        return f", --gripper {self.gripper}" if self.gripper is not None else ""
