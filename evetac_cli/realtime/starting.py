"""Processes of ours that Ctrl-C does not reach, not even while they start.

Ctrl-C goes to all processes of a terminal. Each of ours ignores it as the first thing that it does, because whoever
started it ends it in order. But before it comes to that, it loads the modules that say what to do, for seconds.

Why so: a process inherits which signals are held back. So SIGINT is held back while one is started: in the child until
it ignores it, which forgets one that came; here until the child runs, and none is lost.
"""

import signal
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess


def start(process: BaseProcess) -> None:
    """Start a spawned process whose target begins with `ignore_interrupts`."""
    resource_tracker.ensure_running()  # or starting the process does so, and lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_interrupts() -> None:
    """From now on Ctrl-C is for whoever started this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
