"""How long tests wait: for a condition, with a limit that a process reaches only if it hangs, however busy the machine.

Beside four busy loops on two cores a process gets a quarter of a core, and next to other tests a tenth of one.
"""

import time
from collections.abc import Callable
from typing import Any

from evetac_cli.devices.virtual.word_sources import PreparedWords
from evetac_cli.realtime.shared_time import SharedTime

PATIENCE_S = 600.0


def until(condition: Callable[[], object], every_s: float = 0.01) -> bool:
    """Wait for something to become true; False if it does not in PATIENCE_S."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(every_s)
    return True


def patient_words(words: Any, **more: Any) -> PreparedWords:
    """Prepared words that wait for a driver that is late."""
    return PreparedWords(words, time=SharedTime(), **more)
