"""How much of a core the detector takes while it runs, and at how many events per second it would take all of one."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

WINDOW_SLICES = 100  # of which the processor's time is taken together
FEWEST_WINDOWS = 10
VARIED = 0.2  # of their mean, by which events in windows must vary to tell what an event costs from what a slice does
MOST_FIXED = 0.9  # of the time may be that of slices without events: a rate ten times as high is far enough to guess
FULL = 0.9  # of a core that may be taken: of threads that share an interpreter, one waits for the other now and then


class DetectorLoad(NamedTuple):
    """What a detector took on this computer, its camera's driver included."""

    core_share: float  # processor's time per second of the recording
    events_per_s: float
    bearable_events_per_s: float  # at least, if it has a core for itself

    def words(self) -> str:
        """In half a sentence."""
        return (
            f"the detector took {self.core_share:.0%} of a core for {self.events_per_s:,.0f} events per s, and with a"
            f" core for itself could bear {self.bearable_events_per_s:,.0f}"
        )


class LoadMeter:
    """Adds up what a detector's process takes, slice by slice.

    What grows with events and what does not is told apart where their number varies. Else all of it counts as growing,
    and the rate that can be borne is a lower bound.
    """

    def __init__(self, cpu_s: Callable[[], float] = time.process_time) -> None:
        """cpu_s: the processor's time that this process has taken."""
        self._cpu_s = cpu_s
        self._before_s = cpu_s()
        self._slices = self._events = 0  # of the window that is open
        self._windows: list[tuple[int, float]] = []  # events, and the processor's time

    def add(self, slices: int, events: int) -> None:
        """Some slices with so many events were evaluated."""
        self._slices += slices
        self._events += events
        if self._slices >= WINDOW_SLICES:
            now_s = self._cpu_s()
            passed = self._slices / WINDOW_SLICES
            self._windows.append((round(self._events / passed), (now_s - self._before_s) / passed))
            self._before_s, self._slices, self._events = now_s, 0, 0

    def load(self) -> DetectorLoad | None:
        """What it was so far; None where that was too short to say."""
        if len(self._windows) < FEWEST_WINDOWS:
            return None
        events, cpu_s = np.array(self._windows).T
        window_s = 1e-3 * WINDOW_SLICES
        mean, mean_s = float(events.mean()), float(cpu_s.mean())
        fixed_s = 0.0
        if mean and events.std() > VARIED * mean:
            slope = float(np.mean((events - mean) * (cpu_s - mean_s)) / events.var())
            fixed_s = min(max(mean_s - slope * mean, 0.0), MOST_FIXED * mean_s)
        per_event_s = (mean_s - fixed_s) / mean if mean else 0.0
        bearable = max(FULL * window_s - fixed_s, 0.0) / per_event_s if per_event_s else 0.0
        return DetectorLoad(mean_s / window_s, mean / window_s, bearable / window_s)
