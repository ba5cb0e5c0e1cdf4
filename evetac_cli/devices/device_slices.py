"""Cut a real camera's events into slices, and relate the camera's clock to the host's.

Slice k holds device times [k, k + 1) ms after the recording's start, which is the first ms that the camera sent. A
slice is closed by a later device time. If the sensor is silent, the host's clock closes the slice. This requires a read
that found the camera empty, and that began so late that the camera would have sent the slice's events before it. Events
for a slice that is already closed are counted and dropped, not moved to another slice.

Reason: on a busy machine the time at which data are processed means nothing, but the time at which an empty read began
is reliable. A program that was kept from running therefore closes no slice too early.

The host's time bounds the device time. No slice is closed that could not have passed since the camera was started. If
device time stays far from the host's time, the camera's clock was damaged, and its times are shifted to match the
host's. So no data from a camera can make a recording longer than it took.
"""

from collections import deque
from math import inf

import numpy as np

from evetac_cli.events import SLICE_US, Events, Slicer

WINDOW_US = 5_000_000  # window for the smallest delay: a drift of 50 ppm makes 0.25 ms in it
BUCKET_US = 500_000
# a camera that sends nothing for this long after its start is silent: slices begin without it
FIRST_EVENTS_US = 100_000
# margin by which device time may lead the host's since the start: whole ms, and clocks read one after the other
RESERVE_US = 20_000
DRIFT = 1e-3  # further margin, as a share of the time since then: ten times the error of a crystal
FAR_US = 500_000  # device time this far behind the host's, for this long, is shifted: a camera's buffers hold less
MOST_AT_ONCE = 1000  # most slices returned by one call: a program that was stopped for an hour has 3.6 million


class ClockOffset:
    """Host time minus device time: the minimum over a sliding window, because delays only add to it."""

    def __init__(self) -> None:
        # host time at which a bucket starts, smallest difference in it
        self._least: deque[tuple[float, float]] = deque()
        self.us: float | None = None  # the estimate

    def add(self, host_us: float, device_us: float) -> None:
        """Add an observation: at this host time, device time had reached device_us."""
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

    patience_us: how long the camera may hold back an event. All host times are time.monotonic in us. At most
    MOST_AT_ONCE finished slices are returned at once; the caller fetches the rest with `more` before it pushes anything
    else.
    """

    def __init__(self, patience_us: float) -> None:
        self._slicer = Slicer()
        self._offset = ClockOffset()
        self._started_us = inf  # host time at which the camera was started
        self._patience_us = patience_us
        self._origin_us: int | None = None  # device time at which the recording begins
        self._now_us = 0  # latest known device time
        self._packets: deque[Events] = deque()  # not cut into slices yet; times of the recording
        self._latest_us = 0  # latest time in the packets so far
        self._due = 0  # number of slices that are finished
        self._closed = 0
        self._over_at_time = 0  # slices that were finished when the camera last sent a time
        self._time_sent_us = 0.0  # host time of that
        self._empty_read_us = 0.0  # host time at which the latest empty read began
        self._far_since_us: float | None = None  # host time since which device time has been far from the host's
        self.waiting_events = 0  # events of slices that are not closed
        self.late_events = 0
        self.early_events = 0  # events with times that the host's clock has not reached
        self.clock_restarts = 0  # how often device time was shifted to the host's

    def start(self, host_us: float) -> None:
        """Record that the camera was started at this host time or later."""
        self._started_us = self._time_sent_us = host_us

    def host_us(self, recording_us: float) -> float:
        """Return the host time at which the camera's clock showed a time of the recording."""
        offset = self._offset.us
        if offset is None or self._origin_us is None:
            return self._started_us + recording_us
        return offset + self._origin_us + recording_us

    def recording_us(self, host_us: float) -> float:
        """Return the time of the recording that the camera's clock showed at a host time."""
        return host_us - self.host_us(0.0)

    def most_us(self, host_us: float) -> float:
        """Return the latest time of the recording that is possible at a host time."""
        return (host_us - self._started_us) * (1.0 + DRIFT) + RESERVE_US

    def device_ms(self, host_us: float) -> int | None:
        """Return the device time at a host time; None before the camera has sent a time."""
        if self._origin_us is None:
            return None
        return max(0, int(self.recording_us(host_us) + self._origin_us) // SLICE_US)

    @property
    def ms_without_time(self) -> int:
        """Number of ms closed by the host's clock since the camera last sent a time.

        Only ms covered by empty reads count.
        """
        return max(0, min(self._closed - self._over_at_time, int(self._empty_read_us - self._time_sent_us) // SLICE_US))

    def push(self, events: Events, first_us: int, now_us: int, arrived_us: float) -> list[Events]:
        """Take newly arrived events and return the slices that this closes.

        first_us: the first device time of all; now_us: the latest device time, with or without events.
        """
        if self._origin_us is None:
            self._origin_us = SLICE_US * (first_us // SLICE_US - self._closed)
            self._now_us = first_us - 1
        in_order = events.t == np.maximum.accumulate(events.t)
        if not in_order.all():  # only from a library; evetac's own decoder never goes back in time
            self.late_events += int(events.size - in_order.sum())
            events = Events(*(column[in_order] for column in events))
        self._keep_near_host(now_us, arrived_us)
        possible_us = self._origin_us + int(self.most_us(arrived_us))
        early = events.size - int(np.searchsorted(events.t, possible_us, side="right"))
        self.early_events += early
        closed = self.take(events.part(0, events.size - early))
        if self._now_us < now_us <= possible_us:
            self._now_us = now_us
            self._offset.add(arrived_us, now_us)
            closed += self.close_until((now_us - self._origin_us) // SLICE_US)
            self._over_at_time, self._time_sent_us = max(self._closed, self._due), arrived_us
        return closed

    def over(self, begun_us: float) -> int:
        """Return how many slices are finished, given that a read begun at this host time found the camera empty."""
        self._empty_read_us = begun_us
        if self._origin_us is None and begun_us < self._started_us + FIRST_EVENTS_US:
            return 0
        passed_us = min(self.recording_us(begun_us), self.most_us(begun_us))
        return max(0, int(passed_us - self._patience_us) // SLICE_US)

    def note_sent(self, host_us: float) -> None:
        """Record that the camera sent a time that was not believed: it is not silent."""
        self._over_at_time, self._time_sent_us = max(self._closed, self._due), host_us

    def take(self, events: Events) -> list[Events]:
        """Sort events into their slices, except those whose slice is closed."""
        if events.size == 0 or self._origin_us is None:
            return []
        t_us = events.t - self._origin_us
        late = int(np.searchsorted(t_us, max(self._closed * SLICE_US, self._latest_us)))
        self.late_events += late
        if late == events.size:
            return []
        self.waiting_events += events.size - late
        self._latest_us = int(t_us[-1])
        self._packets.append(events._replace(t=t_us).part(late, events.size))
        return self.more()

    def close_until(self, slices: int) -> list[Events]:
        """Close all slices below this index and return them, or the first of them."""
        self._due = max(self._due, slices)
        return self.more()

    def more(self) -> list[Events]:
        """Return finished slices that were not returned yet, at most MOST_AT_ONCE."""
        end = self._closed + MOST_AT_ONCE
        closed: list[Events] = []
        while self._packets:
            packet = self._packets.popleft()
            cut = int(np.searchsorted(packet.t, end * SLICE_US))
            closed += self._slicer.push(packet.part(0, cut))
            if cut < packet.size:
                self._packets.appendleft(packet.part(cut, packet.size))
                break
        closed += self._slicer.close_until(end if self._packets else min(self._due, end))
        self._closed += len(closed)
        self.waiting_events -= sum(each.size for each in closed)
        return closed

    def _keep_near_host(self, now_us: int, arrived_us: float) -> None:
        """Shift device time to the host's if it has been far from it for FAR_US."""
        assert self._origin_us is not None
        if self._offset.us is None:
            return
        ahead_us = now_us - self._origin_us - self.recording_us(arrived_us)
        if ahead_us >= -FAR_US and now_us - self._origin_us <= self.most_us(arrived_us):
            self._far_since_us = None
        elif self._far_since_us is None:
            self._far_since_us = arrived_us
        elif arrived_us - self._far_since_us > FAR_US:
            self._origin_us += int(ahead_us)
            self._now_us = now_us
            self._offset = ClockOffset()
            self._offset.add(arrived_us, now_us)
            self._far_since_us = None
            self.clock_restarts += 1
