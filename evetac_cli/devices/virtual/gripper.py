"""A virtual RH-P12-RN(A): a servo in its own process on a pseudo terminal, which the real driver opens as a port.

    with VirtualGripper(faults=["lost-answer@1.0"]) as gripper:
        driver = RhP12Rn(gripper.port)

Simulated, in real time. VirtualGripper starts this module as a process and holds the other end of its stdin and stdout.
One JSON object per line is a request, and one line is its answer. The end of stdin ends the process, also if its parent
was killed. The process sleeps until a byte, an answer or the watchdog is due. Answers leave when their last byte would
have passed the wire: bytes of request and answer * 10 / baud, plus the return delay. A frame sent at another baud rate
than the servo's is noise and is ignored.
"""

import json
import os
import pty
import select
import subprocess
import sys
import termios
import time
import tty
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from types import MappingProxyType
from typing import Any

import numpy as np

from evetac_cli.devices.naming import GRIPPER_FAULTS, Fault, gripper_fault
from evetac_cli.devices.rh_p12_rn.control_table import baud_code
from evetac_cli.devices.virtual.dynamixel_frames import FrameReader
from evetac_cli.devices.virtual.servo import Answer, VirtualServo
from evetac_cli.devices.virtual.servo_plant import Obstacle, OwnDynamics, Plant, SharedPlant
from evetac_cli.errors import DeviceError, exit_code_words
from evetac_cli.interrupts import ignore_interrupts
from evetac_cli.realtime.processes import with_reason
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.resources import PACKAGE

LATE_S = 0.5  # delay of a late answer
IDLE_S = 0.02  # longest time between updates of the servo without an instruction
FROZEN_S = 0.01  # if woken later than this, a busy machine had stopped the process
PAUSE_S = 0.02  # a frame whose remainder does not arrive within this time is dropped
_RATES = {
    getattr(termios, f"B{rate}"): rate
    for rate in (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
    if hasattr(termios, f"B{rate}")
}
END_S = 5.0


class VirtualGripper(AbstractContextManager["VirtualGripper"]):
    """A servo on a pseudo terminal; `port` is its path."""

    counted: Mapping[str, int] = MappingProxyType({})

    def __init__(
        self,
        plant: SharedPlant | Obstacle | None = None,
        faults: Iterable[str] = (),
        *,
        baud: int = 2_000_000,
        registers: Mapping[str, int] | None = None,
        position_ticks: float = 400.0,
        seed: int = 0,
    ) -> None:
        """Start the process; when this returns, the servo is listening.

        plant: the gripper of a world that another process steps, or an obstacle for the servo's own drive, which starts
        at position_ticks.

        faults: as in naming.py; registers: values that differ from the factory values, by name; seed: for the faults
        that strike at random.
        """
        all_faults = list(faults)
        for fault in all_faults:
            gripper_fault(fault)
        if isinstance(plant, SharedPlant):
            plant_config: dict[str, Any] = {"shared": str(plant.path)}
        else:
            plant_config = {"obstacle": vars(plant) if plant else None, "position_ticks": position_ticks}
        choice = {
            "plant": plant_config,
            "faults": all_faults,
            "registers": {"Baud Rate": baud_code(baud), **(registers or {})},
            "seed": seed,
        }
        python_path = os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]))
        self._process = subprocess.Popen(
            # -P: ignores the working folder, where a user may have a json.py
            [sys.executable, "-P", "-m", "evetac_cli.devices.virtual.gripper", json.dumps(choice)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": python_path},
            start_new_session=True,
        )
        try:
            self.port: str = self._receive()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id of the servo."""
        return self._process.pid

    def inject(self, fault: str) -> None:
        """Let a fault strike at once, or according to the time or probability in its text."""
        gripper_fault(fault)
        self._ask(inject=fault)

    def faults_struck(self) -> dict[str, int]:
        """Return how often each fault has struck so far, by name; faults that did not strike are missing."""
        return {str(name): int(times) for name, times in self._ask(struck=True).items()}

    def read_register(self, register: str) -> int:
        """Return the value of a register, read without the serial port."""
        return int(self._ask(read=register))

    def instructions(self) -> dict[int, int]:
        """Return how often the servo received each instruction."""
        return {int(code): count for code, count in self._ask(instructions=True).items()}

    def close(self) -> None:
        """End the process; a second call does nothing."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self._process.stdin.closed:
            return
        self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, **question: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(question).encode() + b"\n")
        self._process.stdin.flush()
        return self._receive()

    def _receive(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)
            words = with_reason("the process of the virtual gripper died", exit_code_words(self._process.returncode))
            raise DeviceError(words, hint="its last messages, if any, are above")
        return json.loads(line)


class Faults:
    """The faults that strike now; times are counted from the first time torque was switched on."""

    def __init__(self, faults: list[Fault], rng: np.random.Generator) -> None:
        self._waiting = faults
        self._rng = rng
        self._torque_s: float | None = None  # time at which torque was first on
        self.struck: Counter[str] = Counter()  # how often each fault struck

    def add(self, fault: Fault) -> None:
        """Add a waiting fault."""
        self._waiting.append(fault)

    def due(self, now_s: float, torque: bool) -> list[str]:
        """Return the names of faults that are due now, except those that wait for an answer to spoil."""
        return self._take(now_s, torque, spoiling=False)

    def spoil(self, answer: Answer, now_s: float, torque: bool) -> Answer | None:
        """Return the answer as changed by the faults; None if it is lost."""
        names = self._take(now_s, torque, spoiling=True)
        hit = [
            fault.name
            for fault in self._waiting
            if fault.share and self._lasts(fault, now_s) and self._rng.random() < fault.share
        ]
        self.struck.update(hit)
        names += hit
        if "lost-answer" in names:
            return None
        data, after_s = answer
        if "bad-crc" in names:
            data = data[:-1] + bytes([data[-1] ^ 0x40])
        return Answer(data, after_s + (LATE_S if "late-answer" in names else 0.0))

    def false_readings(self, now_s: float) -> dict[str, int]:
        """Return the false values that registers show now, by name."""
        shown: dict[str, int] = {}
        for fault in self._waiting:
            reads = GRIPPER_FAULTS[fault.name].reads
            if reads is not None and self._lasts(fault, now_s):
                shown[reads[0]] = reads[1]
                self.struck[fault.name] = max(self.struck[fault.name], 1)
        return shown

    def _take(self, now_s: float, torque: bool, *, spoiling: bool) -> list[str]:
        """Return the names of faults that strike once and do so now; they stop waiting."""
        if torque and self._torque_s is None:
            self._torque_s = now_s
        kinds = {name for name, kind in GRIPPER_FAULTS.items() if kind.reads is None and kind.percent == spoiling}
        struck = [
            fault for fault in self._waiting if not fault.share and fault.name in kinds and self._lasts(fault, now_s)
        ]
        self._waiting = [fault for fault in self._waiting if fault not in struck]
        self.struck.update(fault.name for fault in struck)
        return [fault.name for fault in struck]

    def _lasts(self, fault: Fault, now_s: float) -> bool:
        if fault.start_s is None and not GRIPPER_FAULTS[fault.name].torque:
            return True
        return self._torque_s is not None and fault.lasts(now_s - self._torque_s)


class ServoLine:
    """The pseudo terminal and its servo: the wire follows the host's time, the servo that of its world."""

    def __init__(self, servo: VirtualServo, faults: Faults, clock: TimeSource) -> None:
        self._servo = servo
        self._clock = clock
        self._faults = faults
        self._reader = FrameReader()
        self._last_byte_s = 0.0
        self._woken_s = clock.now_s()
        self._due: list[tuple[float, bytes]] = []
        self._servo_end, self._host_end = (
            pty.openpty()
        )  # the host's end also stays open here, otherwise closing the port would end the servo's end
        for end in (self._servo_end, self._host_end):
            tty.setraw(end)
        os.fchmod(self._host_end, 0o600)  # some systems let a group write to terminals
        os.set_blocking(self._servo_end, False)
        self.port = os.ttyname(self._host_end)
        self.plugged = True

    def wait(self, more: int) -> bool:
        """Sleep until something is due, and do it; return True if the descriptor `more` is ready."""
        until_s = max(min([IDLE_S, *(due_s - time.monotonic() for due_s, _ in self._due)]), 0.0)
        listening = [self._servo_end, more] if self.plugged else [more]
        ready = select.select(listening, [], [], until_s)[0]
        now_s = self._clock.now_s()
        if (late_s := now_s - self._woken_s - until_s) > FROZEN_S:
            self._servo.forgive(late_s)
        self._woken_s = now_s
        if not ready and not self._due:
            self._servo.tick(now_s)  # an instruction also does this
        self._strike(now_s)
        if self.plugged:
            self._send()
            if self._servo_end in ready:
                self._receive()
            elif self._reader.partial and time.monotonic() - self._last_byte_s > PAUSE_S:
                self._reader.forget()
        return more in ready

    def _strike(self, now_s: float) -> None:
        for name in self._faults.due(now_s, self._servo.torque):
            if name == "unplug":
                self.unplug()
            elif name == "watchdog":
                self._servo.trip()
            elif name == "restart":
                self._servo.restart(now_s)
            else:
                self._servo.overload()
        self._servo.false_readings = self._faults.false_readings(now_s)

    def _receive(self) -> None:
        host_s, now_s = time.monotonic(), self._clock.now_s()
        data = os.read(self._servo_end, 4096)
        rate = _RATES.get(termios.tcgetattr(self._host_end)[5])
        if rate != self._servo.baud:
            self._reader.forget()
            return
        self._last_byte_s = host_s
        for frame in self._reader.push(data):
            for answer in self._servo.handle(frame, now_s):
                spoiled = self._faults.spoil(answer, now_s, self._servo.torque)
                if spoiled is not None:
                    self._due.append((host_s + spoiled.after_s, spoiled.data))

    def _send(self) -> None:
        for entry in sorted(self._due):
            if entry[0] <= time.monotonic():
                self._due.remove(entry)
                with suppress(BlockingIOError):  # no reader: a wire does not wait
                    os.write(self._servo_end, entry[1])

    def unplug(self) -> None:
        """Remove the port; the servo keeps its power."""
        if self.plugged:
            self.plugged = False
            os.close(self._servo_end)
            os.close(self._host_end)


def make_plant(choice: Mapping[str, Any]) -> Plant:
    """Return the plant that the configuration from VirtualGripper describes."""
    if "shared" in choice:
        return SharedPlant(choice["shared"])
    return OwnDynamics(Obstacle(**choice["obstacle"]) if choice["obstacle"] else None, choice["position_ticks"])


def _reply(request: Mapping[str, Any], servo: VirtualServo, faults: Faults, now_s: float) -> Any:
    if "inject" in request:
        faults.add(gripper_fault(request["inject"]))
        return True
    if "struck" in request:
        return dict(faults.struck)
    if "read" in request:
        servo.tick(now_s)
        return servo.value(request["read"])
    return dict(servo.instructions)


def serve(choice: Mapping[str, Any]) -> None:
    """Run the servo until stdin ends or the parent has gone."""
    ignore_interrupts()  # Ctrl-C is for the host, which still has to switch torque off
    parent = os.getppid()
    faults = Faults([gripper_fault(text) for text in choice["faults"]], np.random.default_rng(choice["seed"]))
    plant = make_plant(choice["plant"])
    clock = plant.time if isinstance(plant, SharedPlant) else HOST_TIME
    servo = VirtualServo(plant, choice["registers"], clock.now_s())
    line = ServoLine(servo, faults, clock)
    _write_line(line.port)
    asking = sys.stdin.fileno()
    begun = b""
    while os.getppid() == parent:
        if not line.wait(asking):
            continue
        data = os.read(asking, 4096)
        if not data:
            return
        *requests, begun = (begun + data).split(b"\n")
        for text in requests:
            _write_line(_reply(json.loads(text), servo, faults, clock.now_s()))


def _write_line(answer: Any) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    serve(json.loads(sys.argv[1]))
    os._exit(0)  # nothing to clean up, and the caller of VirtualGripper.close waits for this process
