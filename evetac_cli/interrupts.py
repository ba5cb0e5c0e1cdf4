"""Signals that end a program: which of them raise an exception, are remembered, or are delayed.

Interrupts are remembered because KeyboardInterrupt may be raised inside an import or a callback of numba's compiler,
where it is swallowed or turned into another error. So code that starts something new checks `interrupt_received` first.

Ctrl-C goes to all processes of a terminal. The process that the user started ends the others in order; those ignore
Ctrl-C (`ignore_interrupts`). SIGTERM and similar signals may be sent to one process alone. Its loop then ends at the
next step, because an exception in the middle of a device command would leave it half sent (`remember_signals`).

Python handles signals only in the main thread. In other threads, the context managers of this module do nothing.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence, Set
from contextlib import contextmanager
from types import FrameType
from typing import Any

CTRL_C = frozenset({signal.SIGINT})
INTERRUPTS = frozenset({signal.SIGINT, signal.SIGTERM})  # the command line treats them alike
ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGABRT", "SIGUSR1", "SIGUSR2")
    if hasattr(signal, name)
)  # signals that end a program and that a program may handle, except Ctrl-C
ALL = (signal.SIGINT, *ENDING)

Handler = Callable[[int, FrameType | None], None]
_received: list[int] = []  # interrupts that were raised
_waiting: list[int] = []  # interrupts to be raised when a file is written
_delayed: list[int] = []  # signals that arrived within `signals_blocked`, through another thread
_handlers: dict[int, Any] = {}  # their handlers for when they are raised


def catch_interrupts(*, every: bool = True) -> None:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt, and remember them.

    every: if false, only the first one raises, so that the clean-up after it is not disturbed.
    """

    def remember(number: int, frame: FrameType | None) -> None:
        first = not _received
        _received.append(number)
        if first or every:
            raise KeyboardInterrupt

    sys.unraisablehook = _show_unless_interrupt
    for number in INTERRUPTS:
        signal.signal(number, remember)


def interrupt_received() -> bool:
    """Whether an interrupt arrived since `catch_interrupts`, even if its exception was swallowed."""
    return bool(_received)


def _show_unless_interrupt(swallowed: "sys.UnraisableHookArgs") -> None:
    """Print an exception that no code could catch, unless it is an interrupt or follows one.

    Interrupts are remembered. An object that was left incomplete by an interrupt may raise when it is deleted.
    """
    if not _received and not isinstance(swallowed.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)


def stop_catching() -> None:
    """Make SIGINT and SIGTERM end this process immediately."""
    for number in INTERRUPTS:
        signal.signal(number, signal.SIG_DFL)


def ignore_interrupts() -> None:
    """Make this process ignore Ctrl-C, which its parent process handles."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def remember_signals() -> list[int]:
    """Return a list that will receive all further signals to end this process; its loop must check the list.

    A signal that is already ignored, such as SIGHUP under nohup, stays ignored.
    """
    ending: list[int] = []
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, frame: ending.append(number))
    return ending


def end_in_order() -> None:
    """Make SIGTERM and SIGHUP end the program like sys.exit, if they would otherwise end it immediately."""
    if not _in_main_thread():
        return
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _exit)


def _exit(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)


@contextmanager
def signals_blocked(numbers: Set[signal.Signals] = INTERRUPTS) -> Iterator[None]:
    """Delay these signals until the end of the block; processes started within it inherit the block.

    Blocking in the system is not enough: the system would deliver the signal to another thread, such as those of
    numpy's linear algebra, and Python would then call the handler here anyway. So the handler delays them as well.
    """
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    handlers = {number: signal.getsignal(number) for number in numbers} if _in_main_thread() else {}
    ours = {number: handler for number, handler in handlers.items() if handler not in (None, signal.SIG_IGN)}
    outside = dict(_handlers)
    try:
        for number, handler in ours.items():
            if handler is not _hold:
                _handlers[number] = handler
                signal.signal(number, _hold)
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        yield
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)
        _handlers.clear()
        _handlers.update(outside)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        _let_through(ours)


class SignalsLetThrough:
    """Context within `signals_blocked` in which the signals are raised, including earlier ones.

    It is a class because a generator that is interrupted at its end may run its remaining code much later.
    """

    def __init__(self, numbers: Set[signal.Signals] = INTERRUPTS) -> None:
        self._numbers = numbers

    def __enter__(self) -> None:
        self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
        try:
            if _in_main_thread():
                for number in self._numbers & _handlers.keys():
                    signal.signal(number, _handlers[number])
            signal.pthread_sigmask(signal.SIG_UNBLOCK, self._numbers)
            _let_through(self._numbers)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)
        if _in_main_thread():
            for number in self._numbers & _handlers.keys():
                signal.signal(number, _hold)


def _hold(number: int, frame: FrameType | None) -> None:
    _delayed.append(number)


def _let_through(numbers: Collection[int]) -> None:
    """Raise the delayed signals, one of each kind, as the system does."""
    received = [number for number in dict.fromkeys(_delayed) if number in numbers]
    _delayed[:] = [number for number in _delayed if number not in numbers]
    for number in received:
        signal.raise_signal(number)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the end of a block that writes a file; see `leave_if_interrupted`."""
    if not _in_main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda number, frame: _waiting.append(number)) for number in INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        first = _waiting[:1]
        _waiting.clear()
        if first:
            signal.raise_signal(first[0])


def leave_if_interrupted() -> None:
    """Raise KeyboardInterrupt if Ctrl-C or SIGTERM is delayed by `interrupts_wait`; for code that writes for long."""
    if _waiting:
        raise KeyboardInterrupt


@contextmanager
def signals_counted(received: Sequence[int] = ()) -> Iterator[list[int]]:
    """Yield a list to which Ctrl-C and other ending signals are added, so that a recording ends between slices.

    A second signal raises KeyboardInterrupt. A signal that is already ignored, such as SIGHUP under nohup, stays
    ignored.
    received: signals that arrived before and should have aborted; if there is any, KeyboardInterrupt is raised now.
    """
    signals: list[int] = []
    if not _in_main_thread():
        yield signals
        return

    def count(number: int, frame: Any) -> None:
        signals.append(number)
        if len(signals) > 1:
            raise KeyboardInterrupt

    with _handled(count):
        if received:
            raise KeyboardInterrupt
        yield signals


@contextmanager
def signals_interrupt() -> Iterator[list[int]]:
    """Make signals that would silently end the program raise KeyboardInterrupt; for use before a recording starts.

    The yielded list of signals is for `signals_counted`: an exception raised while modules or compiled code are loaded
    may be swallowed by a callback.
    """
    received: list[int] = []
    if not _in_main_thread():
        yield received
        return
    before = {number: signal.getsignal(number) for number in ALL}

    def interrupt(number: int, frame: Any) -> None:
        received.append(number)
        handler = before[number]
        if callable(handler):
            handler(number, frame)
        raise KeyboardInterrupt

    with _handled(interrupt):
        yield received


@contextmanager
def signals_held() -> Iterator[None]:
    """Delay signals until the end of a block that releases a gripper, which must not be interrupted."""
    if not _in_main_thread():
        yield
        return
    received: list[tuple[int, Any]] = []
    before = {number: signal.getsignal(number) for number in ALL}
    with _handled(lambda number, frame: received.append((number, frame))):
        yield
    raised: BaseException | None = None
    for number, frame in received:
        handler = before[number]
        try:
            if callable(handler):
                handler(number, frame)
            elif handler == signal.SIG_DFL:
                os.kill(os.getpid(), number)
        except BaseException as error:  # every handler is called, then the first error raised
            raised = raised or error
    if raised is not None:
        raise raised


@contextmanager
def _handled(handler: Handler) -> Iterator[None]:
    """Let a function handle the signals of ALL, except those that are ignored."""
    heeded = [number for number in ALL if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heeded}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
