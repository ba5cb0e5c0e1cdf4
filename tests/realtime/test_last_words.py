"""What a process says of the error that ends it, and how its end is told."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from typing import Any

import pytest

from evetac_cli.errors import DeviceError
from evetac_cli.realtime.processes import LastWords, exit_words, telling
from tests.patience import PATIENCE_S
from tests.quick import few


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
    "a defect": (divides, (0,), "ZeroDivisionError: integer division or modulo by zero, in test_last_words.py, line"),
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
    words = LastWords()
    process = multiprocessing.get_context("spawn").Process(target=telling, args=(words, target, *arguments))
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
    assert exit_words(process, LastWords(), patience_s=0.0) == ""
    process.kill()
    process.join()
