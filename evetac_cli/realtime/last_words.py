"""Report how a child process ended: its signal or exit code, and its last error.

Reason: an exit code alone does not explain anything, and a process whose error looked like a normal end leaves code 0.
So the error that ends a process is written into memory that outlives it, before the process exits.
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
PATIENCE_S = 5.0  # a pipe closes before its process has ended: Python's exit takes seconds on a busy computer


class LastWords:
    """A line of text in shared memory; passed to a process when it is spawned."""

    def __init__(self) -> None:
        self._text = multiprocessing.get_context("spawn").RawArray("c", MOST_BYTES)

    def write(self, text: str) -> None:
        """Replace the text by the first line of another."""
        self._text.value = text.partition("\n")[0].encode(errors="backslashreplace")[: MOST_BYTES - 1]

    def read(self) -> str:
        """Return the text; empty if none was written."""
        return bytes(self._text.value).decode(errors="ignore")


def telling(words: LastWords, target: Callable[..., object], *arguments: Any) -> None:
    """Run a function as the target of a process, and write down the error that ends it, if any."""
    try:
        target(*arguments)
    except BaseException as error:
        words.write(error_words(error))
        if isinstance(error, EvetacError):  # its message is complete; a traceback would not add anything
            sys.exit(1)
        raise


def error_words(error: BaseException) -> str:
    """Return an error on one line: its type, its message, and where in the code it was raised."""
    if isinstance(error, EvetacError):
        return str(error)
    message = shortened(str(error).partition("\n")[0])
    place = ""
    if frames := traceback.extract_tb(error.__traceback__):
        place = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}"
    return f"{type(error).__name__}{': ' if message else ''}{message[: MOST_BYTES // 2]}{place}"


def with_reason(sentence: str, how: str) -> str:
    """Return a sentence about the end of a process, with the reason in brackets if it is known."""
    return f"{sentence} ({how})" if how else sentence


def exit_words(process: BaseProcess, words: LastWords | None = None, patience_s: float = PATIENCE_S) -> str:
    """Return on one line how a process ended; "" if it has not ended within this time."""
    process.join(patience_s)
    return exit_code_words(process.exitcode, "" if words is None else words.read())
