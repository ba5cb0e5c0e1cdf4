"""The loop of a grasp: read a slice, detect slip, and at the controller's rate read the gripper and command it.

The slices and rows go into a `TrialBuffer` in memory, because a simulated grasp can be repeated.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from evetac_cli.devices import EventCamera, GripperReading, Rig, gripper_row
from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, SLICES_PER_S, Events
from evetac_cli.kernels.grip.control import Control, SlipSignal, both_fingers
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim.setup.parts import Timer, untimed

if TYPE_CHECKING:
    from evetac_cli.trials.grasp.online_detector import OnlineSlipDetector


class SliceDetector(Protocol):
    """A slip detector: an `OnlineSlipDetector`, or a substitute for measurements."""

    def step(self, events: Events) -> float:
        """Return the slip probability after one more slice."""

    def tell_gripper(self, position_ticks: float, goal_ticks: float) -> None:
        """Pass on the position read in a controller step, and the goal that the step set."""

    @property
    def signal(self) -> SlipSignal:
        """The signal to the controller after the last slice."""


@dataclass(frozen=True)
class Timing:
    """The durations of the phases, in slices, and the timing of the controller.

    InputError if the controller's steps are not a whole number of slices apart.
    """

    touch_ms: int
    lift_ms: int
    balance_ms: int
    control_hz: float = 500.0
    latency_ms: int = 0  # from the detector's signal to its arrival at the controller

    def __post_init__(self) -> None:
        if SLICES_PER_S % self.control_hz:
            expected = "a rate that divides 1000, for example 50, 100, 250, 500, 1000"
            raise InputError(
                "slices end every millisecond", where="--control-hz", expected=expected, found=f"{self.control_hz:g}"
            )

    @property
    def every_ms(self) -> int:
        """Number of slices between steps of the controller."""
        return round(SLICES_PER_S / self.control_hz)

    @property
    def end_ms(self) -> int:
        """The end of a grasp that holds, in ms."""
        return self.touch_ms + self.lift_ms + self.balance_ms

    def phase(self, slice_: int) -> GraspPhase:
        """Return the grasp phase of a slice."""
        if slice_ < self.touch_ms:
            return GraspPhase.CONTACT
        return GraspPhase.LIFT if slice_ < self.touch_ms + self.lift_ms else GraspPhase.BALANCE


def control_row(
    control: Control, phase: GraspPhase, signal: SlipSignal, reading: GripperReading, goal: int, now_us: int
) -> dict[str, Any]:
    """Return the recorded row of a controller step: the columns of the gripper and of the control."""
    return {
        **gripper_row(now_us, reading),
        "control/t_us": now_us,
        "control/u_ff_ticks": control.u_ff_ticks,
        "control/x_ref_ticks": control.x_ref_ticks,
        "control/goal_ticks": goal,
        "control/slip": control.slip,
        "control/phase": phase,
        "control/mean_displacement_px": (signal.mean_displacement_x_px, signal.mean_displacement_y_px),
    }


def grasp_slices(
    devices: Rig, detector: SliceDetector | None, control: Control, timing: Timing, timer: Timer = untimed
) -> Iterator[tuple[Events, dict[str, Any]]]:
    """Read, detect and control until the scene has ended.

    Yield each slice with its rows. timer: measures the detector.
    """
    detect = None if detector is None else timer("slip detector", detector.step)
    gripper = devices.gripper
    assert gripper is not None
    every_ms = timing.every_ms
    signals: deque[SlipSignal] = deque([SlipSignal()] * timing.latency_ms, maxlen=timing.latency_ms + 1)
    slice_ = 0
    while (events := devices.camera.read()) is not None:
        rows: dict[str, Any] = dict(devices.truth()) if devices.truth else {}
        rows["control/probability"] = float("nan") if detect is None else detect(events)
        if detector is not None and (timing.latency_ms or slice_ % every_ms == 0):
            signals.append(detector.signal)
        if slice_ % every_ms == 0:
            signal = signals[0] if signals else SlipSignal()
            phase = timing.phase(slice_)
            reading = gripper.read()
            goal = control.step(phase, signal, reading.position_ticks)
            gripper.write_position(goal)
            if detector is not None:
                detector.tell_gripper(reading.position_ticks, goal)
            rows |= control_row(control, phase, signal, reading, goal, devices.camera.now_us())
        if isinstance(detector, TwoFingers):
            rows["control/second_probability"] = detector.second_probability
        yield events, rows
        slice_ += 1


class TwoFingers:
    """The detectors of both fingers, a `SliceDetector`; also without detectors, for a law that needs none.

    The loop reads the camera of the first finger: simulated, or a recording. At the end of each of its slices, the
    second detector has processed its own slices that had ended by then, according to the offset between their clocks.
    In real time each detector has its own process instead, and the controller merges their status
    (realtime/shared_status.py). The merging rule is the same: kernels/grip/control.py.
    """

    def __init__(
        self,
        first: "OnlineSlipDetector | None",
        second: "OnlineSlipDetector | None",
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
        return both_fingers(self._first.signal, self._second.signal)
