"""Signals that end a program: which raise, which are remembered, which wait, and the memory of those that came.

Why remembered: KeyboardInterrupt may come up inside an import or a callback of the compiler that numba uses, where it
is swallowed or turned into another error. So whoever begins something new looks at `interrupt_came` first.

Ctrl-C goes to all processes of a terminal. The one that the user started ends the others in order, which ignore it
(`ignore_interrupts`). SIGTERM and the like may be meant for one of them alone: its loop ends at its next step, because
an exception in the middle of a command would leave that half sent (`remember_signals`). Python handles signals in the
main thread only: in another one what is to last for a block does nothing.
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
INTERRUPTS = frozenset({signal.SIGINT, signal.SIGTERM})  # which the command line treats alike
ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGABRT", "SIGUSR1", "SIGUSR2")
    if hasattr(signal, name)
)  # signals that end a program, and that a program may handle; Ctrl-C is another matter
ALL = (signal.SIGINT, *ENDING)

Handler = Callable[[int, FrameType | None], None]
_came: list[int] = []  # interrupts that were raised
_waiting: list[int] = []  # those that come up once a file is written
_held: list[int] = []  # those that came within `signals_blocked`, through another thread
_handlers: dict[int, Any] = {}  # who handles those once they come up


def catch_interrupts(*, every: bool = True) -> None:
    """From now on SIGINT and SIGTERM raise KeyboardInterrupt, and are remembered.

    Unless `every` one, only the first raises, and what is then cleaned up is not disturbed.
    """

    def remember(number: int, frame: FrameType | None) -> None:
        first = not _came
        _came.append(number)
        if first or every:
            raise KeyboardInterrupt

    sys.unraisablehook = _show_unless_interrupt
    for number in INTERRUPTS:
        signal.signal(number, remember)


def interrupt_came() -> bool:
    """Whether an interrupt came since they are caught, even if what it raised was swallowed."""
    return bool(_came)


def _show_unless_interrupt(swallowed: "sys.UnraisableHookArgs") -> None:
    """Print what was raised where nobody could catch it, but for an interrupt, which is remembered, and what follows.

    An object that an interrupt left half made may raise at its own end.
    """
    if not _came and not isinstance(swallowed.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)


def stop_catching() -> None:
    """From now on SIGINT and SIGTERM end this process on the spot."""
    for number in INTERRUPTS:
        signal.signal(number, signal.SIG_DFL)


def ignore_interrupts() -> None:
    """From now on Ctrl-C is for whoever started this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def remember_signals() -> list[int]:
    """From now on signals that would end this process are only added to this list; its loop looks at it.

    A signal that is ignored already, as SIGHUP under nohup, stays so.
    """
    ending: list[int] = []
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, frame: ending.append(number))
    return ending


def end_in_order() -> None:
    """From now on SIGTERM and SIGHUP end the program as sys.exit does, where they would end it on the spot."""
    if not _in_main_thread():
        return
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _exit)


def _exit(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)


@contextmanager
def signals_blocked(numbers: Set[signal.Signals] = INTERRUPTS) -> Iterator[None]:
    """These signals wait until the block is over; processes that are started in it inherit that from the system.

    Blocking alone is not enough: the system then gives the signal to another thread, and numpy's linear algebra has
    threads, whereupon Python calls the handler here all the same. So the handler waits as well.
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
    """Within `signals_blocked`, here they come up, also those from before; afterwards they are held back again.

    Why a class: of a generator that is interrupted at its end, the rest may run much later.
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
    _held.append(number)


def _let_through(numbers: Collection[int]) -> None:
    """Handle the signals that were held, one of each kind, as the system does."""
    came = [number for number in dict.fromkeys(_held) if number in numbers]
    _held[:] = [number for number in _held if number not in numbers]
    for number in came:
        signal.raise_signal(number)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """SIGINT and SIGTERM come up once the block is over, in which a file is written; see `leave_if_interrupted`."""
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
    """KeyboardInterrupt if Ctrl-C or SIGTERM waits for the file that is being written: for whoever writes for long."""
    if _waiting:
        raise KeyboardInterrupt


@contextmanager
def signals_counted(came: Sequence[int] = ()) -> Iterator[list[int]]:
    """Ctrl-C and other signals that end a program are counted at first, so that a recording ends between slices.

    A second one breaks off. One that is ignored already, as SIGHUP under nohup, stays so. came: those that came before,
    and should have broken off: then nothing is begun.
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
        if came:
            raise KeyboardInterrupt
        yield signals


@contextmanager
def signals_interrupt() -> Iterator[list[int]]:
    """Signals that would end the program without a word break off as Ctrl-C does; before anything is recorded.

    They are counted, too, for `signals_counted`: what is raised while modules and compiled code are loaded may come up
    inside a callback, which swallows it.
    """
    came: list[int] = []
    if not _in_main_thread():
        yield came
        return
    before = {number: signal.getsignal(number) for number in ALL}

    def interrupt(number: int, frame: Any) -> None:
        came.append(number)
        handler = before[number]
        if callable(handler):
            handler(number, frame)
        raise KeyboardInterrupt

    with _handled(interrupt):
        yield came


@contextmanager
def signals_held() -> Iterator[None]:
    """Signals wait until the block is over, in which a gripper is let go of: nothing may break that off."""
    if not _in_main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    before = {number: signal.getsignal(number) for number in ALL}
    with _handled(lambda number, frame: came.append((number, frame))):
        yield
    raised: BaseException | None = None
    for number, frame in came:
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
    """Let a function handle the signals of ALL, but for those that are ignored."""
    heeded = [number for number in ALL if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heeded}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
