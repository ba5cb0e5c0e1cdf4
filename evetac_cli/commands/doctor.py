"""doctor and its sub-commands: their flags, their examples, and the module that answers each."""

from dataclasses import dataclass

from evetac_cli.commands.parameter import LOOK, Command, parameter


@dataclass(frozen=True)
class Doctor:
    """Find cameras and grippers, and report what is wrong with each and the command that fixes it; changes nothing.

    The exit code is 0 if all devices are fine or none was found, and 3 if something is wrong.
    """

    gripper: str | None = parameter(
        None,
        "Also examine this port, with or without @BAUD. Without this flag, only ports of FTDI adapters (U2D2) are"
        " examined.",
        recipe=False,
    )


@dataclass(frozen=True)
class DoctorCameras:
    """Report what is wrong with each camera on USB, and the command that fixes it."""


@dataclass(frozen=True)
class DoctorCompile:
    """Compile the inner loops of the commands, so that no command has to wait for this later.

    `make setup` does the same.
    """


@dataclass(frozen=True)
class DoctorSpeed:
    """Measure whether this computer is fast enough to record and grasp in real time.

    This takes 15 to 40 s and also reports how many events per second it can process. It writes temporary files in the
    current folder.
    """


@dataclass(frozen=True)
class DoctorHardware:
    """Try a new camera and gripper step by step with at most 20 mA, and write a report.

    At the first step that does not go as expected, doctor switches torque off and stops.
    """

    camera: str | None = parameter(None, "Camera to try, e.g. dvxplorer:SERIAL; not sim or a replay.", recipe=False)
    gripper: str | None = parameter(None, "Gripper to try, e.g. /dev/ttyUSB0.", recipe=False)
    arm: bool = parameter(False, "Allow a real gripper to move.", recipe=False, consent=True)
    yes: bool = parameter(False, "Do not ask for confirmation before the fingers move.", recipe=False, consent=True)


@dataclass(frozen=True)
class DoctorUdev:
    """Print the udev rules that let users open cameras and adapters, and where to install them."""


def _part(name: str, params: type, module: str, example: str = "", *, unit: str = "", out: str = "") -> Command:
    examples = (f"evetac doctor {name}{example}",)
    return Command(name, params, f"inspect.doctor.{module}", "", unit=unit, examples=examples, does=LOOK, out=out)


COMMAND = Command("doctor", Doctor, "inspect.doctor", "", unit="", examples=("evetac doctor",), does=LOOK)
COMMANDS = (
    _part("cameras", DoctorCameras, "cameras"),
    _part("compile", DoctorCompile, "compile_kernels", unit="parts"),
    _part("speed", DoctorSpeed, "speed", unit="parts"),
    _part(
        "hardware",
        DoctorHardware,
        "hardware_check",
        " --camera virtual --gripper virtual",
        out="Report file; default: evetac-hardware-DATE.json in the current folder.",
    ),
    _part("udev", DoctorUdev, "udev", " | sudo tee /etc/udev/rules.d/60-evetac.rules"),
)
