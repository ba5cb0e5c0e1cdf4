"""How much of a core the detector takes while it runs, and at how many events per second it would take all of one."""

import time
from collections.abc import Callable
from typing import NamedTuple

from evetac_cli.events import SLICE_US

WARM_SLICES = 100  # at the beginning, in which it catches up
FEWEST_SLICES = 1000
FULL = 0.9  # of a core that may be taken: of threads that share an interpreter, one waits for the other now and then
EVENTS_OF_A_SLICE = 1000  # that cost at most what a slice without any does: some 0.07 us each, and 85 us or more


class DetectorLoad(NamedTuple):
    """What a detector took on this computer, its camera's driver included."""

    core_share: float  # processor's time per second of the recording
    events_per_s: float
    bearable_events_per_s: float  # an estimate, for a detector that has a core for itself

    def words(self) -> str:
        """In half a sentence."""
        return (
            f"the detector took {self.core_share:.0%} of a core for {self.events_per_s:,.0f} events per s, and with a"
            f" core for itself could bear some {self.bearable_events_per_s:,.0f}"
        )


class LoadMeter:
    """Adds up what a detector's process takes, slice by slice.

    Why so: most of what a slice costs it costs without events too, and their rate hardly changes in a grasp, so that
    one figure of time has to do for both. What they cost relative to each other is nearly the same on all computers.
    """

    def __init__(self, cpu_s: Callable[[], float] = time.process_time) -> None:
        """cpu_s: the processor's time that this process has taken."""
        self._cpu_s = cpu_s
        self._began_s = cpu_s()
        self._slices = -WARM_SLICES
        self._events = 0

    def add(self, slices: int, events: int) -> None:
        """Some slices with so many events were evaluated."""
        if self._slices >= 0:
            self._events += events
        elif self._slices + slices >= 0:
            self._began_s, self._slices = self._cpu_s(), -slices
        self._slices += slices

    def load(self) -> DetectorLoad | None:
        """What it was so far; None where that was too short to say."""
        if self._slices < FEWEST_SLICES:
            return None
        share = (self._cpu_s() - self._began_s) / (1e-6 * SLICE_US * self._slices)
        events = self._events / self._slices
        without_events = max(share / (1.0 + events / EVENTS_OF_A_SLICE), 1e-6)
        bearable = EVENTS_OF_A_SLICE * max(FULL / without_events - 1.0, 0.0)
        return DetectorLoad(share, 1e6 / SLICE_US * events, 1e6 / SLICE_US * bearable)
