"""What a robot's program requests of the recording thread, and what it is answered.

Requests arrive on a separate thread (request_server.py). They are answered from the last state that the recording
thread reported.
The recording thread looks here once per slice, which takes some us, and never waits for a request.
"""

import math
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from enum import StrEnum
from typing import Any

from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.store.recordings import streams
from evetac_cli.trials.session import ABORTED, STOPPED

NAME = re.compile("[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
# commands and their fields
COMMANDS = {"start": ("name",), "mark": ("text", "at_s"), "stop": (), "abort": (), "status": ()}
PATIENCE_S = 1.0  # how long to wait for the slice in which a trial was stopped, if the camera is late
READINGS = 3  # readings of two clocks: a thread may be paused between them
EARLY_S = 1e-3  # tolerance, because clocks are read one after the other
NOTHING = "nothing is being recorded"

Answer = dict[str, Any]


class State(StrEnum):
    """The state of the recording thread."""

    IDLE = "idle"
    STARTING = "starting"
    RECORDING = "recording"
    SAVING = "saving"


class Refusal(ValueError):
    """A request that cannot be granted; its text is the reason."""


class TrialRequests:
    """Takes requests (`ask`), and informs the recording thread of them; each method may be called from any thread."""

    def __init__(self, longest_s: float | None = None) -> None:
        """longest_s: the time after which an unstopped trial ends; None: no limit."""
        self._longest_s = longest_s
        self._lock = threading.Condition()
        self._state = State.IDLE
        self._name = ""
        self._slices = self._trials = 0
        self._last: Answer | None = None  # outcome of the latest start
        self._last_file: str | None = None
        self._starting: list[Future[Answer]] = []  # requests waiting for the first slice
        self._ending: list[Future[Answer]] = []  # requests waiting for the file
        self._why = ""  # why the trial should end
        self._end_slices = 0
        self._stopped_s = math.inf
        self._interrupted = False
        self._marks: list[tuple[int, str]] = []  # marks that were not fetched yet
        self._latest_us = 0  # time of the last mark
        self._now_s: Callable[[], float] = time.monotonic
        self._zero_us = math.nan  # when the recording began, by the same clock

    # Called by the server.

    def ask(self, request: Mapping[str, Any]) -> "Future[Answer]":
        """Return the answer to a request: at once, or when a trial has started or its file is complete."""
        received_s = time.monotonic()
        answered: Future[Answer] = Future()
        answered.set_running_or_notify_cancel()  # from here it cannot be cancelled
        try:
            command = request.get("command")
            if not isinstance(command, str) or command not in COMMANDS:
                raise Refusal(f"no such command: expected {', '.join(COMMANDS)}")
            fields = COMMANDS[command]
            extra = request.keys() - {"token", "command", *fields}
            if extra:
                raise Refusal(f"{command} has no {min(extra)!r}: expected {' and '.join(fields) or 'nothing more'}")
            with self._lock:
                getattr(self, f"_{command}")(request, received_s, answered)
        except Refusal as refusal:
            with self._lock:
                answered.set_result(self._answer(ok=False, error=str(refusal)))
        return answered

    def _start(self, request: Mapping[str, Any], received_s: float, answered: "Future[Answer]") -> None:
        name = request.get("name")
        if not isinstance(name, str) or not NAME.fullmatch(name) or name.endswith(".h5"):
            expected = "1 to 100 letters, digits, dots, _ and -, the first a letter or digit; no folder, no .h5"
            raise Refusal(f"not the name of a trial: expected {expected}")
        if self._state is not State.IDLE:
            raise Refusal(f"{self._name} is being recorded")
        self._state, self._name, self._slices, self._why = State.STARTING, name, 0, ""
        self._end_slices = 0
        self._marks, self._latest_us = [], 0
        self._zero_us = math.nan
        self._starting.append(answered)
        self._lock.notify_all()

    def _mark(self, request: Mapping[str, Any], received_s: float, answered: "Future[Answer]") -> None:
        text, at_s = request.get("text"), request.get("at_s", received_s)
        if not isinstance(text, str) or not text.isprintable() or not 0 < len(text.encode()) <= streams.MOST_MARK_BYTES:
            raise Refusal(f"not a mark: expected a text of 1 to {streams.MOST_MARK_BYTES} bytes without line ends")
        if isinstance(at_s, bool) or not isinstance(at_s, int | float):
            raise Refusal("not a time: expected at_s in s, by the monotonic clock of this computer")
        if self._state is not State.RECORDING or self._why:
            raise Refusal(NOTHING)
        t_us = self._time_us(received_s, at_s)
        if at_s > received_s + EARLY_S or t_us < 0:
            raise Refusal("the time of the mark is outside this trial: expected at_s by the monotonic clock")
        if t_us < self._latest_us - 1e6 * EARLY_S:
            raise Refusal(f"the previous mark is at {self._latest_us * 1e-6:.3f} s, this one at {t_us * 1e-6:.3f} s")
        self._latest_us = max(self._latest_us, int(t_us))
        self._marks.append((self._latest_us, text))
        answered.set_result(self._answer(slice=self._latest_us // SLICE_US, t_us=self._latest_us))

    def _stop(self, request: Mapping[str, Any], received_s: float, answered: "Future[Answer]") -> None:
        if self._state is State.IDLE:
            if self._last is None:
                raise Refusal(NOTHING)
            answered.set_result(self._answer(**self._last))
            return
        self._end(STOPPED, received_s)
        self._ending.append(answered)

    def _abort(self, request: Mapping[str, Any], received_s: float, answered: "Future[Answer]") -> None:
        if self._state is State.IDLE:
            raise Refusal(NOTHING)
        if self._state is State.SAVING:
            raise Refusal(f"too late: {self._name} is being saved")
        self._end(ABORTED, received_s)
        self._ending.append(answered)

    def _status(self, request: Mapping[str, Any], received_s: float, answered: "Future[Answer]") -> None:
        answered.set_result(self._answer())

    def _end(self, why: str, received_s: float) -> None:
        """End the trial once the present slice is recorded."""
        if self._why and why != ABORTED:
            return
        self._why = why
        t_us = self._time_us(received_s, received_s)
        self._end_slices = 0 if why == ABORTED or math.isnan(self._zero_us) else int(t_us) // SLICE_US + 1
        self._stopped_s = received_s

    def _time_us(self, received_s: float, at_s: float) -> float:
        """Return the recording's time of an instant on the monotonic clock; received_s: when the request arrived."""
        t_us = 1e6 * (min(at_s, received_s) + self._ahead_s()) - self._zero_us
        return float(SLICE_US * self._slices) if math.isnan(t_us) else t_us

    def _ahead_s(self) -> float:
        """Return how far the recording's clock is ahead of the monotonic one, from the quickest of a few readings."""
        readings = [(time.monotonic(), self._now_s(), time.monotonic()) for _ in range(READINGS)]
        before_s, now_s, after_s = min(readings, key=lambda each: each[2] - each[0])
        return now_s - 0.5 * (before_s + after_s)

    def _answer(self, *, ok: bool = True, **more: Any) -> Answer:
        state = {"state": self._state, "name": self._name, "slices": self._slices, "trials": self._trials}
        return {"ok": ok, **more, **state, "last": self._last_file}

    # Called by the recording thread.

    def wanted(self, wait_s: float = 0.0) -> str:
        """Return the name of the requested trial; "" if none is requested within this many seconds."""
        with self._lock:
            if self._state is State.IDLE and wait_s:
                self._lock.wait(wait_s)
            return self._name if self._state is State.STARTING else ""

    @property
    def end_reason(self) -> str:
        """Why the trial should end, or not start; "" if neither."""
        with self._lock:
            return self._why

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C or a similar signal came during a trial, so that no other may start."""
        return self._interrupted

    def record_signals(self, signals: Sequence[int]) -> None:
        """Record signals that came during a trial, which obeyed them or was ending anyway; 0 means none."""
        self._interrupted = self._interrupted or any(signals)

    def recorded(
        self, slices: int, now_s: Callable[[], float], zero_us: float, *, patience_s: float = PATIENCE_S
    ) -> str:
        """Record the number of slices so far; return why the trial should end, "" if it should not.

        now_s: a clock; zero_us: its time at the beginning of the recording, NaN if unknown; patience_s: how long to
        wait for the slice in which the trial was stopped.
        """
        with self._lock:
            self._slices, self._now_s, self._zero_us = slices, now_s, zero_us
            if self._state is State.STARTING:
                self._state = State.RECORDING
                _set(self._starting, self._answer())
            if self._longest_s is not None and slices >= SLICES_PER_S * self._longest_s and not self._why:
                return f"after {self._longest_s:g} s, because no stop command came"
            waits = slices < self._end_slices and time.monotonic() < self._stopped_s + patience_s
            if not self._why or waits:
                return ""
            return self._why

    def marked(self, *, last: bool = False) -> list[Mapping[str, Any]]:
        """Return the rows of marks since the last call. last: the trial is over, and there will be no more."""
        with self._lock:
            if last:
                self._state = State.SAVING
            taken, self._marks = self._marks, []
        return [streams.mark_row(t_us, text) for t_us, text in taken]

    def ended(self, file: str | None, ended: str, slices: int = 0, error: str = "") -> None:
        """Record the outcome of the trial, and answer the requests that wait for it.

        file: its file, None without one.
        """
        with self._lock:
            self._state = State.IDLE
            self._slices = slices
            self._trials += file is not None and not error
            self._last_file = file or self._last_file
            self._last = {"ok": not error, "file": file, "ended": ended, **({"error": error} if error else {})}
            answer = self._answer(**self._last)
            _set(self._starting, answer if error else self._answer(ok=False, error=ended, file=file))
            _set(self._ending, answer)


def _set(waiting: "list[Future[Answer]]", answer: Answer) -> None:
    """Answer all of them with this."""
    for one in waiting:
        one.set_result(answer)
    waiting.clear()
