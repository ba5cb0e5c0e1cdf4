"""Measure which processes used the cores and which had to wait for one, to explain why a process was late.

Linux counts both (/proc/PID/stat, /proc/PID/schedstat); on other systems there is no explanation.
"""

import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

EVERY_S = 0.25  # between two samples, which take some 0.1 ms each
LAST_S = 1.0  # period before a delay that the explanation covers
LEAST = 0.05  # smallest share of a core, or of the time, that is reported
OTHERS, OUTSIDE = "other programs", "other virtual machines on the same host"


class _Sample(NamedTuple):
    """Seconds of core time used, and of waiting for a core, since a fixed time, by name."""

    at_s: float
    used_s: dict[str, float]
    waited_s: dict[str, float]


class CoreUse:
    """Measures the core use of some processes, given by name, since the first sample.

    proc: the folder of Linux's counts.
    """

    def __init__(self, processes: Mapping[str, int], proc: Path = Path("/proc"), cores: int | None = None) -> None:
        self._processes = dict(processes)
        self._proc = proc
        self._cores = cores or os.cpu_count() or 1
        self._tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
        self._first: _Sample | None = None
        self._latest: deque[_Sample] = deque()

    def sample(self, now_s: float) -> None:
        """Read the counts, unless the last sample is less than EVERY_S old."""
        if self._latest and now_s < self._latest[-1].at_s + EVERY_S:
            return
        used_s = dict(self._latest[-1].used_s) if self._latest else {}  # a process that has ended keeps its counts
        waited_s = dict(self._latest[-1].waited_s) if self._latest else {}
        with suppress(OSError, IndexError, ValueError):
            user, nice, system, _, _, irq, soft_irq, stolen = (int(count) for count in self._fields("stat")[1:9])
            for name, process in self._processes.items():
                with suppress(OSError, IndexError, ValueError):  # the process has ended
                    used_s[name] = sum(int(ticks) for ticks in self._fields(f"{process}/stat")[13:15]) * self._tick_s
                    waited_s[name] = int(self._fields(f"{process}/schedstat")[1]) * 1e-9
            used_s.pop(OTHERS, None)
            used_s.pop(OUTSIDE, None)
            used_s[OTHERS] = (user + nice + system + irq + soft_irq) * self._tick_s - sum(used_s.values())
            used_s[OUTSIDE] = stolen * self._tick_s
            self._latest.append(_Sample(now_s, used_s, waited_s))
            self._first = self._first or self._latest[0]
        while len(self._latest) > 2 and self._latest[1].at_s <= now_s - LAST_S:
            self._latest.popleft()

    def _fields(self, file: str) -> list[str]:
        """Return the fields of a file; the name of a process, which may contain anything, is skipped."""
        _, bracket, rest = (self._proc / file).read_text().rpartition(")")
        return [*(["", ""] if bracket else []), *rest.split()]

    def words(self, *, whole: bool = False) -> str:
        """Return a text on core use and waiting in the last second, or the whole time; "" if unknown."""
        first = self._first if whole else self._latest[0] if self._latest else None
        if first is None or not (passed_s := self._latest[-1].at_s - first.at_s) > 0.0:
            return ""
        last = self._latest[-1]
        used = _shares(first.used_s, last.used_s, passed_s)
        waited = _shares(first.waited_s, last.waited_s, passed_s)
        text = "" if whole else f"in the last {passed_s:.1f} s "
        text += f"{_in_words(used, 'used', 'of a core')} ({self._cores} cores in total)"
        return f"{text}; {_in_words(waited, 'waited', 'of the time for a core')}" if waited else text if used else ""


def _in_words(shares: list[tuple[str, float]], verb: str, of: str) -> str:
    """Return shares as text; the first states what they refer to."""
    (name, share), *others = shares or [("", 0.0)]
    return ", ".join([f"{name} {verb} {share:.0%} {of}", *(f"{name} {share:.0%}" for name, share in others)])


def _shares(first: Mapping[str, float], last: Mapping[str, float], passed_s: float) -> list[tuple[str, float]]:
    """Return the increase of each count per second, largest first, without those below LEAST."""
    shares = [(name, (last[name] - first[name]) / passed_s) for name in last if name in first]
    return sorted(((name, share) for name, share in shares if share >= LEAST), key=lambda each: -each[1])
