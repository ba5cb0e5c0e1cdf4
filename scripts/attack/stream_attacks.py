"""Attacks on the stream of a virtual camera, and their effect on a recording.

The driver's loss report is compared with the camera's own count of events. `ATTACKS` are faults of a virtual camera
(devices/naming.py) that a driver must survive. It must end in time, make no more slices than the host's time
allows, and report the number of lost events, or a lower bound.
"""

from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evetac_cli.devices.device_slices import DRIFT, FAR_US, RESERVE_US
from evetac_cli.devices.dvxplorer.camera import DvxplorerCamera
from evetac_cli.devices.dvxplorer.event_word_loops import events_in
from evetac_cli.devices.losses import events_lost
from evetac_cli.devices.virtual.dvxplorer import VirtualDvxplorer
from evetac_cli.devices.virtual.word_sources import PreparedWords, random_event_words
from evetac_cli.events import SLICE_US, SLICES_PER_S
from evetac_cli.realtime.shared_time import HOST_TIME, TimeSource

SHARE = 0.01  # share of all events by which the reported loss may differ from the camera's count
IN_FLIGHT_S = 0.05  # time span of events that were sent for later slices, if they cannot be counted


class Attack(NamedTuple):
    """A fault, and whether the protocol allows the events that it costs to be counted."""

    fault: str
    is_countable: bool


ATTACKS = (
    Attack("random@0:600", False),
    Attack("random@0.5:0.5", False),
    Attack("damage@0.2:600", False),
    Attack("torn@0.5", False),
    Attack("torn@0.2:600", False),
    Attack("odd@0:600", True),
    Attack("lost-timestamps@0.5:0.5", False),
    Attack("jump-forward@0.5", True),
    Attack("jump-back@0.5", True),
    Attack("silence@0:600", False),
    Attack("silence@0.5:0.3", False),
    Attack("silence@0.5:600", False),
    Attack("stall@0.5", True),
)


@dataclass(frozen=True)
class Ending:
    """How a recording of an attacked stream ended."""

    slices: int
    host_ms: float  # from just before the camera is opened to its last slice
    events: int  # events in the slices
    seen: int  # events of the camera's sensor until then
    reported_lost: int | str  # number of lost events reported by the driver
    waiting: int | None = None  # events on the way to a later slice when it ended; None if they cannot be counted

    @property
    def lost(self) -> int:
        """Number of events of the camera that are in no slice and were not on the way to a later one."""
        return self.seen - self.events - (self.waiting or 0)

    def faults(self, attack: Attack, events_s: float) -> list[str]:
        """Return descriptions of everything wrong with this ending; empty if it is as it should be."""
        wrong = []
        most = (self.host_ms * (1.0 + DRIFT)) + RESERVE_US / SLICE_US
        least = self.host_ms - 3 * FAR_US / SLICE_US  # late by FAR_US, for FAR_US, and read FAR_US later
        if not least <= self.slices <= most:
            wrong.append(f"{self.slices} slices in {self.host_ms:.0f} ms")
        tolerance = SHARE * self.seen
        if self.waiting is None:  # events after the last slice are on the way
            tolerance += (IN_FLIGHT_S + max(0.0, self.host_ms - self.slices) * 1e-3) * events_s
        reported = int(str(self.reported_lost).rpartition(" ")[2].replace(",", ""))
        is_number = isinstance(self.reported_lost, int)
        if reported > self.lost + tolerance:
            wrong.append(f"{reported} events reported as lost, at most {self.lost} were")
        if is_number and abs(reported - self.lost) > tolerance:
            wrong.append(f"{reported} events reported as lost, {self.lost} were")
        if attack.is_countable and not is_number:
            wrong.append("the number of lost events is unknown")
        return wrong


def attack(attacked: Attack, seconds: float, events_s: float, time: TimeSource = HOST_TIME) -> Ending:
    """Read this many seconds of a stream with a fault, through the real driver, as a recording does.

    time: the stream's time source.
    """
    words = random_event_words(events_s, 2.0 * seconds, np.random.default_rng(0))
    device = VirtualDvxplorer(PreparedWords(words, time=time), faults=(attacked.fault,))
    slices = events = 0
    began_s = time.now_s()  # before the camera's start: this program may be paused just after it
    with closing(DvxplorerCamera(backend=device)) as camera:
        while slices < round(SLICES_PER_S * seconds) and (part := camera.read()) is not None:
            slices += 1
            events += part.size
        host_ms = 1e3 * (time.now_s() - began_s)
        reported = events_lost(camera.counted)
    # After closing, nothing moves any more: each event is in one place, however busy the computer is.
    waiting, words_left = camera.waiting
    words_left += device.model.waiting
    waiting += int(events_in(np.frombuffer(words_left, "<u4", len(words_left) // 4)))
    return Ending(
        slices, host_ms, events, device.model.events_seen, reported, waiting if attacked.is_countable else None
    )
