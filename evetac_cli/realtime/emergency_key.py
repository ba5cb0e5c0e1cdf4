"""The emergency key: a key on the terminal that opens the gripper while a program moves it.

During the block, keys are read immediately and not shown; Ctrl-C works as usual. Afterwards the terminal is restored,
however the block ended. There is no key if stdin is not a terminal, or currently belongs to another program.
"""

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator

KEY = " "
KEY_NAME = "space"


class EmergencyKey:
    """Whether the key was pressed; `exists`: whether there is a terminal to press it."""

    def __init__(self, terminal: int | None) -> None:
        self._terminal = terminal
        self._pressed = False

    @property
    def exists(self) -> bool:
        """Whether a key can be pressed at all."""
        return self._terminal is not None

    @property
    def pressed(self) -> bool:
        """Whether it has been pressed; other keys are ignored."""
        try:
            while not self._pressed and self._terminal is not None and select.select([self._terminal], [], [], 0)[0]:
                typed = os.read(self._terminal, 64)
                if not typed:
                    self._terminal = None
                self._pressed = KEY.encode() in typed
        except OSError:  # the terminal was closed
            self._terminal = None
        return self._pressed


@contextlib.contextmanager
def emergency_key() -> Iterator[EmergencyKey]:
    """Listen for the key; keys pressed before do not count."""
    terminal = _terminal()
    if terminal is None:
        yield EmergencyKey(None)
        return
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal, termios.TCSAFLUSH)
        yield EmergencyKey(terminal)
    finally:
        with contextlib.suppress(termios.error, OSError):  # the terminal was closed
            if os.tcgetpgrp(terminal) == os.getpgrp():  # otherwise the shell has it, and setting it would stop us
                termios.tcsetattr(terminal, termios.TCSANOW, before)


def _terminal() -> int | None:
    """Return the terminal on which a user can press a key for this program; None if there is none."""
    try:
        terminal = sys.stdin.fileno()
        if os.isatty(terminal) and os.tcgetpgrp(terminal) == os.getpgrp():
            return terminal
    except (AttributeError, OSError, ValueError):  # stdin is missing, not a file, or closed
        pass
    return None
