"""A process of a grasp that ends before its time says why: no death is told as "exit code 0"."""

import itertools
import multiprocessing
import os
import signal
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evetac_cli.devices.cameras import NamedCamera, OpenedCamera
from evetac_cli.errors import DeviceError
from evetac_cli.events import Events, empty
from evetac_cli.realtime.message_pipe import MessageReader, MessageWriter
from evetac_cli.realtime.processes import ErrorText, exit_words, storing_error
from evetac_cli.realtime.shared_status import SharedStatus
from evetac_cli.trials.grasp import recorder
from evetac_cli.trials.grasp.controller_process import ControllerEnded
from evetac_cli.trials.grasp.detector_process import DetectorEnded, DetectorSettings, SliceBatch, joined, run_detector
from evetac_cli.trials.grasp.recorded_grasp import RecordedGrasp
from evetac_cli.trials.session import OVERLOADED
from tests.devices.stand_ins import StillCamera
from tests.quick import few

GOOD_SLICES = 20
PATIENCE_S = 60.0


class Camera(StillCamera):
    """Empty slices, and then what a test wants."""

    sensor: dict[str, Any] = {"sensor/frame_px": (640, 480)}
    counted = {"late_events": 3}

    def __init__(self, then: Callable[[], None]) -> None:
        self._then, self._slices = then, 0

    def read(self) -> Events | None:
        self._slices += 1
        if self._slices > GOOD_SLICES:
            self._then()
        return empty()

    def now_us(self) -> int:
        return 1000 * self._slices

    def close(self) -> None:
        pass


@dataclass(frozen=True)
class Failing(NamedCamera):
    """A camera that fails when it is opened, or later; a process of its own can be given it."""

    name = "failing"
    fault: str = ""
    opens: bool = True

    def open(self, *_: Any) -> OpenedCamera:
        if not self.opens:
            FAULTS[self.fault]()
        return OpenedCamera(Camera(FAULTS[self.fault]), {})


def raises(error: BaseException) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


class Local(Exception):
    """An error that another process cannot be given."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


FAULTS: dict[str, Callable[[], None]] = {
    "EOFError": raises(EOFError()),
    "BrokenPipeError": raises(BrokenPipeError(32, "Broken pipe")),
    "ConnectionResetError": raises(ConnectionResetError(104, "Connection reset by peer")),
    "SystemExit: 0": raises(SystemExit(0)),
    "MemoryError": raises(MemoryError()),
    "Local: 1 and 2": raises(Local(1, 2)),
    "the process of the virtual world died": raises(DeviceError("the process of the virtual world died")),
    "KeyError: 'gel'": lambda: {}["gel"],
}


def started(fault: str, *, opens: bool = True) -> tuple[Any, MessageReader, list[Any]]:
    """The detector's process with a failing camera, told to begin and to go on; what it sends, what must stay open."""
    context = multiprocessing.get_context("spawn")
    theirs, orders = context.Pipe(duplex=False)
    slices, slices_end = context.Pipe(duplex=False)
    ended, alive = context.Pipe(duplex=False)
    seeds = np.random.SeedSequence(0)
    settings = DetectorSettings(Failing(fault=fault, opens=opens), seeds, {}, None, 10_000)
    words = ErrorText()
    arguments = (words, run_detector, settings, SharedStatus(), None, theirs, slices_end, alive)
    process = context.Process(target=storing_error, args=arguments, daemon=True)
    process.start()
    for end in (theirs, slices_end, alive):
        end.close()
    for order in ("begin", "go"):
        orders.send(order)
    return process, MessageReader(slices), [orders, ended, words]


@pytest.mark.parametrize(
    ("fault", "opens"),
    few(
        itertools.product(FAULTS, (True, False)),
        *((fault, True) for fault in ("EOFError", "SystemExit: 0", "Local: 1 and 2", "KeyError: 'gel'")),
        ("the process of the virtual world died", False),
    ),
)
def test_the_detector_says_what_ended_it(fault: str, opens: bool) -> None:
    """Assert that whatever its camera raises, the ends of pipes and of programs too, comes as an error in words."""
    process, inbox, kept = started(fault, opens=opens)
    messages: list[Any] = []
    until_s = time.monotonic() + PATIENCE_S
    while not inbox.ended and time.monotonic() < until_s:
        messages += inbox.take()
        time.sleep(0.01)
    process.join(PATIENCE_S)
    (ended,) = [message for message in messages if isinstance(message, DetectorEnded)]
    assert isinstance(ended.error, DeviceError)
    assert fault in str(ended.error)
    assert ended.counted == ({"late_events": 3} if opens else {})
    assert process.exitcode == 0
    assert len(kept) == 3


def test_a_detector_whose_recorder_is_gone_ends_quietly() -> None:
    """Assert that it neither waits nor complains where nobody is left to read it."""
    process, inbox, kept = started("EOFError")
    inbox._pipe.close()
    kept[0].close()
    process.join(PATIENCE_S)
    assert process.exitcode == 0
    assert kept[2].read() == ""


# What the recorder says of one that ended


def dies(what: str) -> None:
    if what == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "exit":
        os._exit(0)
    raise RuntimeError("the pipe could not be written")


DEATHS = {
    "kill": r"\(SIGKILL\)",
    "exit": r"\(exit code 0, without a message\)",
    "raise": r"\(exit code 1: RuntimeError: the pipe could not be written, in test_deaths.py, line \d+\)",
}


@pytest.mark.parametrize(
    ("part", "how"),
    few(
        itertools.product(("detector", "controller"), DEATHS),
        *(("detector", how) for how in DEATHS),
        ("controller", "kill"),
    ),
)
def test_the_recorder_tells_a_death_with_its_reason(part: str, how: str) -> None:
    """Assert that signal, exit code and last error stand behind `died`, for both processes."""
    words = ErrorText()
    process = multiprocessing.get_context("spawn").Process(target=storing_error, args=(words, dies, how))
    process.start()
    process.join(PATIENCE_S)
    recorded = RecordedGrasp(1000, torque="torque is off (read back)")
    ended = ControllerEnded("stopped", None, 2, 0, 0.1, array("d"), nan, nan, {}, "torque is off (read back)")
    recorded.controller = ended if part == "detector" else None
    both = {"detectors": (process,), "controller": process}
    processes = SimpleNamespace(**both, exit_words=lambda which: exit_words(which, words))
    recorded.conclude(processes)  # type: ignore[arg-type]  # only what is asked of them here
    with pytest.raises(DeviceError, match=f"the {part} died {DEATHS[how]}; torque is off"):
        raise recorded.error or AssertionError
    assert recorded.ended.startswith(f"the {part} died (")


class Writer:
    """In place of the file."""

    def __init__(self) -> None:
        self.slices = 0

    def append_slices(self, events: Events, counts: list[int], rows: dict[str, Any]) -> None:
        self.slices += len(counts)

    def append_rows(self, row: dict[str, Any]) -> None:
        pass


def send_on(outbox: MessageWriter, pipe: Any) -> None:
    """What a detector still sends after the end, for 3 s; then its last words."""
    for _ in range(30):
        outbox.put(SliceBatch(joined([empty()] * 5), [0] * 5, [nan] * 5, [1.0] * 5, [0.0] * 5))
        outbox.flush(PATIENCE_S)
        time.sleep(0.1)
    outbox.put(DetectorEnded({"late_events": 7}, None))
    outbox.flush(PATIENCE_S)
    pipe.close()


def test_a_recorder_waits_for_who_still_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that slices and last words are taken that take longer to come than a process has that says nothing.

    The controller ended first, with the reason; the detector long after, and properly.
    """
    monkeypatch.setattr(recorder, "END_S", 2.0)
    slices, steps = (multiprocessing.Pipe(duplex=False) for _ in range(2))
    failed = DeviceError("the gripper restarted and lost torque; torque is off (read back)")
    outbox = MessageWriter(steps[1])
    outbox.put(ControllerEnded(str(failed), failed, 2, 0, 0.1, array("d"), nan, nan, {}, "torque is off"))
    outbox.flush(PATIENCE_S)
    steps[1].close()
    processes = SimpleNamespace(
        slices=(MessageReader(slices[0]),), steps=MessageReader(steps[0]), now_s=time.monotonic,
        give_sign_of_life=lambda: None, status=SimpleNamespace(stop=lambda: None),
        detectors=("the detector",), controller="the controller",
        exit_words=lambda which: "exit code 0, without a message",
    )  # fmt: skip
    sender = threading.Thread(target=send_on, args=(MessageWriter(slices[1]), slices[1]))
    sender.start()
    writer, key = Writer(), SimpleNamespace(pressed=False)
    recorded = recorder.GraspRecorder(
        *(processes, None, (writer,), 1000, [], key, lambda done: None)  # type: ignore[arg-type]
    ).record()
    sender.join()
    assert writer.slices == recorded.slices == 150
    assert recorded.detector == DetectorEnded({"late_events": 7}, None)
    assert str(recorded.error) == str(failed)
    assert recorded.ended.startswith("the gripper restarted")


class EndedInbox(MessageReader):
    """A pipe whose writer has ended, with messages that come one at a time."""

    def __init__(self, messages: list[Any]) -> None:
        reading, writing = multiprocessing.Pipe(duplex=False)
        writing.close()
        super().__init__(reading)
        self._left = messages

    def take(self) -> Iterator[Any]:
        yield from self._left[:1]
        self.ended = not self._left
        del self._left[:1]


def test_a_recorder_that_is_kept_from_running_reads_all_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the reason a detector gave is told, though every look comes a minute late."""
    hangs = DeviceError("the detector hangs: no sign of life for 50 ms; torque is off", hint=OVERLOADED)
    behind = DeviceError("the recorder cannot keep up", found="64 MB waiting to be written", hint=OVERLOADED)
    ended = ControllerEnded(str(hangs), hangs, 2, 0, 0.1, array("d"), nan, nan, {}, "torque is off")
    batch = SliceBatch(joined([empty()] * 5), [0] * 5, [nan] * 5, [1.0] * 5, [0.0] * 5)
    minutes = itertools.count()
    monkeypatch.setattr(recorder, "time", SimpleNamespace(monotonic=lambda: 60.0 * next(minutes)))
    processes = SimpleNamespace(
        slices=(EndedInbox([batch] * 9 + [DetectorEnded({}, behind)]),), steps=EndedInbox([ended]),
        now_s=time.monotonic,
        give_sign_of_life=lambda: None, status=SimpleNamespace(stop=lambda: None), switch_off=lambda: "torque is off",
        detectors=("the detector",), controller="the controller",
        exit_words=lambda which: "exit code 0, without a message",
    )  # fmt: skip
    writer, key = Writer(), SimpleNamespace(pressed=False)
    recorded = recorder.GraspRecorder(
        *(processes, None, (writer,), 1000, [], key, lambda done: None)  # type: ignore[arg-type]
    ).record()
    assert writer.slices == 45
    assert recorded.ended == "the recorder cannot keep up; torque is off"
    assert recorded.error is behind
    assert behind.found == "64 MB waiting to be written"


def test_who_failed_first_is_told() -> None:
    """Assert that a detector that was ended without its last words does not hide why the controller ended."""
    failed = DeviceError("the gripper restarted; torque is off")
    hangs = DeviceError("the detector hangs: no sign of life for 50 ms; torque is off")
    for error, said in ((failed, "the gripper restarted"), (hangs, "the detector died (SIGKILL)")):
        recorded = RecordedGrasp(1000, torque="torque is off")
        recorded.controller = ControllerEnded(str(error), error, 2, 0, 0.1, array("d"), nan, nan, {}, "torque is off")
        recorded.conclude(SimpleNamespace(detectors=(0,), controller=1, exit_words=lambda which: "SIGKILL"))  # type: ignore[arg-type]
        assert recorded.ended.startswith(said)
