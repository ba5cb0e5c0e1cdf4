"""The gripper driver when something breaks: an error in words or a counted loss, and torque off whatever ends it."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from evetac_cli.devices.naming import GRIPPER_FAULTS
from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import Bus, PortGone
from evetac_cli.devices.rh_p12_rn.torque import release
from evetac_cli.devices.virtual.dynamixel_frames import Instruction
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import DeviceError, DeviceTimeout
from evetac_cli.resources import PACKAGE
from tests.conftest import SLOW, is_off, reboot

COUNTED = ("answers_stray", "answers_lost", "answers_damaged")
FACTORY_RESET = 0x06  # the instruction of the protocol
QUICK = RhP12RnSettings(answer_ms=250, watchdog_ms=1000)  # where answers are lost on purpose


# How a driver sees each fault: as an error in these words, or as a loss that it counts. A late answer that comes while
# the driver sets up anew is thrown away with all that is on the line: then the loss alone is counted.
SEEN_AS = {
    "late-answer": "answers_stray|answers_lost",
    "lost-answer": "answers_lost",
    "bad-crc": "answers_damaged",
    "watchdog": "bus watchdog has tripped",
    "overload": "hardware error: overload",
    "restart": "lost torque",
    "false-position": "reports an impossible position",
    "false-current": "reports an impossible current",
    "false-voltage": "reports an impossible supply",
    "false-temperature": "reports an impossible temperature",
    "unplug": "the port is gone|there is no such port",
}


@pytest.mark.parametrize("moment", ["", *(pytest.param(at, marks=pytest.mark.slow) for at in ("@0", "@0.3"))])
@pytest.mark.parametrize(
    "fault",
    [pytest.param(name, marks=() if name in ("bad-crc", "watchdog") else pytest.mark.slow) for name in GRIPPER_FAULTS],
)
def test_m10_a_fault_strikes_when_it_is_asked_for(fault: str, moment: str) -> None:
    """Assert that each fault is seen by the driver, also where it is asked for at once or at second 0."""
    seen = SEEN_AS[fault]
    with VirtualGripper(faults=[fault + moment]) as gripper:
        until_s = time.monotonic() + 30.0
        counts = seen.split("|")
        if set(counts) <= set(COUNTED):
            with RhP12Rn(gripper.port, settings=QUICK) as driver:
                while not any(driver.counted[name] for name in counts) and time.monotonic() < until_s:
                    cycles(driver, 1)
            assert any(driver.counted[name] for name in counts)
            assert gripper.faults_struck() == {fault: 1}
            return
        with pytest.raises(DeviceError, match=seen):
            driver = RhP12Rn(gripper.port, settings=QUICK)
            while time.monotonic() < until_s:
                cycles(driver, 1)
        assert gripper.faults_struck() == {fault: 1}
        if fault != "unplug":  # then the watchdog takes the current, see test_unplugging_is_said_and_stops_the_gripper
            assert gripper.read_register("Torque Enable") == 0


def cycles(driver: RhP12Rn, count: int) -> None:
    for _ in range(count):
        driver.read()
        driver.write_current(5)


@pytest.mark.parametrize(
    ("fault", "counted"),
    [("lost-answer", "answers_lost"), ("bad-crc", "answers_damaged"), ("late-answer", "answers_stray")],
)
def test_one_spoiled_answer_is_counted(fresh: VirtualGripper, fault: str, counted: str) -> None:
    """Assert that the driver goes on after one answer that was lost, damaged or late, and counts it.

    On a computer that stands still for half a second the late answer is in time: then another is made late.
    """
    with RhP12Rn(fresh.port, settings=QUICK) as driver:
        cycles(driver, 3)
        for _ in range(5):
            fresh.inject(fault)
            until_s = time.monotonic() + 2.0
            while driver.counted[counted] == 0 and time.monotonic() < until_s:
                cycles(driver, 3)
            if driver.counted[counted]:
                break
        assert driver.counted[counted] >= 1
    assert is_off(fresh)


@pytest.mark.parametrize("fault", ["lost-answer%20", "bad-crc%20"])
@pytest.mark.slow
def test_many_spoiled_answers(fault: str) -> None:
    """Assert that with a fifth of all answers spoiled, losses are counted until the driver gives up in words."""
    with VirtualGripper(seed=3) as gripper:
        driver = RhP12Rn(gripper.port, settings=RhP12RnSettings(answer_ms=30, watchdog_ms=1000))
        gripper.inject(fault)
        with pytest.raises(DeviceError, match="answer"):
            cycles(driver, 2000)
        assert gripper.read_register("Torque Enable") == 0
        assert driver.counted["answers_lost"] + driver.counted["answers_damaged"] >= 2


@pytest.mark.slow
def test_set_up_is_repeated_after_a_loss() -> None:
    """Assert that the driver sets up anew when an answer was late, so that no answer is taken for another's."""
    with VirtualGripper(faults=["late-answer"]) as gripper:
        with RhP12Rn(gripper.port, settings=QUICK) as driver:
            assert driver.described["eeprom_written"] == {"Operating Mode": [5, 0], "Return Delay Time": [250, 0]}
            assert driver.described["range_ticks"] == [0, 740]
            assert driver.counted["answers_lost"] >= 1
        assert gripper.instructions()[Instruction.PING] >= 3  # the first, once more, and the one of the second set-up


@pytest.mark.slow
def test_set_up_gives_up_on_a_bad_line() -> None:
    """Assert that a line on which nearly every set-up loses an answer is refused in words, with torque off."""
    with VirtualGripper(faults=["lost-answer%20"], seed=1) as gripper:
        with pytest.raises(DeviceError, match="answer"):
            RhP12Rn(gripper.port, settings=RhP12RnSettings(answer_ms=20, watchdog_ms=1000))
        assert gripper.read_register("Torque Enable") == 0


def test_overload_is_named(fresh: VirtualGripper) -> None:
    """Assert that a hardware error ends the driver in words, that opening says so too, and that reboot mends it."""
    driver = RhP12Rn(fresh.port, settings=SLOW)
    cycles(driver, 3)
    fresh.inject("overload")
    with pytest.raises(DeviceError, match=r"hardware error: overload(.|\n)*torque is off"):
        cycles(driver, 300)
    assert is_off(fresh)
    with pytest.raises(DeviceError, match="hardware error: overload"):
        RhP12Rn(fresh.port, settings=SLOW)
    reboot(fresh)
    RhP12Rn(fresh.port, settings=SLOW).close()


@pytest.mark.slow
def test_unplugging_is_said_and_stops_the_gripper() -> None:
    """Assert that a port that goes away is an error in words at once, and that the watchdog takes the current."""
    with VirtualGripper(faults=["unplug@0.2"]) as gripper:
        driver = RhP12Rn(gripper.port, settings=QUICK)
        with pytest.raises(PortGone, match=r"port is gone(.|\n)*watchdog stops the motor 1000 ms after"):
            while True:
                cycles(driver, 1)
        driver.close()
        deadline_s = time.monotonic() + 20
        while gripper.read_register("Bus Watchdog") != -1 and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert gripper.read_register("Bus Watchdog") == -1
        time.sleep(0.05)
        assert gripper.read_register("Present Current") == 0


@pytest.mark.slow
def test_a_dead_gripper_is_a_timeout() -> None:
    """Assert that silence for good is a DeviceTimeout that says that torque may be on."""
    with VirtualGripper() as gripper:
        driver = RhP12Rn(gripper.port, settings=RhP12RnSettings(answer_ms=1000, watchdog_ms=2540))
        cycles(driver, 2)
        gripper.inject("lost-answer%100")
        with pytest.raises(
            DeviceTimeout, match=r"no answer(.|\n)*could not be read back as off: (.|\n)*watchdog stops the motor"
        ):
            cycles(driver, 1)
        driver.close()
        assert gripper.read_register("Torque Enable") == 0  # it heard, but could not say so


# Whatever ends the program


PROGRAM = """
import sys, time
from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings
driver = RhP12Rn(sys.argv[1], settings=RhP12RnSettings(answer_ms=2000, watchdog_ms=2540))
driver.write_current(30)
driver.write_current(30)
print("ready", flush=True)
if sys.argv[2] == "end":
    sys.exit()
if sys.argv[2] == "error":
    raise RuntimeError
while True:
    driver.read()
    driver.write_current(30)
    time.sleep(0.002)
"""


@pytest.mark.parametrize(
    ("ending", "code"),
    [("end", 0), ("error", 1), (signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
)
def test_torque_is_off_when_the_program_has_ended(fresh: VirtualGripper, ending: Any, code: int) -> None:
    """Assert that a program that never closes the gripper leaves no torque, however it ends."""
    assert run_program(fresh, ending) == code
    assert is_off(fresh)
    assert fresh.read_register("Bus Watchdog") == 0


def test_watchdog_stops_the_gripper_of_a_killed_program(fresh: VirtualGripper) -> None:
    """Assert that a program that is killed loses the gripper to the watchdog."""
    assert run_program(fresh, signal.SIGKILL) == -signal.SIGKILL
    deadline_s = time.monotonic() + 20
    while fresh.read_register("Bus Watchdog") != -1 and time.monotonic() < deadline_s:
        time.sleep(0.05)
    time.sleep(0.05)
    assert (fresh.read_register("Bus Watchdog"), fresh.read_register("Present Current")) == (-1, 0)


def test_a_program_that_was_stopped_does_not_grip_again(fresh: VirtualGripper) -> None:
    """Assert that after SIGSTOP the watchdog takes the current, and after SIGCONT the program ends, torque off."""
    command = [sys.executable, "-c", PROGRAM, fresh.port, "go"]
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        program.send_signal(signal.SIGSTOP)
        deadline_s = time.monotonic() + 20
        while fresh.read_register("Bus Watchdog") != -1 and time.monotonic() < deadline_s:
            time.sleep(0.05)
        time.sleep(0.05)
        assert (fresh.read_register("Torque Enable"), fresh.read_register("Present Current")) == (1, 0)
        before = fresh.read_register("Present Position")
        program.send_signal(signal.SIGCONT)
        said = program.communicate(timeout=60)[1].decode()
    assert program.returncode == 1
    assert "bus watchdog has tripped" in said and "torque is off (read back)" in said
    assert is_off(fresh)
    assert fresh.read_register("Present Position") == before


def run_program(gripper: VirtualGripper, ending: Any) -> int:
    """Exit code of PROGRAM, ended by itself (a word) or by a signal once it commands the gripper."""
    command = [sys.executable, "-c", PROGRAM, gripper.port, ending if isinstance(ending, str) else "go"]
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, start_new_session=True
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        if not isinstance(ending, str):
            assert gripper.read_register("Goal Current") == 30
            time.sleep(0.05)
            program.send_signal(ending)
        said = program.communicate(timeout=60)[1].decode()
        if ending != signal.SIGKILL:
            assert f"gripper at {gripper.port}: torque is off (read back)" in said
        return program.returncode


def test_an_error_inside_with_switches_torque_off(fresh: VirtualGripper) -> None:
    """Assert that an exception leaves the block with the gripper off, and that closing twice is as closing once."""
    with pytest.raises(KeyboardInterrupt), RhP12Rn(fresh.port, settings=SLOW) as driver:
        driver.write_current(9)
        raise KeyboardInterrupt
    assert is_off(fresh)
    driver.close()


def test_ctrl_c_in_a_transaction_leaves_the_port_usable(fresh: VirtualGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that after an interrupt while waiting for an answer the next question is answered, and close closes."""
    driver = RhP12Rn(fresh.port, settings=SLOW)
    driver.write_current(9)
    read = driver._bus._port.readPort

    def interrupted(length: int) -> bytes:
        monkeypatch.setattr(driver._bus._port, "readPort", read)
        raise KeyboardInterrupt

    monkeypatch.setattr(driver._bus._port, "readPort", interrupted)
    with pytest.raises(KeyboardInterrupt):
        driver.read()
    driver.read()
    assert driver.counted["answers_lost"] == 0
    driver.close()
    assert is_off(fresh)


def test_close_waits_for_another_threads_command(fresh: VirtualGripper) -> None:
    """Assert that closing while another thread commands leaves torque off, and tells the other that it is closed."""
    driver = RhP12Rn(fresh.port, settings=SLOW)
    errors: list[str] = []

    def command() -> None:
        try:
            while True:
                cycles(driver, 1)
        except DeviceError as error:
            errors.append(str(error))

    other = threading.Thread(target=command)
    other.start()
    time.sleep(0.1)
    driver.close()
    other.join(timeout=30)
    assert is_off(fresh)
    assert len(errors) == 1
    assert "is closed" in errors[0]


def test_nothing_is_reset_to_factory_values(gripper: VirtualGripper) -> None:
    """Assert that in all that was done to this gripper there is no factory reset."""
    assert FACTORY_RESET not in gripper.instructions()


BEFORE_A_COMMAND = """
import sys, time
from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings
settings = RhP12RnSettings(answer_ms=2000, watchdog_ms=2540, max_current_ma=100)
driver = RhP12Rn(sys.argv[1], 2_000_000, sys.argv[2], settings)
print("ready", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("mode", ["current", "position"])
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV])
def test_h1_no_torque_stays_on_where_a_program_dies_before_its_first_command(
    fresh: VirtualGripper, mode: str, ending: signal.Signals
) -> None:
    """Assert that a program that opened the gripper and then died or stood still leaves no torque unwatched."""
    command = [sys.executable, "-c", BEFORE_A_COMMAND, fresh.port, mode]
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        program.send_signal(ending)
        time.sleep(0.1)
        torque, watchdog = (fresh.read_register(name) for name in ("Torque Enable", "Bus Watchdog"))
        program.kill()
    assert torque == 0 or watchdog != 0


@pytest.mark.parametrize("mode", ["current", "position"])
def test_h1_the_watchdog_is_armed_before_torque(
    fresh: VirtualGripper, monkeypatch: pytest.MonkeyPatch, mode: Any
) -> None:
    """Assert that at the moment of torque the watchdog runs, and goals are no current and where the fingers are."""
    at_torque: list[tuple[int, int, int]] = []
    write = Bus.write

    def watched(bus: Bus, name: str, value: int) -> None:
        if (name, value) == ("Torque Enable", 1):
            registers = [fresh.read_register(each) for each in ("Bus Watchdog", "Goal Current", "Goal Position")]
            registers[2] -= fresh.read_register("Present Position")
            at_torque.append((registers[0], registers[1], registers[2] if mode == "position" else 0))
        write(bus, name, value)

    monkeypatch.setattr(Bus, "write", watched)
    with RhP12Rn(fresh.port, mode=mode, settings=SLOW) as driver:
        if mode == "current":
            driver.write_current(5)
        else:
            driver.write_position(driver.read().position_ticks + 2)
        assert fresh.read_register("Torque Enable") == 1
    assert at_torque == [(SLOW.watchdog_ms // 20, 0, 0)]


def test_h1_a_tripped_gripper_does_not_grip_again_while_it_is_opened() -> None:
    """Assert that what a dead program left on, its watchdog tripped, has no current at any moment of a new start."""
    left = {"Torque Enable": 1, "Bus Watchdog": -1, "Operating Mode": 0, "Goal Current": 300}
    with VirtualGripper(registers=left) as gripper:
        seen: list[tuple[int, int]] = []
        write = Bus.write

        class Watched(Bus):
            def write(self, name: str, value: int) -> None:
                write(self, name, value)
                seen.append((gripper.read_register("Torque Enable"), gripper.read_register("Bus Watchdog")))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("evetac_cli.devices.rh_p12_rn.driver.Bus", Watched)
            RhP12Rn(gripper.port, settings=SLOW).close()
        assert seen
        assert (1, 0) not in seen


# Words, and the emergency key


@pytest.fixture
def half_open() -> Iterator[VirtualGripper]:
    """A gripper whose fingers can still open."""
    with VirtualGripper() as gripper:
        yield gripper


def test_words_say_what_was_read_back(fresh: VirtualGripper) -> None:
    """Assert that the driver says before, while and after it drove the gripper what is known of torque."""
    driver = RhP12Rn(fresh.port, settings=SLOW)
    assert driver.release_words == "torque is off: no command has been sent yet"
    driver.write_current(5)
    assert driver.release_words == "torque is on"
    driver.close()
    assert driver.release_words == "torque is off (read back)"


def test_words_where_nothing_can_be_read_back() -> None:
    """Assert that a port that is gone is said so, with what the watchdog does and what is left behind."""
    with VirtualGripper() as gripper:
        driver = RhP12Rn(gripper.port, settings=QUICK)
        driver.write_current(5)
        gripper.inject("unplug")
        with pytest.raises(DeviceError, match=r"watchdog stops the motor 1000 ms after the last instruction"):
            driver.close()
        assert driver.release_words.startswith("torque could not be read back as off: ")
        assert "the port is gone" in driver.release_words
        assert driver.release_words.endswith("Torque Enable stays 1 until the next start")


def test_words_where_torque_was_never_on() -> None:
    """Assert that a gripper that was lost before its first command is not said to be stopped by its watchdog."""
    with VirtualGripper() as gripper:
        driver = RhP12Rn(gripper.port, settings=QUICK)
        gripper.inject("unplug")
        with pytest.raises(DeviceError):
            driver.close()
        assert driver.release_words.endswith("this program never switched it on")


@pytest.mark.parametrize("mode", ["current", "position"])
def test_emergency_opening_is_bounded_and_ends_without_torque(half_open: VirtualGripper, mode: Any) -> None:
    """Assert that it opens with no more than the current asked for, and then is off and closed to other commands."""
    driver = RhP12Rn(half_open.port, mode=mode, settings=SLOW)
    start = driver.read().position_ticks
    command = driver.write_current if mode == "current" else driver.write_position
    command(50 if mode == "current" else start + 5)
    seen_ma = []
    put = RhP12Rn._put

    def watched(self: RhP12Rn, goals: Any) -> None:
        put(self, goals)
        seen_ma.append(abs(half_open.read_register("Goal Current")))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RhP12Rn, "_put", watched)
        driver.emergency_open(80, 1.0)
    assert set(seen_ma) == {80}
    assert driver.release_words == "torque is off (read back)"
    assert is_off(half_open)
    assert half_open.read_register("Present Position") < start
    with pytest.raises(DeviceError, match="is closed"):
        command(10)


def test_emergency_opening_of_a_gripper_that_was_never_commanded(half_open: VirtualGripper) -> None:
    """Assert that it opens then too, and refuses what is no bound."""
    driver = RhP12Rn(half_open.port, settings=SLOW)
    for current_ma, seconds in ((0, 0.5), (100, 0.0), (100, 11.0), (100, float("nan"))):
        with pytest.raises(ValueError, match="expected 1 mA or more"):
            driver.emergency_open(current_ma, seconds)
    start = driver.read().position_ticks
    driver.emergency_open(seconds=1.0)
    assert half_open.read_register("Present Position") < start
    assert is_off(half_open)


def test_emergency_opening_on_a_broken_line_says_so() -> None:
    """Assert that a port that goes away meanwhile is an error with what is known of torque."""
    with VirtualGripper() as gripper:
        driver = RhP12Rn(gripper.port, settings=QUICK)
        driver.write_current(5)
        gripper.inject("unplug")
        with pytest.raises(DeviceError, match=r"gone(.|\n)*then: +torque could not be read back"):
            driver.emergency_open()
        driver.close()


def test_torque_of_a_dead_program_is_switched_off_and_read_back(fresh: VirtualGripper) -> None:
    """Assert that another process ends what a killed one left, in words; and says so where the port is still held."""
    assert run_program(fresh, signal.SIGKILL) == -signal.SIGKILL
    assert fresh.read_register("Torque Enable") == 1
    assert release(fresh.port, 2_000_000, answer_ms=2000) == "torque is off (read back)"
    assert is_off(fresh)
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        driver.write_current(3)
        words = release(fresh.port, 2_000_000, watchdog_ms=60)
        assert "could not be read back as off" in words and "in use" in words
        assert "stops the motor 60 ms after the last instruction" in words


def test_a_second_ctrl_c_inside_close_leaves_no_torque(fresh: VirtualGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that Ctrl-C while torque is being switched off interrupts only once it is off."""
    driver = RhP12Rn(fresh.port, settings=SLOW)
    driver.write_current(9)
    write, pressed = Bus.write, []

    def interrupted(bus: Bus, name: str, value: int) -> None:
        if name == "Torque Enable" and not pressed:
            pressed.append(name)
            raise KeyboardInterrupt
        write(bus, name, value)

    monkeypatch.setattr(Bus, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        driver.close()
    assert driver.release_words == "torque is off (read back)"
    assert is_off(fresh)
