"""doctor hardware: the first test of a camera and a gripper, step by step at low current, with a report.

Each step states its expectation first and its finding afterwards; the first unexpected finding ends the check, with
torque off. Nothing moves before communication, limits and the Bus Watchdog have been tested. Then the fingers close and
open with 20 mA for 0.2 s each: in the simulated drive, 10 mA just exceed the friction of the gear.

Reason: evetac's drivers have only been tested with virtual devices. The report has everything that a maintainer needs
to fix them remotely: all registers, all expectations, and the behaviour of the hardware.
"""

import json
import platform
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli import console
from evetac_cli.commands.doctor import DoctorHardware
from evetac_cli.console import print_text
from evetac_cli.devices import cameras as named_cameras
from evetac_cli.devices import grippers as named_grippers
from evetac_cli.devices.cameras import CameraSettings, NamedCamera
from evetac_cli.devices.grippers import NamedGripper, RhP12RnGripper
from evetac_cli.devices.opening import require_arm
from evetac_cli.devices.plugin_devices import open_camera, open_gripper
from evetac_cli.devices.rh_p12_rn.control_table import (
    CURRENT_MODE,
    MODEL_NUMBER,
    TABLE,
    WATCHDOG_TRIPPED,
    check_model,
    hardware_errors,
)
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.devices.rh_p12_rn.dynamixel_bus import RANGE_FAULT, Bus, InstructionRefused
from evetac_cli.devices.rh_p12_rn.torque import SETTLE_S, Torque
from evetac_cli.errors import EvetacError, InputError
from evetac_cli.events import SLICES_PER_S
from evetac_cli.jobs import LookCall, Outcome
from evetac_cli.names import Capability
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.provenance import time_host_versions

CURRENT_MA, MOVE_S, STEP_S, LEAST_COMMANDS = 20, 0.2, 0.005, 10
REST_MA = 3  # current that may be measured at a motor without current
READS = 200  # reads of the position, none of which may be lost
SILENCE = 3  # in units of the watchdog's time
ROOM_TICKS = range(60, 640)  # positions from which the fingers can both close and open a little
CAMERA_S = 1.0
LIBRARIES = ("dynamixel-sdk", "pyserial", "pyusb", "libusb-package")
LOOK_FOR_IT = "is 24 V on? evetac doctor --gripper PORT shows the id and baud rate that answer"
MOTION = "the fingers will move a little: keep the space between them empty, and the 24 V switch within reach"


class NotAsExpected(Exception):
    """A step had an unexpected finding; its row has the details."""


class Steps:
    """The expectations and findings so far; the first unexpected finding ends the check."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def do(self, device: str, check: str, expected: str, act: Callable[[], tuple[bool, str]], fix: str = "") -> None:
        """Print the expectation, run the step, and print the finding; raise NotAsExpected if it is unexpected."""
        console.say(f"{len(self.rows) + 1:2d}. {device}, {check}: expected {expected}")
        try:
            ok, found = act()
        except EvetacError as error:
            ok, found = False, " ".join(str(error).split())
        row = {"device": device, "check": check, "ok": ok, "found": found, "expected": expected}
        self.rows.append({**row, "fix": fix or None if not ok else None})
        console.say(f"    {'ok' if ok else 'NOT AS EXPECTED'}: {found}")
        if not ok:
            raise NotAsExpected


def look(call: LookCall) -> Outcome:
    """Test the given devices; InputError with --quiet, because every step is announced."""
    if call.quiet:
        raise InputError("has no effect: every step is announced", where="--quiet")
    return run(call.params, call.out)


def run(params: DoctorHardware, out: Path | None, ask: Callable[[str], bool] | None = None) -> Outcome:
    """Test the given camera and gripper; return a row for every step, and write a report file.

    ask: asks the user a question before the first motion. Raises InputError without --arm, without a gripper or camera,
    if the user cannot be asked (unless --yes is given), or if the report cannot be written.
    """
    if params.gripper is None and params.camera is None:
        raise InputError(
            "no device was given to test", where="doctor hardware", expected="--gripper PORT, --camera NAME, or both"
        )
    camera = named_cameras.parse(params.camera) if params.camera is not None else None
    gripper = named_grippers.parse(params.gripper or "none")
    no_devices = {Capability.STEPPED, Capability.REPLAY}
    if no_devices & (gripper.capabilities | (frozenset() if camera is None else camera.capabilities)):
        raise InputError(
            "this is not a device", where="--camera, --gripper", expected="a real or virtual device", found="sim"
        )
    plan = f"closes and opens with {CURRENT_MA} mA, {MOVE_S:g} s each"
    require_arm(gripper, armed=params.arm, plan=plan, hint="`evetac doctor` alone moves nothing")
    if gripper.has(Capability.HARDWARE) and not params.yes and ask is None:
        if not sys.stdin.isatty():
            raise InputError(
                "the user cannot be asked before the gripper moves",
                where="doctor hardware",
                expected="a terminal, or --yes",
            )
        ask = _ask
    path = out or Path(f"evetac-hardware-{datetime.now():%Y%m%d-%H%M%S}.json")
    try:
        path.touch(exist_ok=False)
    except OSError as error:
        raise InputError("the report cannot be written", where=str(path), found=error.strerror or str(error)) from None
    steps, registers = Steps(), dict[str, int]()
    moves_virtual = gripper.has(Capability.MOVED) and not gripper.has(Capability.HARDWARE)
    simulated = moves_virtual or (camera is not None and camera.has(Capability.SIMULATED))
    interrupted = True
    try:
        if camera is not None:
            _try_camera(steps, camera)
        if isinstance(gripper, RhP12RnGripper):
            _try_gripper(steps, gripper, None if params.yes or not gripper.has(Capability.HARDWARE) else ask, registers)
        elif gripper.has(Capability.MOVED):
            _try_gripper_of_plugin(steps, gripper)
        interrupted = False
    except NotAsExpected:
        interrupted = False
    finally:
        wrong = [row["check"] for row in steps.rows if not row["ok"]]
        ended = "interrupted" if interrupted else f"stopped at: {wrong[0]}" if wrong else "all as expected"
        summary = {"steps": len(steps.rows), "wrong": len(wrong), "ended": ended}
        about = {"camera": None if camera is None else str(camera), "gripper": str(gripper), "registers": registers}
        _write_report(path, {"simulated": simulated, "rows": steps.rows, "summary": summary, **about})
    return Outcome(steps.rows, simulated, {**summary, "report": str(path)})


def _write_report(path: Path, report: dict[str, Any]) -> None:
    """Write the report, with the versions of programs; a failure is only said, as the rows are printed anyway."""
    libraries = {name: version(name) for name in LIBRARIES}
    made = {**time_host_versions(), "system": platform.platform(), **libraries}
    try:
        with taking_the_place_of(path) as temporary:
            temporary.write_text(json.dumps({"command": "doctor hardware", **report, "made": made}, indent=1) + "\n")
    except InputError as error:
        console.say(f"{path}: the report could not be written: {error.message}")


def show(result: Outcome, **_: Any) -> None:
    """Print what is wrong, how the check ended, and the path of the report; the steps were printed before."""
    for row in result.rows:
        if not row["ok"]:
            print_text(f"{row['device']}, {row['check']}: expected {row['expected']}; found {row['found']}")
            if row["fix"]:
                print_text(f"  try: {row['fix']}")
    print_text(f"{result.summary['ended']}; {result.summary['steps']} steps; report: {result.summary['report']}")
    if result.summary["wrong"]:
        print_text("please send the report to the maintainers; it has all that they need")


def _ask(question: str) -> bool:
    console.say(f"{question}. Continue? Type yes and press Enter:")
    return sys.stdin.readline().strip().lower() == "yes"


# The camera


def _try_camera(steps: Steps, camera: NamedCamera) -> None:
    """Open the camera, read a second of slices, and count losses."""
    name = f"camera {camera}"
    with ExitStack() as opened:
        running: Any = None

        def open_() -> tuple[bool, str]:
            nonlocal running
            running, setup, _ = open_camera(camera, CameraSettings(), None, np.random.SeedSequence(0))
            opened.callback(running.close)
            return True, json.dumps(dict(setup), default=str)

        def events() -> tuple[bool, str]:
            sizes: list[int] = []
            for _ in range(round(CAMERA_S * SLICES_PER_S)):
                slice_ = running.read()
                if slice_ is None:
                    return False, f"the stream ended after {len(sizes)} slices"
                sizes.append(slice_.size)
            busy = sum(size > 0 for size in sizes)
            return busy > 0, f"{sum(sizes)} events in {len(sizes)} slices, {busy} of them not empty"

        def losses() -> tuple[bool, str]:
            lost = {why: count for why, count in running.counted.items() if count}
            return not lost, ", ".join(f"{why} {count}" for why, count in lost.items()) or "none"

        steps.do(name, "opens", "it opens and identifies itself", open_, "evetac doctor shows the cause")
        steps.do(
            name,
            "events",
            f"slices for {CAMERA_S:g} s, with events",
            events,
            "remove the lens cap, check the cable",
        )
        steps.do(name, "losses", "nothing lost", losses, "use another USB 3 port, and end other programs")


# The gripper


def _try_gripper(
    steps: Steps, gripper: NamedGripper, ask: Callable[[str], bool] | None, registers: dict[str, int]
) -> None:
    """Run all steps of the gripper; however they end, torque is off and the operating mode restored."""
    name = f"gripper {gripper}"
    with ExitStack() as opened:
        servo = gripper.open_peer(None)
        if servo is not None:
            opened.callback(servo.close)
        port = gripper.port if servo is None else servo.port
        settings = gripper.settings()
        found_bus: list[Bus] = []

        def open_() -> tuple[bool, str]:
            found_bus.append(opened.enter_context(Bus(port, gripper.baud, settings.id, answer_ms=settings.answer_ms)))
            return True, f"{port} at {gripper.baud} baud, id {settings.id}"

        steps.do(name, "port", "the serial port opens", open_, "evetac doctor shows the cause")
        check = GripperCheck(found_bus[0], settings, steps, name, registers)
        try:
            check.read_all()
            check.try_watchdog(ask)
            check.move()
        finally:
            check.end()


def _try_gripper_of_plugin(steps: Steps, gripper: NamedGripper) -> None:
    """Open, read and close the gripper of a plug-in; its registers are unknown, and nothing is moved."""
    name = f"gripper {gripper}"
    with ExitStack() as opened:
        running: Any = None

        def open_() -> tuple[bool, str]:
            nonlocal running
            running, setup = open_gripper(gripper, "current", gripper.port)
            opened.callback(running.close)
            return True, json.dumps(setup, default=str)

        def reads() -> tuple[bool, str]:
            reading = running.read()
            return True, f"{reading.current_ma:g} mA, {reading.position_ticks} ticks"

        def closes() -> tuple[bool, str]:
            running.close()
            return True, running.release_words or "closed"

        steps.do(name, "opens", "it opens and identifies itself", open_)
        steps.do(name, "answers", "current and position", reads)
        steps.do(name, "closes", "torque is off", closes)


class GripperCheck:
    """The steps of one gripper on an open bus."""

    def __init__(self, bus: Bus, settings: RhP12RnSettings, steps: Steps, name: str, registers: dict[str, int]) -> None:
        self._bus, self._settings, self._steps, self._name = bus, settings, steps, name
        self._registers = registers
        self._torque = Torque(bus, settings.watchdog_ms)
        self._mode: int | None = None  # the operating mode to restore
        self._is_ours = False

    def _do(self, check: str, expected: str, act: Callable[[], tuple[bool, str]], fix: str = "") -> None:
        self._steps.do(self._name, check, expected, act, fix)

    def read_all(self) -> None:
        """Read the gripper's identity and state; nothing is written except torque off."""
        bus = self._bus

        def answers() -> tuple[bool, str]:
            bus.tolerant = True  # a hardware error has its own step
            model = bus.ping()
            check_model(model, self._name)
            self._is_ours = True
            return True, f"model number {model}"

        def read_registers(*names: str) -> list[int]:
            for each in names:
                self._registers[each] = bus.read(each)
            return [self._registers[each] for each in names]

        def everything() -> tuple[bool, str]:
            read_registers(*(each.name for each in TABLE))
            return True, f"{len(self._registers)} registers, in the report"

        def within(value: float, low: float, high: float, unit: str) -> tuple[bool, str]:
            return low <= value <= high, f"{value:g} {unit}, limits {low:g} to {high:g}"

        def supply() -> tuple[bool, str]:
            now, low, high = read_registers("Present Input Voltage", "Min Voltage Limit", "Max Voltage Limit")
            return within(now / 10, low / 10, high / 10, "V")

        def temperature() -> tuple[bool, str]:
            now, high = read_registers("Present Temperature", "Temperature Limit")
            return now < high, f"{now} C, limit {high} C"

        def errors() -> tuple[bool, str]:
            errors_now = hardware_errors(*read_registers("Hardware Error Status"))
            bus.tolerant = False
            return not errors_now, ", ".join(errors_now) or "none"

        def torque() -> tuple[bool, str]:
            was = read_registers("Torque Enable")[0]
            self._torque.clear()
            return True, "0" if was == 0 else "was 1, left by another program; now 0 (read back)"

        def line() -> tuple[bool, str]:
            for _ in range(READS):
                bus.read("Present Position")
            lost = {why: count for why, count in bus.counted.items() if count}
            return not lost, ", ".join(f"{why} {count}" for why, count in lost.items()) or f"{READS} answers, none lost"

        self._do("answers", f"model number {MODEL_NUMBER}, RH-P12-RN(A)", answers, LOOK_FOR_IT)
        self._do("registers", "every register can be read", everything)
        self._do("supply", "a voltage within its limits", supply, "check the 24 V supply")
        self._do("temperature", "below its limit", temperature, "let it cool down")
        self._do("hardware error", "none", errors, "remove the cause, then switch 24 V off and on")
        self._do("torque", "Torque Enable 0, read back", torque, "switch 24 V off and on")
        self._do("line", f"{READS} requests answered, nothing lost", line, "check cable, ground, latency timer")

    def try_watchdog(self, ask: Callable[[str], bool] | None) -> None:
        """Ask the user, arm the watchdog, send nothing at 0 mA, and check that it trips."""
        bus, silence_ms = self._bus, SILENCE * self._settings.watchdog_ms

        def position() -> tuple[bool, str]:
            ticks = bus.read("Present Position")
            return ticks in ROOM_TICKS, f"{ticks} ticks"

        def agreed() -> tuple[bool, str]:
            return ask is None or ask(MOTION), "asked" if ask is not None else "not asked (--yes, or a virtual device)"

        def trips() -> tuple[bool, str]:
            self._torque_on()
            armed, torque = bus.read("Bus Watchdog"), bus.read("Torque Enable")
            time.sleep(silence_ms * 1e-3)
            ok, text = self._tripped(f"before: Bus Watchdog {armed}, Torque Enable {torque}")
            return ok and armed > 0 and torque == 1, text

        room = f"{ROOM_TICKS.start} to {ROOM_TICKS.stop - 1} ticks, so that the fingers can close and open"
        self._do("position", room, position, "move the fingers half open by hand: torque is off")
        self._do("agreed", "the user agrees", agreed, "run the command again when everything is ready")
        self._do(
            "watchdog",
            f"after {silence_ms} ms without an instruction, at 0 mA: Bus Watchdog {WATCHDOG_TRIPPED}, goals refused,"
            " Torque Enable 1",
            trips,
            "do not use this gripper with evetac: it would not stop after a crash",
        )

    def move(self) -> None:
        """Close, open, and let the watchdog switch off the current; each briefly with a low current."""

        def moved(current_ma: int) -> tuple[bool, str]:
            self._torque_on()
            before = self._bus.read("Present Position")
            measured_ma = self._hold(current_ma)
            self._bus.write("Goal Current", 0)
            ticks = self._bus.read("Present Position") - before
            right = ticks * current_ma > 0 and measured_ma * current_ma > 0
            self._torque.switch_off()
            return right and not self._torque.is_on, f"{ticks:+d} ticks, {measured_ma:+d} mA measured"

        def stopped() -> tuple[bool, str]:
            self._torque_on()
            self._hold(CURRENT_MA)
            time.sleep(SILENCE * self._settings.watchdog_ms * 1e-3)
            left_ma = self._bus.read("Present Current")
            ok, text = self._tripped(f"{left_ma:+d} mA left")
            return ok and abs(left_ma) <= REST_MA, text

        fix = "are the fingers at a limit, or is an object between them? otherwise please send the report"
        for check, sign in (("closes", 1), ("opens", -1)):
            self._do(
                check,
                f"{sign * CURRENT_MA:+d} mA for {MOVE_S:g} s: ticks and measured current of the same sign",
                lambda sign=sign: moved(sign * CURRENT_MA),  # type: ignore[misc]
                fix,
            )
        self._do(
            "watchdog with current",
            f"silence while closing with {CURRENT_MA} mA: tripped, at most {REST_MA} mA left",
            stopped,
            "do not use this gripper with evetac: it would not stop after a crash",
        )

    def end(self) -> None:
        """Switch torque off, read it back, and restore the operating mode; add a row with the result."""
        if not self._is_ours:
            return
        off = self._torque.switch_off()
        if off and self._mode is not None:
            with suppress(EvetacError):
                self._bus.write("Operating Mode", self._mode)
        with suppress(NotAsExpected):
            fix = "switch 24 V off"
            self._do("torque at the end", "torque is off (read back)", lambda: (off, self._torque.words), fix)

    def _torque_on(self) -> None:
        """Clear the state of the previous step, then set current mode, watchdog, and torque at 0 mA."""
        self._bus.settle_s = SETTLE_S
        self._torque.clear()
        mode = self._bus.read("Operating Mode")
        if mode != CURRENT_MODE:
            self._mode = mode
            self._bus.write("Operating Mode", CURRENT_MODE)
        self._torque.switch_on(None)

    def _hold(self, current_ma: int) -> int:
        """Command a current for MOVE_S; return the strongest current measured in this time (mA)."""
        strongest = commands = 0
        until_s = time.monotonic() + MOVE_S
        while time.monotonic() < until_s or commands < LEAST_COMMANDS:  # a busy computer may send few commands
            self._bus.write("Goal Current", current_ma)
            measured = self._bus.read("Present Current")
            strongest = max(strongest, measured, key=abs)
            commands += 1
            time.sleep(STEP_S)
        return strongest

    def _tripped(self, also: str) -> tuple[bool, str]:
        """Return whether the watchdog has tripped as the manual describes, and a text on what was read."""
        watchdog, torque = self._bus.read("Bus Watchdog"), self._bus.read("Torque Enable")
        try:
            self._bus.write("Goal Current", 0)
            refused = False
        except InstructionRefused as error:
            refused = error.fault == RANGE_FAULT
        goals = "refused" if refused else "accepted"
        text = f"Bus Watchdog {watchdog}, goals {goals}, Torque Enable {torque}; {also}"
        return watchdog == WATCHDOG_TRIPPED and refused and torque == 1, text
