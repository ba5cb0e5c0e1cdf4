"""Slices of a real camera's events: when one is over, and what the camera's clock has to do with the host's.

Slice k holds device times [k, k + 1) ms after the recording's begin, the first ms of which the camera spoke. It is
closed by a later device time, or, when the sensor is silent, by the host's clock: once a read that found the camera
empty was begun so much later than the end of the slice that the camera would have sent it. What comes for a
closed slice is counted, not put elsewhere.

Why so: on a busy machine the time at which data are processed means nothing; the time at which a read was begun that
found nothing does. So a program that is kept from running closes no slice too early.
"""

from collections import deque
from math import inf

import numpy as np

from evetac_cli.events import SLICE_US, Events, Slicer

WINDOW_US = 5_000_000  # over which the smallest delay is looked for: 50 ppm of drift make 0.25 ms in it
BUCKET_US = 500_000
FIRST_EVENTS_US = 100_000  # a camera that sends nothing for so long after its start is silent: slices begin without it


class ClockOffset:
    """Host time minus device time: the smallest of a sliding window, as only delays are added to it."""

    def __init__(self) -> None:
        self._least: deque[tuple[float, float]] = deque()  # start of a bucket on the host, least difference in it
        self.us: float | None = None  # the estimate

    def add(self, host_us: float, device_us: float) -> None:
        """At this host time it was known that device time had come to this."""
        difference = host_us - device_us
        if self._least and host_us < self._least[-1][0] + BUCKET_US:
            start, least = self._least[-1]
            self._least[-1] = (start, min(least, difference))
        else:
            self._least.append((host_us, difference))
        while self._least[0][0] < host_us - WINDOW_US:
            self._least.popleft()
        self.us = min(least for _, least in self._least)


class DeviceSlices:
    """Cuts the events of one camera into slices.

    patience_us: how long the camera may keep an event back. All host times in us, of time.monotonic.
    """

    def __init__(self, patience_us: float) -> None:
        self._slicer = Slicer()
        self._offset = ClockOffset()
        self._started_us = inf  # host time at which the camera was started
        self._patience_us = patience_us
        self._origin_us: int | None = None  # device time at which the recording begins
        self._now_us = 0  # latest device time known
        self._closed = 0
        self.waiting_events = 0  # of slices that are not closed
        self.late_events = 0

    def start(self, host_us: float) -> None:
        """The camera was started at this host time."""
        self._started_us = host_us

    def host_us(self, recording_us: float) -> float:
        """Host time at which the camera's clock showed a time of the recording."""
        offset = self._offset.us
        if offset is None or self._origin_us is None:
            return self._started_us + recording_us
        return offset + self._origin_us + recording_us

    def recording_us(self, host_us: float) -> float:
        """Time of the recording that the camera's clock showed at a host time."""
        return host_us - self.host_us(0.0)

    def device_ms(self, host_us: float) -> int | None:
        """Device time at a host time; None before the camera has spoken."""
        if self._origin_us is None:
            return None
        return max(0, int(self.recording_us(host_us) + self._origin_us) // SLICE_US)

    def push(self, events: Events, first_us: int, now_us: int, arrived_us: float) -> list[Events]:
        """Take events that arrived; return the slices that are closed now.

        first_us: the first device time of all; now_us: the latest, whether or not it has events.
        """
        if self._origin_us is None:
            self._origin_us = SLICE_US * (first_us // SLICE_US - self._closed)
            self._now_us = first_us - 1
        closed = self.take(events)
        if now_us > self._now_us:
            self._now_us = now_us
            self._offset.add(arrived_us, now_us)
            closed += self.close_until((now_us - self._origin_us) // SLICE_US)
        return closed

    def over(self, begun_us: float) -> int:
        """How many slices are over, given that a read begun at this host time found the camera empty."""
        if self._origin_us is None and begun_us < self._started_us + FIRST_EVENTS_US:
            return 0
        return max(0, int(self.recording_us(begun_us) - self._patience_us) // SLICE_US)

    def take(self, events: Events) -> list[Events]:
        """Put events into their slices, but for those whose slice is closed."""
        if events.size == 0 or self._origin_us is None:
            return []
        t_us = events.t - self._origin_us
        late = int(np.searchsorted(t_us, self._closed * SLICE_US))
        self.late_events += late
        self.waiting_events += events.size - late
        return self._handed_out(self._slicer.push(events._replace(t=t_us).part(late, events.size)))

    def close_until(self, slices: int) -> list[Events]:
        """Close all slices below this index, and return them."""
        return self._handed_out(self._slicer.close_until(slices))

    def _handed_out(self, closed: list[Events]) -> list[Events]:
        self._closed += len(closed)
        self.waiting_events -= sum(each.size for each in closed)
        return closed
