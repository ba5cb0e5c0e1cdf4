"""Opening a port, finding what is on it, changing its rate: the virtual gripper through the maker's library."""

import os
import pty
import select
import threading
import time
import tty
from pathlib import Path

import pytest

from evetac_cli.devices.rh_p12_rn import dynamixel_bus
from evetac_cli.devices.rh_p12_rn.control_table import REGISTERS
from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings, change_baud
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus, BusDevice, latency_timer_ms, scan
from evetac_cli.devices.virtual.dynamixel_frames import FrameReader, Instruction, status
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import DeviceError, DeviceTimeout
from tests.conftest import SLOW
from tests.patience import PATIENCE_S


def test_what_cannot_be_opened_is_said(gripper: VirtualGripper, tmp_path: Path) -> None:
    """Assert an error in words for no port, one in use, no such rate, another rate or id, and a plain file."""
    with pytest.raises(DeviceError, match="no such port"):
        RhP12Rn(str(tmp_path / "ttyUSB9"))
    with pytest.raises(DeviceError, match="57600, 115200"):
        RhP12Rn(gripper.port, baud=12345)
    with RhP12Rn(gripper.port, settings=SLOW), pytest.raises(DeviceError, match="in use"):
        RhP12Rn(gripper.port)
    with pytest.raises(DeviceTimeout, match="which id and rate answer"):
        RhP12Rn(gripper.port, baud=57_600)
    with pytest.raises(DeviceTimeout, match="gripper 7"):
        RhP12Rn(gripper.port, settings=RhP12RnSettings(id=7))
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="cannot be opened"):
        RhP12Rn(str(tmp_path / "file"))
    with pytest.raises(ValueError, match="mode must be"):
        RhP12Rn(gripper.port, mode="velocity")  # type: ignore[arg-type]


def test_a_question_damaged_on_its_way_is_asked_again(gripper: VirtualGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a write that reached the gripper with a wrong checksum is sent once more, and counted."""
    with Bus(gripper.port, 2_000_000, answer_ms=2000) as bus:
        write = bus._port.writePort

        def damaged(packet: list[int]) -> int:
            monkeypatch.setattr(bus._port, "writePort", write)
            return int(write([*packet[:-1], packet[-1] ^ 1]))

        monkeypatch.setattr(bus._port, "writePort", damaged)
        bus.write("LED Red", 77)
        assert gripper.read_register("LED Red") == 77
        assert bus.counted == {"answers_lost": 0, "answers_damaged": 1, "answers_stray": 0}


def test_a_program_that_stood_still_while_writing_has_its_port(
    gripper: VirtualGripper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a write that took effect counts, however late the program goes on (stopped, or without a core)."""
    write = os.write

    def stands_still(file: int, data: bytes) -> int:
        monkeypatch.setattr(os, "write", write)
        written = write(file, data)
        time.sleep(0.2)
        return written

    monkeypatch.setattr(dynamixel_bus, "WRITE_S", 0.1)
    with Bus(gripper.port, 2_000_000, answer_ms=2000) as bus:
        monkeypatch.setattr(os, "write", stands_still)
        bus.write("LED Red", 77)
        assert gripper.read_register("LED Red") == 77


def test_a_late_answer_does_not_shift_those_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that after a lost answer that comes late, questions that follow closely get their own answers again.

    The servo here is slow: the answer to a question leaves when the next one comes, or after 5 ms, and the bus expects
    it within 20 ms. A real servo and bus are twenty times faster, too fast for a busy machine.
    """
    monkeypatch.setattr(dynamixel_bus, "FOLLOWS_S", 0.02)
    monkeypatch.setattr(dynamixel_bus, "WARY_S", 20.0)
    ours, theirs = pty.openpty()
    for end in (ours, theirs):
        tty.setraw(end)
    done, asked = threading.Event(), 0

    def slow_servo() -> None:
        nonlocal asked
        reader, held = FrameReader(), b""
        while not done.is_set():
            ready = select.select([ours], [], [], 0.005 if asked > 2 else 0.05)[0]
            if held and (asked > 2 or (asked == 2 and ready)):
                os.write(ours, held)
                held = b""
            for one in reader.push(os.read(ours, 100)) if ready else []:
                held = status(1, 0, one.parameters[:1])  # says which register was asked for
                asked += 1

    servo = threading.Thread(target=slow_servo)
    servo.start()
    try:
        with Bus(os.ttyname(theirs), 2_000_000, answer_ms=100) as bus:
            with pytest.raises(DeviceTimeout):
                bus.read("LED Red")  # asked twice, and the answer to the second comes with the next question
            deadline = time.monotonic() + PATIENCE_S
            # on a busy machine the servo may not have read the second question yet
            while asked < 2 and time.monotonic() < deadline:
                time.sleep(0.001)
            in_a_row = 0
            for name in ["LED Red", "LED Blue"] * 40:  # a busy machine delays some answers again
                in_a_row = in_a_row + 1 if bus.read(name) == REGISTERS[name].address & 0xFF else 0
                if in_a_row == 10:
                    break
            assert in_a_row == 10  # not the count of strays: the kernel may discard a late answer before it is seen
    finally:
        done.set()
        servo.join()
        os.close(ours)
        os.close(theirs)


def test_baud_rate_is_changed_and_found() -> None:
    """Assert that the rate changes at both ends, that the same rate again writes nothing, and that a scan finds it."""
    with VirtualGripper(baud=57_600, registers={"Torque Enable": 1}) as gripper:
        change_baud(gripper.port, 57_600, 1_000_000, answer_ms=1000)
        assert gripper.read_register("Baud Rate") == 3
        writes = gripper.instructions()[Instruction.WRITE]
        change_baud(gripper.port, 1_000_000, 1_000_000, answer_ms=1000)
        assert gripper.instructions()[Instruction.WRITE] == writes + 1  # torque off
        assert scan(gripper.port, (57_600,), answer_ms=20) == []
        assert scan(gripper.port, (1_000_000,), (7, 1), answer_ms=1000) == [BusDevice(1_000_000, 1, 35074)]
        with Bus(gripper.port, 1_000_000) as bus:
            assert bus.devices(least_ms=3000) == {1: (35074, 14)}
        with pytest.raises(ValueError, match="baud"):
            change_baud(gripper.port, 1_000_000, 123)


def test_latency_timer_is_read_where_there_is_one(tmp_path: Path) -> None:
    """Assert the timer of an adapter, also through a link to its port, and None where there is none."""
    (tmp_path / "ttyUSB0").mkdir()
    (tmp_path / "ttyUSB0" / "latency_timer").write_text("16\n")
    assert latency_timer_ms("/dev/ttyUSB0", tmp_path) == 16
    (tmp_path / "by-id").symlink_to("/dev/ttyUSB0")
    assert latency_timer_ms(str(tmp_path / "by-id"), tmp_path) == 16
    assert latency_timer_ms("/dev/pts/3", tmp_path) is None
