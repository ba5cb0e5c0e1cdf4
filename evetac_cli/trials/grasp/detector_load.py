"""The share of a core that the detector uses, and an estimate of the event rate at which it would use all of it."""

import time
from collections.abc import Callable
from typing import NamedTuple

from evetac_cli.events import SLICE_US

WARM_SLICES = 100  # slices at the beginning, during which it catches up
FEWEST_SLICES = 1000
FULL = 0.9  # Usable share of a core: threads of one interpreter sometimes wait for each other.
# Events that cost at most as much as an empty slice: about 0.07 us each, and 85 us or more per slice.
EVENTS_OF_A_SLICE = 1000


class DetectorLoad(NamedTuple):
    """The load of a detector on this computer, including its camera's driver."""

    core_share: float  # CPU time per second of the recording
    events_per_s: float
    bearable_events_per_s: float  # an estimate for a detector with its own core

    def words(self) -> str:
        """Return the load as half a sentence."""
        return (
            f"the detector used {self.core_share:.0%} of a core at {self.events_per_s:,.0f} events per s; with its own"
            f" core it could process about {self.bearable_events_per_s:,.0f}"
        )


class LoadMeter:
    """Sums the CPU time of a detector's process, slice by slice.

    Most of the cost of a slice does not depend on its events, and their rate hardly changes during a grasp. So one
    measured time must serve for both costs. Their ratio is nearly the same on all computers.
    """

    def __init__(self, cpu_s: Callable[[], float] = time.process_time) -> None:
        """cpu_s: returns the CPU time used by this process."""
        self._cpu_s = cpu_s
        self._began_s = cpu_s()
        self._slices = -WARM_SLICES
        self._events = 0

    def add(self, slices: int, events: int) -> None:
        """Record that some slices with this number of events were evaluated."""
        if self._slices >= 0:
            self._events += events
        elif self._slices + slices >= 0:
            self._began_s, self._slices = self._cpu_s(), -slices
        self._slices += slices

    def load(self) -> DetectorLoad | None:
        """Return the load so far; None if the time was too short to estimate it."""
        if self._slices < FEWEST_SLICES:
            return None
        share = (self._cpu_s() - self._began_s) / (1e-6 * SLICE_US * self._slices)
        events = self._events / self._slices
        without_events = max(share / (1.0 + events / EVENTS_OF_A_SLICE), 1e-6)
        bearable = EVENTS_OF_A_SLICE * max(FULL / without_events - 1.0, 0.0)
        return DetectorLoad(share, 1e6 / SLICE_US * events, 1e6 / SLICE_US * bearable)
