"""Flags that `record` and `grasp` share: devices, trials to simulate, and the precision of the simulation."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evetac_cli import names
from evetac_cli.commands.parameter import EXPERTS, RUNNING, parameter
from evetac_cli.names import Capability

SCENE, VIEW, DEVICES = "Scene", "Live view", "Devices"  # panels of --help
SIMULATED = (Capability.SCENE,)
SERIES = (Capability.SCENE, Capability.DEVICE)
SOLVER_OPTIONS = ("tolerance_um", "step_ms", "node_pitch_mm")


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
        "Dot grid (JSON) of the sensor, or A,B for two. A grasp with a real camera needs it.",
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
        panel=EXPERTS,
        needs=(Capability.MOVED, Capability.GRASPED),
    )

    listen: bool = parameter(
        False,
        "Let a robot's program start, mark and stop each trial, through the address in the file evetac.listen in the"
        " folder -o (docs/hardware.md).",
        recipe=False,
        panel=EXPERTS,
        needs=(Capability.RECORDED, Capability.GRASPED),
    )
    listen_port: int = parameter(
        0,
        "Port on 127.0.0.1 for --listen; 0: the operating system chooses one.",
        low=0,
        high=65535,
        recipe=False,
        panel=EXPERTS,
        needs=(Capability.LISTENING,),
    )

    def gripper_flag(self) -> str:
        """Return `, --gripper NAME` for error messages, or an empty text if no gripper was named."""
        return f", --gripper {self.gripper}" if self.gripper is not None else ""


@dataclass(frozen=True)
class Trials:
    """Flags that `record` and `grasp` share: the trials to simulate."""

    scene: str
    objects: str
    count: int = parameter(1, "Trials per object.", low=1, high=100000, recipe=False, needs=SERIES)
    seed: int = parameter(0, "Seed of all random choices.", low=0, high=2**31 - 1, needs=(*SERIES, Capability.DOTS))
    sensor: str = parameter(
        "evetac",
        "Sensor (`evetac list sensors`), or a TOML file (`evetac identify`); A,B: two.",
        needs=(*SIMULATED, Capability.DOTS),
    )
    gel: str | None = parameter(
        None,
        "Gel type: cut has a window next to its dots. Default: the scene's.",
        choices=("cut", "closed"),
        panel=SCENE,
        needs=SIMULATED,
    )
    texture: str | None = parameter(
        None,
        "Whether the object's texture is visible through the window. Default: as in the scene.",
        choices=("on", "off"),
        panel=EXPERTS,
        needs=SIMULATED,
    )
    tolerance_um: float | None = parameter(
        None,
        "Largest estimated displacement error of one mechanical step; default: the scene's, or 0.2.",
        unit="um",
        low=0.001,
        high=1000.0,
        flag="--tolerance",
        panel=EXPERTS,
        needs=SIMULATED,
    )
    step_ms: float | None = parameter(
        None,
        "Use a fixed mechanical step instead of --tolerance; must be 1 divided by a whole number.",
        unit="ms",
        low=0.0001,
        high=1.0,
        panel=EXPERTS,
        needs=SIMULATED,
    )
    node_pitch_mm: float | None = parameter(
        None,
        "Distance between the gel's nodes; default: the scene's, or 0.833; a simulated `grasp` takes the coarsest of"
        " 1.45 to 0.5 that resolves slip.",
        unit="mm",
        low=0.05,
        high=5.0,
        panel=EXPERTS,
        needs=SIMULATED,
    )
    live: bool = parameter(
        False,
        "Show the trial while it runs, in the browser.",
        recipe=False,
        panel=VIEW,
        needs=(Capability.SCENE, Capability.RECORDED, Capability.PREVIEW, Capability.GRASPED),
    )
    dry_run: bool = parameter(False, "Only print what would be made and its cost.", recipe=False, panel=RUNNING)

    @property
    def shown(self) -> bool:
        """Whether the trials are shown while they run."""
        return self.live

    def solver(self) -> dict[str, Any]:
        """Return the simulation settings that were given as flags."""
        settings = {name: getattr(self, name) for name in SOLVER_OPTIONS}
        return {name: value for name, value in settings.items() if value is not None}
