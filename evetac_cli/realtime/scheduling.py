"""Ask the system to let a process run when its time has come, ahead of others that compute.

Why so: a beat of 1 ms is longer than what a usual scheduler promises on a busy computer. What is permitted depends on
the user (`ulimit -r`, `ulimit -e`): it is tried, and what came of it is said. Only for what takes little: Linux stops
all real-time processes of a core for the rest of a second of which they took 0.95 s (sched_rt_runtime_us), which with a
simulated world and a recorder among them looked like a dead detector.
"""

import os
import sys

NICE = -10
USUAL = "as usual"


def set_realtime_priority(rank: int, process: int = 0) -> str:
    """Raise this process (or one by its number) above others; of two, the one of higher rank, 1 to 50, goes first.

    What it is then: `real-time RANK` (first in, first out), `nice -10`, or `as usual` where nothing is permitted.
    """
    if sys.platform != "linux":
        return USUAL
    try:
        os.sched_setscheduler(process, os.SCHED_FIFO, os.sched_param(rank))
        return f"real-time {rank}"
    except OSError:
        pass
    try:
        os.setpriority(os.PRIO_PROCESS, process, NICE)
        return f"nice {NICE}"
    except OSError:
        return USUAL
