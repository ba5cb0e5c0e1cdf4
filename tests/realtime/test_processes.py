"""Processes that Ctrl-C does not reach, from their first moment on."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import pytest

from evetac_cli import interrupts
from evetac_cli.errors import DeviceError
from evetac_cli.realtime import processes

PATIENCE_S = 60.0


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
