"""Lift an object by feel: grasp."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli.params.parameter import parameter
from evetac_cli.params.trials import Trials

DEVICES, GRIP = "Devices", "Grip and detector"  # panels of --help


@dataclass(frozen=True)
class Grasp(Trials):
    """Lift an object with slip feedback: detect slip at 1000 Hz, control the gripper at 500 Hz."""

    scene: str = parameter("lift", "Scene: lift, sideways, drop-20g, drop-100g, or a TOML file.")
    objects: str = parameter(
        "11",
        "Objects of the paper's table, 1 to 20, as in `11` or `10-18`; or a TOML file.",
        flag="--object",
    )
    model: Path | None = parameter(
        None,
        "Model file of the slip detector; default: `shipped`, the package's, disp-xy 10 ms ahead.",
        recipe=False,
    )
    slip_threshold: float = parameter(
        0.3,
        "Probability from which on the controller is told of slip. Lower than the package's detector's own, which is"
        " chosen for timing: a grip is best tightened while the contact begins to slip.",
        low=0.0,
        high=1.0,
        panel=GRIP,
    )
    controller: str = parameter(
        "paper",
        "Law of the grip; paper: balance sets the reference at the first slip; paper-reset: at every slip;"
        " load-proportional: ours; none: contact alone, no detector; fixed:N: N ticks beyond light contact.",
    )
    gain: float = parameter(
        1.0, "K_p in balance, in multiples of the paper's; paper and paper-reset.", low=0.01, high=100.0, panel=GRIP
    )
    latency_ms: int = parameter(
        0, "The slip signal reaches the controller so much later.", unit="ms", low=0, high=1000, panel=GRIP
    )
    control_hz: float = parameter(
        500.0,
        "Steps of the controller a second; 1000 has to be a multiple.",
        unit="Hz",
        low=1.0,
        high=1000.0,
        panel=GRIP,
    )
    tracker: str = parameter(
        "stable", "Preset of the dot tracker.", choices=("stable", "paper", "official", "unregularised"), panel=GRIP
    )
    lift_s: float = parameter(10.0, "Duration of the lifting phase.", unit="s", low=1.0, high=600.0, panel=GRIP)
    balance_s: float = parameter(20.0, "Duration of the balancing phase.", unit="s", low=0.0, high=600.0, panel=GRIP)
    camera: str = parameter(
        "sim",
        "Camera: sim; virtual, a simulated world behind the real driver; dvxplorer or dvxplorer:SERIAL; dv or"
        " dv:SERIAL; replay:RECORDING, what the controller would have done.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Gripper: sim; virtual, with faults as in virtual:overload@1 (docs/hardware.md lists them); or"
        " PORT[:ID][@BAUD], as in /dev/ttyUSB0:5@57600, id 1 and 2000000 baud if left out; default: that of the"
        " camera.",
        recipe=False,
    )
    calibration: Path | None = parameter(
        None, "Dot grid (JSON) of the sensor; default: what a virtual world says.", recipe=False, panel=DEVICES
    )
    arm: bool = parameter(
        False,
        "Move a real gripper. Torque goes off at the end and if anything fails: what is held then falls.",
        recipe=False,
        consent=True,
    )
    max_current_ma: int = parameter(
        100,
        "The gripper's motor current never exceeds this.",
        unit="mA",
        low=1,
        high=2000,
        recipe=False,
        panel=DEVICES,
    )
    max_seconds: float = parameter(
        60.0, "No grasp takes longer.", unit="s", low=1.0, high=3600.0, recipe=False, panel=DEVICES
    )
    watchdog_ms: int = parameter(
        60,
        "Torque is switched off if detector, camera or computer are silent for so long; a multiple of 20.",
        unit="ms",
        low=20,
        high=500,
        recipe=False,
        panel=DEVICES,
    )
