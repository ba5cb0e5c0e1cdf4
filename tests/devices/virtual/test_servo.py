"""The virtual servo, step by step: what it answers, what it refuses, when its watchdog trips."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.devices.rh_p12_rn import control_table as table
from evetac_cli.devices.virtual.dynamixel_frames import (
    BROADCAST_ID,
    DynamixelFrame,
    FrameReader,
    Instruction,
    StatusError,
    frame,
    status,
)
from evetac_cli.devices.virtual.servo import VirtualServo
from evetac_cli.devices.virtual.servo_plant import Goals, ServoMotion

REGISTERS = table.REGISTERS


class Still:
    """A plant that stands where it is put and remembers its goals."""

    def __init__(self) -> None:
        self.motion = ServoMotion(0.0, 300, 0.0)
        self.goals = Goals()

    def advance(self, goals: Goals, now_s: float) -> ServoMotion:
        self.goals = goals
        return self.motion


class Asked:
    """A servo and its clock; instructions by name, answers as (error byte, data)."""

    def __init__(self, **registers: int) -> None:
        self.plant = Still()
        named = {name.replace("_", " "): value for name, value in registers.items()}
        self.servo = VirtualServo(self.plant, {"Baud Rate": 4, **named}, 0.0)
        self.now_s = 0.0

    def raw(self, instruction: int, parameters: bytes = b"", id_: int = 1) -> list[bytes]:
        (one,) = FrameReader().push(frame(id_, instruction, parameters))
        return [answer.data for answer in self.servo.handle(one, self.now_s)]

    def ask(self, instruction: int, parameters: bytes = b"", id_: int = 1) -> tuple[int, bytes] | None:
        answers = self.raw(instruction, parameters, id_)
        if not answers:
            return None
        (answer,) = FrameReader().push(answers[0])
        assert answer.sound
        assert answer.instruction == Instruction.STATUS
        return answer.parameters[0], answer.parameters[1:]

    def read(self, name: str) -> int:
        register = REGISTERS[name]
        answer = self.ask(Instruction.READ, struct.pack("<HH", register.address, register.size))
        assert answer is not None
        assert answer[0] & 0x7F == StatusError.NONE
        return register.decode(answer[1])

    def write(self, name: str, value: int) -> int | None:
        register = REGISTERS[name]
        answer = self.ask(Instruction.WRITE, struct.pack("<H", register.address) + register.encode(value))
        return None if answer is None else answer[0]


def test_ping_alone_and_among_all() -> None:
    """Assert model and firmware in the answer to a ping, to a broadcast too, and silence to another's."""
    asked = Asked()
    assert asked.ask(Instruction.PING) == (0, struct.pack("<HB", 35074, 14))
    assert asked.raw(Instruction.PING, id_=BROADCAST_ID) == [status(1, 0, struct.pack("<HB", 35074, 14))]
    assert asked.raw(Instruction.PING, id_=2) == []
    assert Asked(Model_Number=35073, ID=7).ask(Instruction.PING, id_=7) == (0, struct.pack("<HB", 35073, 14))


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("Position P Gain", 50, StatusError.NONE),
        ("Operating Mode", 0, StatusError.NONE),
        ("Operating Mode", 3, StatusError.DATA_RANGE),
        ("Position P Gain", 40000, StatusError.DATA_RANGE),
        ("Goal Current", -661, StatusError.NONE),
        ("Goal Current", 662, StatusError.DATA_LIMIT),
        ("Goal Current", -30000, StatusError.DATA_RANGE),
        ("Goal Position", 1100, StatusError.DATA_LIMIT),
        ("Goal Position", 20, StatusError.DATA_LIMIT),
        ("Goal Position", -5, StatusError.DATA_RANGE),
        ("Goal Velocity", 2900, StatusError.DATA_LIMIT),
        ("Present Current", 1, StatusError.ACCESS),
        ("Model Number", 1, StatusError.ACCESS),
    ],
)
def test_writes_are_judged(name: str, value: int, fault: StatusError) -> None:
    """Assert that a write is carried out, or refused with its reason and without effect."""
    asked = Asked(Max_Position_Limit=1000, Min_Position_Limit=30, Velocity_Limit=2800)
    before = asked.read(name)
    assert asked.write(name, value) == fault
    assert asked.read(name) == (before if fault else value)


def test_wrong_places_and_lengths_are_refused() -> None:
    """Assert the errors for a place between registers, half a register, a write of nothing, and the table's end."""
    asked = Asked()
    assert asked.ask(Instruction.READ, struct.pack("<HH", 519, 2)) == (StatusError.ACCESS, b"")
    assert asked.ask(Instruction.READ, struct.pack("<HH", 606, 3)) == (StatusError.ACCESS, b"")
    assert asked.ask(Instruction.READ, b"\x44\x02\x04") == (StatusError.DATA_LENGTH, b"")
    assert asked.ask(Instruction.WRITE, struct.pack("<HB", 564, 1)) == (StatusError.DATA_LENGTH, b"")
    assert asked.ask(Instruction.WRITE, struct.pack("<HB", 565, 1)) == (StatusError.ACCESS, b"")
    assert asked.ask(Instruction.WRITE, struct.pack("<H", 564)) == (StatusError.DATA_LENGTH, b"")
    assert asked.ask(Instruction.WRITE, struct.pack("<HHB", 606, 1, 1)) == (StatusError.ACCESS, b"")
    assert asked.ask(Instruction.WRITE, b"\1") == (StatusError.DATA_LENGTH, b"")
    assert asked.ask(0x77) == (StatusError.INSTRUCTION, b"")
    assert asked.ask(0x06, b"\xff") == (StatusError.INSTRUCTION, b"")  # a factory reset
    assert asked.ask(Instruction.SYNC_WRITE, b"\0") is None


def test_consecutive_registers_are_written_together_or_not_at_all() -> None:
    """Assert that one write may cover several registers, and does nothing if one of its values is refused."""
    asked = Asked()
    assert asked.ask(Instruction.WRITE, struct.pack("<Hhi", 550, 100, 500)) == (0, b"")
    assert (asked.read("Goal Current"), asked.read("Goal Velocity")) == (100, 500)
    assert asked.ask(Instruction.WRITE, struct.pack("<Hhi", 550, 200, 9999)) == (StatusError.DATA_RANGE, b"")
    assert (asked.read("Goal Current"), asked.read("Goal Velocity")) == (100, 500)


def test_eeprom_is_locked_while_torque_is_on() -> None:
    """Assert that an EEPROM register cannot be written with torque on, that RAM can, and that it can be afterwards."""
    asked = Asked()
    assert asked.write("Torque Enable", 1) == 0
    assert asked.write("Return Delay Time", 0) == StatusError.ACCESS
    assert asked.write("Position P Gain", 60) == 0
    assert asked.write("Torque Enable", 0) == 0
    assert asked.write("Return Delay Time", 0) == 0


def test_watchdog_trips_and_refuses_goals() -> None:
    """Assert that silence trips the watchdog, that this takes the current away, and that only 0 allows goals again."""
    asked = Asked(Operating_Mode=0)
    asked.write("Torque Enable", 1)
    asked.write("Bus Watchdog", 5)
    asked.write("Goal Current", 40)
    asked.now_s = 0.1
    asked.servo.tick(asked.now_s)
    assert asked.plant.goals.command() == ("current", 40.0)
    asked.now_s = 0.101
    asked.servo.tick(asked.now_s)
    assert asked.plant.goals.command() == ("current", 0.0)
    assert asked.read("Bus Watchdog") == -1
    assert asked.write("Goal Current", 10) == StatusError.DATA_RANGE
    assert asked.write("Goal Position", 300) == StatusError.DATA_RANGE
    assert asked.write("Bus Watchdog", 5) == StatusError.DATA_RANGE  # not armed again before it is cleared
    assert asked.read("Goal Current") == 40
    assert asked.read("Torque Enable") == 1  # stays, until somebody writes 0
    assert asked.write("Torque Enable", 0) == 0
    assert asked.write("Bus Watchdog", 0) == 0
    assert asked.write("Goal Current", 10) == 0
    asked.now_s = 9.0
    asked.servo.tick(asked.now_s)
    assert asked.read("Bus Watchdog") == 0


def test_anything_heard_feeds_the_watchdog() -> None:
    """Assert that a read every 90 ms keeps a watchdog of 100 ms quiet, but not one meant for another servo."""
    asked = Asked()
    asked.write("Bus Watchdog", 5)
    asked.write("Torque Enable", 1)
    for _ in range(5):
        asked.now_s += 0.09
        assert asked.read("Bus Watchdog") == 5
    asked.now_s += 0.09
    asked.raw(Instruction.PING, id_=3)
    asked.now_s += 0.02
    assert asked.read("Bus Watchdog") == -1


def test_the_watchdog_counts_while_torque_is_on() -> None:
    """Assert that silence without torque trips nothing, and that torque does not inherit it."""
    asked = Asked(Operating_Mode=0)
    asked.write("Bus Watchdog", 5)
    asked.now_s = 3.0
    asked.servo.tick(asked.now_s)
    assert asked.read("Bus Watchdog") == 5
    asked.now_s = 6.0
    asked.write("Torque Enable", 1)
    asked.now_s = 6.09
    asked.servo.tick(asked.now_s)
    assert asked.read("Bus Watchdog") == 5
    asked.now_s = 6.2
    asked.servo.tick(asked.now_s)
    assert asked.read("Bus Watchdog") == -1


@pytest.mark.parametrize(("level", "answered"), [(0, (True, False, False)), (1, (True, True, False)), (2, (True,) * 3)])
def test_status_return_level(level: int, answered: tuple[bool, ...]) -> None:
    """Assert that a ping is always answered, a read from level 1 and a write at level 2 only, though it is done."""
    asked = Asked(Status_Return_Level=level)
    done = (
        asked.ask(Instruction.PING),
        asked.ask(Instruction.READ, struct.pack("<HH", 580, 4)),
        asked.ask(Instruction.WRITE, struct.pack("<Hh", 550, 33)),
    )
    assert tuple(one is not None for one in done) == answered
    assert asked.servo.value("Goal Current") == 33


def test_answers_take_the_time_of_the_wire() -> None:
    """Assert that an answer ends after request, return delay (2 us a unit) and answer: bytes * 10 / baud."""
    asked = Asked(Return_Delay_Time=250)
    ping = FrameReader().push(frame(1, Instruction.PING))[0]
    (answer,) = asked.servo.handle(ping, 0.0)
    assert answer.after_s == pytest.approx((10 + 14) * 10 / 2e6 + 500e-6)
    asked.write("Return Delay Time", 0)
    (answer,) = asked.servo.handle(ping, 0.0)
    assert answer.after_s == pytest.approx((10 + 14) * 10 / 2e6)


def test_a_wrong_checksum_is_answered_with_its_error() -> None:
    """Assert that a damaged frame changes nothing, is answered with error 3, and not at all if it was for everybody."""
    asked = Asked()
    for id_, expected in ((1, [status(1, StatusError.CRC)]), (BROADCAST_ID, []), (4, [])):
        damaged = DynamixelFrame(id_, Instruction.WRITE, struct.pack("<Hh", 550, 9), False, 14)
        assert [answer.data for answer in asked.servo.handle(damaged, 0.0)] == expected
    assert asked.read("Goal Current") == 0


def test_overload_drops_torque_until_reboot() -> None:
    """Assert alert in every answer, torque off and refused, and that a reboot clears it and keeps the EEPROM."""
    asked = Asked(Operating_Mode=0)
    asked.write("Torque Enable", 1)
    asked.write("Goal Current", 30)
    asked.servo.overload()
    assert asked.ask(Instruction.PING) == (0x80, struct.pack("<HB", 35074, 14))
    assert asked.read("Torque Enable") == 0
    assert asked.read("Hardware Error Status") == 0b100000
    assert asked.write("Torque Enable", 1) == 0x80 | StatusError.RESULT
    assert asked.ask(Instruction.REBOOT) == (0, b"")
    assert (asked.read("Hardware Error Status"), asked.read("Goal Current")) == (0, 0)
    assert asked.read("Operating Mode") == 0
    assert asked.read("Goal Position") == 300
    assert asked.write("Torque Enable", 1) == 0


def test_a_restart_is_as_after_switching_it_on() -> None:
    """Assert that it has no torque, no watchdog, no error and a clock at 0, and takes goals, as if nothing had been."""
    asked = Asked(Operating_Mode=0)
    for name, value in (("Bus Watchdog", 5), ("Torque Enable", 1), ("Goal Current", 30)):
        asked.write(name, value)
    asked.servo.tick(0.05)
    assert asked.servo.value("Realtime Tick") == 50
    asked.servo.restart(0.06)
    names = ("Torque Enable", "Bus Watchdog", "Goal Current", "Hardware Error Status", "Realtime Tick")
    asked.servo.tick(0.06)
    assert [asked.servo.value(name) for name in names] == [0] * 5
    assert asked.write("Goal Current", 20) == 0
    assert not asked.servo.torque


@given(st.integers(0, 254), st.integers(0, 255), st.binary(max_size=30))
def test_no_frame_breaks_the_servo(id_: int, instruction: int, parameters: bytes) -> None:
    """Assert that whatever is asked, the servo answers at most once, soundly, and goes on."""
    asked = Asked()
    answers = asked.raw(instruction, parameters, id_)
    assert len(answers) <= 1
    for answer in answers:
        assert FrameReader().push(answer)[0].sound
    if asked.servo.value("ID") == 1 and asked.servo.value("Status Return Level") == 2:
        assert asked.ask(Instruction.PING) is not None
