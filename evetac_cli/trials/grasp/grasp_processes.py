"""Start, supervise and end the processes of a real-time grasp; this module runs in the recorder, which is their parent.

There is one controller, and one detector per finger with a camera, so that each has a core of its own. If the
controller has died or hangs, the recorder ends it, switches torque off and reads it back.
"""

import contextlib
import math
import multiprocessing
import select
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, TypeVar

from evetac_cli.devices.plugin_devices import release_gripper
from evetac_cli.errors import DeviceError
from evetac_cli.interrupts import signals_held
from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.realtime.processes import ErrorText, exit_words, start_shielded, storing_error
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.trials.grasp import controller_process, detector_process
from evetac_cli.trials.grasp.controller_process import ControllerEnded, ControllerSettings, GripperReady
from evetac_cli.trials.grasp.detector_process import CameraReady, DetectorEnded, DetectorSettings
from evetac_cli.trials.session import HANGS_S, HANGS_WATCHDOGS, OPENING_S

if TYPE_CHECKING:
    from evetac_cli.devices.virtual.world import VirtualWorld

LOAD_S = 120.0  # limit for detector and controller to be ready, including compilation
OPEN_S = 30.0  # limit for the camera to run
END_S = 3.0
POLL_S = 0.05
_T = TypeVar("_T")


class GraspProcesses:
    """Detectors and controller, each in its own process; closing them switches torque off."""

    def __init__(
        self, detectors: Sequence[DetectorSettings], controller: ControllerSettings, world: "VirtualWorld | None"
    ) -> None:
        """Start all processes, with one detector per finger; they load, and wait for `begin`."""
        context = multiprocessing.get_context("spawn")
        self.status = SharedStatus(len(detectors))
        self._settings = controller
        self.now_s = controller.time.now_s
        self._hangs_us = 1e6 * max(HANGS_S, HANGS_WATCHDOGS * 1e-3 * controller.watchdog_ms)
        self._began_us = math.inf
        self._orders: list[Connection] = []  # pipes to the detectors
        theirs: list[Connection] = []
        readers: list[MessageReader] = []
        detector_ends: list[Connection] = []
        started: list[BaseProcess] = []
        self._error_texts: list[ErrorText] = []  # that ended the detectors and the controller
        for settings in detectors:
            of = "-second" if settings.finger else ""
            order, ours = context.Pipe(duplex=False)
            slices, slices_end = context.Pipe(duplex=False)
            detector_end, alive = context.Pipe(duplex=False)  # nothing is sent on it: it closes when the detector ends
            self._orders.append(ours)
            readers.append(MessageReader(slices))
            self._error_texts.append(ErrorText())
            view = None if world is None else world.seen_by(settings.finger)
            started.append(
                context.Process(
                    target=storing_error,
                    args=(
                        *(self._error_texts[-1], detector_process.run_detector),
                        *(settings, self.status, view, order, slices_end, alive),
                    ),
                    name=f"evetac-detector{of}",
                )
            )
            detector_ends.append(detector_end)
            theirs += [order, slices_end, alive]
        order, self._to_controller = context.Pipe(duplex=False)
        steps, steps_end = context.Pipe(duplex=False)
        self._error_texts.append(ErrorText())
        self.controller = context.Process(
            target=storing_error,
            args=(
                *(self._error_texts[-1], controller_process.run_controller),
                *(controller, self.status, order, steps_end, detector_ends),
            ),
            name="evetac-controller",
        )
        self.slices, self.steps = tuple(readers), MessageReader(steps)
        self.detectors: tuple[BaseProcess, ...] = tuple(started)
        for process in (*self.detectors, self.controller):
            process.daemon = True
            start_shielded(process)
        # Close the recorder's copies of their ends; otherwise a pipe would not close with the process at its other end.
        for end in (*theirs, *detector_ends, order, steps_end):
            end.close()

    def begin(self, signals: list[int]) -> tuple[tuple[CameraReady, ...], GripperReady]:
        """Open the gripper once all detectors have loaded, then the cameras; return what they report.

        EvetacError if one fails. Nothing moves before `go`. signals: grows when Ctrl-C is pressed.
        """
        both = tuple(zip(self.slices, self.detectors, strict=True))
        for slices, detector in both:
            self._wait_for(str, slices, detector, LOAD_S, signals)
        _order((self._to_controller,), "begin")
        gripper = self._wait_for(GripperReady, self.steps, self.controller, LOAD_S, signals)
        _order(self._orders, "begin")
        return tuple(self._wait_for(CameraReady, *each, OPEN_S, signals) for each in both), gripper

    def go(self) -> None:
        """Start the detectors, after which the controller moves the gripper; from here it needs signs of life."""
        self.give_sign_of_life()
        self._began_us = self.now_s() * 1e6
        _order(self._orders, "go")

    def give_sign_of_life(self) -> None:
        """Report that the supervising loop is alive."""
        self.status.recorder_lives(self.now_s() * 1e6)

    def end_hanging_controller(self) -> str:
        """Kill a controller that gives no sign of life; return a sentence on that, or "" if it is alive."""
        patience_us = self._hangs_us + 1e6 * OPENING_S * self.status.opening
        silent_us = self.now_s() * 1e6 - max(self.status.controller_us, self._began_us)
        if not silent_us > patience_us:
            return ""
        self.controller.kill()
        return f"the controller hangs: no sign of life for {silent_us * 1e-6:.1f} s"

    def switch_off(self) -> str:
        """Switch torque off after the controller ended without reporting its state; return what was read back.

        The port is free once the process has ended.
        """
        self.controller.kill()
        self.controller.join(END_S)
        return release_gripper(self._settings.gripper, self._settings.port, self._settings.driver)

    def _wait_for(self, kind: type[_T], inbox: MessageReader, process: Any, most_s: float, signals: list[int]) -> _T:
        """Return the first message of a kind; raise any error that occurs before it arrives."""
        until_s = time.monotonic() + most_s
        while time.monotonic() < until_s and not signals:
            select.select([inbox], [], [], POLL_S)
            for message in inbox.take():
                if isinstance(message, kind):
                    return message
                if isinstance(message, (DetectorEnded, ControllerEnded)) and message.error is not None:
                    raise message.error
            if inbox.ended:
                torque = f"; {self.switch_off()}" if process is self.controller else ""
                raise DeviceError(f"{process.name} died while it started{torque}", found=self.exit_words(process))
        if signals:
            raise KeyboardInterrupt("interrupted: nothing was recorded")
        raise DeviceError(f"{process.name} did not start", expected=f"within {most_s:g} s")

    def exit_words(self, process: Any) -> str:
        """Return how one of the processes ended; "" if it has not ended within a second."""
        return exit_words(process, self._error_texts[(*self.detectors, self.controller).index(process)])

    def close(self) -> None:
        """End all processes; afterwards torque is off, or the servo's watchdog stops the motor.

        Signals wait until then.
        """
        with signals_held():
            self._close()

    def _close(self) -> None:
        self.status.stop()
        for orders in (*self._orders, self._to_controller):
            orders.close()
        for process in (self.controller, *self.detectors):
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()

    def torque_words(self) -> str:
        """Return the torque state after all processes were closed, for a caller that aborts the recording."""
        ended = [message for message in self.steps.take() if isinstance(message, ControllerEnded)]
        return ended[-1].torque if ended else self.switch_off()


def _order(whom: Sequence[Connection], order: str) -> None:
    for each in whom:
        with contextlib.suppress(OSError):  # the process has died, which the code that waits for its answer detects
            each.send(order)
