"""A line about what numba compiles, in a command that has to wait for it.

What is compiled is kept (kernel_cache.py): so it is the first command after an installation that waits, or after
an update of what has changed. `evetac doctor --compile`, which `make setup` runs, does it for all commands.
"""

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from evetac_cli import console, kernel_cache

PATIENCE_S = 2.0  # nothing is said of what takes less
AGAIN_S = 5.0


@contextmanager
def announced(
    *, quiet: bool, interrupted: Callable[[], bool] = lambda: False, say: Callable[[str], None] = console.say
) -> Iterator[None]:
    """Say that functions are being compiled, and every few seconds how many are, while this lasts.

    interrupted: whether Ctrl-C was pressed. A callback of the compiler may swallow what that raises: then it is raised
    again after the function that was being compiled, and not after all of them.

    Why so: Python's collector of garbage looks at all that the compiler holds again and again. It waits until a
    function is compiled, which saves a seventh of the time.
    """
    from numba.core import event  # `evetac --help` loads none of it

    kernel_cache.drop_unreadable()

    class Announcer(event.Listener):  # type: ignore[misc]
        """Counts functions; those that one needs are compiled while it waits."""

        def __init__(self) -> None:
            self.waiting = self.done = 0
            self.spent_s = self.started_s = 0.0
            self.next_s = PATIENCE_S
            self.collects = False

        def on_start(self, happens: Any) -> None:
            if self.waiting == 0:
                self.started_s = time.monotonic()
                self.collects = gc.isenabled()
                gc.disable()
            self.waiting += 1

        def on_end(self, happens: Any) -> None:
            self.waiting -= 1
            self.done += 1
            spent_s = self.spent_s + time.monotonic() - self.started_s
            if self.waiting == 0:
                self.spent_s = spent_s
                if self.collects:
                    gc.enable()
            if spent_s >= self.next_s and not quiet:
                self.next_s = spent_s + AGAIN_S
                say(f"compiling, once after installing: {self.done} functions so far, {spent_s:.0f} s")
            if interrupted() and sys.exc_info()[1] is None:  # else it was not swallowed, or something is cleaned up
                raise KeyboardInterrupt

    with event.install_listener("numba:compile", Announcer()):
        yield
