"""Two detectors as one, for a loop that reads the camera of the first finger: simulated, or on two recordings.

The first camera leads. At the end of each of its slices the second detector has seen those slices of its own that had
ended by then, as the offset of their clocks says. In real time each detector has a process of its own instead, and the
controller merges what they publish (realtime/shared_status.py); how, is the same: kernels/grip/two_fingers.py.
"""

import math
from collections.abc import Callable
from typing import Any

from evetac_cli.devices import EventCamera
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.grip import two_fingers
from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector


class TwoFingers:
    """The detectors of both fingers, a `SliceDetector`; also without detectors, for a law that needs none."""

    def __init__(
        self,
        first: OnlineSlipDetector | None,
        second: OnlineSlipDetector | None,
        camera: EventCamera,
        seen: Callable[[Events], None] = lambda _: None,
        clock_offset_us: float = 0.0,
    ) -> None:
        """camera: of the second finger, whose slices `seen` gets.

        clock_offset_us: from time 0 of the first camera to time 0 of the second.
        """
        self._first, self._second = first, second
        self._camera, self._seen = camera, seen
        self._offset_us = clock_offset_us
        self._slices = self._second_slices = 0
        self._is_over = False  # the second camera
        self.second_probability = math.nan

    @property
    def count(self) -> int:
        """Slices that alarmed so far, of both."""
        return sum(each.count for each in (self._first, self._second) if each is not None)

    def step(self, events: Events) -> float:
        """Slip probability of the first finger after one more slice; the second finger comes as far."""
        probability = math.nan if self._first is None else self._first.step(events)
        self._slices += 1
        while not self._is_over and (self._second_slices + 1 - self._slices) * SLICE_US + self._offset_us <= 0.0:
            self._step_second()
        return probability

    def _step_second(self) -> None:
        events = self._camera.read()
        if events is None:
            self._is_over = True
            return
        self._second_slices += 1
        self._seen(events)
        if self._second is not None:
            self.second_probability = self._second.step(events)

    def recorded_by(self, append: Callable[[Events, dict[str, Any]], None]) -> Callable[[Events, dict[str, Any]], None]:
        """What takes the slices of the first finger and their rows, with what the second detector says beside it."""

        def both(events: Events, rows: dict[str, Any]) -> None:
            rows["control/second_probability"] = self.second_probability
            append(events, rows)

        return both

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Where the fingers were read in a step of the controller, and the goal that it gave them."""
        for each in (self._first, self._second):
            if each is not None:
                each.tell_gripper(position_ticks, goal_ticks)

    @property
    def signal(self) -> SlipSignal:
        """What the controller gets to know after the last slice."""
        if self._first is None or self._second is None:
            return SlipSignal()
        return two_fingers.both(self._first.signal, self._second.signal)
