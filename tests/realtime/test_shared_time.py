"""A clock that processes share and that waits: it never goes back, and it does not wait for ever."""

import math
import multiprocessing
import pickle
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime import shared_time
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.realtime.shared_time import CREEP, HOST_TIME, SharedTime, WakeSignal
from tests.patience import PATIENCE_S

START = 32  # of the clock in its file


class Host:
    """The host's clock, in the place of the module time."""

    def __init__(self) -> None:
        self.s = 1000.0

    def monotonic(self) -> float:
        return self.s

    def sleep(self, seconds: float) -> None:
        self.s += seconds


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Host:
    host = Host()
    monkeypatch.setattr(shared_time, "time", host)
    return host


@pytest.fixture
def clock(tmp_path: Path) -> SharedTime:
    path = tmp_path / "clock"
    path.write_bytes(bytes(START + SharedTime.SIZE))
    return SharedTime(path, START)


def test_it_is_the_hosts_unless_limited(clock: SharedTime, host: Host) -> None:
    """Assert that without a limit, and below one, it is the host's clock."""
    assert clock.now_s() == host.s
    clock.limit(host.s + 1.0)
    host.s += 0.5
    assert clock.now_s() == host.s
    assert clock.reader_s == math.inf


def test_it_stands_still_at_the_limit_and_goes_on_from_there(clock: SharedTime, host: Host) -> None:
    """Assert that it waits at the limit, that the wait is not made up for, and that a copy says the same."""
    clock.limit(1000.1)
    host.s = 1000.8
    copy = pickle.loads(pickle.dumps(clock))
    assert clock.now_s() == copy.now_s() == pytest.approx(1000.1 + CREEP * 0.7, abs=1e-9)
    clock.limit(1000.2)
    assert copy.now_s() == pytest.approx(1000.107, abs=1e-9)
    host.s += 0.05
    assert clock.now_s() == copy.now_s() == pytest.approx(1000.157, abs=1e-9)
    host.s += 0.143
    assert copy.now_s() == pytest.approx(1000.201, abs=1e-9)
    clock.limit(math.inf)
    host.s += 5.0
    assert copy.now_s() == pytest.approx(1005.201, abs=1e-9)
    clock.limit(1005.301)
    host.s += 1.1
    assert copy.now_s() == pytest.approx(1005.311, abs=1e-9)


def test_it_never_goes_back(clock: SharedTime, host: Host) -> None:
    """Assert that an earlier limit, a late one and any number of the same leave it monotonic."""
    times_s = [clock.now_s()]
    for limit in (999.0, 1000.05, 1000.02, 1000.02, math.inf, 1000.01, 1000.3, 1000.3, 1002.0):
        clock.limit(limit)
        times_s.append(clock.now_s())
        host.s += 0.04
        times_s.append(clock.now_s())
    assert times_s == sorted(times_s)
    assert (np.diff(times_s)[1::2] > 0).all()


def test_patience_ends(clock: SharedTime, host: Host) -> None:
    """Assert that whoever is late for longer than the patience, or dead, does not hold it up, limited again or not."""
    clock.limit(1000.1)
    for _ in range(100):
        host.s += 0.1
        clock.limit(1000.1)
    assert clock.now_s() == pytest.approx(host.s - shared_time.PATIENCE_S)


def test_sleep_waits_by_it(clock: SharedTime, host: Host) -> None:
    """Assert that a sleep ends when so much of its time has passed, not of the host's."""
    clock.limit(1000.1)
    host.s = 1000.5
    clock.limit(1000.15)
    began_s = clock.now_s()
    clock.sleep(0.02)
    assert clock.now_s() == pytest.approx(began_s + 0.02, abs=1e-3)
    clock.sleep(0.5)  # past the limit: until the patience is over
    assert clock.now_s() == pytest.approx(began_s + 0.52, abs=2e-3)
    assert host.s == pytest.approx(1000.52 + shared_time.PATIENCE_S + 0.5, abs=0.01)


def _ask(clock: SharedTime, answers: Connection) -> None:
    clock.slices_read_until(7.5)
    answers.send(clock.now_s())


def test_another_process_has_the_same_clock(clock: SharedTime) -> None:
    """Assert that a spawned process sees the limit, and that what it read is seen here."""
    answers, theirs = multiprocessing.Pipe()
    clock.limit(now := HOST_TIME.now_s())
    process: Any = multiprocessing.get_context("spawn").Process(target=_ask, args=(clock, theirs))
    process.start()
    process.join()
    assert answers.recv() >= now
    assert clock.reader_s == 7.5
    assert clock.now_s() <= time.monotonic()


SILENCE_S = 0.001  # after which no signal is still expected


def publish(shared: SharedStatus, slips: int) -> None:
    shared.publish(DetectorStatus(SlipSignal(slips), 1, 0.0, 0.0, 0.0, ()))


def test_signals_before_and_while_it_is_waited_for() -> None:
    """Assert that a signal before counts once, however many there were, and that silence takes its time."""
    wake = WakeSignal()
    assert not wake.wait(SILENCE_S)
    for _ in range(3):
        wake.send()
    assert wake.wait(PATIENCE_S)
    assert not wake.wait(SILENCE_S)


def test_whoever_sends_never_waits() -> None:
    """Assert that more signals than a pipe holds are no error, nor a wait, and still one."""
    wake = WakeSignal()
    for _ in range(1 << 17):
        wake.send()
    assert wake.wait(PATIENCE_S)


def test_new_slip_wakes_and_nothing_else() -> None:
    """Assert that a status wakes only with more slip than any before it, and is there when it does."""
    shared = SharedStatus()
    for slips, wakes in ((0, False), (1, True), (1, False), (3, True), (3, False)):
        publish(shared, slips)
        assert shared.slip_wake.wait(SILENCE_S) == wakes
        status = shared.latest()
        assert status is not None
        assert status.signal.slips == slips


def test_it_wakes_another_process() -> None:
    """Assert that slip that is published in one process is heard in another."""
    shared = SharedStatus()
    process = multiprocessing.get_context("spawn").Process(target=publish, args=(shared, 1))
    process.start()
    assert shared.slip_wake.wait(PATIENCE_S)
    process.join(PATIENCE_S)
    assert process.exitcode == 0
