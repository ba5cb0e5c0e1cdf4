"""Cameras and grippers: one small protocol for each, shared by simulated, replayed and real devices.

A camera returns slices in order, including empty ones, sets the pace for its reader and knows the device time. A
gripper takes one command and returns one reading per cycle. Both count their losses under plain names. Ground truth
comes only from a simulation and is only written to the file.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any, NamedTuple, Protocol

from evetac_cli.events import Events
from evetac_cli.realtime.shared_time import TimeSource


class EventCamera(Protocol):
    """A source of slices, one per millisecond, and the clock of its recording."""

    @property
    def sensor(self) -> Mapping[str, Any]:
        """The known properties of the sensor, as datasets `sensor/...` of a recording."""

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name, such as events_dropped; empty for a camera that cannot lose anything."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that the user should read about this camera; usually none."""

    @property
    def time(self) -> TimeSource:
        """The time source of the camera and of the loops around it: HOST_TIME, unless its scene has its own time."""

    def now_us(self) -> int:
        """Device time in us since the start of the recording."""

    def host_us(self, device_us: float) -> float:
        """Return the reading of `time`, in us, at this time of the recording; NaN if the camera cannot relate the two.

        Used to measure how late slices are, and to compare the clocks of two cameras.
        """

    def read(self) -> Events | None:
        """Return the next slice of 1 ms (t in us, absolute), or None after the end of the stream.

        DeviceError if the camera failed.
        """

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""


class GripperReading(NamedTuple):
    """Current and position as a gripper measures them; closing is positive."""

    current_ma: float
    position_ticks: int


def gripper_row(
    now_us: int, reading: GripperReading, *, target_ma: float = float("nan"), written_ma: int = 0
) -> dict[str, Any]:
    """Return the row of one command in the datasets `gripper/...` of a recording.

    now_us: device time; target_ma, written_ma: the goal current, and the integer that was written. The defaults are for
    a position command.
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
        """Losses so far by plain name, such as answers_lost; empty for a gripper that cannot lose anything."""

    @property
    def release_words(self) -> str:
        """The known state of torque; after `close`, the state that was read back.

        Empty for a gripper without torque.
        """

    def read(self) -> GripperReading:
        """Return the measured current and position; DeviceError if the gripper does not answer."""

    def write_current(self, current_ma: int) -> None:
        """Set the goal current register (integer mA) in current mode."""

    def write_position(self, goal_ticks: int) -> None:
        """Set the goal position register (integer ticks) in current-based position mode."""

    def emergency_open(self) -> None:
        """Open the fingers at bounded current for a bounded time, then close the driver."""

    def close(self) -> None:
        """Set the current to zero and switch torque off; a second call does nothing."""


class Peer(Protocol):
    """The process behind a virtual device."""

    @property
    def counted(self) -> Mapping[str, int]:
        """Losses so far by plain name."""

    def close(self) -> None:
        """End the process; a second call does nothing."""


OF_SECOND = "second/"  # prefix of the second finger's rows where rows of both fingers are combined


def of_finger(rows: Mapping[str, Any], finger: int) -> dict[str, Any]:
    """Return the rows of the first (0) or the second finger, selected from rows of both."""
    if finger:
        return {name.removeprefix(OF_SECOND): row for name, row in rows.items() if name.startswith(OF_SECOND)}
    return {name: row for name, row in rows.items() if not name.startswith(OF_SECOND)}


class SecondCamera(NamedTuple):
    """The camera of a second finger in a simulation; truth: one row for the slice read last."""

    camera: EventCamera
    truth: Callable[[], Mapping[str, Any]]


@dataclass(frozen=True)
class Rig:
    """Camera and gripper of one trial, and their known properties."""

    camera: EventCamera
    gripper: Gripper | None
    truth: Callable[[], Mapping[str, Any]] | None = None  # one row for the slice read last; simulations only
    holding_ma: float = 0.0  # the current that holds the object stably; 0 if unknown
    slices: int = 0  # the most slices there can be; 0 if unknown. Simulations only, for the progress display
    slips_at_ma: float = nan  # at about this current the object slips away, which ends the trial early
    sampled: str = ""  # JSON of the parameters that a simulation sampled for this trial
    fall_factor: float = 1.0  # factor on the rate at which a ramp lowers the current
    sensor: Mapping[str, Any] = field(default_factory=dict)  # sensor properties that the camera itself does not report
    setup: Mapping[str, Any] = field(default_factory=dict)  # identity and settings of the devices; JSON
    simulated: bool = True  # the camera shows a simulation
    parents: tuple[dict[str, Any], ...] = ()  # headers of the files that the camera replays
    # processes that the devices need, such as the virtual devices at the other end of the wire
    peers: tuple[Peer, ...] = ()
    second: "SecondCamera | None" = None  # camera of the second finger; simulations only

    @property
    def watchdog_ms(self) -> float:
        """Time without commands, in ms, after which the gripper releases on its own; inf if unknown."""
        gripper = self.setup.get("gripper")
        return float(gripper.get("watchdog_ms", inf)) if isinstance(gripper, Mapping) else inf

    def known_sensor(self) -> dict[str, Any]:
        """Return all datasets of the sensor, from the camera and from `sensor`."""
        return {**self.camera.sensor, **self.sensor}

    def counted(self) -> dict[str, int]:
        """Return the losses so far, named camera.REASON and gripper.REASON."""
        by_name = [("camera", self.camera), ("gripper", self.gripper), *(("world", peer) for peer in self.peers)]
        return {
            f"{name}.{why}": count
            for name, device in by_name
            if device is not None
            for why, count in device.counted.items()
        }

    def close(self) -> None:
        """Close all devices, the gripper first, then the processes behind them.

        An error in one does not stop the others.
        """
        with ExitStack() as closing:
            second = None if self.second is None else self.second.camera
            for device in (*reversed(self.peers), second, self.camera, self.gripper):
                if device is not None:
                    closing.callback(device.close)
