"""Processes that keep a beat of 1 or 2 ms: started so that Ctrl-C does not reach them, and put ahead of others.

Why so, Ctrl-C: it goes to all processes of a terminal, and whoever started ours ends them in order; so each ignores it
as the first thing that it does. But before it comes to that, it loads modules for seconds. A process inherits which
signals are held back: so SIGINT is held back while one is started, in the child until it ignores it, here until the
child runs, and none is lost.

Why so, priority: a beat of 1 ms is shorter than what a usual scheduler promises on a busy computer. What is permitted
depends on the user (`ulimit -r`, `ulimit -e`): it is tried, and the result is recorded. Only for what takes little:
Linux stops all real-time processes of a core for the rest of a second of which they took 0.95 s (sched_rt_runtime_us),
which with a simulated world and a recorder among them looked like a dead detector. And serial bytes are handed on by
threads of the kernel with usual priority: where a detector with real-time priority took most of a core, the controller
waited for answers of its gripper, and missed one command in eight on two cores. So the detector is only nicer.
"""

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from evetac_cli.errors import DeviceError
from evetac_cli.interrupts import CTRL_C, signals_blocked

STANDSTILL_S = 60.0  # a process that computed nothing for so long while it starts will not come up any more
ENDING_FLAG = 0x4  # of a process that has begun to end (PF_EXITING): one that was killed may need a core for that
NICE = -10
USUAL = "as usual"
REALTIME = "real-time"


def start_shielded(process: BaseProcess) -> None:
    """Start a spawned process whose target begins with `ignore_interrupts`; until then Ctrl-C does not reach it.

    Nor does it load modules from the working folder, where Python looks first for those of a process that is spawned.
    """
    unsafe = "PYTHONSAFEPATH" not in os.environ  # which the command `evetac` sets; this may be somebody else's program
    if unsafe:
        os.environ["PYTHONSAFEPATH"] = "1"
    resource_tracker.ensure_running()  # or starting the process does so, and lets signals through again
    try:
        with signals_blocked(CTRL_C):
            process.start()
    finally:
        if unsafe:
            del os.environ["PYTHONSAFEPATH"]


def cpu_time_s(process: int | None) -> float:
    """How long a process has computed so far, to see whether it does; where Linux does not say it, the time of day."""
    with suppress(OSError, IndexError, ValueError):
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return time.monotonic()


def stands_still(process: int) -> bool:
    """Whether a process was stopped (SIGSTOP, a debugger) or killed, and does not only wait for a core or a disk.

    Where Linux does not say which, it counts as stopped: whoever asks has not heard of it for a while.
    """
    try:
        state, *more = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        is_ending = int(more[5]) & ENDING_FLAG
        pending = Path(f"/proc/{process}/status").read_text().partition("SigPnd:")[2].split()[0]
    except (OSError, IndexError, ValueError):
        return True
    return state in "TtZXx" or bool(is_ending) or bool(int(pending, 16) >> (signal.SIGKILL - 1) & 1)


def wait_while_computing(pipe: Connection, process: BaseProcess, failure: str) -> None:
    """Wait until a process that starts says something, or ends; DeviceError(failure) where it stands still.

    Why not for a time: its kernels may have to be compiled, which takes minutes where others want the cores too.
    """
    used_s, since_s = -1.0, time.monotonic()
    while not pipe.poll(1.0):
        now_s = cpu_time_s(process.pid)
        if now_s > used_s:
            used_s, since_s = now_s, time.monotonic()
        elif time.monotonic() - since_s > STANDSTILL_S:
            raise DeviceError(failure, expected="a process that computes", found=f"none for {STANDSTILL_S:g} s")


def set_realtime_priority(rank: int, process: int = 0) -> str:
    """Raise this process (or one by its number) above others; of two, the one of higher rank, 1 to 50, goes first.

    Returns `real-time RANK` (first in, first out), `nice -10`, or `as usual` where nothing is permitted.
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
    """Put this process ahead of others (below 0) or behind them; returns `nice N`, or `as usual` if not permitted."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
        return f"nice {niceness}"
    except OSError:
        return USUAL


@contextmanager
def raised_priority(rank: int, *, wanted: bool = True) -> Iterator[str]:
    """Let this thread, and threads that it starts, go ahead of others for as long as the block lasts, if permitted.

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
