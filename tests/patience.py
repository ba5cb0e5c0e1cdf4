"""How long tests wait for a condition; only a process that hangs reaches the limit, however busy the machine is.

With four busy loops on two cores a process gets a quarter of a core, and with other tests in parallel a tenth.
"""

import time
from collections.abc import Callable
from typing import Any

from evetac_cli.devices.virtual.word_sources import PreparedWords
from evetac_cli.realtime.shared_time import SharedTime

PATIENCE_S = 600.0


def until(condition: Callable[[], object], every_s: float = 0.01) -> bool:
    """Wait for a condition; return False if it is not true within PATIENCE_S."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(every_s)
    return True


def patient_words(words: Any, **more: Any) -> PreparedWords:
    """Return prepared words that wait for a slow driver."""
    return PreparedWords(words, time=SharedTime(), **more)
