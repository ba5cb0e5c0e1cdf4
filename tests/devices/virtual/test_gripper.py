"""The virtual gripper's process under the maker's own library, and its end."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import dynamixel_sdk as sdk
import pytest

from evetac_cli.devices.virtual.dynamixel_frames import StatusError
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.resources import PACKAGE

ANSWER_MS = 2000.0  # a busy machine may stop either process for long


class Port(sdk.PortHandler):
    """The SDK's port, but patient, and it does not burn the core that the servo needs."""

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(ANSWER_MS)

    def readPort(self, length: int) -> Any:
        time.sleep(50e-6)
        return super().readPort(length)


@pytest.fixture
def port(gripper: VirtualGripper) -> Iterator[Port]:
    """The port at the servo's rate, the servo as after reboot."""
    opened = Port(gripper.port)
    assert opened.setBaudRate(2_000_000)
    packets = sdk.PacketHandler(2.0)
    assert packets.reboot(opened, 1) == (sdk.COMM_SUCCESS, 0)
    yield opened
    opened.closePort()


def test_sdk_pings(gripper: VirtualGripper, port: Port) -> None:
    """Assert that the library finds the servo by its id and by a broadcast."""
    packets = sdk.PacketHandler(2.0)
    assert packets.ping(port, 1) == (35074, sdk.COMM_SUCCESS, 0)
    answers, result = packets.broadcastPing(port)
    assert (answers, result) == ({1: [35074, 14]}, sdk.COMM_SUCCESS)


def test_sdk_reads_and_writes(gripper: VirtualGripper, port: Port) -> None:
    """Assert that registers of each size come back as written, through writes and a sync write."""
    packets = sdk.PacketHandler(2.0)
    ok = sdk.COMM_SUCCESS
    assert packets.write1ByteTxRx(port, 1, 513, 7) == (ok, 0)
    assert packets.write2ByteTxRx(port, 1, 550, -100 & 0xFFFF) == (ok, 0)
    assert packets.write4ByteTxRx(port, 1, 564, 123) == (ok, 0)
    assert packets.read1ByteTxRx(port, 1, 513) == (7, ok, 0)
    assert packets.read2ByteTxRx(port, 1, 550) == (-100 & 0xFFFF, ok, 0)
    assert packets.read4ByteTxRx(port, 1, 564) == (123, ok, 0)
    assert packets.readTxRx(port, 1, 574, 10) == ([0, 0, 0, 0, 0, 0, 400 & 0xFF, 400 >> 8, 0, 0], ok, 0)
    writes = sdk.GroupSyncWrite(port, packets, 550, 2)
    assert writes.addParam(1, [44, 0])
    assert writes.txPacket() == ok
    assert gripper.read_register("Goal Current") == 44


def test_sdk_is_told_errors(gripper: VirtualGripper, port: Port) -> None:
    """Assert that the library reports the servo's refusals: access, limit, an instruction that it does not know."""
    packets = sdk.PacketHandler(2.0)
    ok = sdk.COMM_SUCCESS
    assert packets.write1ByteTxRx(port, 1, 512, 1) == (ok, 0)
    assert packets.write1ByteTxRx(port, 1, 9, 0) == (ok, StatusError.ACCESS)
    assert packets.write2ByteTxRx(port, 1, 550, 700) == (ok, StatusError.DATA_LIMIT)
    assert packets.factoryReset(port, 1, 2) == (ok, StatusError.INSTRUCTION)
    assert gripper.read_register("Torque Enable") == 1


def test_another_rate_is_noise(gripper: VirtualGripper, port: Port) -> None:
    """Assert that the servo hears only its own rate, also after that was changed over the wire, and back."""
    packets = sdk.PacketHandler(2.0)
    assert packets.write1ByteTxRx(port, 1, 8, 3) == (sdk.COMM_SUCCESS, 0)
    before = gripper.instructions()
    assert packets.writeTxOnly(port, 1, 513, 1, [1]) == sdk.COMM_SUCCESS
    time.sleep(0.1)
    assert gripper.instructions() == before
    assert port.setBaudRate(1_000_000)
    assert packets.ping(port, 1) == (35074, sdk.COMM_SUCCESS, 0)
    assert packets.write1ByteTxRx(port, 1, 8, 4) == (sdk.COMM_SUCCESS, 0)


def test_a_stopped_servo_does_not_blame_the_host(gripper: VirtualGripper, port: Port) -> None:
    """Assert that the watchdog does not trip for the time in which the servo's own process stood still."""
    packets = sdk.PacketHandler(2.0)
    assert packets.write1ByteTxRx(port, 1, 546, 50) == (sdk.COMM_SUCCESS, 0)
    gripper._process.send_signal(signal.SIGSTOP)
    time.sleep(1.2)
    gripper._process.send_signal(signal.SIGCONT)
    assert gripper.read_register("Bus Watchdog") == 50


def test_process_ends_with_its_parent() -> None:
    """Assert that the servo's process is gone after the program that started it was killed."""
    program = (
        "import time; from evetac_cli.devices.virtual.gripper import VirtualGripper;"
        "gripper = VirtualGripper(); print(gripper._process.pid, flush=True); time.sleep(60)"
    )
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=environment) as parent:
        assert parent.stdout is not None
        servo = int(parent.stdout.readline())
        assert running(servo)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    for _ in range(200):
        if not running(servo):
            break
        time.sleep(0.05)
    assert not running(servo)


def running(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_close_ends_the_process(gripper: VirtualGripper) -> None:
    """Assert that closing twice is as closing once, and that the port is gone with it."""
    other = VirtualGripper(registers={"Model Number": 35073})
    assert other.read_register("Model Number") == 35073
    other.close()
    assert other._process.returncode == 0
    other.close()
    assert not os.path.exists(other.port) or other.port == gripper.port
