"""Which processes used the cores of this computer, and which of them had to wait for one: for words when one is late.

Linux counts both (/proc/PID/stat, /proc/PID/schedstat); elsewhere there are no words.
"""

import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

EVERY_S = 0.25  # between two samples, each of which costs some 0.1 ms
LAST_S = 1.0  # of which words are given where somebody has just been late
LEAST = 0.05  # of a core, or of the time, that is worth a word
OTHERS, OUTSIDE = "other programs", "other virtual machines on the same host"


class _Sample(NamedTuple):
    """Seconds of cores used, and waited for one, since some moment, by name."""

    at_s: float
    used_s: dict[str, float]
    waited_s: dict[str, float]


class CoreUse:
    """Follows some processes, by their names in words, from the first sample on.

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
        """Look at the counts, unless that was done just now."""
        if self._latest and now_s < self._latest[-1].at_s + EVERY_S:
            return
        used_s = dict(self._latest[-1].used_s) if self._latest else {}  # of one that has ended they stay
        waited_s = dict(self._latest[-1].waited_s) if self._latest else {}
        with suppress(OSError, IndexError, ValueError):
            user, nice, system, _, _, irq, soft_irq, stolen = (int(count) for count in self._fields("stat")[1:9])
            for name, process in self._processes.items():
                with suppress(OSError, IndexError, ValueError):  # it has ended
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
        """The numbers of a file, from its first line on; the name of a process, which may hold anything, is one."""
        _, bracket, rest = (self._proc / file).read_text().rpartition(")")
        return [*(["", ""] if bracket else []), *rest.split()]

    def words(self, *, whole: bool = False) -> str:
        """Who used the cores, and who waited for one, in the last second, or in the whole time; "" if not known."""
        first = self._first if whole else self._latest[0] if self._latest else None
        if first is None or not (passed_s := self._latest[-1].at_s - first.at_s) > 0.0:
            return ""
        last = self._latest[-1]
        used = _shares(first.used_s, last.used_s, passed_s)
        waited = _shares(first.waited_s, last.waited_s, passed_s)
        said = "" if whole else f"in the last {passed_s:.1f} s "
        said += f"{_in_words(used, 'used', 'of a core')}, of {self._cores}"
        return f"{said}; {_in_words(waited, 'waited', 'of the time for one')}" if waited else said if used else ""


def _in_words(shares: list[tuple[str, float]], verb: str, of: str) -> str:
    """Shares in a sentence, where the first says what they are of."""
    (name, share), *others = shares or [("", 0.0)]
    return ", ".join([f"{name} {verb} {share:.0%} {of}", *(f"{name} {share:.0%}" for name, share in others)])


def _shares(first: Mapping[str, float], last: Mapping[str, float], passed_s: float) -> list[tuple[str, float]]:
    """What passed of each, per second, the largest first, without what is not worth a word."""
    shares = [(name, (last[name] - first[name]) / passed_s) for name in last if name in first]
    return sorted(((name, share) for name, share in shares if share >= LEAST), key=lambda each: -each[1])
