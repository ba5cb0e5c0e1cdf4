"""Losses of a camera from its counters: the number of lost events, or a lower bound, and messages for the user.

Reasons are named DEVICE.REASON, for example `capture/lost/camera.late_events`. Some count events. Others count
incidents that cost an unknown number of events. The rest, such as lost answers of a gripper, cost none.
"""

from collections.abc import Mapping

COUNTS_EVENTS = frozenset(
    {
        "events_in_dropped_frames",
        "events_before_first_timestamp",
        "events_in_full_queue",
        "late_events",
        "early_events",
        "events_after_last_slice",
    }
)
NUMBER_UNKNOWN = frozenset(
    {
        "unknown_words",
        "missing_words",
        "outside_frame",
        "repeated_rows",
        "torn_bytes",
        "failed_transfers",
        "ms_without_time",
        "ms_without_events",
        "slices_dropped",
    }
)
SILENCES = {
    "ms_without_time": "sends nothing, not even timestamps",
    "ms_without_events": "sends no events",
}
AGAIN_S = 5.0  # interval after which the same message is repeated


def _reason(name: str) -> str:
    return name.rpartition(".")[2]


def events_lost(counts: Mapping[str, int]) -> int | str:
    """Return the number of lost events, or `unknown, at least N` with the N known losses."""
    least = sum(count for name, count in counts.items() if _reason(name) in COUNTS_EVENTS)
    if any(count for name, count in counts.items() if _reason(name) in NUMBER_UNKNOWN):
        return f"unknown, at least {least:,}"
    return least


def reasons(counts: Mapping[str, int]) -> str | None:
    """Return every reason and how often it occurred, as text; None if there is none."""
    return "; ".join(f"{name} {count}" for name, count in counts.items() if count) or None


class LossNews:
    """Messages on losses while they happen: silence and damage when they begin, then every AGAIN_S."""

    def __init__(self) -> None:
        self._silent: dict[str, int] = {}  # name -> ms of silence before the present silence
        self._before: Mapping[str, int] = {}
        self._reported_s: dict[str, float] = {}
        self._lost: int | str = 0

    def of(self, counts: Mapping[str, int], now_s: float) -> list[str]:
        """Return sentences for the user, given the counts of all devices at this time."""
        news = []
        silences = {name: ms for name, ms in counts.items() if _reason(name) in SILENCES}
        for name, ms in silences.items():
            device, _, reason = name.rpartition(".")
            before_ms = self._before.get(name, 0)
            if ms > before_ms:
                silent_s = (ms - self._silent.setdefault(name, before_ms)) * 1e-3
                if self._is_due(name, now_s):
                    news.append(f"{device} {SILENCES[reason]}, for {silent_s:.1f} s now: is it plugged in firmly?")
            elif name in self._silent:
                silent_s = (ms - self._silent.pop(name)) * 1e-3
                self._reported_s.pop(name, None)
                news.append(f"{device} sends again, after {silent_s:.1f} s; its events of that time are lost")
        self._before = silences
        others = {name: count for name, count in counts.items() if _reason(name) in COUNTS_EVENTS | NUMBER_UNKNOWN}
        others = {name: count for name, count in others.items() if name not in silences}
        lost = events_lost(others)
        if lost != self._lost and self._is_due("events", now_s):
            self._lost = lost
            damaged = f"the stream is damaged, events lost so far: {lost}" if isinstance(lost, str) else ""
            news.append(f"{damaged or f'events lost so far: {lost:,}'} ({reasons(others)})")
        return news

    def _is_due(self, what: str, now_s: float) -> bool:
        """Return whether this was not reported in the last AGAIN_S, and note that it is reported now."""
        due = now_s - self._reported_s.get(what, -AGAIN_S) >= AGAIN_S
        if due:
            self._reported_s[what] = now_s
        return due
