"""doctor: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.command import Command
from evetac_cli.commands.parameter import parameter


@dataclass(frozen=True)
class Doctor:
    """Find cameras and grippers, and say of each what is wrong and the command that mends it; changes nothing.

    Ends with 0 if all that was found is fine, or nothing was found, and with 3 if something is wrong. With --speed it
    measures this computer instead, with --compile it only has the commands' inner loops compiled. With --hardware it
    tries a camera and a gripper step by step, moves the fingers a little, and writes a report.
    """

    print_udev: bool = parameter(False, "Print udev rules and where to put them, and do nothing else.", recipe=False)
    compile: bool = parameter(
        False,
        "Compile what the commands need, so that none of them waits for it later, and do nothing else; `make setup`"
        " does it.",
        recipe=False,
    )
    speed: bool = parameter(
        False,
        "Measure for 20 to 50 s whether this computer is fast enough to record and to grasp in real time, and how many"
        " events per second it can judge; writes temporary files in this folder. Nothing else is examined.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Examine this port too, with or without @BAUD. By itself it only talks to ports of FTDI adapters (U2D2).",
        recipe=False,
    )
    hardware: bool = parameter(
        False,
        "First contact: try --camera and --gripper step by step, with at most 20 mA; stops, torque off, at the first"
        " step that is not as expected.",
        recipe=False,
    )
    camera: str | None = parameter(
        None, "--hardware: camera to try, as in dvxplorer:SERIAL; not sim, nor a replay.", recipe=False
    )
    arm: bool = parameter(False, "--hardware: move a real gripper.", recipe=False, consent=True)
    yes: bool = parameter(False, "--hardware: do not ask before the fingers move.", recipe=False, consent=True)


COMMAND = Command(
    "doctor",
    Doctor,
    "inspect.doctor",
    "",
    examples=("evetac doctor", "evetac doctor --speed", "evetac doctor --hardware --camera virtual --gripper virtual"),
)
