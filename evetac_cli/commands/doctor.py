"""doctor: its flags, its examples, and the stage that it runs."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import Command, parameter


@dataclass(frozen=True)
class Doctor:
    """Find cameras and grippers, and report what is wrong with each and the command that fixes it; changes nothing.

    The exit code is 0 if all devices are fine or none was found, and 3 if something is wrong. With --speed, doctor
    measures this computer instead; with --compile, it only compiles the inner loops of the commands. With --hardware,
    it tries a camera and a gripper step by step, moves the fingers a little, and writes a report.
    """

    print_udev: bool = parameter(False, "Only print udev rules and where to install them.", recipe=False)
    compile: bool = parameter(
        False,
        "Only compile the inner loops of the commands, so that no command has to wait for this later. `make setup` does"
        " the same.",
        recipe=False,
    )
    speed: bool = parameter(
        False,
        "Only measure, for 15 to 40 s, whether this computer is fast enough to record and grasp in real time, and how"
        " many events per second it can process. Writes temporary files in the current folder.",
        recipe=False,
    )
    gripper: str | None = parameter(
        None,
        "Also examine this port, with or without @BAUD. Without this flag, only ports of FTDI adapters (U2D2) are"
        " examined.",
        recipe=False,
    )
    hardware: bool = parameter(
        False,
        "Try new hardware: --camera and --gripper are tested step by step with at most 20 mA. At the first step that"
        " does not go as expected, doctor switches torque off and stops.",
        recipe=False,
    )
    camera: str | None = parameter(
        None, "With --hardware: camera to try, e.g. dvxplorer:SERIAL; not sim or a replay.", recipe=False
    )
    arm: bool = parameter(False, "With --hardware: allow a real gripper to move.", recipe=False, consent=True)
    yes: bool = parameter(
        False, "With --hardware: do not ask for confirmation before the fingers move.", recipe=False, consent=True
    )


COMMAND = Command(
    "doctor",
    Doctor,
    "inspect.doctor",
    "",
    examples=("evetac doctor", "evetac doctor --speed", "evetac doctor --hardware --camera virtual --gripper virtual"),
)
