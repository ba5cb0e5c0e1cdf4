"""Two detectors combined, for a loop that reads the camera of the first finger: simulated, or on two recordings.

The first camera leads. At the end of each of its slices, the second detector has processed its own slices that had
ended by then, according to the offset between their clocks. In real time each detector has its own process instead, and
the controller merges their status (realtime/shared_status.py). The merging rule is the same:
kernels/grip/control.py.
"""

import math
from collections.abc import Callable
from typing import Any

from evetac_cli.devices import EventCamera
from evetac_cli.events import SLICE_US, Events
from evetac_cli.kernels.grip import control
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
        """camera: of the second finger; `seen` receives its slices.

        clock_offset_us: from time 0 of the first camera to time 0 of the second.
        """
        self._first, self._second = first, second
        self._camera, self._seen = camera, seen
        self._offset_us = clock_offset_us
        self._slices = self._second_slices = 0
        self._is_over = False  # whether the second camera has ended
        self.second_probability = math.nan

    @property
    def count(self) -> int:
        """The number of slices with an alarm so far, of both fingers."""
        return sum(each.count for each in (self._first, self._second) if each is not None)

    def step(self, events: Events) -> float:
        """Return the first finger's slip probability after one more slice.

        The second finger advances to the same time.
        """
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
        """Return a function that adds the second detector's probability to the first finger's rows.

        It then calls `append` with the events and the rows.
        """

        def both(events: Events, rows: dict[str, Any]) -> None:
            rows["control/second_probability"] = self.second_probability
            append(events, rows)

        return both

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Pass on the position read in a controller step, and the goal that the step set."""
        for each in (self._first, self._second):
            if each is not None:
                each.tell_gripper(position_ticks, goal_ticks)

    @property
    def signal(self) -> SlipSignal:
        """The signal to the controller after the last slice."""
        if self._first is None or self._second is None:
            return SlipSignal()
        return control.both_fingers(self._first.signal, self._second.signal)
