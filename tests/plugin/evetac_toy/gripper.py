"""A gripper that takes every command and stands still."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evetac_cli.devices import GripperReading
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.names import Capability

MOST_MA = 300


class StillGripper:
    """The open gripper: the fingers stay where they are, and the current is what was commanded last."""

    counted: Mapping[str, int] = {}
    release_words = ""

    def __init__(self, most_ma: int) -> None:
        self.most_ma = most_ma
        self.current_ma = 0

    def read(self) -> GripperReading:
        """Measured current and position."""
        return GripperReading(float(self.current_ma), 400)

    def write_current(self, current_ma: int) -> None:
        """Command a current."""
        self.current_ma = max(-self.most_ma, min(current_ma, self.most_ma))

    def write_position(self, goal_ticks: int) -> None:
        """Command a position."""

    def emergency_open(self) -> None:
        """Open the fingers, then let go."""
        self.close()

    def close(self) -> None:
        """Torque off."""
        self.current_ma = 0
        self.release_words = "torque is off (it never was on)"


@dataclass(frozen=True)
class Still(NamedGripper):
    """`still` on the command line. Nothing real moves here, so it has no HARDWARE and needs no --arm."""

    name = "still"
    capabilities = frozenset({Capability.MOVED})

    def open(self, mode: Mode, port: str, settings: Any = None) -> tuple[StillGripper, dict[str, Any]]:
        """The gripper, and what a header is to know of it."""
        most_ma = settings.max_current_ma if settings is not None else None
        return StillGripper(most_ma or MOST_MA), {"name": self.name, "mode": mode}
