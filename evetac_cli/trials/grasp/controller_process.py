"""The controller's process of a grasp in real time: every 2 ms it reads the gripper and the detector, and commands.

Deadlines are absolute (deadlines.py): a late step does not move the following ones, and a missed one is counted, not
made up for. New slip between two steps is answered at once.

However the grasp ends, torque is switched off and read back; only the emergency key opens the fingers. Failures, and
the process that detects each:

- The bus fails: this process switches torque off.
- A detector publishes no status, or a camera sends no event, for FRESH of the watchdog's time: this process switches
  torque off. With two fingers, one such fault is enough.
- The recorder, the parent of all processes, gives no sign of life for FRESH of the watchdog's time, or RECORDER_MS if
  longer. This process ends the grasp if the recorder was stopped or killed. A recorder that only waits for a core has
  RECORDER_LATE_MS; the detector buffers its data meanwhile.
- This process dies: the servo notices, because only the commands of this loop keep its Bus Watchdog from tripping.
- This process was stopped for longer than the watchdog's time: it switches torque off before it commands again.

A camera without any events is broken or unplugged, not idle: sensor noise alone causes events in every slice, even at
rest.
"""

import contextlib
import gc
import math
import os
import signal
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from evetac_cli import console
from evetac_cli.devices import Gripper
from evetac_cli.devices.grippers import NamedGripper
from evetac_cli.devices.plugin_devices import open_gripper
from evetac_cli.devices.rh_p12_rn.driver import RhP12RnSettings
from evetac_cli.errors import DeviceError, EvetacError
from evetac_cli.events import SLICE_US
from evetac_cli.interrupts import ignore_interrupts, remember_signals
from evetac_cli.kernels.grip.control import Control, Law
from evetac_cli.realtime.message_pipe import FLUSH_S, LAST_FLUSH_S, ORDER_S, MessageWriter, PeerGone, take_order
from evetac_cli.realtime.processes import error_words, raise_if_ended, set_realtime_priority, stands_still
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource
from evetac_cli.trials.grasp.deadlines import Deadlines, EarlyAnswer, early_columns, shift_us
from evetac_cli.trials.grasp.loop import Timing, control_row
from evetac_cli.trials.session import FRESH, OPENED, OVERLOADED, RECORDER_LATE_MS, RECORDER_MS

PRIORITY = 30
BATCH_STEPS = 25  # number of steps whose rows are sent to the recorder at once
COMMAND_BYTES = 19  # bytes of a goal position on the wire, 10 bits each
FROZEN_US = 10_000.0  # a step later than due by this much was stopped, or waited for an answer
DYING_S = 0.5
FIRST_STATUS_S = 30.0  # limit for the camera to be found and send its first slice
WAITING_S = 0.01
OVER = "the grasp is over"
DETECTOR = "the detector"
OF_FINGER = " of the first finger", " of the second finger"
RECORDER_HANGS = "the recorder hangs"
STOPPED = "stopped"
TOO_LONG = "the time allowed is over"


@dataclass(frozen=True)
class ControllerSettings:
    """The settings of the controller's process, which are sent to it."""

    gripper: NamedGripper
    port: str
    driver: RhP12RnSettings
    law: Law
    timing: Timing
    watchdog_ms: int
    most_s: float  # longest duration of the grasp, independent of the camera's clock
    time: TimeSource = HOST_TIME  # time source of the controller
    controller: str = ""  # name of the controller, for errors


class GripperReady(NamedTuple):
    """The gripper is set up, without torque until its first command."""

    setup: dict[str, Any]
    scheduling: str


class ControllerEnded(NamedTuple):
    """The end of the controller's commands, and the reason."""

    ended: str
    error: Exception | None  # the error, if the end was not intended
    steps: int
    missed: int  # number of missed deadlines
    seconds: float  # from the first step to the last
    cycle_us: "array[float]"  # duration of every step, from its beginning to the end of its command
    alive_us: float  # last event of the camera if it is silent, otherwise last status; NaN if the bus failed
    released_us: float  # time at which torque was off; NaN if unknown
    counted: dict[str, int]
    torque: str = "torque was never on"  # sentence on the torque state that was read back
    missed_by_gripper: int = 0  # missed deadlines because the gripper's answers were late


class FaultDetector:
    """Detects a dead or hanging detector or recorder, and a silent camera.

    A busy computer stops all of its processes now and then. So silence is counted from the time at which the controller
    itself was awake again, and a process that was stopped with it gets that much more time. The extra time is limited
    to the same length, because otherwise a controller that is late at every step would detect nothing.
    """

    def __init__(
        self,
        watchdog_ms: float,
        has_ended: Callable[[int], bool] = lambda finger: False,
        recorder_stopped: Callable[[], bool] = lambda: True,
    ) -> None:
        """has_ended: returns whether the process of a finger's detector has ended, without waiting.

        recorder_stopped: called once the recorder is silent; returns whether it was stopped, and does not just wait for
        a core.
        """
        self._fresh_us = 1e3 * FRESH * watchdog_ms
        self._recorder_us = max(self._fresh_us, 1e3 * RECORDER_MS)
        self._late_us = max(self._recorder_us, 1e3 * RECORDER_LATE_MS)
        self._has_ended, self._recorder_stopped = has_ended, recorder_stopped
        self._awake_us = -math.inf

    def slept_until(self, now_us: float) -> None:
        """Record that the controller was stopped until now."""
        self._awake_us = now_us

    def fault(self, status: DetectorStatus, recorder_us: float, now_us: float) -> tuple[str, float]:
        """Return the fault, or "" for none, and when the faulty part was last alive.

        recorder_us: when the recorder was last alive. With two fingers, the first one with a fault is named.
        """
        for finger, each in enumerate(status.fingers):
            of = "" if status.second is None else OF_FINGER[finger]
            if self._has_ended(finger):
                return f"{DETECTOR}{of} died", each.at_us
            for what, alive_us, most_us in (
                (f"{DETECTOR}{of} hangs: no sign of life", each.at_us, self._fresh_us),
                (f"the camera{of} is silent: not a single event", each.last_event_us, self._fresh_us),
            ):
                if self._is_silent(alive_us, most_us, now_us):
                    return f"{what} for {(now_us - alive_us) * 1e-3:.0f} ms", alive_us
        silent_us = now_us - recorder_us
        if self._is_silent(recorder_us, self._recorder_us, now_us) and (
            silent_us > self._late_us or self._recorder_stopped()
        ):
            return f"{RECORDER_HANGS}: no sign of life for {silent_us * 1e-3:.0f} ms", recorder_us
        return "", status.at_us

    def _is_silent(self, alive_us: float, most_us: float, now_us: float) -> bool:
        silent_us = now_us - alive_us
        return silent_us > 2 * most_us or min(silent_us, now_us - self._awake_us) > most_us


def run_controller(
    settings: ControllerSettings,
    shared: SharedStatus,
    orders: Connection,
    pipe: Connection,
    detectors: Sequence[Connection],
) -> None:
    """Run the controller's process: wait for an order, open the gripper, command until the end, torque off, report why.

    detectors: for each finger, the end of a pipe whose other end only its detector holds, so that it closes with the
    detector.
    """
    ignore_interrupts()  # Ctrl-C is for the recorder, which then stops this process
    ending = remember_signals()
    recorder = os.getppid()
    outbox = MessageWriter(pipe)
    result = ControllerEnded(STOPPED, None, 0, 0, 0.0, array("d"), math.nan, math.nan, {})
    gripper: Gripper | None = None
    try:
        while not take_order(orders, ORDER_S):
            raise_if_ended("the controller", ending)
        scheduling = set_realtime_priority(PRIORITY)
        gripper, setup = open_gripper(settings.gripper, "position", settings.port, settings.driver)
        assert gripper is not None
        with contextlib.closing(gripper):
            outbox.put(GripperReady(setup, scheduling))
            outbox.flush(FLUSH_S)
            gc.collect()
            gc.freeze()
            gc.disable()  # the loop creates no reference cycles
            has_ended = [detector.poll for detector in detectors]
            faults = FaultDetector(
                settings.watchdog_ms, lambda finger: has_ended[finger](), lambda: stands_still(recorder)
            )
            result = command_grasp(gripper, shared, settings, outbox, faults, ending)
    except PeerGone:  # the process that started this has gone, or asked this one to end
        result = result._replace(torque=result.torque if gripper is None else gripper.release_words)
        _speak_for_recorder(result, died=_has_died(recorder))
        return
    except EvetacError as error:
        result = result._replace(ended=str(error).splitlines()[0], error=error)
    except BaseException as error:  # the process that started this raises it
        torque = result.torque if gripper is None else gripper.release_words
        failed = DeviceError(f"the controller failed: {error_words(error)}; {torque}")
        result = result._replace(ended=str(failed), error=failed, torque=torque)
    _speak_for_recorder(result, died=os.getppid() != recorder)
    outbox.put(result)
    with contextlib.suppress(PeerGone):
        outbox.flush(LAST_FLUSH_S)


def _has_died(parent: int) -> bool:
    """Return whether the parent died, given that its end of a pipe is closed.

    A dying process closes it a little earlier.
    """
    until_s = time.monotonic() + DYING_S
    while os.getppid() == parent and time.monotonic() < until_s:
        time.sleep(WAITING_S)
    return os.getppid() != parent


def _speak_for_recorder(result: ControllerEnded, *, died: bool) -> None:
    """Report the torque state to the user if the recorder cannot, or not now."""
    with contextlib.suppress(OSError):  # there may be no terminal any more
        if died:
            kept = "`evetac validate --repair` completes the recording up to then"
            console.say(f"error: the recorder died; {result.torque}; {kept}")
        elif RECORDER_HANGS in result.ended:
            console.say(f"error: {result.ended}; {result.torque}")


def command_grasp(
    gripper: Gripper,
    shared: SharedStatus,
    settings: ControllerSettings,
    outbox: MessageWriter,
    faults: FaultDetector | None = None,
    ending: Sequence[int] = (),
) -> ControllerEnded:
    """Command until the grasp is over, an order to stop or open arrives, or something fails; then switch torque off.

    faults: supervises detector, camera and recorder; ending: signals received by this process.
    """
    result = ControllerEnded(STOPPED, None, 0, 0, 0.0, array("d"), math.nan, math.nan, {})
    try:
        if _wait_for_status(shared, settings.time, ending):
            faults = faults or FaultDetector(settings.watchdog_ms)
            result = _command(gripper, shared, settings, outbox, faults, ending)
        if result.ended == OPENED:
            gripper.emergency_open()
        gripper.close()  # without effect if the driver has already released the gripper
    except DeviceError as failed:
        with contextlib.suppress(DeviceError):  # release_words report the failure
            gripper.close()
        # another fault may have ended the grasp before it
        first = result.error if result.error is not None else failed
        result = result._replace(ended=str(first).splitlines()[0], error=first, alive_us=math.nan)
    torque = gripper.release_words
    error = result.error
    if isinstance(error, EvetacError) and torque not in str(error):
        error.message += f"; {torque}"
    bus_failed = error is not None and math.isnan(result.alive_us)  # the error reports whether torque is off
    released_us = math.nan if bus_failed else settings.time.now_s() * 1e6
    return result._replace(released_us=released_us, counted=dict(gripper.counted), torque=torque)


def _command(
    gripper: Gripper,
    shared: SharedStatus,
    settings: ControllerSettings,
    outbox: MessageWriter,
    faults: FaultDetector,
    ending: Sequence[int],
) -> ControllerEnded:
    """Run the loop; its result does not contain yet when torque was off."""
    timing, clock = settings.timing, settings.time.now_s
    control = Control(settings.law, timing.control_hz, settings.controller)
    control.copy()  # early answers need copies: fail before there is torque
    wire_us = COMMAND_BYTES * 1e7 / settings.gripper.baud
    early = EarlyAnswer(
        *(gripper, shared, timing, wire_us * 1e-6, settings.time),
        may_write=lambda: not (shared.stopping or shared.opening or ending),
    )
    deadlines = Deadlines(1.0 / timing.control_hz, clock, early.sleep)
    parent = os.getppid()
    cycle_us = array("d")
    rows: list[dict[str, Any]] = []
    ended, alive_us = "", math.nan
    error: EvetacError | None = None
    began_s = begun_s = last_s = clock()
    missed_before = 0
    seen_slips = [0, 0]  # number of known slices with slip per finger
    # time on the bus: excess of the last step over the shortest step; the shortest step
    waited_s, least_s = 0.0, math.inf
    while True:
        try:
            late_us = deadlines.wait(waited_s)
            begun_s = clock()
            reading = gripper.read()
            read_s = clock()
            now_us = read_s * 1e6
            status = shared.latest()
            assert status is not None
            if now_us - begun_s * 1e6 + late_us > FROZEN_US:
                faults.slept_until(now_us)
            deadlines.shift(shift_us(now_us - status.at_us))
            slice_ = max(int(now_us - status.zero_us) // SLICE_US, 0)
            shared.controller_lives(now_us)
            fault, alive_us = faults.fault(status, shared.recorder_us, now_us)
            if slice_ >= timing.end_ms:
                ended = OVER
            elif shared.opening:
                ended = OPENED
            elif shared.stopping or os.getppid() != parent:
                ended = STOPPED
            elif begun_s > began_s + settings.most_s:
                ended = TOO_LONG
            elif fault:
                ended, error = fault, DeviceError(fault, hint=OVERLOADED if "hangs" in fault else "")
            elif ending:
                ended = f"the controller was ended by {signal.Signals(ending[0]).name}"
                error = DeviceError(ended)
            if ended:
                break
            phase = timing.phase(slice_)
            slip_signal = status.control_signal
            goal = control.step(phase, slip_signal, reading.position_ticks)
            decided_s = clock()
            silent_ms = (decided_s - last_s) * 1e3
            # the servo's watchdog has stopped the motor, which must not grip again
            if silent_ms > settings.watchdog_ms:
                ended, alive_us = f"the controller was stopped for {silent_ms:.0f} ms", last_s * 1e6
                error = DeviceError(ended, hint=OVERLOADED)
                break
            gripper.write_position(goal)
        except DeviceError as failed:
            ended, error, alive_us = str(failed).splitlines()[0], failed, math.nan
            break
        except EvetacError as failed:  # raised by a plug-in's law
            ended, error, alive_us = str(failed).splitlines()[0], failed, begun_s * 1e6
            break
        last_s = clock()
        shared.tell_gripper(reading.position_ticks, goal)
        cycle_us.append((last_s - begun_s) * 1e6)
        on_bus_s = read_s - begun_s + last_s - decided_s
        least_s = min(least_s, on_bus_s)
        waited_s = on_bus_s - least_s
        row = control_row(control, phase, slip_signal, reading, goal, round(now_us - status.zero_us))
        row["control/late_us"] = late_us
        row["control/missed"] = deadlines.missed - missed_before
        row["control/slices_processed"] = status.slices
        if status.second is not None:
            row["control/second_slices_processed"] = status.second.slices
        row |= early_columns(early.written, len(status.fingers))
        answered_s = last_s if math.isnan(early.written.done_s) else early.written.done_s
        row["control/latency_us"] = answered_s * 1e6 + wire_us - _slip_began_us(status, seen_slips)
        missed_before, seen_slips = deadlines.missed, [each.signal.slips for each in status.fingers]
        early.after_step(control, phase, reading.position_ticks, slip_signal.slips)
        rows.append(row)
        if len(rows) >= BATCH_STEPS:
            outbox.put(rows)
            outbox.send()
            rows = []
    outbox.put(rows)
    seconds = last_s - began_s
    result = ControllerEnded(ended, error, len(cycle_us), deadlines.missed, seconds, cycle_us, alive_us, math.nan, {})
    return result._replace(missed_by_gripper=deadlines.missed_by_gripper)


def _slip_began_us(status: DetectorStatus, seen: Sequence[int]) -> float:
    """Return the time of the first event of the earliest new slice with slip, of any finger; NaN if there is none.

    seen: number of known slices with slip per finger.
    """
    began_us = [each.slip_began_us(slips) for each, slips in zip(status.fingers, seen, strict=False)]
    return min((each for each in began_us if not math.isnan(each)), default=math.nan)


def _wait_for_status(shared: SharedStatus, time: TimeSource, ending: Sequence[int]) -> bool:
    """Wait until the detector has evaluated a first slice; return False if it was stopped before.

    There is no torque yet.
    """
    until_s = time.now_s() + FIRST_STATUS_S
    parent = os.getppid()
    while shared.latest() is None:
        shared.controller_lives(time.now_s() * 1e6)
        if shared.stopping or os.getppid() != parent:
            return False
        raise_if_ended("the controller", ending)
        if time.now_s() > until_s:
            raise DeviceError(f"{DETECTOR} did not start", expected=f"a first slice within {FIRST_STATUS_S:g} s")
        time.sleep(WAITING_S)
    return True
