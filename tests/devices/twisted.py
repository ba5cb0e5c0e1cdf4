"""A servo in a thread of this process, on a pseudo terminal, that a test twists while the real driver commands it."""

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from evetac_cli.devices.rh_p12_rn.control_table import baud_code
from evetac_cli.devices.virtual.servo import VirtualServo
from evetac_cli.devices.virtual.servo_plant import Obstacle, OwnDynamics
from evetac_cli.devices.virtual.servo_process import Faults, Line
from evetac_cli.realtime.shared_time import HOST_TIME


class Twist(Faults):
    """What a test wants to go wrong now."""

    def __init__(self) -> None:
        super().__init__([], np.random.default_rng(0))
        self.readings: Mapping[str, int] = {}  # what registers show instead of what is measured
        self.next: list[str] = []  # faults that strike before the next instruction

    def due(self, now_s: float, torque: bool) -> list[str]:
        names, self.next = self.next, []
        return names

    def false_readings(self, now_s: float) -> dict[str, int]:
        return dict(self.readings)


class TwistedServo:
    """A servo at a port."""

    def __init__(self, registers: Mapping[str, int], position_ticks: float) -> None:
        plant = OwnDynamics(Obstacle(), position_ticks)
        self._servo = VirtualServo(plant, {"Baud Rate": baud_code(2_000_000), **registers}, HOST_TIME.now_s())
        self.twist = Twist()
        self._line = Line(self._servo, self.twist, HOST_TIME)
        self.port = self._line.port

    def value(self, name: str) -> int:
        """A register, as it is."""
        return self._servo.value(name)

    def serve(self, until: int) -> None:
        """Be the servo until this descriptor can be read."""
        while not self._line.wait(until):
            pass
        self._line.unplug()


@contextmanager
def twisted_servo(registers: Mapping[str, int] | None = None, position_ticks: float = 400.0) -> Iterator[TwistedServo]:
    """A servo that listens for as long as the block lasts."""
    servo = TwistedServo(registers or {}, position_ticks)
    until, end = os.pipe()
    thread = threading.Thread(target=servo.serve, args=(until,), daemon=True)
    thread.start()
    try:
        yield servo
    finally:
        os.close(end)
        thread.join()
        os.close(until)
