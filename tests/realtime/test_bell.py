"""A bell between processes: it wakes whoever sleeps, and never keeps whoever rings."""

import multiprocessing

from evetac_cli.kernels.grip.control import SlipSignal
from evetac_cli.realtime.shared_status import DetectorStatus, SharedStatus
from evetac_cli.realtime.shared_time import Bell
from tests.patience import PATIENCE_S

SILENCE_S = 0.001  # after which no ring is still expected


def publish(shared: SharedStatus, slips: int) -> None:
    shared.publish(DetectorStatus(SlipSignal(slips), 1, 0.0, 0.0, 0.0, ()))


def test_rings_before_and_while_it_is_waited_for() -> None:
    """Assert that a ring before counts once, however many there were, and that silence takes as long as it is given."""
    bell = Bell()
    assert not bell.wait(SILENCE_S)
    for _ in range(3):
        bell.ring()
    assert bell.wait(PATIENCE_S)
    assert not bell.wait(SILENCE_S)


def test_whoever_rings_never_waits() -> None:
    """Assert that more rings than a pipe holds are no error, nor a wait, and still one ring."""
    bell = Bell()
    for _ in range(1 << 17):
        bell.ring()
    assert bell.wait(PATIENCE_S)


def test_new_slip_rings_and_nothing_else() -> None:
    """Assert that a status rings only with more slip than any before it, and is there when it does."""
    shared = SharedStatus()
    for slips, rings in ((0, False), (1, True), (1, False), (3, True), (3, False)):
        publish(shared, slips)
        assert shared.slip_bell.wait(SILENCE_S) == rings
        status = shared.latest()
        assert status is not None
        assert status.signal.slips == slips


def test_it_wakes_another_process() -> None:
    """Assert that slip that is published in one process is heard in another."""
    shared = SharedStatus()
    process = multiprocessing.get_context("spawn").Process(target=publish, args=(shared, 1))
    process.start()
    assert shared.slip_bell.wait(PATIENCE_S)
    process.join(PATIENCE_S)
    assert process.exitcode == 0
