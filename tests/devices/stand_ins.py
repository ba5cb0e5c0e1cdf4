"""Cameras and grippers of tests: all that is asked of a device, doing nothing; a test overrides what it is about."""

import math
from collections.abc import Mapping
from typing import Any

from evetac_cli.devices import GripperReading
from evetac_cli.events import SLICE_US, Events, empty
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource


class StillCamera:
    """A camera of empty slices without an end, which has lost nothing and knows no host time."""

    sensor: Mapping[str, Any] = {}
    counted: Mapping[str, int] = {}
    notes: tuple[str, ...] = ()
    time: TimeSource = HOST_TIME
    slices = 0  # so far

    def read(self) -> Events | None:
        self.slices += 1
        return empty()

    def now_us(self) -> int:
        return SLICE_US * self.slices

    def host_us(self, device_us: float) -> float:
        return math.nan

    def close(self) -> None:
        pass


class StillGripper:
    """A gripper whose fingers stay where they are, and which takes any command."""

    counted: Mapping[str, int] = {}
    release_words = ""

    def read(self) -> GripperReading:
        return GripperReading(0.0, 400)

    def write_current(self, current_ma: int) -> None:
        pass

    def write_position(self, goal_ticks: int) -> None:
        pass

    def emergency_open(self) -> None:
        self.close()

    def close(self) -> None:
        pass
