"""The motor current that a gripper follows over time, where a scene names one instead of closing, holding and ramping.

A line through points, and on top of it, for a while, a square wave: its steps show how late commands take effect.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Square:
    """A square wave: every so many ms the current falls by by_ma, or rises by it again."""

    from_s: float
    to_s: float
    every_ms: int
    by_ma: float


@dataclass(frozen=True)
class CurrentCourse:
    """Current in mA at times in s, linear in between, with a square wave if there is one."""

    at_s: tuple[float, ...]
    current_ma: tuple[float, ...]
    square: Square | None = None

    @classmethod
    def read(cls, scene: Mapping[str, Any]) -> "CurrentCourse | None":
        """As a scene's gripper.current says; None where it names none."""
        named = scene.get("gripper", {}).get("current")
        if named is None:
            return None
        square = None if "square" not in named else Square(**named["square"])
        return cls(tuple(named["at_s"]), tuple(named["ma"]), square)

    @property
    def ends_s(self) -> float:
        """When the last point is reached."""
        return self.at_s[-1]

    def at(self, time_s: float) -> float:
        """The current at a time; that of the first and the last point before and after them."""
        current_ma = float(np.interp(time_s, self.at_s, self.current_ma))
        square = self.square
        if square is not None and square.from_s <= time_s < square.to_s:
            current_ma -= square.by_ma * (int((time_s - square.from_s) * 1e3 + 1e-6) // square.every_ms % 2)
        return current_ma
