"""doctor: find faults of cameras, grippers and this installation, and print the command that fixes each.

What drivers set or refuse when they open a device, such as supply and temperature of a gripper, is not repeated here.
It only reads: it writes no register, no setting and no file. A gripper's baud rate or an adapter's timer changes only
when the user runs the printed command.
"""

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from evetac_cli import plugins
from evetac_cli.commands.doctor import Doctor
from evetac_cli.devices.cameras import NamedCamera
from evetac_cli.devices.grippers import BAUD, ID, NamedGripper, Serial, parse_port
from evetac_cli.devices.probe import FTDI, Host, SerialPort
from evetac_cli.devices.rh_p12_rn.control_table import MODEL_NUMBER, OLD_MODEL_NUMBER, hardware_errors
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import BusDevice
from evetac_cli.errors import EXTRAS, DeviceError, InputError, install_hint, pip
from evetac_cli.formats.exports import ExportFormat
from evetac_cli.formats.imports import ImportFormat
from evetac_cli.inspect.doctor.cameras import camera_rows, check, end_program, show
from evetac_cli.inspect.doctor.udev import INSTALL_RULES, JOIN
from evetac_cli.jobs import LookCall, Outcome, Row
from evetac_cli.kernels.grip.control import PluginLaw
from evetac_cli.kernels.slip.architectures import PluginLayers
from evetac_cli.plugins import Plugin
from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.plan import named_objects, one_sensor

__all__ = ["LOADED", "SERVES", "check", "look", "plugin_rows", "run", "show"]

LEAST_BAUD = 1_000_000  # required for a control cycle of 2 ms
LATENCY_MS = 1
FREE_BYTES = 1 << 30  # some 5 min at a million events per second, with 3.5 bytes per event on disk
OPENCV = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")

# The features that need each extra.
SERVES = {
    "camera": "--camera dv",
    "convert": "AEDAT4, bags, Prophesee's files, tables, LeRobot",
    "plot": "pictures of reports, pages",
    "cluster": "--engine dask:ADDRESS",
    "robot": "evetac_cli.gym, examples",
}

# The function that loads the plug-ins of each group, as a command that uses one does.
LOADED: dict[str, Callable[[Plugin], object]] = {
    plugins.CAMERAS: lambda plugin: plugin.load(NamedCamera),
    plugins.GRIPPERS: lambda plugin: plugin.load(NamedGripper),
    plugins.IMPORTERS: lambda plugin: plugin.load(ImportFormat),
    plugins.EXPORTERS: lambda plugin: plugin.load(ExportFormat),
    plugins.CONTROLLERS: lambda plugin: plugin.load(PluginLaw),
    plugins.NETWORKS: lambda plugin: plugin.load(PluginLayers),
    plugins.SCENES: lambda plugin: scene_file.load(plugin.name),
    plugins.SENSORS: lambda plugin: one_sensor(plugin.name),
    plugins.OBJECTS: lambda plugin: named_objects(plugin.name),
}

NOT_ASKED = "not checked: not an FTDI adapter"
WHICH_PORTS = "`ls /dev/ttyUSB* /dev/ttyACM*` lists the ports"


def look(call: LookCall) -> Outcome:
    """Examine everything."""
    return run(call.params)


def run(params: Doctor, host: Host | None = None) -> Outcome:
    """Return a row for every check of the installation, the disk, and every camera and gripper."""
    host = host or Host()
    rows = [*_software(host), *plugin_rows(), _disk(host, Path.cwd())]
    cameras = host.cameras() if host.has_libusb() else []
    for camera in cameras:
        rows += camera_rows(host, camera)
    grippers = 0
    for port, user_gripper in _ports(host, params):
        if user_gripper is None and port.vendor != FTDI:
            rows.append(
                check(f"port {port.path}", "gripper", None, NOT_ASKED, "", f"evetac doctor --gripper {port.path}")
            )
            continue
        port_rows, count = _port(host, port.path, user_gripper)
        rows += port_rows
        grippers += count
    wrong = sum(row["ok"] is False for row in rows)
    return Outcome(rows, False, {"cameras": len(cameras), "grippers": grippers, "wrong": wrong})


def _software(host: Host) -> Iterator[Row]:
    loads = host.has_libusb()
    fix = f"{pip('install')} --force-reinstall libusb-package"
    yield check("software", "libusb", loads, "loads" if loads else "does not load", "a USB library", fix)
    missing = host.missing_libraries()
    state = f"without {', '.join(missing)}" if missing else "installed"
    yield check("software", "libraries", not missing, state, "", install_hint())
    for extra, packages in EXTRAS.items():
        lacking = [name for name in packages if not host.has_package(name)]
        state = f"without {', '.join(lacking)}: no {SERVES[extra]}" if lacking else "installed"
        yield check("software", f"extra {extra}", None if lacking else True, state, "", install_hint(extra))
    installed = host.distributions(OPENCV)
    builds, expected = ", ".join(installed) or "none", "only one: several overwrite each other"
    fix = f"{pip('uninstall')} {' '.join(name.split()[0] for name in installed)}; {pip('install')} {OPENCV[-1]}"
    yield check("software", "opencv", len(installed) == 1, builds, expected, fix)


def plugin_rows() -> Iterator[Row]:
    """Yield a row for every installed plug-in, grouped by package."""
    every = [plugin for group in LOADED for plugin in plugins.installed(group)]
    fix = "install a version that fits this evetac, or uninstall it"
    for plugin in sorted(every, key=lambda each: each.package):
        fault = _why_not(plugin)
        device = f"plug-ins of {plugin.package} {plugin.version}"
        yield check(device, plugin.what, not fault, fault or "loads", "", fix)


def _why_not(plugin: Plugin) -> str:
    """Return a text on why a plug-in cannot be used; empty if it can."""
    if fault := plugin.fault():
        return fault
    try:
        with plugins.only_looked_at():
            LOADED[plugin.group](plugin)
    except InputError as error:
        return error.found or error.message
    except Exception as error:  # the plug-in's code may raise anything, and the others must still be checked
        return f"{type(error).__name__}: {error}"
    return ""


def _disk(host: Host, folder: Path) -> Row:
    free = host.free_bytes(folder)
    enough = free >= FREE_BYTES
    minutes = free / 3.5e6 / 60
    room = f"{free / 1e9:.1f} GB free in {folder}: {minutes:.0f} min at 1,000,000 events per second"
    fix = "free some space, or record elsewhere with -o"
    return check("disk", "free space", enough, room, f"{FREE_BYTES / 1e9:.1f} GB", fix)


def _ports(host: Host, params: Doctor) -> Iterator[tuple[SerialPort, Serial | None]]:
    """Yield the existing serial ports and the one that the user gave, with the gripper given there."""
    user_gripper = parse_port(params.gripper) if params.gripper else None
    for port in host.serial_ports():
        if user_gripper is None or port.path.resolve() != Path(user_gripper.port).resolve():
            yield port, None
    if user_gripper is not None:
        yield SerialPort(Path(user_gripper.port), "", ""), user_gripper


def _port(host: Host, path: Path, user_gripper: Serial | None) -> tuple[list[Row], int]:
    """Return rows of one port and of the grippers on it, and the number of grippers."""
    name = f"port {path}"
    if not path.exists():
        return [check(name, "exists", False, "no such port", "", f"plug the adapter in; {WHICH_PORTS}")], 0
    if not _is_serial(path):
        fix = f"give the adapter's port; {WHICH_PORTS}"
        return [check(name, "serial port", False, "not a serial port", "a port such as /dev/ttyUSB0", fix)], 0
    rows: list[Row] = []
    if not os.access(path, os.R_OK | os.W_OK):
        fix = f"{JOIN}; or {INSTALL_RULES}"
        return [check(name, "permission", False, "none for this user", "", fix)], 0
    latency_ms = host.latency_ms(path)
    if latency_ms is not None:
        fine = latency_ms <= LATENCY_MS
        timer = f"/sys/bus/usb-serial/devices/{path.name}/latency_timer"
        fix = f"echo 1 | sudo tee {timer}; permanently: {INSTALL_RULES}"
        rows.append(
            check(name, "latency timer", fine, f"{latency_ms} ms", f"{LATENCY_MS} ms, for 500 commands per second", fix)
        )
    users = host.programs_using(path)
    if users:
        return [*rows, check(name, "busy", False, f"used by {', '.join(users)}", "free", end_program(users))], 0
    try:
        grippers = host.scan(path, ID if user_gripper is None else user_gripper.id)
    except DeviceError as error:
        return [*rows, check(name, "opens", False, " ".join(str(error).split()), "", f"sudo fuser {path}")], 0
    if not grippers:
        rates = f"{host.rates[0]} to {host.rates[-1]} baud"
        fix = "switch on the gripper's 24 V, check the cable between adapter and gripper"
        # an adapter that the user did not give may be connected to another device
        return [
            *rows,
            check(
                name, "gripper", None if user_gripper is None else False, "none answers", f"an answer at {rates}", fix
            ),
        ], 0
    if user_gripper is not None and user_gripper.id != ID and user_gripper.id not in [each.id for each in grippers]:
        answers = " and ".join(f"gripper {each.id}" for each in grippers)
        fix = " or ".join(_flag(path, each) for each in grippers)
        answering = f"{answers} answer{'s' if len(grippers) == 1 else ''}"
        rows.append(
            check(name, "id", False, answering, f"gripper {user_gripper.id}, as given", f"give the right id: {fix}")
        )
    for gripper in grippers:
        try:
            rows += _gripper(host, path, gripper)
        except DeviceError as error:
            fault = " ".join(str(error).split())
            rows.append(check(f"gripper {gripper.id} at {path}", "answers", False, fault, "", "check cable and 24 V"))
    return rows, len(grippers)


def _is_serial(path: Path) -> bool:
    """Whether a path is a terminal; one that cannot be opened counts as one, and a later check gives the reason."""
    if not stat.S_ISCHR(path.stat().st_mode):
        return False
    try:
        port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return True
    try:
        return os.isatty(port)
    finally:
        os.close(port)


def _flag(path: Path, gripper: BusDevice) -> str:
    """Return the shortest flag that selects a gripper in a command."""
    return f"--gripper {Serial(str(path), gripper.baud, gripper.id).shortest}"


def _gripper(host: Host, path: Path, gripper: BusDevice) -> Iterator[Row]:
    name = f"gripper {gripper.id} at {path}"
    right = gripper.model == MODEL_NUMBER
    older = " (RH-P12-RN without A: another control table)" if gripper.model == OLD_MODEL_NUMBER else ""
    fix = "use an RH-P12-RN(A): the driver supports no other gripper"
    yield check(name, "model", right, f"{gripper.model}{older}", f"{MODEL_NUMBER}, RH-P12-RN(A)", fix)
    fast = gripper.baud >= LEAST_BAUD
    change = f"change_baud('{path}', {gripper.baud}, {BAUD}, id_={gripper.id})"
    slow_fix = f'python -c "from evetac_cli.devices.rh_p12_rn.driver import change_baud; {change}" (turns torque off)'
    expected = f"at least {LEAST_BAUD}, for 500 commands per second"
    yield check(name, "baud", fast, str(gripper.baud), expected, slow_fix)
    if not right:
        return
    yield check(name, "flag", True, _flag(path, gripper))
    registers = host.registers(path, gripper)
    errors = hardware_errors(registers["Hardware Error Status"])
    fix = "remove the cause, then switch the gripper's 24 V off and on"
    yield check(name, "hardware error", not errors, ", ".join(errors) or "none", "none", fix)
    off = registers["Torque Enable"] == 0
    fix = "end the program that drives the gripper, or it was left on by one that has ended"
    yield check(name, "torque", True if off else None, "off" if off else "on", "off while no program uses it", fix)
    yield check(
        name, "firmware", True, f"{registers['Firmware Version']}; current limit {registers['Current Limit']} mA"
    )
