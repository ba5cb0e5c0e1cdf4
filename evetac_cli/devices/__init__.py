"""Cameras and grippers: three small protocols, and behind them simulated, replayed or real devices alike.

A camera hands out slices in order, empty ones included, and paces whoever reads it. A gripper takes one command and
gives one reading a cycle. A clock tells device time. Truth comes only from a simulation and goes only into the file.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from evetac_cli.events import Events


class EventCamera(Protocol):
    """A source of slices."""

    @property
    def sensor(self) -> Mapping[str, Any]:
        """What is known about the sensor, as datasets `sensor/...` of a recording."""

    def read(self) -> Events | None:
        """The next slice of 1 ms (t in us, absolute), or None once the stream has ended; DeviceError if it broke."""

    def close(self) -> None:
        """Let go of the device; a second call does nothing."""


class GripperReading(NamedTuple):
    """What a gripper says of itself; closing is positive."""

    current_ma: float
    position_ticks: int


class Gripper(Protocol):
    """A parallel gripper driven by motor current or by goal position."""

    def read(self) -> GripperReading:
        """Measured current and position; DeviceError if it does not answer."""

    def write_current(self, current_ma: int) -> None:
        """Set the goal current register (integer mA) in current mode."""

    def write_position(self, goal_ticks: int) -> None:
        """Set the goal position register (integer ticks) in current-based position mode."""

    def close(self) -> None:
        """Current zero and torque off; a second call does nothing."""


class Clock(Protocol):
    """Device time."""

    def now_us(self) -> int:
        """Microseconds since the start of the recording."""


@dataclass(frozen=True)
class Rig:
    """Devices that belong together in one trial."""

    camera: EventCamera
    gripper: Gripper | None
    clock: Clock
    truth: Callable[[], Mapping[str, Any]] | None = None  # one row per slice just read; simulations only
    holding_ma: float = 0.0  # the current that holds the object stably
    drawn: str = ""  # JSON of what a simulation drew for this trial

    def close(self) -> None:
        """Close all devices, the gripper first."""
        try:
            if self.gripper is not None:
                self.gripper.close()
        finally:
            self.camera.close()
