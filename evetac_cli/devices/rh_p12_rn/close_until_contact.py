"""Close in current mode until the fingers touch something: a small current, until the position no longer changes.

One step per command, so the caller keeps its own pace. In the simulated drive, 10 mA is just more than the gear's
friction, and a tick takes 0.09 s. A driver by Evetac's authors closes at the same current.
"""

from dataclasses import dataclass

from evetac_cli.checks import check_range
from evetac_cli.errors import DeviceError


@dataclass(frozen=True)
class ClosingSettings:
    """Current (mA) and limits of closing; cycles are commands, 500 per second."""

    current_ma: int = 10
    still_cycles: int = 150  # cycles without a new position that count as contact
    longest_cycles: int = 10_000
    last_tick: int = 717  # the gap is 0 here (sim/gripper.py): the fingers touch each other

    def __post_init__(self) -> None:
        for name in ("current_ma", "still_cycles", "longest_cycles"):
            check_range(name, getattr(self, name), 1)


class Closing:
    """The state of closing: command `settings.current_ma`, and pass every reading to `step`."""

    def __init__(self, settings: ClosingSettings = ClosingSettings()) -> None:  # frozen: may be shared
        self.settings = settings
        self._cycles = self._still = 0
        self._furthest: int | None = None
        self.moved_ticks = 0  # 0 at contact: it touched from the start, or the current was too small to move it

    def step(self, position_ticks: int) -> bool:
        """Return whether there is contact.

        DeviceError if the fingers closed fully or still move after longest_cycles.
        """
        settings = self.settings
        if self._furthest is None:
            self._furthest = position_ticks
        self._cycles += 1
        self._still += 1
        if position_ticks > self._furthest:
            self.moved_ticks += position_ticks - self._furthest
            self._furthest = position_ticks
            self._still = 0
        if position_ticks >= settings.last_tick:
            raise DeviceError(
                "the gripper closed without contact",
                expected=f"contact before {settings.last_tick} ticks",
                found=f"{position_ticks} ticks",
                hint="put an object between the fingers",
            )
        if self._still >= settings.still_cycles:
            return True
        if self._cycles >= settings.longest_cycles:
            raise DeviceError(
                "the gripper is still closing",
                expected=f"contact within {settings.longest_cycles} commands",
                found=f"{self.moved_ticks} ticks of motion without contact",
                hint="open it less beforehand, or close with more current",
            )
        return False
