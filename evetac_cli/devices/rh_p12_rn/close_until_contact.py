"""Closing in current mode until the fingers touch something: a small current, and a position that no longer changes.

One step a command, so that whoever commands a gripper keeps its own pace. In the simulated drive 10 mA is just more
than the gear's friction: a tick takes 0.09 s; a driver by Evetac's authors closes at the same current.
"""

from dataclasses import dataclass

from evetac_cli.checks import check_range
from evetac_cli.errors import DeviceError


@dataclass(frozen=True)
class ClosingSettings:
    """Current (mA) and limits of closing; cycles are commands, 500 a second."""

    current_ma: int = 10
    still_cycles: int = 150  # without a new position: contact
    longest_cycles: int = 10_000
    last_tick: int = 717  # here the gap is 0 (sim/gripper.py), and the fingers met each other

    def __post_init__(self) -> None:
        for name in ("current_ma", "still_cycles", "longest_cycles"):
            check_range(name, getattr(self, name), 1)


class Closing:
    """Where closing stands: command `settings.current_ma`, and ask `step` of every reading."""

    def __init__(self, settings: ClosingSettings = ClosingSettings()) -> None:  # frozen: may be shared
        self.settings = settings
        self._cycles = self._still = 0
        self._furthest: int | None = None
        self.moved_ticks = 0  # 0 at contact: it touched from the start, or the current was too small to move it

    def step(self, position_ticks: int) -> bool:
        """Whether there is contact; DeviceError if the fingers met, or still move after longest_cycles."""
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
                "the gripper closed and met nothing",
                expected=f"something to touch before {settings.last_tick} ticks",
                found=f"{position_ticks} ticks",
                hint="put an object between the fingers",
            )
        if self._still >= settings.still_cycles:
            return True
        if self._cycles >= settings.longest_cycles:
            raise DeviceError(
                "the gripper still closes",
                expected=f"contact within {settings.longest_cycles} commands",
                found=f"{self.moved_ticks} ticks further, none touched",
                hint="open it less before, or close with more current",
            )
        return False
