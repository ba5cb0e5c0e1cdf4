"""The gripper driver against the virtual gripper: set-up, limits, commands, watchdog."""

import time
from types import SimpleNamespace
from typing import Any

import pytest

from evetac_cli.devices.rh_p12_rn import driver as driver_module
from evetac_cli.devices.rh_p12_rn.driver import RhP12Rn, RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import _Port
from evetac_cli.devices.virtual.dynamixel_frames import Instruction
from evetac_cli.devices.virtual.gripper import VirtualGripper
from evetac_cli.errors import DeviceError
from tests.conftest import SLOW, is_off
from tests.devices.stepped import StepClock
from tests.devices.twisted import twisted_servo

# Setting up


def test_current_mode_is_set_up(fresh: VirtualGripper) -> None:
    """Assert the mode, torque from the first command only, all off afterwards, and the EEPROM written at need only."""
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        assert fresh.read_register("Operating Mode") == 0
        assert is_off(fresh)
        driver.write_current(0)
        assert (fresh.read_register("Torque Enable"), fresh.read_register("Goal Current")) == (1, 0)
        assert fresh.read_register("Return Delay Time") == 0
        assert driver.described["current_limit_ma"] == 661
        assert driver.described["firmware"] == 14
        assert set(driver.counted.values()) == {0}
    assert is_off(fresh)
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        assert driver.described["eeprom_written"] == {}


def test_position_mode_is_set_up(fresh: VirtualGripper) -> None:
    """Assert mode 5, the P gain, no torque at first, and the limit as goal current from the first command on."""
    settings = RhP12RnSettings(answer_ms=2000, watchdog_ms=2540, max_current_ma=200)
    with RhP12Rn(fresh.port, mode="position", settings=settings) as driver:
        assert driver.described["eeprom_written"] == {"Operating Mode": [0, 5]}
        assert fresh.read_register("Operating Mode") == 5
        assert is_off(fresh)
        here = driver.read().position_ticks
        driver.write_position(here)
        assert (fresh.read_register("Torque Enable"), fresh.read_register("Position P Gain")) == (1, 50)
        assert driver.described["p_gain"] == 50
        assert fresh.read_register("Goal Current") == 200
        assert fresh.read_register("Goal Position") == here
        with pytest.raises(DeviceError, match="opened in position mode"):
            driver.write_current(5)
    assert is_off(fresh)


def test_what_another_program_left_behind_is_cleared() -> None:
    """Assert that torque on, a tripped watchdog and a servo that does not answer writes are no obstacles."""
    left = {"Torque Enable": 1, "Bus Watchdog": -1, "Status Return Level": 1, "Operating Mode": 5}
    with VirtualGripper(registers=left) as gripper:
        with RhP12Rn(gripper.port, settings=SLOW) as driver:
            driver.write_current(20)
            assert gripper.read_register("Goal Current") == 20
            assert driver.described["eeprom_written"] == {"Operating Mode": [5, 0], "Return Delay Time": [250, 0]}
        assert is_off(gripper)


def test_return_delay_may_be_left_alone() -> None:
    """Assert that the EEPROM's return delay stays if so asked, and a device's own limits are heeded."""
    own = {"Current Limit": 300, "Min Position Limit": 100, "Max Position Limit": 600, "Operating Mode": 0}
    with VirtualGripper(registers=own) as gripper:
        settings = RhP12RnSettings(answer_ms=2000, watchdog_ms=2540, return_delay_us=None)
        with RhP12Rn(gripper.port, settings=settings) as driver:
            assert driver.described["eeprom_written"] == {}
            assert driver.described["return_delay_us"] == 500
            driver.write_current(500)
            driver.write_current(-500)
            assert driver.counted["commands_clamped"] == 2
            assert gripper.read_register("Goal Current") == -300
        with RhP12Rn(gripper.port, mode="position", settings=settings) as driver:
            assert driver.described["range_ticks"] == [100, 600]
            driver.write_position(0)
            assert gripper.read_register("Goal Position") == 100
            driver.write_position(650)
            assert driver.counted["commands_clamped"] == 2
        narrow = RhP12RnSettings(answer_ms=2000, first_tick=620)
        with pytest.raises(DeviceError, match="100 to 600"):
            RhP12Rn(gripper.port, settings=narrow)
        assert is_off(gripper)


@pytest.mark.parametrize(
    ("registers", "words"), [({"Model Number": 35073}, "older RH-P12-RN"), ({"Model Number": 1020}, "another device")]
)
def test_other_models_are_refused(registers: dict[str, int], words: str) -> None:
    """Assert that another model is refused in words, and that nothing was written to it."""
    with VirtualGripper(registers=registers) as gripper:
        with pytest.raises(DeviceError, match=words):
            RhP12Rn(gripper.port, settings=RhP12RnSettings(answer_ms=2000))
        assert gripper.read_register("Operating Mode") == 5
        assert gripper.read_register("Return Delay Time") == 250


@pytest.mark.parametrize(
    "wrong",
    [
        {"id": 253},
        {"p_gain": -1},
        {"max_current_ma": 0},
        {"first_tick": 740},
        {"watchdog_ms": 30},
        {"watchdog_ms": 0},
        {"return_delay_us": 1},
        {"answer_ms": 0.0},
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, Any]) -> None:
    """Assert that a setting out of its range is a ValueError that names it."""
    with pytest.raises(ValueError, match="last_tick" if "first_tick" in wrong else next(iter(wrong))):
        RhP12RnSettings(**wrong)


# Commands


@pytest.mark.parametrize("commands", [1, 2])
def test_one_answered_transaction_a_cycle(fresh: VirtualGripper, commands: int) -> None:
    """Assert that of 201 cycles each reads once, and that all commands but the 1st, 101st and 201st go unanswered.

    Of a hundred cycles one asks too for torque, and one for supply and temperature. A second command asks nothing.
    """
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        before = fresh.instructions()
        for k in range(201):
            driver.read()
            for _ in range(commands):
                driver.write_current(k % 7)
        after = fresh.instructions()
        spent = {code: after[code] - before.get(code, 0) for code in after}
        assert spent[Instruction.READ] == 201 + 2 * 2 + 1  # and the watchdog, whether it is armed
        assert spent[Instruction.SYNC_WRITE] == 198 + 201 * (commands - 1)
        assert spent[Instruction.WRITE] == 3 + 3  # and goal current, watchdog and torque before the first
        assert fresh.read_register("Goal Current") == 200 % 7


def test_who_never_reads_is_checked_too(fresh: VirtualGripper) -> None:
    """Assert that of 302 commands without a reading four are answered: the 1st, 102nd, 202nd and 302nd."""
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        before = fresh.instructions()
        for _ in range(302):
            driver.write_current(3)
        after = fresh.instructions()
        assert after[Instruction.SYNC_WRITE] - before.get(Instruction.SYNC_WRITE, 0) == 298


def test_bytes_on_the_wire(fresh: VirtualGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert what a cycle costs on average: 52 bytes for reading and commanding, and 1.2 for all that is checked."""
    sizes: list[int] = []
    write, read = _Port.writePort, _Port.readPort

    def counted_write(port: _Port, packet: list[int]) -> int:
        sizes.append(len(packet))
        return write(port, packet)

    def counted_read(port: _Port, length: int) -> bytes:
        data = read(port, length)
        sizes.append(len(data))
        return data

    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        driver.write_current(1)
        monkeypatch.setattr(_Port, "writePort", counted_write)
        monkeypatch.setattr(_Port, "readPort", counted_read)
        cycles = 1000
        for _ in range(cycles):
            driver.read()
            driver.write_current(1)
        reading, command = 14 + 21, 17
        checks = 0.1 * 6 + (14 + 12 + 14 + 14) / 100 + (14 + 11 - command) / 100
        assert sum(sizes) / cycles == pytest.approx(reading + command + checks)
        assert checks < 1.5


def test_readings_are_signed(fresh: VirtualGripper) -> None:
    """Assert that opening shows as a negative current and a falling position, as whole ticks."""
    with RhP12Rn(fresh.port, settings=SLOW) as driver:
        start = driver.read()
        for _ in range(100):
            driver.write_current(-40)
            reading = driver.read()
            time.sleep(0.002)
        assert reading.current_ma == -40.0
        assert isinstance(reading.position_ticks, int)
        assert reading.position_ticks < start.position_ticks


def test_commands_are_whole_numbers(fresh: VirtualGripper) -> None:
    """Assert that a fraction is refused before it reaches the gripper."""
    with RhP12Rn(fresh.port, settings=SLOW) as driver, pytest.raises(TypeError):
        driver.write_current(1.5)  # type: ignore[arg-type]


def test_watchdog_runs_from_the_first_command_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that one may take one's time before the first command, and that silence after it is said at the next."""
    clock = StepClock()
    monkeypatch.setattr(driver_module, "time", SimpleNamespace(monotonic=clock.now_s, sleep=time.sleep))
    settings = RhP12RnSettings(answer_ms=2000, watchdog_ms=100)
    with twisted_servo(clock=clock) as servo:
        driver = RhP12Rn(servo.port, settings=settings)
        servo.pass_time(0.3)
        driver.read()
        driver.write_current(12)
        servo.pass_time(0.09)
        driver.write_current(12)
        servo.pass_time(0.5)
        assert (servo.value("Bus Watchdog"), servo.value("Torque Enable")) == (-1, 1)
        said = r"bus watchdog has tripped(.|\n)*every 100 ms(.|\n)*silence 500 ms(.|\n)*torque is off"
        with pytest.raises(DeviceError, match=said):
            driver.write_current(12)
        assert servo.value("Torque Enable") == 0
        with pytest.raises(DeviceError, match="is closed"):
            driver.read()
        driver.close()


def test_waiting_for_an_answer_does_not_trip_the_watchdog() -> None:
    """Assert that asking twice for an answer takes less than the watchdog's time, as the driver is by default."""
    settings = RhP12RnSettings()
    assert 2 * settings.answer_ms < settings.watchdog_ms
