"""Slices of a real camera's events: when one is over, and what the camera's clock has to do with the host's.

Slice k holds device times [k, k + 1) ms after the recording's begin, the first ms of which the camera spoke. It is
closed by a later device time, or, when the sensor is silent, by the host's clock: once a read that found the camera
empty was begun so much later than the end of the slice that the camera would have sent it. What comes for a
closed slice is counted, not put elsewhere.

Why so: on a busy machine the time at which data are processed means nothing; the time at which a read was begun that
found nothing does. So a program that is kept from running closes no slice too early.

Device time is bounded by the host's: no slice is closed that could not have passed since the camera was started, and
where device time stays far from the host's, the camera's clock was damaged, and its times are moved to where the host
says that they are. So a camera cannot make a recording longer than it took, whatever it sends.
"""

from collections import deque
from math import inf

import numpy as np

from evetac_cli.events import SLICE_US, Events, Slicer

WINDOW_US = 5_000_000  # over which the smallest delay is looked for: 50 ppm of drift make 0.25 ms in it
BUCKET_US = 500_000
FIRST_EVENTS_US = 100_000  # a camera that sends nothing for so long after its start is silent: slices begin without it
RESERVE_US = 20_000  # of device time ahead of the host's since the start: whole ms, and clocks that are read in turns
DRIFT = 1e-3  # and so much of the time since then: ten times what a crystal is off by
FAR_US = 500_000  # device time that is so far behind the host's, for so long, is moved: a camera's buffers hold less
MOST_AT_ONCE = 1000  # slices that are handed out at once: a program that was stopped for an hour has 3.6 million


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

    patience_us: how long the camera may keep an event back. All host times in us, of time.monotonic. What is over is
    handed out by MOST_AT_ONCE slices: `more` gives the rest, and is asked before anything else is pushed.
    """

    def __init__(self, patience_us: float) -> None:
        self._slicer = Slicer()
        self._offset = ClockOffset()
        self._started_us = inf  # host time at which the camera was started
        self._patience_us = patience_us
        self._origin_us: int | None = None  # device time at which the recording begins
        self._now_us = 0  # latest device time known
        self._packets: deque[Events] = deque()  # not cut yet; times of the recording
        self._latest_us = 0  # of the packets so far
        self._due = 0  # slices that are over
        self._closed = 0
        self._told = 0  # slices that were over when the camera last gave a time
        self._told_us = 0.0  # and the host's time then
        self._asked_us = 0.0  # host time at which the latest read was begun that found nothing
        self._far_since_us: float | None = None  # host time since which device time has been far from the host's
        self.waiting_events = 0  # of slices that are not closed
        self.late_events = 0
        self.early_events = 0  # of times that the host's clock has not come to
        self.clock_restarts = 0  # times at which device time was moved to the host's

    def start(self, host_us: float) -> None:
        """The camera was started at this host time, or later."""
        self._started_us = self._told_us = host_us

    def host_us(self, recording_us: float) -> float:
        """Host time at which the camera's clock showed a time of the recording."""
        offset = self._offset.us
        if offset is None or self._origin_us is None:
            return self._started_us + recording_us
        return offset + self._origin_us + recording_us

    def recording_us(self, host_us: float) -> float:
        """Time of the recording that the camera's clock showed at a host time."""
        return host_us - self.host_us(0.0)

    def most_us(self, host_us: float) -> float:
        """The latest time of the recording that there can be at a host time."""
        return (host_us - self._started_us) * (1.0 + DRIFT) + RESERVE_US

    def device_ms(self, host_us: float) -> int | None:
        """Device time at a host time; None before the camera has spoken."""
        if self._origin_us is None:
            return None
        return max(0, int(self.recording_us(host_us) + self._origin_us) // SLICE_US)

    @property
    def ms_without_time(self) -> int:
        """How many ms were closed by the host's clock since the camera last gave a time, as far as it was asked."""
        return max(0, min(self._closed - self._told, int(self._asked_us - self._told_us) // SLICE_US))

    def push(self, events: Events, first_us: int, now_us: int, arrived_us: float) -> list[Events]:
        """Take events that arrived; return slices that are closed now.

        first_us: the first device time of all; now_us: the latest, whether or not it has events.
        """
        if self._origin_us is None:
            self._origin_us = SLICE_US * (first_us // SLICE_US - self._closed)
            self._now_us = first_us - 1
        in_order = events.t == np.maximum.accumulate(events.t)
        if not in_order.all():  # of a library; our own decoder never goes back
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
            self._told, self._told_us = max(self._closed, self._due), arrived_us
        return closed

    def over(self, begun_us: float) -> int:
        """How many slices are over, given that a read begun at this host time found the camera empty."""
        self._asked_us = begun_us
        if self._origin_us is None and begun_us < self._started_us + FIRST_EVENTS_US:
            return 0
        passed_us = min(self.recording_us(begun_us), self.most_us(begun_us))
        return max(0, int(passed_us - self._patience_us) // SLICE_US)

    def heard(self, host_us: float) -> None:
        """The camera gave a time that was not believed: it is not silent."""
        self._told, self._told_us = max(self._closed, self._due), host_us

    def take(self, events: Events) -> list[Events]:
        """Put events into their slices, but for those whose slice is closed."""
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
        """Close all slices below this index, and return them, or the first of them."""
        self._due = max(self._due, slices)
        return self.more()

    def more(self) -> list[Events]:
        """Slices that are over and were not handed out, MOST_AT_ONCE at most."""
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
        """Move device time to the host's where it has been far from it for FAR_US."""
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
