"""The loop of a grasp: read a slice, detect slip, and at the controller's rate read the gripper and command it.

The slices and rows go into a `TrialBuffer` in memory, because a simulated grasp can be repeated.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from evetac_cli.devices import GripperReading, Rig, gripper_row
from evetac_cli.errors import InputError
from evetac_cli.events import SLICES_PER_S, Events
from evetac_cli.kernels.grip.control import Control, SlipSignal
from evetac_cli.kernels.grip.paper import GraspPhase
from evetac_cli.sim.parts import Timer, untimed


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
        yield events, rows
        slice_ += 1


def run_grasp(
    devices: Rig,
    detector: SliceDetector | None,
    control: Control,
    timing: Timing,
    append: Callable[[Events, dict[str, Any]], None],
    progress: Callable[[int], None],
    timer: Timer = untimed,
) -> int:
    """Pass each slice of a grasp and its rows to `append` until the scene has ended; return their number."""
    slices = 0
    for events, rows in grasp_slices(devices, detector, control, timing, timer):
        append(events, rows)
        slices += 1
        if slices % 100 == 0:
            progress(slices)
    return slices
