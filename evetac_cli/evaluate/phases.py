"""Phases of a recording: its longest rest, all slices with motion, and the dots that were stroked."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events, concatenate
from evetac_cli.kernels.calibration import rest_image
from evetac_cli.kernels.identify.rest import check_still, find_hot
from evetac_cli.kernels.realism import figures
from evetac_cli.sim.setup.plan import one_sensor
from evetac_cli.stages.identify import pressed
from evetac_cli.stages.identify.at_rest import LONGEST_REST, SHORTEST_REST
from evetac_cli.store.recordings.read import Recording

SHORTEST_MOTION = 300  # slices
MOST_EVENTS = 5_000_000  # limit per phase

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class ContactPhase:
    """The events of one phase on a continuous time axis without the gaps between its pieces, and events per slice."""

    events: Events
    counts: Counts

    @property
    def duration_us(self) -> int:
        """Duration of the phase."""
        return len(self.counts) * SLICE_US

    def part(self, first: int, stop: int) -> "ContactPhase":
        """Return the slices [first, stop) of the phase, with time starting at 0."""
        begin, end = (int(self.counts[:place].sum()) for place in (first, stop))
        events = self.events.part(begin, end)
        return ContactPhase(events._replace(t=events.t - first * SLICE_US), self.counts[first:stop])

    def halves(self) -> tuple["ContactPhase", "ContactPhase"]:
        """Return the first and the second half."""
        middle = len(self.counts) // 2
        return self.part(0, middle), self.part(middle, 2 * middle)


def rest_and_motion(recording: Recording) -> tuple[ContactPhase | None, ContactPhase | None]:
    """Return the longest rest and all motion of a recording; None for either if it is missing or too short."""
    counts = np.diff(recording.starts)
    spells = rest_image.quiet_spells(counts)
    first, stop = max(spells, key=lambda spell: spell[1] - spell[0], default=(0, 0))
    stop = min(stop, first + LONGEST_REST)
    rest = _phase(recording, [(first, stop)]) if stop - first >= SHORTEST_REST else None
    if rest is not None and not _is_still(rest, recording.frame_px):
        rest, spells = None, []  # something always moves: this is only the slowest motion
    edges = [0, *(edge for spell in spells for edge in spell), len(counts)]
    moving = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    whole = sum(b - a for a, b in moving) >= SHORTEST_MOTION
    return rest, _phase(recording, moving) if whole else None


def stroked(recording: Recording, rest: ContactPhase | None) -> pressed.Press | None:
    """Return the dots that were stroked from rest and the estimates from them; None if no dots were stroked."""
    noise_hz = 0.0
    if rest is not None:
        noise_hz = figures.at_rest(*rest.events, recording.frame_px, rest.duration_us)["ordinary_hz"]
    with suppress(ValueError):
        return pressed.find(recording, one_sensor("evetac").log_contrast, None, noise_hz, np.random.default_rng(0))
    return None


def _is_still(phase: ContactPhase, frame_px: tuple[int, int]) -> bool:
    width, height = frame_px
    pixel = phase.events.y.astype(np.int64) * width + phase.events.x
    hot = find_hot(np.bincount(pixel, minlength=width * height), phase.duration_us * 1e-6)
    try:
        check_still(hot.reshape(height, width))
    except ValueError:
        return False
    return True


def _phase(recording: Recording, pieces: list[tuple[int, int]]) -> ContactPhase | None:
    """Return pieces of a recording joined end to end, up to MOST_EVENTS; None if the first slice already has more."""
    parts: list[Events] = []
    counts: list[Counts] = []
    slices, event_count = 0, 0
    for first, end in pieces:
        room = recording.starts[first] + MOST_EVENTS - event_count
        stop = min(end, int(np.searchsorted(recording.starts, room, side="right")) - 1)
        if stop <= first:
            break
        events = recording.between(first, stop)
        parts.append(events._replace(t=events.t + (slices - first) * SLICE_US))
        counts.append(np.diff(recording.starts[first : stop + 1]))
        slices += stop - first
        event_count += events.size
    return ContactPhase(concatenate(parts), np.concatenate(counts).astype(np.int64)) if parts else None
