"""grasp: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.parameter import Command, parameter
from evetac_cli.commands.trials import DEVICES, SIMULATED, Devices, Trials
from evetac_cli.names import Capability

GRIP = "Grip and detector"  # panel of --help
WITH_DEVICES, DETECTED = (Capability.GRASPED,), (Capability.DETECTOR,)


@dataclass(frozen=True)
class Grasp(Devices, Trials):
    """Lift an object with slip detection at 1000 Hz and gripper control at 500 Hz."""

    scene: str = parameter("lift", "Scene (`evetac list scenes`) or TOML file.")
    objects: str = parameter(
        "11",
        "Objects of the paper's table, 1 to 20, e.g. `11` or `10-18`; or a TOML file.",
        flag="--object",
        needs=SIMULATED,
    )
    model: Path | None = parameter(
        None,
        "Slip detector; default: `shipped`, the pretrained load-path, 10 ms ahead.",
        recipe=False,
        needs=DETECTED,
    )
    slip_threshold: float | None = parameter(
        None,
        "Slip probability that three consecutive slices must reach before slip is reported to the controller; default:"
        " the model's own.",
        low=0.0,
        high=1.0,
        panel=GRIP,
        needs=DETECTED,
    )
    false_alarms_per_min: float | None = parameter(
        None,
        "Use the lowest threshold with, at 95 % confidence for what was counted in training, at most this many false"
        " alarms per minute.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # the threshold is
        panel=GRIP,
        needs=DETECTED,
    )
    controller: str = parameter(
        "load-proportional",
        f"Grip controller; {names.words(names.CONTROLLERS)}; or a plug-in's.",
    )
    gain: float = parameter(
        1.0,
        "Gain K_p of the balancing phase, as a multiple of the paper's; for paper and paper-reset.",
        low=0.01,
        high=100.0,
        panel=GRIP,
    )
    grip_margin: float = parameter(
        1.4,
        "Target grip force as a multiple of the force needed to hold the object; for load-proportional only.",
        low=1.0,
        high=5.0,
        panel=GRIP,
    )
    latency_ms: int = parameter(
        0,
        "Extra delay of the slip signal to the controller.",
        unit="ms",
        low=0,
        high=1000,
        panel=GRIP,
        needs=(Capability.STEPPED, Capability.REPLAY),
    )
    control_hz: float = parameter(
        500.0,
        "Rate of the controller; must divide 1000.",
        unit="Hz",
        low=1.0,
        high=1000.0,
        panel=GRIP,
    )
    tracker: str = parameter(
        "stable", "Preset of the dot tracker.", choices=tuple(names.TRACKERS), panel=GRIP, needs=DETECTED
    )
    lift_s: float = parameter(
        10.0,
        "Duration of the lifting phase. A lifted object hangs 50 mm high, which takes 3.1 s in the scene lift.",
        unit="s",
        low=1.0,
        high=600.0,
        panel=GRIP,
    )
    balance_s: float = parameter(20.0, "Duration of the balancing phase.", unit="s", low=0.0, high=600.0, panel=GRIP)
    max_current_ma: int = parameter(
        100,
        "Upper limit of the gripper's motor current.",
        unit="mA",
        low=1,
        high=2000,
        recipe=False,
        panel=DEVICES,
        needs=WITH_DEVICES,
    )
    max_seconds: float = parameter(
        60.0,
        "Longest duration of a grasp.",
        unit="s",
        low=1.0,
        high=3600.0,
        recipe=False,
        panel=DEVICES,
        needs=WITH_DEVICES,
    )


COMMAND = Command(
    "grasp",
    Grasp,
    "trials.grasp",
    "",
    examples=(
        "evetac grasp --object 11-13 --count 2 -o grasps",
        "evetac grasp --object 11 --controller paper --model paper.model.h5 -o grasps",
        "evetac grasp --camera dvxplorer --gripper /dev/ttyUSB0 --arm",
    ),
)
