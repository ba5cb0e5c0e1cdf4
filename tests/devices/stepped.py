"""Words that come by a clock of their own, so that no test of a virtual camera depends on how fast the machine is."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.devices.virtual import device_model
from evetac_cli.devices.virtual.word_sources import due_us
from evetac_cli.realtime.shared_time import TimeSource, WakeSignal


class StepClock:
    """Time that passes only where somebody waits for it; a test may move it on."""

    def __init__(self) -> None:
        self.s = 1000.0

    def now_s(self) -> float:
        """The time, in s."""
        return self.s

    def sleep(self, seconds: float, wake: WakeSignal | None = None) -> bool:
        """So much of it passes; no wake rings."""
        self.s += max(seconds, 0.0)
        return False

    def slices_read_until(self, now_s: float) -> None:
        """Without effect: it waits for nobody."""


class SteppedWords:
    """A stream of words as a camera would have sent it, each due by a clock that whoever waits for words moves on."""

    def __init__(self, words: NDArray[np.uint32], monkeypatch: pytest.MonkeyPatch) -> None:
        """The virtual camera's own waiting goes by this clock too."""
        self._data, self._due_us = words.astype("<u4").tobytes(), due_us(words)
        self._at = 0
        self._began_s = float("inf")
        self.clock = StepClock()
        monkeypatch.setattr(device_model, "time", SimpleNamespace(monotonic=self.clock.now_s, sleep=self.clock.sleep))

    @property
    def time(self) -> TimeSource:
        """The clock by which the words are due."""
        return self.clock

    def run(self, on: bool) -> None:
        """Start the stream, or end it for good."""
        self._began_s = self.clock.s if on else float("inf")

    def take(self, most: int, timeout_s: float) -> bytes:
        """At most so many bytes that are due; if there are none, after the time until there are some has passed."""
        due = self._due()
        if due == self._at:
            left_s = self._next_s() - self.clock.s
            self.clock.sleep(min(timeout_s, left_s + 1e-6))
            due = self._due()
        start, self._at = self._at, min(self._at + most, due)
        return self._data[start : self._at]

    def _due(self) -> int:
        passed_us = (self.clock.s - self._began_s) * 1e6
        return max(self._at, 4 * int(np.searchsorted(self._due_us, passed_us, side="right")))

    def _next_s(self) -> float:
        if self._at == len(self._data):
            return float("inf")
        return self._began_s + 1e-6 * float(self._due_us[self._at // 4])
