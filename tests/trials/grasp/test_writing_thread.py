"""The thread that writes: late for as long as memory holds, and never in the way of who watches."""

import multiprocessing
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from evetac_cli.realtime.message_pipe import MessageReader
from evetac_cli.trials.grasp import recorder
from evetac_cli.trials.grasp.detector_process import DetectorEnded, SliceBatch
from evetac_cli.trials.grasp.recorder import WritingThread

PATIENCE_S = 60.0


def test_all_is_written_in_order() -> None:
    """Assert that the block ends once all is written, by another thread, in the order in which it came."""
    written: list[int] = []
    threads: set[int] = set()

    def write(message: int) -> None:
        threads.add(threading.get_ident())
        time.sleep(1e-3)
        written.append(message)

    with WritingThread(write, 0) as writing:
        for number in range(50):
            writing.put(number, 1)
    assert written == list(range(50))
    assert threads.isdisjoint({threading.get_ident()})
    assert writing.waiting_bytes == 0


def test_it_is_full_until_something_was_written() -> None:
    """Assert that it says when as much waits as may, and when there is room again."""
    goes_on = threading.Event()
    taken = threading.Event()

    def write(message: int) -> None:
        taken.set()
        goes_on.wait(PATIENCE_S)

    with WritingThread(write, 0, most_bytes=10) as writing:
        writing.put(0, 0)
        assert taken.wait(PATIENCE_S)
        writing.put(1, 9)
        assert not writing.is_full
        writing.put(2, 1)
        assert writing.is_full
        goes_on.set()
    assert not writing.is_full


def test_a_full_disk_is_told() -> None:
    """Assert that what fails in writing is raised where messages are put, and again at the end of the block."""

    def write(message: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"), WritingThread(write, 0) as writing:
        writing.put(0)
        writing.join(PATIENCE_S)
        writing.check()
    with pytest.raises(OSError, match="No space"), WritingThread(write, 0) as writing:
        writing.put(0)


def test_a_block_that_fails_drops_what_waits() -> None:
    """Assert that only what is being written is waited for, and that the error of the block goes on."""
    written: list[int] = []
    taken = threading.Event()
    goes_on = threading.Event()

    def write(message: int) -> None:
        taken.set()
        goes_on.wait(PATIENCE_S)
        written.append(message)

    with pytest.raises(KeyboardInterrupt), WritingThread(write, 0) as writing:
        for number in range(10):
            writing.put(number)
        assert taken.wait(PATIENCE_S)
        threading.Timer(0.05, goes_on.set).start()
        raise KeyboardInterrupt
    assert written == [0]


class Inbox(MessageReader):
    """Messages that are there already; it ends when it is told to."""

    def __init__(self, pipe: Any, messages: list[Any]) -> None:
        super().__init__(pipe)
        self.messages = messages

    def take(self) -> Any:
        while self.messages:
            yield self.messages.pop(0)
        yield from super().take()


def test_who_watches_gives_signs_of_life_while_writing_hangs() -> None:
    """Assert that a disk that hangs holds up neither signs of life nor the emergency key, and that nothing is lost."""
    signs: list[int] = []
    pressed = threading.Event()
    pipes = [multiprocessing.Pipe(duplex=False) for _ in range(2)]
    columns = tuple(bytes(0) for _ in range(4))
    batches = [SliceBatch(columns, [0] * 5, [0.5] * 5, [1.0] * 5, [0.0] * 5) for _ in range(40)]

    def give_sign_of_life() -> None:
        signs.append(len(signs))

    def open_gripper() -> None:
        pressed.set()  # which the writer waits for: a loop that waits for the writer would never come here
        pipes[0][1].close()
        pipes[1][1].close()

    class Writer:
        slices = 0

        def append_slices(self, events: Any, counts: list[int], rows: dict[str, Any]) -> None:
            assert pressed.wait(PATIENCE_S)
            self.slices += len(counts)

    processes = SimpleNamespace(
        slices=(Inbox(pipes[0][0], [*batches, DetectorEnded({}, None)]),), steps=MessageReader(pipes[1][0]),
        now_s=time.monotonic, give_sign_of_life=give_sign_of_life, switch_off=lambda: "torque is off",
        status=SimpleNamespace(stop=lambda: None, open_gripper=open_gripper), end_hanging_controller=lambda: "",
        detectors=("the detector",), controller="the controller", exit_words=lambda which: "SIGKILL",
    )  # fmt: skip
    writer = Writer()

    class Key:
        @property
        def pressed(self) -> bool:
            return len(signs) > 20

    recorded = recorder.GraspRecorder(
        *(processes, None, (writer,), 1000, [], Key(), lambda done: None)  # type: ignore[arg-type]
    ).record()
    assert len(signs) > 20
    assert writer.slices == recorded.slices == 200
