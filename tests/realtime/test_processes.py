"""Processes that Ctrl-C does not reach, from their first moment on."""

import multiprocessing
import os
import signal
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import pytest

from evetac_cli import interrupts
from evetac_cli.realtime import processes


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


def test_niceness_is_changed_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a process is put behind others and back again, and that a refusal changes nothing."""
    changed: list[int] = []
    permitted = SimpleNamespace(
        PRIO_PROCESS=0,
        getpriority=lambda what, process: -3,
        setpriority=lambda what, process, value: changed.append(value),
    )
    monkeypatch.setattr(processes, "os", permitted)
    with processes.at_niceness(15):
        assert changed == [-4, 15]
    assert changed == [-4, 15, -3]
    assert processes.set_niceness(-10) == "nice -10"

    def refuse(what: int, process: int, value: int) -> None:
        raise PermissionError

    permitted.setpriority = refuse
    with processes.at_niceness(15):
        assert processes.set_niceness(-10) == processes.USUAL
