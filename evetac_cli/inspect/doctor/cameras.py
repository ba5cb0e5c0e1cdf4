"""doctor cameras: what is wrong with each camera on USB, and the rows of all checks. Nothing is written to a camera."""

import errno
import itertools
from collections.abc import Iterator
from typing import Any

from evetac_cli.console import print_text
from evetac_cli.devices.dvxplorer import protocol
from evetac_cli.devices.dvxplorer.camera import SUPER_SPEED, FoundCamera
from evetac_cli.devices.probe import Host
from evetac_cli.events import FRAME_PX
from evetac_cli.inspect.doctor.udev import INSTALL_RULES, JOIN
from evetac_cli.jobs import LookCall, Outcome, Row


def check(device: str, check: str, ok: bool | None, result: str, expected: str = "", fix: str = "") -> Row:
    """Return the row of a check. ok: None if it is neither right nor wrong; fix: what to do unless it is right."""
    return {
        "device": device,
        "check": check,
        "ok": ok,
        "found": result,
        "expected": expected or None,
        "fix": fix if fix and ok is not True else None,
    }


def show(result: Outcome, **_: Any) -> None:
    """Print a block for each device: what is right, what is wrong, and how to fix it."""
    counts = result.summary
    for device, group in itertools.groupby(result.rows, key=lambda row: str(row["device"])):
        print_text(device)
        for row in group:
            sign = {True: "ok", False: "WRONG", None: "-"}[row["ok"]]
            expected = f"  (expected: {row['expected']})" if row["ok"] is not True and row["expected"] else ""
            print_text(f"  {sign:<6}{row['check']:<15} {row['found']}{expected}")
            if row["fix"]:
                print_text(f"        {'':<16}try: {row['fix']}")
    if counts.get("cameras") == 0:
        print_text(
            "no camera found on USB. If one is plugged in, try another port or cable (some cables only carry power);"
        )
        print_text("`lsusb -d 152a:` shows whether the system sees it. Simulated and virtual devices need no camera.")
    if counts.get("grippers") == 0:
        print_text(
            "no gripper found. By default doctor only checks FTDI adapters (U2D2): give another port with"
            " --gripper PORT."
        )
    print_text(f"{counts['wrong']} wrong" if counts["wrong"] else "no faults found")


__all__ = ["camera_rows", "end_program", "look", "show"]

OLDEST_FIRMWARE = 8
SPEEDS = {
    1: "USB 1, 1.5 Mbit/s",
    2: "USB 1, 12 Mbit/s",
    3: "USB 2, 480 Mbit/s",
    4: "USB 3, 5 Gbit/s",
    5: "USB 3, 10 Gbit/s",
}


def look(call: LookCall) -> Outcome:
    """Return a row for every check of every camera."""
    host = Host()
    found = host.cameras() if host.has_libusb() else []
    rows = [row for camera in found for row in camera_rows(host, camera)]
    return Outcome(rows, False, {"cameras": len(found), "wrong": sum(row["ok"] is False for row in rows)})


def camera_rows(host: Host, camera: FoundCamera) -> Iterator[Row]:
    """Yield the checks of a camera."""
    name = f"camera {camera.serial or 'at ' + camera.where}"
    mini = camera.board == protocol.MINI_BOARD
    fix = "record with iniVation's DV, and import the file: evetac record --from FILE.aedat4"
    yield check(name, "model", mini, f"board {camera.board}", f"board {protocol.MINI_BOARD}, a DVXplorer Mini", fix)
    if mini:
        is_supported = OLDEST_FIRMWARE <= camera.firmware <= protocol.NEWEST_FIRMWARE
        newer = "install a newer evetac; this version may work too"
        fix = "update it with iniVation's DV" if camera.firmware < OLDEST_FIRMWARE else newer
        expected = f"{OLDEST_FIRMWARE} to {protocol.NEWEST_FIRMWARE}"
        yield check(name, "firmware", is_supported, str(camera.firmware), expected, fix)
    if camera.speed is not None:
        fast = camera.speed >= SUPER_SPEED
        fix = "use a USB 3 port (blue, or marked SS) and a USB 3 cable, without a hub"
        yield check(name, "link", fast, SPEEDS.get(camera.speed, f"speed {camera.speed}"), "USB 3", fix)
    answer = host.ask_camera(camera)
    yield check(name, *_opened(host, camera, answer.errno, answer.message))
    if answer.frame_px is not None and mini:
        right = answer.frame_px == FRAME_PX
        fix = "the sensor is not that of a DVXplorer Mini: is this the right camera?"
        yield check(name, "sensor", right, "{} x {} px".format(*answer.frame_px), "{} x {} px".format(*FRAME_PX), fix)


def _opened(host: Host, camera: FoundCamera, number: int, message: str) -> tuple[str, bool, str, str, str]:
    """Return the check of opening a camera and reading its sensor's size: check, ok, found, expected, fix."""
    if number == 0:
        return "access", True, "opens and answers", "", ""
    node = host.dev / "bus" / "usb" / f"{camera.device.bus or 0:03d}" / f"{camera.device.address or 0:03d}"
    if number == errno.EACCES:
        fix = f"{INSTALL_RULES}; over ssh, also {JOIN}"
        return "permission", False, f"none for this user ({message})", "a udev rule", fix
    if number == errno.EBUSY:
        users = host.programs_using(node)
        by = ", ".join(users) or "another program"
        return "busy", False, f"used by {by}", "free", end_program(users) if users else f"sudo fuser {node} shows which"
    if number in (errno.ENODEV, errno.ENOENT):
        gone = f"the camera disappeared from the bus while it was read ({message})"
        return "access", False, gone, "", "check the cable, or try another port"
    if number in (errno.EPIPE, errno.ETIMEDOUT, errno.EIO):
        return "answers", False, f"no ({message})", "the size of its sensor", "unplug the camera and plug it in again"
    return "access", False, message, "", "unplug the camera and plug it in again, without a hub"


def end_program(users: list[str]) -> str:
    """Return how to end the programs that use a device."""
    return f"end that program, or: kill {' '.join(user.split('(')[-1].rstrip(')') for user in users)}"
