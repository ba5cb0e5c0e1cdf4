"""grasp: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass
from pathlib import Path

from evetac_cli import names
from evetac_cli.commands.command import Command
from evetac_cli.commands.devices import DEVICES, Devices
from evetac_cli.commands.parameter import parameter
from evetac_cli.commands.trials import SIMULATED, Trials
from evetac_cli.names import Capability

GRIP = "Grip and detector"  # panel of --help
WITH_DEVICES = (Capability.GRASPED,)


@dataclass(frozen=True)
class Grasp(Devices, Trials):
    """Lift an object with slip feedback: detect slip at 1000 Hz, control the gripper at 500 Hz."""

    scene: str = parameter("lift", f"Scene: {', '.join(names.GRASPED_SCENES)}, or a TOML file.")
    objects: str = parameter(
        "11",
        "Objects of the paper's table, 1 to 20, as in `11` or `10-18`; or a TOML file.",
        flag="--object",
        needs=SIMULATED,
    )
    model: Path | None = parameter(
        None,
        "Slip detector; default: `shipped`, the package's, disp-xy-grip 10 ms ahead.",
        recipe=False,
    )
    slip_threshold: float | None = parameter(
        None,
        "Probability that three slices in a row have to reach, for the controller to be told of slip; default: the"
        " model's own, or of a model that does not say how often it alarms falsely, 0.3.",
        low=0.0,
        high=1.0,
        panel=GRIP,
    )
    false_alarms_per_min: float | None = parameter(
        None,
        "Choose the lowest threshold with at most so many false alarms per minute, as they were counted in training.",
        unit="1/min",
        low=0.0,
        high=300.0,
        recipe=False,  # the threshold is
        panel=GRIP,
    )
    controller: str = parameter(
        "paper",
        f"Grip law; {names.words(names.CONTROLLERS)}; or a plug-in's.",
    )
    gain: float = parameter(
        1.0, "K_p in balance, in multiples of the paper's; paper and paper-reset.", low=0.01, high=100.0, panel=GRIP
    )
    grip_margin: float = parameter(
        1.4,
        "How many times the needed force the grip aims at; load-proportional alone.",
        low=1.0,
        high=5.0,
        panel=GRIP,
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
    tracker: str = parameter("stable", "Preset of the dot tracker.", choices=tuple(names.TRACKERS), panel=GRIP)
    lift_s: float = parameter(10.0, "Duration of the lifting phase.", unit="s", low=1.0, high=600.0, panel=GRIP)
    balance_s: float = parameter(20.0, "Duration of the balancing phase.", unit="s", low=0.0, high=600.0, panel=GRIP)
    max_current_ma: int = parameter(
        100,
        "The gripper's motor current never exceeds this.",
        unit="mA",
        low=1,
        high=2000,
        recipe=False,
        panel=DEVICES,
        needs=WITH_DEVICES,
    )
    max_seconds: float = parameter(
        60.0, "No grasp takes longer.", unit="s", low=1.0, high=3600.0, recipe=False, panel=DEVICES, needs=WITH_DEVICES
    )


COMMAND = Command(
    "grasp",
    Grasp,
    "trials.grasp",
    "",
    examples=(
        "evetac grasp --object 11-13 --count 2 -o grasps",
        "evetac grasp --object 11 --controller load-proportional -o grasps",
        "evetac grasp --camera dvxplorer --gripper /dev/ttyUSB0 --arm",
    ),
)
