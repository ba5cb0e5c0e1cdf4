"""Cameras and grippers: two small protocols, and behind them simulated, replayed or real devices alike.

A camera hands out slices in order, empty ones included, paces whoever reads it, and tells device time. A gripper takes
one command and gives one reading a cycle. What a device lost or dropped it counts, by plain names. Truth comes only
from a simulation and goes only into the file.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any, NamedTuple, Protocol

from evetac_cli.events import Events
from evetac_cli.realtime.shared_time import TimeSource


class EventCamera(Protocol):
    """A source of slices, one for every millisecond, and the clock of its recording."""

    @property
    def sensor(self) -> Mapping[str, Any]:
        """What is known about the sensor, as datasets `sensor/...` of a recording."""

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name, such as events_dropped; nothing from a camera that cannot lose any."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know about this camera, in sentences; usually nothing."""

    @property
    def time(self) -> TimeSource:
        """The time by which the camera and the loops around it run: HOST_TIME, unless what it sees has its own."""

    def now_us(self) -> int:
        """Device time in us since the start of the recording."""

    def host_us(self, device_us: float) -> float:
        """The time of `time`, in us, at this time of the recording; NaN where the camera does not know it.

        By it the lateness of slices is measured, and the clocks of two cameras are compared.
        """

    def read(self) -> Events | None:
        """The next slice of 1 ms (t in us, absolute), or None once the stream has ended; DeviceError if it broke."""

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""


class GripperReading(NamedTuple):
    """Current and position as a gripper measures them; closing is positive."""

    current_ma: float
    position_ticks: int


def gripper_row(
    now_us: int, reading: GripperReading, *, target_ma: float = float("nan"), written_ma: int = 0
) -> dict[str, Any]:
    """The row of a command in datasets `gripper/...` of a recording.

    now_us: device time; target_ma, written_ma: the goal current and what was written of it; the defaults stand for a
    command that is a position.
    """
    return {
        "gripper/t_us": now_us,
        "gripper/current_target_ma": target_ma,
        "gripper/current_written_ma": written_ma,
        "gripper/current_ma": reading.current_ma,
        "gripper/position_ticks": reading.position_ticks,
    }


class Gripper(Protocol):
    """A parallel gripper that is commanded by motor current or by goal position."""

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name, such as answers_lost; nothing from a gripper that cannot lose any."""

    @property
    def release_words(self) -> str:
        """What is known about torque, and once the gripper is closed, what was read back; empty if it has no torque."""

    def read(self) -> GripperReading:
        """Measured current and position; DeviceError if it does not answer."""

    def write_current(self, current_ma: int) -> None:
        """Set the goal current register (integer mA) in current mode."""

    def write_position(self, goal_ticks: int) -> None:
        """Set the goal position register (integer ticks) in current-based position mode."""

    def emergency_open(self) -> None:
        """Open it at bounded current for a bounded time, then close the driver."""

    def close(self) -> None:
        """Current zero and torque off; a second call does nothing."""


class Peer(Protocol):
    """What is behind a virtual device."""

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name."""

    def close(self) -> None:
        """End it; a second call does nothing."""


OF_SECOND = "second/"  # before the names of rows of the second finger, where those of both come together


def of_finger(rows: Mapping[str, Any], finger: int) -> dict[str, Any]:
    """The rows of the first (0) or the second finger, of rows of both."""
    if finger:
        return {name.removeprefix(OF_SECOND): row for name, row in rows.items() if name.startswith(OF_SECOND)}
    return {name: row for name, row in rows.items() if not name.startswith(OF_SECOND)}


class SecondCamera(NamedTuple):
    """The camera of a second finger in a simulation; truth: one row per slice just read."""

    camera: EventCamera
    truth: Callable[[], Mapping[str, Any]]


@dataclass(frozen=True)
class Rig:
    """Camera and gripper of one trial, and what is known of them."""

    camera: EventCamera
    gripper: Gripper | None
    truth: Callable[[], Mapping[str, Any]] | None = None  # one row per slice just read; simulations only
    holding_ma: float = 0.0  # the current that holds the object stably; 0 where it is not known
    slices: int = 0  # how many there are at most; 0 where nobody knows. Simulations only, for the progress shown
    slips_at_ma: float = nan  # about this current lets the object go, which ends the trial earlier
    sampled: str = ""  # JSON of the parameters that a simulation sampled for this trial
    fall_factor: float = 1.0  # on how fast a ramp lets the current fall
    sensor: Mapping[str, Any] = field(default_factory=dict)  # what is known beyond what the camera says of itself
    setup: Mapping[str, Any] = field(default_factory=dict)  # what the devices are and how they are set; JSON
    simulated: bool = True  # what the camera sees comes from a simulation
    parents: tuple[dict[str, Any], ...] = ()  # headers of the files that the camera plays
    peers: tuple[Peer, ...] = ()  # what the devices need, such as the virtual ones behind the wire
    second: "SecondCamera | None" = None  # of the second finger; simulations only

    @property
    def watchdog_ms(self) -> float:
        """Time without commands after which the gripper lets go by itself; inf where nothing is known of that."""
        gripper = self.setup.get("gripper")
        return float(gripper.get("watchdog_ms", inf)) if isinstance(gripper, Mapping) else inf

    def known_sensor(self) -> dict[str, Any]:
        """All datasets of the sensor, those of the camera and those known beyond it."""
        return {**self.camera.sensor, **self.sensor}

    def counted(self) -> dict[str, int]:
        """What was lost so far, as camera.REASON and gripper.REASON."""
        named = [("camera", self.camera), ("gripper", self.gripper), *(("world", peer) for peer in self.peers)]
        return {
            f"{name}.{why}": count
            for name, device in named
            if device is not None
            for why, count in device.counted.items()
        }

    def close(self) -> None:
        """Close all devices, the gripper first, then what is behind them; an error in one does not keep the others."""
        with ExitStack() as closing:
            second = None if self.second is None else self.second.camera
            for device in (*reversed(self.peers), second, self.camera, self.gripper):
                if device is not None:
                    closing.callback(device.close)
