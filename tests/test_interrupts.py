"""Signals that end a program: counted, raised, or held back for as long as a block lasts."""

import os
import signal
import threading
import time
from contextlib import suppress

import pytest

from evetac_cli import interrupts
from tests.patience import PATIENCE_S


def test_the_second_signal_breaks_off() -> None:
    """Assert that a first Ctrl-C is counted, a second one raised, and that handlers are then what they were."""
    before = signal.getsignal(signal.SIGINT)
    with interrupts.signals_counted() as signals:
        signal.raise_signal(signal.SIGINT)
        assert signals == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGINT) == before


class SlowGripper:
    """A gripper that is being let go of when a signal comes."""

    def __init__(self) -> None:
        self.released = False

    def close(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        self.released = True


def test_low_ctrl_c_inside_close_waits_until_the_gripper_is_released() -> None:
    """Assert that a second and third Ctrl-C do not break off the end of torque, and are raised after it."""
    gripper = SlowGripper()
    with interrupts.signals_counted() as signals:
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt), interrupts.signals_held():
            gripper.close()
        assert gripper.released
        assert len(signals) == 3


def test_low_other_signals_interrupt_before_anything_is_recorded() -> None:
    """Assert that signals which would end the program without a word break off as Ctrl-C does; ignored ones do not."""
    numbers = [signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1]
    before = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    try:
        with interrupts.signals_interrupt():
            for number in numbers:
                with pytest.raises(KeyboardInterrupt):
                    os.kill(os.getpid(), number)
        assert all(signal.getsignal(number) is signal.SIG_DFL for number in numbers)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with interrupts.signals_interrupt(), interrupts.signals_counted() as signals:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not signals
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_h2_a_swallowed_ctrl_c_still_ends_before_anything_is_recorded() -> None:
    """Assert that Ctrl-C counts, too, where a callback of the compiler or an import swallowed what it raised.

    Else a recording would begin, and run on, after somebody has ended it.
    """
    before = signal.getsignal(signal.SIGINT)
    with interrupts.signals_interrupt() as came:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert came == [signal.SIGINT]
        with pytest.raises(KeyboardInterrupt), interrupts.signals_counted(came):
            pytest.fail("a recording was begun")
    assert signal.getsignal(signal.SIGINT) == before


def test_a_signal_that_is_held_back_comes_up_where_it_is_let_through() -> None:
    """Assert that what came while signals were held back comes up, and that they are then held back again."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with interrupts.signals_blocked(interrupts.CTRL_C):
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # to this thread alone: libraries have others
        with pytest.raises(KeyboardInterrupt), interrupts.SignalsLetThrough(interrupts.CTRL_C):
            pytest.fail("it did not come up")
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def send_and_wait(number: signal.Signals) -> None:
    """Send a signal to this process, and wait until another thread has taken it: on a busy computer that takes a while.

    Else it could come after the block that is to hold it, where nothing expects it, and end the process of the tests.
    """
    before, deadline = len(interrupts._delayed), time.monotonic() + PATIENCE_S
    os.kill(os.getpid(), number)
    while len(interrupts._delayed) == before:  # a signal that is pending may still be any thread's
        assert time.monotonic() < deadline
        time.sleep(1e-3)


def test_a_signal_waits_also_if_another_thread_takes_it() -> None:
    """Assert that a library's thread, to which the system gives a blocked signal, does not bring it up too early."""
    number, done = signal.SIGINT, []
    before = signal.getsignal(number)
    over = threading.Event()
    library = threading.Thread(target=over.wait)  # it blocks nothing
    library.start()
    try:
        with pytest.raises(KeyboardInterrupt), interrupts.signals_blocked(interrupts.CTRL_C):
            with interrupts.signals_blocked(interrupts.CTRL_C):  # the inner one ends nothing
                send_and_wait(number)
                done.append("inner")
            done.append("outer")
            with pytest.raises(KeyboardInterrupt), interrupts.SignalsLetThrough(interrupts.CTRL_C):
                pytest.fail("it did not come up")
            send_and_wait(number)
            done.append("again")
    finally:
        over.set()
        library.join()
    assert done == ["inner", "outer", "again"]
    assert signal.getsignal(number) == before


def test_a_file_is_written_to_its_end() -> None:
    """Assert that a signal waits for a file, is known to whoever writes for long, and comes up afterwards, once."""
    with pytest.raises(KeyboardInterrupt), interrupts.interrupts_wait():
        interrupts.leave_if_interrupted()
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interrupts.leave_if_interrupted()
    interrupts.leave_if_interrupted()
