"""A gripper that accepts every command and does not move."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from evetac_cli.devices import GripperReading
from evetac_cli.devices.grippers import Mode, NamedGripper
from evetac_cli.names import Capability

MOST_MA = 300


class StillGripper:
    """An open gripper: the fingers never move, and the current is the one commanded last."""

    counted: Mapping[str, int] = {}
    release_words = ""

    def __init__(self, most_ma: int) -> None:
        self.most_ma = most_ma
        self.current_ma = 0

    def read(self) -> GripperReading:
        """Return the measured current and position."""
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
        """Switch the torque off."""
        self.current_ma = 0
        self.release_words = "torque is off (it never was on)"


@dataclass(frozen=True)
class Still(NamedGripper):
    """The gripper as named on the command line: `still`. No hardware moves, so it needs neither HARDWARE nor --arm."""

    name = "still"
    capabilities = frozenset({Capability.MOVED})

    def open(self, mode: Mode, port: str, settings: Any = None) -> tuple[StillGripper, dict[str, Any]]:
        """Return the open gripper and the entries for the recording's header."""
        most_ma = settings.max_current_ma if settings is not None else None
        return StillGripper(most_ma or MOST_MA), {"name": self.name, "mode": mode}
