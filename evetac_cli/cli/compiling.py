"""Report that numba is compiling, in a command that has to wait for it.

Compiled code is kept (kernel_cache.py), so only the first command after an installation or an update waits.
`evetac doctor compile`, which `make setup` runs, compiles the code of all commands.
"""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from evetac_cli import console
from evetac_cli.kernels import kernel_cache

PATIENCE_S = 2.0  # shorter compilation is not reported
AGAIN_S = 5.0  # time between two reports


class Announcer:
    """Counts the functions that numba compiles. Nested: a function waits while those that it calls are compiled."""

    def __init__(self, quiet: bool, interrupted: Callable[[], bool], say: Callable[[str], None]) -> None:
        self.quiet, self.interrupted, self.say = quiet, interrupted, say
        self.waiting = self.done = 0
        self.spent_s = self.started_s = 0.0
        self.next_s = PATIENCE_S
        self.collects = False

    def on_start(self, happens: Any) -> None:
        """Note that the compilation of a function starts."""
        if self.waiting == 0:
            self.started_s = time.monotonic()
            self.collects = gc.isenabled()
            gc.disable()
        self.waiting += 1

    def on_end(self, happens: Any) -> None:
        """Note that the compilation of a function ended, with or without success, and report progress."""
        self.waiting -= 1
        self.done += 1
        spent_s = self.spent_s + time.monotonic() - self.started_s
        if self.waiting == 0:
            self.spent_s = spent_s
            if self.collects:
                gc.enable()
        if spent_s >= self.next_s and not self.quiet:
            self.next_s = spent_s + AGAIN_S
            self.say(f"compiling, once after installing: {self.done} functions so far, {spent_s:.0f} s")
        if self.interrupted() and sys.exc_info()[1] is None:  # otherwise it is already on its way
            raise KeyboardInterrupt


@contextmanager
def announced(
    *, quiet: bool, interrupted: Callable[[], bool] = lambda: False, say: Callable[[str], None] = console.say
) -> Iterator[None]:
    """Report every few seconds, within this context, how many functions have been compiled.

    interrupted: returns whether Ctrl-C was pressed. A callback of the compiler may swallow the exception that Ctrl-C
    raises. It is then raised again after the current function, and not only after all functions.

    Python's garbage collector is paused while a function is compiled: it would scan the compiler's data again and
    again, and the pause saves a seventh of the time. A command that calls no kernel does not load numba for this.
    """
    with ExitStack() as listening:

        def listen() -> None:
            from numba.core import event

            class Listener(Announcer, event.Listener):  # type: ignore[misc]
                """The Announcer as a listener of numba."""

            listening.enter_context(event.install_listener("numba:compile", Listener(quiet, interrupted, say)))

        kernel_cache.before_the_first_kernel(listen)
        listening.callback(kernel_cache.forget, listen)
        yield
