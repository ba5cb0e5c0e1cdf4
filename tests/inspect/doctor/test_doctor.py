"""doctor, on machines made up of folders, the virtual camera's bus and the virtual gripper's port."""

import dataclasses
import errno
import importlib.metadata
import json
import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evetac_cli.cli.main import app
from evetac_cli.commands.doctor import Doctor
from evetac_cli.devices import grippers
from evetac_cli.devices.probe import Host
from evetac_cli.devices.rh_p12_rn.control_table import baud_code
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.devices.virtual.word_sources import PreparedWords
from evetac_cli.errors import install_hint
from evetac_cli.inspect import doctor
from evetac_cli.jobs import Outcome
from tests.quick import few

RATES = (2_000_000,)  # each at which nobody answers takes its time
PATIENCE_MS = 300.0  # the virtual servo's process may have to wait for a core
BROADCAST_MS = 3000.0  # and so where it is found by asking all


class NoBus:
    """A USB bus with nothing on it."""

    def enumerate_devices(self) -> Any:
        return iter(())


class Made(Host):
    """A machine with known software and disk."""

    def has_libusb(self) -> bool:
        return self.usb_backend is not None

    def free_bytes(self, folder: Path) -> int:
        return 10 << 30

    def has_package(self, name: str) -> bool:
        return True

    def distributions(self, names: Any) -> list[str]:
        return ["opencv-contrib-python-headless 5.0"]


@pytest.fixture
def machine(tmp_path: Path) -> Made:
    """A machine without devices."""
    for name in ("sys/class/tty", "proc", "dev"):
        (tmp_path / name).mkdir(parents=True)
    return Made(tmp_path / "sys", tmp_path / "proc", tmp_path / "dev", NoBus(), answer_ms=PATIENCE_MS, rates=RATES)


def with_camera(machine: Made, *faults: str, **options: Any) -> tuple[Made, VirtualDvxplorer]:
    camera = VirtualDvxplorer(PreparedWords(np.empty(0, np.uint32)), faults=faults, **options)
    return dataclasses.replace(machine, usb_backend=camera), camera


def wrong(result: Outcome) -> dict[str, dict[str, Any]]:
    """What is wrong, by check; each with something to do about it."""
    rows = {row["check"]: row for row in result.rows if row["ok"] is False}
    assert result.summary["wrong"] == len(rows)
    assert all(row["fix"] for row in rows.values())
    return rows


def rows_of_device(result: Outcome, device: str) -> dict[str, dict[str, Any]]:
    return {row["check"]: row for row in result.rows if row["device"].startswith(device)}


def test_nothing_plugged_in_is_no_fault(machine: Made, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that a machine without devices has no faults, and the user reads what to check."""
    result = doctor.run(Doctor(), machine)
    assert wrong(result) == {}
    assert (result.summary["cameras"], result.summary["grippers"], result.simulated) == (0, 0, False)
    doctor.show(result)
    text = capsys.readouterr().out
    assert "no camera found" in text and "no gripper found" in text and "no faults found" in text


@pytest.mark.parametrize("firmware", [8, 9, 10])
def test_a_good_camera_is_well(machine: Made, monkeypatch: pytest.MonkeyPatch, firmware: int) -> None:
    """Assert that both generations of the camera are found, read and released, with nothing written to them."""
    host, camera = with_camera(machine, firmware=firmware)
    handles: list[str] = []
    monkeypatch.setattr(camera, "open_device", lambda dev: handles.append("opened") or camera)
    monkeypatch.setattr(camera, "close_device", lambda handle: handles.append("closed"))
    for _ in range(2):
        result = doctor.run(Doctor(), host)
        assert wrong(result) == {}
        rows = rows_of_device(result, "camera DXM00042")
        assert [row["found"] for row in rows.values()] == [
            "board 4",
            str(firmware),
            "USB 3, 5 Gbit/s",
            "opens and answers",
            "640 x 480 px",
        ]
    assert handles[-2:] == ["opened", "closed"]
    assert handles.count("opened") == handles.count("closed")
    assert camera.log == []


@pytest.mark.parametrize(
    ("faults", "options", "check", "fix"),
    [
        (["usb2"], {}, "link", "USB 3 port"),
        (["no-permission"], {}, "permission", "doctor udev | sudo tee"),
        (["busy"], {}, "busy", "fuser"),
        ([], {"board": 2}, "model", "record with iniVation"),
        ([], {"firmware": 5}, "firmware", "update it"),
        ([], {"firmware": 11}, "firmware", "newer evetac"),
    ],
)
def test_faults_of_a_camera(machine: Made, faults: list[str], options: dict[str, Any], check: str, fix: str) -> None:
    """Assert that each fault is named, with what mends it, and nothing is written."""
    host, camera = with_camera(machine, *faults, **options)
    faulty = wrong(doctor.run(Doctor(), host))
    assert fix in faulty.pop(check)["fix"]
    assert faulty == {}
    assert camera.log == []


def test_who_uses_the_camera_is_named(machine: Made) -> None:
    """Assert that the program that has the camera open is found by its open files."""
    host, _ = with_camera(machine, "busy")
    process = machine.proc / "4321"
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("dv-gui\n")
    (process / "fd" / "7").symlink_to(machine.dev / "bus" / "usb" / "009" / "002")
    row = wrong(doctor.run(Doctor(), host))["busy"]
    assert row["found"] == "used by dv-gui (4321)"
    assert "kill 4321" in row["fix"]


FAILING = {
    errno.ENODEV: "access",
    errno.ETIMEDOUT: "answers",
    errno.EPIPE: "answers",
    errno.EIO: "answers",
    99: "access",
}


@pytest.mark.parametrize(("number", "check"), FAILING.items())
def test_a_camera_that_fails_while_asked(
    machine: Made, monkeypatch: pytest.MonkeyPatch, number: int, check: str
) -> None:
    """Assert that a camera that goes away or does not answer is a row, not a crash."""
    import usb.core

    host, camera = with_camera(machine)

    def fail(*_: Any) -> None:
        raise usb.core.USBError("it failed", -1, number)

    monkeypatch.setattr(camera, "claim_interface", fail)
    assert list(wrong(doctor.run(Doctor(), host))) == [check]


def test_software_and_disk(machine: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a missing libusb, two builds of OpenCV and a full disk are wrong, and missing extras are listed."""
    monkeypatch.setattr(Made, "has_package", lambda self, name: name != "faery")
    monkeypatch.setattr(Made, "free_bytes", lambda self, folder: 5_000_000)
    monkeypatch.setattr(Made, "distributions", lambda self, names: ["opencv-python 4.1", f"{names[-1]} 5.0"])
    monkeypatch.setattr(Made, "missing_libraries", lambda self: ["torch", "onnx"])
    result = doctor.run(Doctor(), dataclasses.replace(machine, usb_backend=None))
    faulty = wrong(result)
    assert list(faulty) == ["libusb", "libraries", "opencv", "free space"]
    assert (faulty["libraries"]["found"], faulty["libraries"]["fix"]) == (
        "without torch, onnx",
        install_hint(),
    )
    assert "pip uninstall opencv-python opencv-contrib-python-headless" in faulty["opencv"]["fix"]
    extra = rows_of_device(result, "software")["extra convert"]
    assert (extra["ok"], extra["fix"]) == (None, install_hint("convert"))
    assert extra["found"].startswith("without faery: no AEDAT4")


def test_libraries_that_are_missing_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that of what evetac requires, extras left out, what is not installed is named."""
    required = ["numpy>=2.0", "not-there-1>=3", "not.there[fast]~=2; python_version > '3'", "nor-this>=1; extra == 'x'"]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    assert Host().missing_libraries() == ["not-there-1", "not.there"]


def test_extras_are_those_that_can_be_installed() -> None:
    """Assert that every extra a user may lack is asked for, each of its packages by the name it is imported under."""
    project = tomllib.loads((Path(__file__).resolve().parents[3] / "pyproject.toml").read_text())["project"]
    offered = {
        name: packages for name, packages in project["optional-dependencies"].items() if name not in ("dev", "docs")
    }
    assert {name: len(packages) for name, packages in offered.items()} == {
        name: len(modules) for name, modules in doctor.EXTRAS.items()
    }
    assert doctor.SERVES.keys() == doctor.EXTRAS.keys()


def adapter(
    machine: Made, latency_ms: int = 1, timer: str = "ttyUSB0", vendor: str = "0403", name: str = "ttyUSB0"
) -> Path:
    """A serial adapter on USB, in sysfs as the kernel shows it; returns its port, which nothing stands behind yet.

    Where a terminal will stand in for the port, its latency timer has to bear the terminal's name.
    """
    usb_device = machine.sysfs / "devices" / "usb1" / "1-1"
    tty = usb_device / "1-1:1.0" / name
    tty.mkdir(parents=True)
    (usb_device / "idVendor").write_text(f"{vendor}\n")
    (usb_device / "idProduct").write_text("6014\n")
    (machine.sysfs / "class" / "tty" / name).mkdir()
    (machine.sysfs / "class" / "tty" / name / "device").symlink_to(tty)
    timers = machine.sysfs / "bus" / "usb-serial" / "devices" / timer
    timers.mkdir(parents=True)
    (timers / "latency_timer").write_text(f"{latency_ms}\n")
    return machine.dev / name


Gripper = Callable[..., VirtualGripper]


@pytest.fixture
def plugged(machine: Made) -> Any:
    """Plug a virtual gripper into an adapter."""
    open_ones: list[VirtualGripper] = []

    def plug(latency_ms: int = 1, **options: Any) -> tuple[Path, VirtualGripper]:
        gripper = VirtualGripper(**options)
        open_ones.append(gripper)
        port = adapter(machine, latency_ms, os.path.basename(gripper.port))
        port.symlink_to(gripper.port)
        return port, gripper

    yield plug
    for gripper in open_ones:
        gripper.close()


GOOD = {"Return Delay Time": 0}


def test_a_good_gripper_is_well(machine: Made, plugged: Any) -> None:
    """Assert that a gripper is found by itself at the adapter, and well."""
    plugged(registers=GOOD)
    result = doctor.run(Doctor(), machine)
    assert wrong(result) == {}
    assert result.summary["grippers"] == 1
    states = {check: row["found"] for check, row in rows_of_device(result, f"gripper 1 at {machine.dev}").items()}
    assert states["model"] == "35074" and states["baud"] == "2000000" and states["torque"] == "off"


def test_a_gripper_as_it_comes_from_the_factory(machine: Made, plugged: Any) -> None:
    """Assert that slow rate and latency timer are named, and nothing is changed by asking."""
    port, gripper = plugged(latency_ms=16, baud=57_600)
    result = doctor.run(Doctor(), dataclasses.replace(machine, rates=(2_000_000, 57_600)))
    faulty = wrong(result)
    assert list(faulty) == ["latency timer", "baud"]
    assert f"change_baud('{port}', 57600, 2000000, id_=1)" in faulty["baud"]["fix"]
    assert "latency_timer" in faulty["latency timer"]["fix"] and "16 ms" in faulty["latency timer"]["found"]
    with Bus(gripper.port, 57_600, answer_ms=PATIENCE_MS) as bus:
        assert [bus.read(name) for name in ("Return Delay Time", "Baud Rate", "Torque Enable")] == [
            250,
            baud_code(57_600),
            0,
        ]


@pytest.mark.parametrize(
    ("id_", "baud"), few([(5, 57_600), (0, 2_000_000), (1, 1_000_000), (1, 2_000_000)], (5, 57_600))
)
def test_the_flag_that_doctor_names_reaches_the_gripper(machine: Made, plugged: Any, id_: int, baud: int) -> None:
    """Assert that a gripper of any id and rate is found, and opened by the very text that doctor prints."""
    port, gripper = plugged(registers=GOOD | {"ID": id_}, baud=baud)
    host = dataclasses.replace(machine, rates=(baud,), broadcast_ms=BROADCAST_MS)
    flag = rows_of_device(doctor.run(Doctor(), host), f"gripper {id_} at {port}")["flag"]["found"]
    assert flag.startswith("--gripper ")
    named = grippers.parse(flag.removeprefix("--gripper "))
    assert (named.id, named.baud) == (id_, baud)
    with Bus(named.port, named.baud, named.id, answer_ms=PATIENCE_MS) as bus:
        assert bus.ping() == 35074
    assert len(flag) == len(f"--gripper {port}") + 2 * (id_ != 1) + (1 + len(str(baud))) * (baud != 2_000_000)


@pytest.mark.parametrize("asked", few([":7", ":7@2000000", ":0"], ":7"))
def test_an_id_that_does_not_answer(machine: Made, plugged: Any, asked: str) -> None:
    """Assert that a gripper that was named by an id that is not there is missed, with those that are."""
    port, _ = plugged(registers=GOOD | {"ID": 5})
    host = dataclasses.replace(machine, broadcast_ms=BROADCAST_MS)
    result = doctor.run(Doctor(gripper=f"{port}{asked}"), host)
    row = wrong(result)["id"]
    assert row["found"] == "gripper 5 answers" and f"gripper {asked[1]}" in row["expected"]
    assert f"--gripper {port}:5" in row["fix"]


@pytest.mark.parametrize(
    ("registers", "check", "words"),
    [
        ({"Hardware Error Status": 0b100100}, "hardware error", "overheating, overload"),
        ({"Model Number": 35073}, "model", "RH-P12-RN without A"),
        ({"Model Number": 1020}, "model", "1020"),
    ],
)
@pytest.mark.slow
def test_faults_of_a_gripper(machine: Made, plugged: Any, registers: dict[str, int], check: str, words: str) -> None:
    """Assert that each fault is named."""
    plugged(registers=GOOD | registers)
    faulty = wrong(doctor.run(Doctor(), machine))
    assert list(faulty) == [check]
    assert words in faulty[check]["found"]


@pytest.mark.slow
def test_an_adapter_without_a_gripper(machine: Made, plugged: Any) -> None:
    """Assert that silence is a fault only on a port that the user named."""
    port, gripper = plugged(registers=GOOD, faults=["lost-answer%100"])
    fast = dataclasses.replace(machine, rates=(2_000_000,), answer_ms=20.0)
    result = doctor.run(Doctor(), fast)
    assert wrong(result) == {}
    assert rows_of_device(result, f"port {port}")["gripper"]["found"] == "none answers"
    named = wrong(doctor.run(Doctor(gripper=f"{port}@2000000"), fast))
    assert list(named) == ["gripper"] and "24 V" in named["gripper"]["fix"]


def test_other_adapters_are_left_alone(machine: Made) -> None:
    """Assert that doctor sends nothing to what is no FTDI adapter, unless it is named."""
    port = adapter(machine, vendor="2341", name="ttyACM0")
    (row,) = rows_of_device(doctor.run(Doctor(), machine), f"port {port}").values()
    assert (row["ok"], row["found"]) == (None, "not checked: not an FTDI adapter")
    assert row["fix"] == f"evetac doctor --gripper {port}"
    assert list(wrong(doctor.run(Doctor(gripper=str(port)), machine))) == ["exists"]


@pytest.mark.slow
def test_ports_that_cannot_be_used(machine: Made, plugged: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a port without permission, one in use, and one that is locked are distinguished."""
    port, gripper = plugged(registers=GOOD)
    process = machine.proc / "77"
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("minicom\n")
    (process / "fd" / "3").symlink_to(Path(gripper.port).resolve())
    assert wrong(doctor.run(Doctor(), machine))["busy"]["found"] == "used by minicom (77)"
    (process / "fd" / "3").unlink()
    with Bus(gripper.port, 2_000_000):
        assert "in use" in wrong(doctor.run(Doctor(), machine))["opens"]["found"]
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "dialout" in wrong(doctor.run(Doctor(), machine))["permission"]["fix"]


@pytest.mark.parametrize("name", ["/dev/null", "/dev/zero", ".", "file", "/dev/null@57600"])
def test_what_is_no_serial_port(machine: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Assert that it is called that, and neither asked nor are those who have it open (nobody is to be ended)."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("text")
    monkeypatch.setattr(Made, "programs_using", lambda *_: pytest.fail("asked who uses it"))
    monkeypatch.setattr(Made, "scan", lambda *_: pytest.fail("talked to it"))
    (row,) = wrong(doctor.run(Doctor(gripper=name), machine)).values()
    assert row["found"] == "not a serial port"
    assert "/dev/ttyUSB*" in row["fix"] and "kill" not in row["fix"]


def test_from_the_command_line(monkeypatch: pytest.MonkeyPatch, machine: Made) -> None:
    """Assert exit codes 0 and 3, flat rows as JSON, that `udev` prints rules and nothing else, and flags come last."""
    monkeypatch.setattr(doctor, "Host", lambda: machine)
    fine = CliRunner().invoke(app, ["doctor", "--json"])
    assert fine.exit_code == 0, fine.output
    result = json.loads(fine.stdout)
    assert all(set(row) == {"device", "check", "ok", "found", "expected", "fix"} for row in result["rows"])
    host, _ = with_camera(machine, "usb2")
    monkeypatch.setattr(doctor, "Host", lambda: host)
    ill = CliRunner().invoke(app, ["doctor"])
    assert ill.exit_code == 3
    assert "WRONG" in ill.stdout and "1 wrong" in ill.stdout and "try: use a USB 3 port" in ill.stdout
    rules = CliRunner().invoke(app, ["doctor", "udev"])
    assert rules.exit_code == 0
    answer = json.loads(CliRunner().invoke(app, ["doctor", "udev", "--json"]).stdout)
    assert answer["summary"]["udev"] == rules.stdout.removesuffix("\n")
    assert CliRunner().invoke(app, ["doctor", "--json", "udev"]).exit_code == 2
    lines = [line for line in rules.stdout.splitlines() if not line.startswith("#")]
    assert len(lines) == 2 and '"152a"' in lines[0] and 'latency_timer}="1"' in lines[1]
    assert all(part.count('"') == 2 for line in lines for part in line.split(", "))
    # Who can open the adapter can move the gripper: not everybody, but who sits there, and a group.
    for line in lines:
        assert {'GROUP="dialout"', 'MODE="0660"', 'TAG+="uaccess"'} <= set(line.split(", "))
