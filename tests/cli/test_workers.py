"""Worker processes after Ctrl-C: what is finished is told, and nothing is begun."""

import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evetac_cli import interrupts
from evetac_cli.cli import workers
from evetac_cli.jobs import Job, Outcome, Progress

JOB = Job((), Path("a.recording.h5"))


@pytest.fixture
def stage_is(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Let a function stand in for a stage's run; signals are handled as before once it is over."""

    def put(run: Any) -> None:
        monkeypatch.setattr(workers.importlib, "import_module", lambda name: SimpleNamespace(run=run))

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # what is set while it runs, is undone
    monkeypatch.setattr(interrupts, "_received", [])
    numbers = (signal.SIGINT, signal.SIGTERM)
    mask, handlers = signal.pthread_sigmask(signal.SIG_BLOCK, ()), [signal.getsignal(number) for number in numbers]
    yield put
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def test_nothing_is_begun_after_an_interrupt(stage_is: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a worker that was interrupted leaves the jobs alone that wait for it."""
    stage_is(lambda *_, **__: pytest.fail("begun"))
    monkeypatch.setattr(interrupts, "_received", [signal.SIGINT])
    assert workers._in_worker("record", JOB, None, False) is None


def test_what_was_finished_when_it_came_is_told(stage_is: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a job whose file was complete when Ctrl-C came is a result, and one broken off is none."""
    made = Outcome([{"output": "a"}], True)

    def finished(*_: Any, **__: Any) -> Outcome:
        monkeypatch.setattr(interrupts, "_received", [signal.SIGINT])
        return made

    def broken_off(*_: Any, **__: Any) -> Outcome:
        raise KeyboardInterrupt

    stage_is(finished)
    assert workers._in_worker("record", JOB, None, False) is made
    monkeypatch.setattr(interrupts, "_received", [])
    stage_is(broken_off)
    assert workers._in_worker("record", JOB, None, False) is None


def test_m9_an_interrupt_that_was_swallowed_comes_up_with_the_next_progress(
    stage_is: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a job goes on no longer than until it tells its progress, and one with devices ends by itself."""

    class WithDevices(Job):
        exclusive = True

    def run(job: Job, chosen: Any, *, force: bool, progress: Progress) -> Outcome:
        monkeypatch.setattr(
            interrupts, "_received", [signal.SIGINT]
        )  # and nothing came up, as in a callback of the compiler
        progress(1, 2)
        monkeypatch.setattr(interrupts, "_received", [])
        return Outcome([{"output": "a"}], True)

    stage_is(run)
    with pytest.raises(KeyboardInterrupt):
        workers.run_one("record", JOB, None, False)
    monkeypatch.setattr(interrupts, "_received", [])
    assert isinstance(workers.run_one("record", WithDevices((), Path("a")), None, False), Outcome)


def test_h2_an_interrupt_that_was_swallowed_while_a_stage_loads_begins_no_job(
    stage_is: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that a job with devices, which heeds no progress, is not begun after Ctrl-C."""
    stage_is(lambda *_, **__: pytest.fail("begun"))
    monkeypatch.setattr(interrupts, "_received", [signal.SIGINT])
    with pytest.raises(KeyboardInterrupt):
        workers.run_one("record", JOB, None, False)
