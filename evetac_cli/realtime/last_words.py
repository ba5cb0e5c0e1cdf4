"""How a process of ours ended, told by whoever started it: signal, exit code, and the error that the process met last.

Why so: an exit code alone helps nobody, and code 0 is what a process leaves whose error looked like an ordinary end. So
what ends a process is written into memory that outlives it, before it goes on its way.
"""

import multiprocessing
import sys
import traceback
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError, exit_code_words, shortened

MOST_BYTES = 512
PATIENCE_S = 5.0  # a pipe tells that a process ends before it has: Python takes a while, on a busy computer seconds


class LastWords:
    """A line of text in shared memory; given to a process when it is spawned."""

    def __init__(self) -> None:
        self._text = multiprocessing.get_context("spawn").RawArray("c", MOST_BYTES)

    def write(self, text: str) -> None:
        """Replace the text by the first line of another."""
        self._text.value = text.partition("\n")[0].encode(errors="backslashreplace")[: MOST_BYTES - 1]

    def read(self) -> str:
        """The text; empty before the first."""
        return bytes(self._text.value).decode(errors="ignore")


def telling(words: LastWords, target: Callable[..., object], *arguments: Any) -> None:
    """Run a function as the target of a process, and write down what ends it but for a return."""
    try:
        target(*arguments)
    except BaseException as error:
        words.write(error_words(error))
        if isinstance(error, EvetacError):  # it is in words; a traceback would say no more
            sys.exit(1)
        raise


def error_words(error: BaseException) -> str:
    """An error in a line: its type, its message, and where in the code it came up."""
    if isinstance(error, EvetacError):
        return str(error)
    said = shortened(str(error).partition("\n")[0])
    place = ""
    if frames := traceback.extract_tb(error.__traceback__):
        place = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}"
    return f"{type(error).__name__}{': ' if said else ''}{said[: MOST_BYTES // 2]}{place}"


def with_reason(sentence: str, how: str) -> str:
    """A sentence about the end of a process, with how it ended in brackets where that is known."""
    return f"{sentence} ({how})" if how else sentence


def exit_words(process: BaseProcess, words: LastWords | None = None, patience_s: float = PATIENCE_S) -> str:
    """How a process ended, in a line; "" if it has not within this time."""
    process.join(patience_s)
    return exit_code_words(process.exitcode, "" if words is None else words.read())
