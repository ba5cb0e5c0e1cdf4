"""A servo in a thread of this process, on a pseudo terminal, that a test twists while the real driver commands it."""

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from evetac_cli.devices.rh_p12_rn.control_table import baud_code
from evetac_cli.devices.virtual.gripper import Faults, ServoLine
from evetac_cli.devices.virtual.servo import VirtualServo
from evetac_cli.devices.virtual.servo_plant import Obstacle, OwnDynamics
from evetac_cli.realtime.shared_time import HOST_TIME
from tests.devices.stepped import StepClock

PATIENCE_S = 60.0


class Twist(Faults):
    """What a test wants to go wrong now."""

    def __init__(self) -> None:
        super().__init__([], np.random.default_rng(0))
        self.readings: Mapping[str, int] = {}  # what registers show instead of what is measured
        self.next: list[str] = []  # faults that strike before the next instruction
        self.passes_s = 0.0  # time that passes before the next instruction
        self.passed = threading.Event()

    def due(self, now_s: float, torque: bool) -> list[str]:
        names, self.next = self.next, []
        return names

    def false_readings(self, now_s: float) -> dict[str, int]:
        return dict(self.readings)


class TwistedServo:
    """A servo at a port; its time is the host's, or that of a clock which only the test moves."""

    def __init__(self, registers: Mapping[str, int], position_ticks: float, clock: StepClock | None) -> None:
        self._clock = clock
        time = clock or HOST_TIME
        plant = OwnDynamics(Obstacle(), position_ticks)
        self._servo = VirtualServo(plant, {"Baud Rate": baud_code(2_000_000), **registers}, time.now_s())
        self.twist = Twist()
        self._line = ServoLine(self._servo, self.twist, time)
        self.port = self._line.port

    def value(self, name: str) -> int:
        """A register, as it is."""
        return self._servo.value(name)

    def pass_time(self, seconds: float) -> None:
        """Let so much of the test's clock pass, in which nobody speaks to the servo, and wait until it has."""
        self.twist.passed.clear()
        self.twist.passes_s = seconds
        assert self.twist.passed.wait(PATIENCE_S)

    def serve(self, until: int) -> None:
        """Be the servo until this descriptor can be read."""
        while not self._line.wait(until):
            if self.twist.passes_s:
                assert self._clock is not None
                self._clock.sleep(self.twist.passes_s)
                self._line._woken_s = self._clock.now_s()  # else it would take the time for one in which it was frozen
                self._servo.tick(self._clock.now_s())
                self.twist.passes_s = 0.0
                self.twist.passed.set()
        self._line.unplug()


@contextmanager
def twisted_servo(
    registers: Mapping[str, int] | None = None, position_ticks: float = 400.0, clock: StepClock | None = None
) -> Iterator[TwistedServo]:
    """A servo that listens for as long as the block lasts."""
    servo = TwistedServo(registers or {}, position_ticks, clock)
    until, end = os.pipe()
    thread = threading.Thread(target=servo.serve, args=(until,), daemon=True)
    thread.start()
    try:
        yield servo
    finally:
        os.close(end)
        thread.join()
        os.close(until)
