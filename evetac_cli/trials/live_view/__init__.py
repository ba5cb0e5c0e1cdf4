"""--live: a browser page that shows a recording while it is made.

The recording process passes slices and commands through shared memory, which takes some us, and never waits for the
view. The view is a separate process with the lowest priority (process.py).
"""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli import console
from evetac_cli.devices import losses
from evetac_cli.errors import DeviceError
from evetac_cli.events import Events
from evetac_cli.realtime.message_pipe import MessageWriter
from evetac_cli.realtime.processes import (
    ErrorText,
    exit_words,
    start_shielded,
    storing_error,
    wait_while_computing,
    with_reason,
)
from evetac_cli.trials.live_view.shared_view import Ended, GripperNumbers, Lost, Message, SharedView, Started, Title
from evetac_cli.trials.trial import Trial

if TYPE_CHECKING:
    from evetac_cli.trials.live_view.samples import OpenDetector

END_S = 3.0
MOST_BYTES = 1 << 20  # limit of messages that the view has not read yet
SETTLED_MS = 2000  # if a simulation falls this far behind real time, its pace is counted again from there


class LiveView:
    """The view of one recording, from the recorder's side; nothing here waits, and a failing view causes no error."""

    def __init__(self, title: Title, open_detector: "OpenDetector") -> None:
        """Start the view's process, and wait until it can be viewed; DeviceError if it does not start."""
        from evetac_cli.trials.live_view.process import run_view

        context = multiprocessing.get_context("spawn")
        self._shared = SharedView()
        inbox, outbox = context.Pipe(duplex=False)
        ready, ready_end = context.Pipe(duplex=False)
        self._messages = MessageWriter(outbox, MOST_BYTES)
        self._lost: tuple[str, str] | None = None
        self._missed = 0
        self._has_ended = self._death_reported = False
        self._moves = title.moves
        self._error_text = ErrorText()
        self._process = context.Process(
            target=storing_error,
            args=(self._error_text, run_view, title, self._shared, open_detector, inbox, ready_end),
            name="evetac-live-view",
            daemon=True,
        )
        start_shielded(self._process)
        inbox.close()
        ready_end.close()
        try:
            wait_while_computing(ready, self._process, "the live view did not start")
            self.url, self.url_once = ready.recv()
        except EOFError:
            how = exit_words(self._process, self._error_text)
            raise DeviceError(
                with_reason("the live view died while it started", how), hint="leave out --live"
            ) from None
        except BaseException:
            self._process.kill()
            raise
        finally:
            ready.close()

    def begin(self, sensor: Mapping[str, Any]) -> None:
        """Report that the camera runs; sensor: its datasets `sensor/...`, and other known ones."""
        datasets = {name: value for name, value in sensor.items() if name.startswith("sensor/")}
        self._send(Started(datasets))

    def add_slice(self, events: Events, late_us: float = float("nan"), probability: float = float("nan")) -> None:
        """Show one more slice; late_us: from its end until its arrival; probability: of slip, if the loop has one."""
        self._shared.add_slice(events, late_us, probability)

    def add_command(self, row: Mapping[str, Any]) -> None:
        """Show a command, given as a row of datasets `gripper/...` and `control/...`."""
        self._missed += int(row.get("control/missed", 0))
        self._shared.set_gripper(
            GripperNumbers(
                float(row["gripper/position_ticks"]),
                float(row.get("control/goal_ticks", "nan")),
                float(row["gripper/current_ma"]),
                float(row["gripper/current_target_ma"]),
                float(self._missed),
                float(row.get("control/phase", "nan")),
            )
        )

    def lost(self, counts: Mapping[str, int]) -> None:
        """Show the losses of devices so far, by DEVICE.REASON; called regularly, it also reports that the view died."""
        self._report_death()
        lost = losses.events_lost(counts)
        now = (lost if isinstance(lost, str) else f"{lost:,}", losses.reasons(counts) or "")
        if now != self._lost:
            self._lost = now
            self._send(Lost(*now))

    def say(self, text: str) -> None:
        """Show a message to the user, on the page and the terminal."""
        self._send(Message(text))
        console.say(text)

    @property
    def is_asked_to_let_go(self) -> bool:
        """Whether the user pressed the button."""
        return self._shared.is_asked_to_let_go

    def end(self, why: str) -> None:
        """Report why there will be no more slices, and end the process; a second call does nothing."""
        if self._has_ended:
            return
        self._report_death()
        self._has_ended = True
        self._send(Ended(why))
        with suppress(BrokenPipeError):
            self._messages.flush(END_S)
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _report_death(self) -> None:
        """Report once that the view has died, why, and the effect on its button."""
        if self._death_reported or self._has_ended or self._process.exitcode is None:
            return
        self._death_reported = True
        how = exit_words(self._process, self._error_text)
        button = ", so its button no longer works: Ctrl-C releases the gripper" if self._moves else ""
        console.say(f"{with_reason('the live view died', how)}{button}; the recording continues")

    def _send(self, message: Any) -> None:
        with suppress(BrokenPipeError):  # the view has gone, which does not end the recording
            self._messages.put(message)
            self._messages.send()


@contextmanager
def opened(trial: Trial, name: str, *, moves: bool) -> Iterator[LiveView | None]:
    """Yield the view of a trial, with its page announced, and opened if there is a display; or None.

    name: of the displayed trial; moves: whether a gripper moves that the button can release.
    """
    request = trial.view
    if request is None:
        yield None
        return
    # loads modules that a recording does not need
    from evetac_cli.realtime.local_server import announce
    from evetac_cli.trials.grasp.online_detector import open_view_detector

    title = Title(name, trial.shows_simulation, moves)
    view = LiveView(title, partial(open_view_detector, request.model, request.preset, request.threshold))
    ended = "ended"
    try:
        announce(view.url, view.url_once, "live view")
        yield view
    except BaseException as error:
        ended = str(error).splitlines()[0] if str(error) else "interrupted"
        raise
    finally:
        view.end(ended)


def shown_in_real_time(
    view: LiveView | None, append: Callable[[Events, dict[str, Any]], None]
) -> Callable[[Events, dict[str, Any]], None]:
    """Return a function that also shows the slices and rows of a simulation, no faster than in real time."""
    if view is None:
        return append
    slices, began_s = 0, time.monotonic()

    def show(events: Events, rows: dict[str, Any]) -> None:
        nonlocal slices, began_s
        append(events, rows)
        view.add_slice(events, probability=float(rows.get("control/probability", np.nan)))
        if "gripper/position_ticks" in rows:
            view.add_command(rows)
        slices += 1
        ahead_s = began_s + slices * 1e-3 - time.monotonic()
        if ahead_s > 0:
            time.sleep(ahead_s)
        elif ahead_s < -1e-3 * SETTLED_MS:
            began_s -= ahead_s

    return show
