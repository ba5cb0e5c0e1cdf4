"""The real driver before a servo that restarts, or reports what cannot be: it ends in words, with torque off."""

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.rh_p12_rn import measurements
from evetac_cli.devices.rh_p12_rn.driver import CHECK_EVERY, Mode, RhP12Rn, RhP12RnSettings
from evetac_cli.errors import DeviceError
from tests.conftest import SLOW
from tests.devices.twisted import TwistedServo, twisted_servo

MODES: tuple[Mode, ...] = ("current", "position")
CYCLES = 3 * CHECK_EVERY


def cycles(driver: RhP12Rn, count: int, mode: Mode = "current") -> None:
    """Read and command, so many times."""
    for _ in range(count):
        ticks = driver.read().position_ticks
        if mode == "current":
            driver.write_current(5)
        else:
            driver.write_position(ticks)


def ends(servo: TwistedServo, mode: Mode, twist: Any, settings: RhP12RnSettings = SLOW) -> str:
    """What the driver says where it is twisted after some cycles; torque is off then, and the driver closed."""
    driver = RhP12Rn(servo.port, mode=mode, settings=settings)
    cycles(driver, 5, mode)
    twist(servo)
    with pytest.raises(DeviceError) as ended:
        cycles(driver, CYCLES, mode)
    assert servo.value("Torque Enable") == 0
    assert driver.release_words == "torque is off (read back)"
    with pytest.raises(DeviceError, match="is closed"):
        driver.read()
    assert "torque is off (read back)" in str(ended.value)
    return str(ended.value)


def restart(servo: TwistedServo) -> None:
    servo.twist.next = ["restart"]


def shows(**readings: int) -> Any:
    def twist(servo: TwistedServo) -> None:
        servo.twist.readings = {name.replace("_", " "): value for name, value in readings.items()}

    return twist


# A servo that restarts


@pytest.mark.parametrize("mode", MODES)
def test_a_restart_is_noticed(mode: Mode) -> None:
    """Assert that a servo that restarted under way, with no error of its own, ends the driver and is named."""
    with twisted_servo() as servo:
        words = ends(servo, mode, restart)
    assert "lost torque" in words
    assert "24 V" in words


def test_a_restart_is_noticed_at_once_by_the_clock() -> None:
    """Assert that it takes no more readings than there are between two looks at the servo's clock."""
    with twisted_servo() as servo:
        servo.twist.readings = {"Realtime Tick": 20_000}
        driver = RhP12Rn(servo.port, settings=SLOW)
        cycles(driver, 40)
        servo.twist.readings = {"Realtime Tick": 3}
        restart(servo)
        with pytest.raises(DeviceError, match="the gripper restarted(.|\n)*Realtime Tick fell from 20,000 to 3 ms"):
            cycles(driver, 12)


def test_a_restart_that_the_clock_hides_is_noticed_too() -> None:
    """Assert that torque itself is asked for now and then, whatever the clock shows."""
    with twisted_servo() as servo:
        servo.twist.readings = {"Realtime Tick": 5}
        words = ends(servo, "current", restart)
    assert "Realtime Tick" not in words and "the gripper lost torque" in words


def test_torque_that_another_program_switched_off_is_noticed() -> None:
    """Assert that it need be no restart."""
    with twisted_servo() as servo:
        words = ends(servo, "position", shows(Torque_Enable=0))
    assert "another program" in words


def test_a_restart_before_the_first_command_costs_nothing() -> None:
    """Assert that a gripper that restarts after it was set up is commanded as it was set up."""
    settings = RhP12RnSettings(answer_ms=2000, watchdog_ms=2540, p_gain=77)
    with twisted_servo() as servo, RhP12Rn(servo.port, mode="position", settings=settings) as driver:
        cycles_read(driver, 12)
        restart(servo)
        cycles_read(driver, 30)
        driver.write_position(410)
        assert servo.value("Position P Gain") == 77
        assert servo.value("Torque Enable") == 1
        cycles(driver, CYCLES, "position")


def cycles_read(driver: RhP12Rn, count: int) -> None:
    for _ in range(count):
        driver.read()


def test_an_emergency_opening_that_finds_no_torque_says_so() -> None:
    """Assert that a gripper that restarted is not said to have been opened."""
    with twisted_servo() as servo:
        driver = RhP12Rn(servo.port, settings=SLOW)
        cycles(driver, 5)
        restart(servo)
        with pytest.raises(DeviceError, match="lost torque"):
            driver.emergency_open(seconds=10.0)


def test_a_clock_that_wraps_or_stands_still_is_no_restart() -> None:
    """Assert that 32767 -> 0 is time that passed, that a slow or standing clock is none of our business."""
    with twisted_servo() as servo, RhP12Rn(servo.port, settings=SLOW) as driver:
        for ticks in (32_760, 32_767, 0, 4, 4, 4, 9):
            servo.twist.readings = {"Realtime Tick": ticks}
            cycles(driver, 15)
        assert driver.counted["readings_impossible"] == 0


# What cannot be

IMPOSSIBLE = {
    "position, largest": ({"Present_Position": 2**31 - 1}, "position"),
    "position, smallest": ({"Present_Position": -(2**31)}, "position"),
    "position, far open": ({"Present_Position": -65}, "position"),
    "position, far closed": ({"Present_Position": 1215}, "position"),
    "position, one turn on": ({"Present_Position": 400 + 4096}, "position"),
    "current, largest": ({"Present_Current": 2**15 - 1}, "current"),
    "current, smallest": ({"Present_Current": -(2**15)}, "current"),
    "current, beyond the motor's peak": ({"Present_Current": 4001}, "current"),
    "supply, none": ({"Present_Input_Voltage": 0}, "supply"),
    "supply, largest": ({"Present_Input_Voltage": 2**16 - 1}, "supply"),
    "supply, of another kind": ({"Present_Input_Voltage": 50}, "supply"),
    "temperature, largest": ({"Present_Temperature": 255}, "temperature"),
    "temperature, of a servo that would have stopped": ({"Present_Temperature": 110}, "temperature"),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
@pytest.mark.parametrize("mode", MODES)
def test_what_cannot_be_ends_it_in_words(mode: Mode, case: str) -> None:
    """Assert that a reading that no servo can have is named with what was expected, and nothing more is commanded."""
    readings, name = IMPOSSIBLE[case]
    with twisted_servo() as servo:
        words = ends(servo, mode, shows(**readings))
    (value,) = readings.values()
    shown = f"{value / 10:g} V" if name == "supply" else f"{value:,} "
    assert f"the gripper reports an impossible {name}: {shown}" in words


@pytest.mark.parametrize("ticks", [-1, 0, 250, 600, 740, 1151])
@pytest.mark.parametrize("mode", MODES)
def test_a_position_that_was_not_reached_ends_it(mode: Mode, ticks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a position within the limits is impossible where the finger was far from it a cycle before."""
    now_s = iter(np.arange(0.0, 1e3, 0.5e-3))  # however late this computer is, a cycle takes some ms
    monkeypatch.setattr(measurements, "time", SimpleNamespace(monotonic=lambda: float(next(now_s))))
    with twisted_servo() as servo:
        words = ends(servo, mode, shows(Present_Position=ticks))
    assert f"the gripper reports an impossible position: {ticks:,} ticks" in words
    assert "ticks from 4" in words and "ms earlier" in words


def test_a_single_wild_reading_is_asked_again() -> None:
    """Assert that one reading that cannot be is counted, not used, and no reason to let go."""
    with twisted_servo() as servo, RhP12Rn(servo.port, settings=SLOW) as driver:
        cycles(driver, 5)
        wild = iter([{"Present Position": -(2**31)}])
        servo.twist.false_readings = lambda now_s: next(wild, {})  # type: ignore[method-assign]
        cycles(driver, 1)
        readings = [driver.read().position_ticks for _ in range(20)]
        assert max(readings) < 450 and min(readings) > 350
        assert driver.counted["readings_impossible"] <= 1
        cycles(driver, CYCLES)


# What real servos do


@pytest.mark.parametrize("ticks", [-1, -20, 1151, 1200])
def test_a_finger_pushed_a_little_beyond_its_limits_is_normal(ticks: int) -> None:
    """Assert that a position just beyond the limits is a reading, where the finger came there by and by."""
    with twisted_servo() as servo, RhP12Rn(servo.port, settings=SLOW) as driver:
        servo.twist.readings = {"Present Position": ticks}
        cycles(driver, CYCLES)
        assert driver.read().position_ticks == ticks
        assert driver.counted["readings_impossible"] == 0


@pytest.mark.parametrize(
    "readings",
    [
        {"Present_Current": 3330},  # the motor's peak, for a moment beyond the limit
        {"Present_Current": -1984},
        {"Present_Input_Voltage": 149},  # just below its limit: the servo's own alert says more
        {"Present_Input_Voltage": 360},
        {"Present_Temperature": 0},
        {"Present_Temperature": 81},
        {"Present_Velocity": 2**31 - 1},  # in the same block, and used by nobody
    ],
    ids=str,
)
def test_what_is_unusual_is_no_fault(readings: dict[str, int]) -> None:
    """Assert that readings at the ends of what there is go into law and file."""
    with twisted_servo() as servo, RhP12Rn(servo.port, settings=SLOW) as driver:
        shows(**readings)(servo)
        cycles(driver, CYCLES)
        assert driver.counted["readings_impossible"] == 0


def test_a_fast_finger_is_no_jump() -> None:
    """Assert that the fastest motion of the drive, and a program that was away for a while, are no reason to end."""
    with twisted_servo(position_ticks=60.0) as servo, RhP12Rn(servo.port, settings=SLOW) as driver:
        for _ in range(100):
            driver.write_current(600)
            driver.read()
        time.sleep(0.5)
        driver.write_current(600)
        assert driver.read().position_ticks > 100
        assert driver.counted["readings_impossible"] == 0
