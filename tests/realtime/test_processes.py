"""Processes that Ctrl-C does not reach, from their first moment on."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import pytest

from evetac_cli.realtime import processes


def child(pipe: Connection) -> None:
    """Tell whether Ctrl-C was held back until now, and go on though it came."""
    held_back = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    os.kill(os.getpid(), signal.SIGINT)
    processes.ignore_interrupts()
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


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux binds threads")
def test_threads_of_one_interpreter_share_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that each is bound to the last core, where there is a choice, and none where it is refused."""
    bound: dict[int, set[int]] = {}
    cores = {0, 2, 3}
    permitted = SimpleNamespace(sched_getaffinity=lambda thread: cores, sched_setaffinity=bound.__setitem__)
    monkeypatch.setattr(processes, "os", permitted)
    ended = threading.Event()
    other = threading.Thread(target=ended.wait)
    other.start()
    assert processes.bind_threads() == " on core 3"
    ended.set()
    other.join()
    assert {threading.get_native_id(), other.native_id} <= set(bound)
    assert all(only == {3} for only in bound.values())
    cores = {1}
    bound.clear()
    assert (processes.bind_threads(), bound) == ("", {})


def test_threads_stay_where_binding_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(thread: int, cores: set[int]) -> None:
        raise PermissionError

    monkeypatch.setattr(processes, "sys", SimpleNamespace(platform="linux"))
    refusing = SimpleNamespace(sched_getaffinity=lambda thread: {0, 1}, sched_setaffinity=refuse)
    monkeypatch.setattr(processes, "os", refusing)
    assert processes.bind_threads() == ""
    monkeypatch.setattr(processes, "sys", SimpleNamespace(platform="darwin"))
    assert processes.bind_threads() == ""
