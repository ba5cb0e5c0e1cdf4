"""doctor udev: the rules that let users open cameras and adapters of grippers."""

from typing import Any

from evetac_cli.console import print_text
from evetac_cli.jobs import LookCall, Outcome

RULES = "/etc/udev/rules.d/60-evetac.rules"
RELOAD = "sudo udevadm control --reload && sudo udevadm trigger"
MAY_USE = 'GROUP="dialout", MODE="0660", TAG+="uaccess"'
JOIN = "sudo usermod -aG dialout $USER, and log in again"
INSTALL_RULES = f"evetac doctor udev | sudo tee {RULES} && {RELOAD}; then plug it in again"


def look(call: LookCall) -> Outcome:
    """Return no rows; the rules are in the summary."""
    return Outcome([], False, {"udev": udev_rules()})


def show(result: Outcome, **_: Any) -> None:
    """Print the rules and nothing else, for a file."""
    print_text(result.summary["udev"])


def udev_rules() -> str:
    """Return udev rules that permit the use of the camera and the gripper's adapter, and set its latency to 1 ms.

    Permitted are the user who is logged in at the computer and the group dialout, not everybody, because write access
    to the adapter can move the gripper.
    """
    return "\n".join(
        (
            f"# For {RULES}. Install with:",
            f"#   evetac doctor udev | sudo tee {RULES}",
            f"#   {RELOAD}",
            "# and plug the devices in again. The user logged in at the computer and the group dialout may use them:",
            f"#   {JOIN}",
            "# Cameras of iniVation, including the DVXplorer Mini (152a:8419).",
            'SUBSYSTEM=="usb", ATTR{idVendor}=="152a", ATTR{idProduct}=="84[0-1]?", ' + MAY_USE,
            "# Serial adapters of FTDI, including ROBOTIS' U2D2: an answer is passed on after 1 ms instead of 16 ms.",
            'SUBSYSTEM=="tty", KERNEL=="ttyUSB*", DRIVERS=="ftdi_sio", ATTR{device/latency_timer}="1", ' + MAY_USE,
        )
    )
