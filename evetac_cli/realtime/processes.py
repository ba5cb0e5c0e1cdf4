"""Start processes with a period of 1 or 2 ms shielded from Ctrl-C, raise their priority, and report how they ended.

Ctrl-C: the signal goes to all processes of a terminal, but the parent process must end its children in order. So each
child ignores SIGINT first of all. But before it can do so, it loads modules for seconds. Blocked signals are inherited:
so SIGINT is blocked while a child is started, in the child until it ignores the signal, in the parent until the child
runs. No signal is lost.

Priority: a period of 1 ms is shorter than the usual scheduler guarantees on a busy computer. The permitted priority
depends on the user (`ulimit -r`, `ulimit -e`): it is tried, and the result is recorded. Only processes with little load
get real-time priority. Linux stops all real-time processes of a core for the rest of a second after 0.95 s
(sched_rt_runtime_us); with a simulated world and a recorder among them, this looked like a dead detector. Also, kernel
threads of usual priority deliver serial bytes. When a detector with real-time priority took most of a core, the
controller waited for answers of its gripper and missed one command in eight on two cores. So the detector only gets a
lower niceness.

Errors: an exit code alone does not explain anything, and a process whose error looked like a normal end leaves code
0. So the error that ends a process is written into memory that outlives it, before the process exits.
"""

import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from evetac_cli.errors import DeviceError, EvetacError, exit_code_words, shortened
from evetac_cli.interrupts import CTRL_C, signals_blocked

STANDSTILL_S = 60.0  # a starting process without any computation for this long is considered stuck
ENDING_FLAG = 0x4  # PF_EXITING: the process has begun to end; a killed process may have to wait for a core to do so
NICE = -10
USUAL = "as usual"
REALTIME = "real-time"
MOST_BYTES = 512  # of the error that ended a process
PATIENCE_S = 5.0  # a pipe closes before its process has ended: Python's exit takes seconds on a busy computer


def start_shielded(process: BaseProcess) -> None:
    """Start a spawned process whose target begins with `ignore_interrupts`; until then Ctrl-C does not reach it.

    The process does not import modules from the working folder either, which Python would search first.
    """
    unsafe = "PYTHONSAFEPATH" not in os.environ  # the command `evetac` sets it; this may be another program
    if unsafe:
        os.environ["PYTHONSAFEPATH"] = "1"
    resource_tracker.ensure_running()  # otherwise starting the process does so, which unblocks the signals
    try:
        with signals_blocked(CTRL_C):
            process.start()
    finally:
        if unsafe:
            del os.environ["PYTHONSAFEPATH"]


def cpu_time_s(process: int | None) -> float:
    """Return the CPU time of a process, which shows whether it computes; without Linux's count, the current time."""
    with suppress(OSError, IndexError, ValueError):
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return time.monotonic()


def stands_still(process: int) -> bool:
    """Whether a process was stopped (SIGSTOP, a debugger) or killed, and is not only waiting for a core or a disk.

    If Linux does not state it, the process counts as stopped: the caller has not heard from it for a while.
    """
    try:
        state, *more = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        is_ending = int(more[5]) & ENDING_FLAG
        pending = Path(f"/proc/{process}/status").read_text().partition("SigPnd:")[2].split()[0]
    except (OSError, IndexError, ValueError):
        return True
    return state in "TtZXx" or bool(is_ending) or bool(int(pending, 16) >> (signal.SIGKILL - 1) & 1)


def wait_while_computing(pipe: Connection, process: BaseProcess, failure: str) -> None:
    """Wait until a starting process sends something or ends; raise DeviceError(failure) if it stops computing.

    Why there is no fixed timeout: its kernels may have to be compiled, which takes minutes on a busy computer.
    """
    used_s, since_s = -1.0, time.monotonic()
    while not pipe.poll(1.0):
        now_s = cpu_time_s(process.pid)
        if now_s > used_s:
            used_s, since_s = now_s, time.monotonic()
        elif time.monotonic() - since_s > STANDSTILL_S:
            raise DeviceError(
                failure, expected="a process that computes", found=f"no computation for {STANDSTILL_S:g} s"
            )


def raise_if_ended(process: str, signals: Sequence[int]) -> None:
    """Raise DeviceError if a signal to end this process was received; process: its name."""
    if signals:
        raise DeviceError(f"{process} was ended by {signal.Signals(signals[0]).name}")


def set_realtime_priority(rank: int, process: int = 0) -> str:
    """Raise the priority of this process (or another, by its id); a higher rank, 1 to 50, takes precedence.

    Returns `real-time RANK` (first in, first out), `nice -10`, or `as usual` if nothing is permitted.
    """
    if sys.platform != "linux":
        return USUAL
    try:
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(rank))
        return f"{REALTIME} {rank}"
    except OSError:
        pass
    try:
        os.setpriority(os.PRIO_PROCESS, process, NICE)
        return f"nice {NICE}"
    except OSError:
        return USUAL


def set_niceness(niceness: int) -> str:
    """Set the niceness of this process, below 0 for precedence; return `nice N`, or `as usual` if not permitted."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
        return f"nice {niceness}"
    except OSError:
        return USUAL


@contextmanager
def raised_priority(rank: int, *, wanted: bool = True) -> Iterator[str]:
    """Raise the priority of this thread, and of threads that it starts, during the block, if permitted.

    Yields what `set_realtime_priority` returns.
    """
    if not wanted or sys.platform != "linux":
        yield USUAL
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    scheduling = set_realtime_priority(rank)
    try:
        yield scheduling
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameters)
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, niceness)


class ErrorText:
    """The error that ended a process, as a line of text in shared memory; passed to the process when it is spawned."""

    def __init__(self) -> None:
        self._text = multiprocessing.get_context("spawn").RawArray("c", MOST_BYTES)

    def write(self, text: str) -> None:
        """Replace the text by the first line of another."""
        self._text.value = text.partition("\n")[0].encode(errors="backslashreplace")[: MOST_BYTES - 1]

    def read(self) -> str:
        """Return the text; empty if none was written."""
        return bytes(self._text.value).decode(errors="ignore")


def storing_error(words: ErrorText, target: Callable[..., object], *arguments: Any) -> None:
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


def exit_words(process: BaseProcess, words: ErrorText | None = None, patience_s: float = PATIENCE_S) -> str:
    """Return on one line how a process ended; "" if it has not ended within this time."""
    process.join(patience_s)
    return exit_code_words(process.exitcode, "" if words is None else words.read())
