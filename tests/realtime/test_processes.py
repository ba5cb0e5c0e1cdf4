"""Processes that Ctrl-C does not reach, from their first moment on."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evetac_cli import interrupts
from evetac_cli.errors import DeviceError
from evetac_cli.realtime import processes
from evetac_cli.realtime.processes import ErrorText, exit_words, storing_error
from tests.patience import PATIENCE_S
from tests.quick import few


def child(pipe: Connection) -> None:
    """Tell whether Ctrl-C was held back until now, and go on though it came."""
    held_back = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    os.kill(os.getpid(), signal.SIGINT)
    interrupts.ignore_interrupts()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    os.kill(os.getpid(), signal.SIGINT)
    pipe.send(held_back)


def parent() -> None:
    """Start the first process of a program; Ctrl-C goes on to come up here."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    processes.start_shielded(context.Process(target=child, args=(theirs,)))
    theirs.close()
    assert ours.recv() is True
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        print("interrupted")


def test_ctrl_c_is_held_back_from_the_first_moment() -> None:
    """Assert that a child never sees Ctrl-C, not even the first process that a program starts, and the parent does."""
    program = "from tests.realtime import test_processes as test; test.parent()"
    path = str(Path(__file__).resolve().parents[2])
    run = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.stdout, run.stderr) == ("interrupted\n", "")


def test_a_process_that_was_stopped_stands_still() -> None:
    """Assert that one that computes or waits does not stand still, and one that was stopped or has ended does."""
    command = [sys.executable, "-c", "import sys; print(flush=True); sys.stdin.read()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as waiting:
        assert waiting.stdout is not None
        waiting.stdout.readline()
        assert not processes.stands_still(waiting.pid)
        assert not processes.stands_still(os.getpid())
        for number, stands in ((signal.SIGSTOP, True), (signal.SIGCONT, False), (signal.SIGKILL, True)):
            waiting.send_signal(number)
            until_s = time.monotonic() + PATIENCE_S
            while processes.stands_still(waiting.pid) != stands and time.monotonic() < until_s:
                time.sleep(0.001)
            assert processes.stands_still(waiting.pid) == stands
    assert processes.stands_still(waiting.pid)  # nobody of this number any more


@pytest.mark.parametrize(("share", "starts"), [(0.02, True), (0.0, False)])
def test_a_process_that_computes_is_waited_for(share: float, starts: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a process with a share of every second is waited for, here half an hour, and one without is not."""
    now_s = 0.0

    def poll(timeout_s: float) -> bool:
        nonlocal now_s
        now_s += timeout_s
        return share * now_s >= 40.0

    monkeypatch.setattr(processes, "cpu_time_s", lambda pid: round(share * now_s, 2))
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: now_s))
    pipe, process = SimpleNamespace(poll=poll), SimpleNamespace(pid=1)
    with nullcontext() if starts else pytest.raises(DeviceError, match="did not start"):
        processes.wait_while_computing(pipe, process, "it did not start")  # type: ignore[arg-type]


def fails(error: BaseException) -> None:
    raise error


def divides(by: int) -> None:
    print(1 // by)


def exits(code: int) -> None:
    os._exit(code)


def is_killed(number: int) -> None:
    os.kill(os.getpid(), number)


def ends() -> None:
    pass


CASES: dict[str, tuple[Callable[..., None], tuple[Any, ...], str]] = {
    "a defect": (divides, (0,), "ZeroDivisionError: integer division or modulo by zero, in test_processes.py, line"),
    "a name that is no UTF-8": (fails, (DeviceError("gone", where="a\udcff"),), r"exit code 1: a\udcff: gone"),
    "an end of a pipe": (fails, (EOFError(),), "EOFError"),
    "a broken pipe": (fails, (BrokenPipeError(32, "Broken pipe"),), "BrokenPipeError: [Errno 32] Broken pipe"),
    "memory": (fails, (MemoryError(),), "MemoryError"),
    "an error in words": (fails, (DeviceError("no answer", where="here", hint="ask"),), "exit code 1: here: no answer"),
    "sys.exit(0)": (fails, (SystemExit(0),), "exit code 0: SystemExit: 0"),
    "many lines": (fails, (ValueError("one\ntwo\nthree"),), "exit code 1: ValueError: one, in"),
    "a long line": (fails, (ValueError("x" * 10_000),), "ValueError: xxx"),
    "not ASCII": (fails, (ValueError("ä" * 1000),), "ValueError: äää"),
    "os._exit(0)": (exits, (0,), "exit code 0, without a message"),
    "os._exit(7)": (exits, (7,), "exit code 7"),
    "SIGKILL": (is_killed, (signal.SIGKILL,), "SIGKILL"),
    "SIGSEGV": (is_killed, (signal.SIGSEGV,), "SIGSEGV"),
    "SIGTERM": (is_killed, (signal.SIGTERM,), "SIGTERM"),
}


@pytest.mark.parametrize("case", few(CASES, "a defect", "an error in words", "os._exit(0)", "many lines", "SIGKILL"))
def test_how_a_process_ended(case: str) -> None:
    """Assert that signal, exit code and the last line of a traceback are said, and a place in the code."""
    target, arguments, said = CASES[case]
    words = ErrorText()
    process = multiprocessing.get_context("spawn").Process(target=storing_error, args=(words, target, *arguments))
    process.start()
    process.join(PATIENCE_S)
    words_of_exit = exit_words(process, words)
    assert said in words_of_exit
    assert "\n" not in words_of_exit
    assert len(words_of_exit.encode()) < 700


def test_a_process_that_runs_has_not_ended() -> None:
    """Assert that nothing is said of one that is alive."""
    process = multiprocessing.get_context("spawn").Process(target=signal.pause, daemon=True)
    process.start()
    assert exit_words(process, ErrorText(), patience_s=0.0) == ""
    process.kill()
    process.join()
