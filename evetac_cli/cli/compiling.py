"""A line about what numba compiles, in a command that has to wait for it.

What is compiled is kept (kernel_cache.py): so it is the first command after an installation that waits, or after
an update of what has changed. `evetac doctor --compile`, which `make setup` runs, does it for all commands.
"""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from evetac_cli import console, kernel_cache

PATIENCE_S = 2.0  # nothing is said of what takes less
AGAIN_S = 5.0


class Announcer:
    """Counts the functions that numba compiles; those that one needs are compiled while it waits."""

    def __init__(self, quiet: bool, interrupted: Callable[[], bool], say: Callable[[str], None]) -> None:
        self.quiet, self.interrupted, self.say = quiet, interrupted, say
        self.waiting = self.done = 0
        self.spent_s = self.started_s = 0.0
        self.next_s = PATIENCE_S
        self.collects = False

    def on_start(self, happens: Any) -> None:
        """A function is begun."""
        if self.waiting == 0:
            self.started_s = time.monotonic()
            self.collects = gc.isenabled()
            gc.disable()
        self.waiting += 1

    def on_end(self, happens: Any) -> None:
        """A function is compiled, or failed to be."""
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
        if self.interrupted() and sys.exc_info()[1] is None:  # else it was not swallowed, or something is cleaned up
            raise KeyboardInterrupt


@contextmanager
def announced(
    *, quiet: bool, interrupted: Callable[[], bool] = lambda: False, say: Callable[[str], None] = console.say
) -> Iterator[None]:
    """Say that functions are being compiled, and every few seconds how many are, while this lasts.

    interrupted: whether Ctrl-C was pressed. A callback of the compiler may swallow what that raises: then it is raised
    again after the function that was being compiled, and not after all of them.

    Why so: Python's collector of garbage looks at all that the compiler holds again and again. It waits until a
    function is compiled, which saves a seventh of the time. A command that calls no kernel loads no numba for this.
    """
    with ExitStack() as listening:

        def listen() -> None:
            from numba.core import event

            class Listener(Announcer, event.Listener):  # type: ignore[misc]
                """The same as numba takes it."""

            kernel_cache.drop_unreadable()
            listening.enter_context(event.install_listener("numba:compile", Listener(quiet, interrupted, say)))

        kernel_cache.before_the_first_kernel(listen)
        listening.callback(kernel_cache.forget, listen)
        yield
