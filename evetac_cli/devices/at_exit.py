"""Devices that are let go of when the program ends: by its last line, an error, SIGTERM or a lost terminal (SIGHUP).

Why so: Python ends on the spot at those two signals and asks nobody, unless somebody has told it otherwise.
"""

import atexit
import contextlib
import signal
import sys
import threading
from types import FrameType

from evetac_cli.devices import Closable
from evetac_cli.errors import EvetacError

_OPEN: list[Closable] = []


def close_at_exit(device: Closable) -> None:
    """Close it when the program ends; signals that would end it on the spot end it in order from now on."""
    if not _OPEN:
        atexit.unregister(_close_all)
        atexit.register(_close_all)
    _OPEN.append(device)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, _end_in_order)


def closed(device: Closable) -> None:
    """It is closed already."""
    if device in _OPEN:
        _OPEN.remove(device)


def _close_all() -> None:
    for device in _OPEN.copy():
        with contextlib.suppress(EvetacError):
            device.close()


def _end_in_order(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
