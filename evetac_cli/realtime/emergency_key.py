"""The emergency key: a key on the terminal that opens the gripper, while a program runs that moves it.

Keys come at once and are not shown, as long as the block lasts; Ctrl-C works as ever. The terminal is then as it was,
whatever ended the block. There is no key where stdin is no terminal, or belongs to another program just now.
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
    """Whether the key was pressed; `exists` says whether there is one."""

    def __init__(self, terminal: int | None) -> None:
        self._terminal = terminal
        self._pressed = False

    @property
    def exists(self) -> bool:
        """Whether a key can be pressed at all."""
        return self._terminal is not None

    @property
    def pressed(self) -> bool:
        """Whether it was pressed until now; other keys are passed over."""
        try:
            while not self._pressed and self._terminal is not None and select.select([self._terminal], [], [], 0)[0]:
                typed = os.read(self._terminal, 64)
                if not typed:
                    self._terminal = None
                self._pressed = KEY.encode() in typed
        except OSError:  # the terminal is gone
            self._terminal = None
        return self._pressed


@contextlib.contextmanager
def emergency_key() -> Iterator[EmergencyKey]:
    """Listen for the key; what was typed before does not count."""
    terminal = _terminal()
    if terminal is None:
        yield EmergencyKey(None)
        return
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal, termios.TCSAFLUSH)
        yield EmergencyKey(terminal)
    finally:
        with contextlib.suppress(termios.error, OSError):  # the terminal is gone
            if os.tcgetpgrp(terminal) == os.getpgrp():  # else the shell has it, and whoever sets it is stopped
                termios.tcsetattr(terminal, termios.TCSANOW, before)


def _terminal() -> int | None:
    """The terminal at which somebody can press a key for this program; None if there is none."""
    try:
        terminal = sys.stdin.fileno()
        if os.isatty(terminal) and os.tcgetpgrp(terminal) == os.getpgrp():
            return terminal
    except (AttributeError, OSError, ValueError):  # no stdin, one that is no file, or one that was closed
        pass
    return None
