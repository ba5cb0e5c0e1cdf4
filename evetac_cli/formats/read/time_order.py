"""Handle events whose times go back: the one rule for all formats.

An event that is less than 1 ms late is sorted: sensors and their drivers send such events. A step back of 1 ms or more
that is not a wrap of the clock (clock.py) is a restart: the camera was restarted, files were joined, or a packet was
damaged. The numbers do not show what the user wants then. So the file is refused with an error message, which states
the position and the effect of each option. The options are `from_restart`, which keeps one part, `drop_late`, which
drops late events, and `sort`, which sorts all events by time.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events, concatenate

MOST_RESTARTS = 1000  # with more, a file counts as unsorted, and its parts are no longer counted
FEW_LATE = 0.02  # share of late events up to which the hint proposes dropping them first
MOST_SHOWN = 4  # restarts listed in a message

Placed = tuple[Events, Callable[[int], str]]  # events, and a function that describes the position of row i in the file


@dataclass(frozen=True)
class OrderOptions:
    """How to handle events that are 1 ms or more older than an event before them; by default, the file is refused.

    sort: sort all events by time. drop_late: leave such events out. from_restart: keep only the part from this restart,
    counted from 1, up to the next; 0 is the part before the first restart.
    """

    sort: bool = False
    drop_late: bool = False
    from_restart: int | None = None

    def __post_init__(self) -> None:
        """Raise InputError if two options are set, because one of them would have no effect."""
        options = {"--sort": self.sort, "--drop-late": self.drop_late, "--from-restart": self.from_restart is not None}
        flags = [flag for flag, is_set in options.items() if is_set]
        if len(flags) > 1:
            raise InputError("these options cannot be combined", found=" and ".join(flags), hint="give only one")


IN_ORDER = OrderOptions()


class Restart(NamedTuple):
    """A step back in time: its position in the file, and the times before and after it."""

    place: str
    before_us: int
    after_us: int


class TimeOrder:
    """Yields events in time order, according to the options, and counts events that were out of order."""

    def __init__(self, options: OrderOptions) -> None:
        self._options = options
        self._first_us = 0  # of the file
        self._latest_us: int | None = None  # since the last restart
        self._top_us: int | None = None  # of all events
        self._restarts: list[Restart] = []
        self._sizes = [0]  # events of each part
        self.total = 0  # events, whether they are kept or not
        self._late = 0  # events at least 1 ms late, in any part
        self.small = 0  # events less than 1 ms late, or with `sort` late by any time
        self.back_us = 0  # the largest delay of these events

    @property
    def unsorted(self) -> bool:
        """Whether the file has more steps back than restarts of a camera can explain."""
        return len(self._restarts) >= MOST_RESTARTS

    @property
    def refused(self) -> bool:
        """Whether the events so far cannot be used with these options."""
        options = self._options
        return bool(self._restarts) and (options.from_restart is None or self.unsorted)

    def ordered(self, parts: Iterable[Placed]) -> Iterator[Events]:
        """Yield the events that the options keep; in time order, unless the caller sorts or refuses them."""
        judged = (piece for part, place in parts if part.size for piece in self._judged(part, place))
        return judged if self._options.sort else self._in_order(judged)

    def _judged(self, part: Events, place: Callable[[int], str]) -> Iterator[Events]:
        """Yield the pieces of a part that are kept, split where the clock was restarted."""
        t = part.t
        self.total += part.size
        if self._latest_us is None:
            self._first_us = self._latest_us = self._top_us = int(t[0])
        if t[0] >= self._latest_us and (t[1:] >= t[:-1]).all():
            yield from self._piece(part)
            return
        start = 0
        while start < part.size:
            latest = np.maximum(np.maximum.accumulate(t[start:]), self._latest_us)
            back_us = latest - t[start:]
            if self._options.sort or self.unsorted:
                self._count_small(back_us)
                yield from self._piece(part.part(start, part.size))
                return
            far = np.flatnonzero(back_us >= SLICE_US)
            if self._options.drop_late:
                kept = np.flatnonzero(back_us < SLICE_US)
                self._late += len(far)
                self._count_small(back_us[kept])
                yield from self._piece(part.at(kept))
                return
            stop = start + int(far[0]) if len(far) else part.size
            self._count_small(back_us[: stop - start])
            if stop > start:
                yield from self._piece(part.part(start, stop))
            if stop < part.size:
                self._restarts.append(Restart(place(stop), self._latest_us, int(t[stop])))
                self._sizes.append(0)
                self._latest_us = int(t[stop])
            start = stop

    def _count_small(self, back_us: NDArray[np.int64]) -> None:
        self.small += int(np.count_nonzero(back_us))
        self.back_us = max(self.back_us, int(back_us.max(initial=0)))

    def _piece(self, piece: Events) -> Iterator[Events]:
        """Count the events of a piece, and yield them if they are kept."""
        if not piece.size:
            return
        assert self._latest_us is not None and self._top_us is not None
        latest_us = int(piece.t.max())
        if self._restarts:
            self._late += int(np.count_nonzero(piece.t <= self._top_us - SLICE_US))
        self._latest_us, self._top_us = max(self._latest_us, latest_us), max(self._top_us, latest_us)
        part = len(self._restarts)
        self._sizes[part] += piece.size
        if not self.refused and self._options.from_restart in (None, part):
            yield piece

    def _in_order(self, pieces: Iterable[Events]) -> Iterator[Events]:
        """Sort events that are less than 1 ms late; events with the same time keep their order."""
        waiting: list[Events] = []  # pieces that are sorted, and follow each other in time
        for judged in pieces:
            piece = judged if (judged.t[1:] >= judged.t[:-1]).all() else _sorted(judged)
            first_us = int(piece.t[0])
            overtaken = []
            while waiting and waiting[-1].t[-1] > first_us:
                overtaken.append(waiting.pop())
            waiting.append(_sorted(concatenate([*reversed(overtaken), piece])) if overtaken else piece)
            assert self._latest_us is not None
            while waiting[0].t[-1] <= self._latest_us - SLICE_US:
                yield waiting.pop(0)
        yield from waiting

    def refuse(self, where: str) -> None:
        """Raise InputError if the events cannot be used with these options."""
        wanted = self._options.from_restart
        if self.refused:
            message, expected = "time goes backwards", "events in order of time, at most 1 ms late"
            raise InputError(message, where=where, expected=expected, found=self._steps(), hint=self._hint())
        if wanted is not None and (not self._restarts or wanted >= len(self._sizes)):
            message = "--from-restart: there is no such part"
            raise InputError(message, where=where, expected=self._parts(), found=str(wanted))

    def _steps(self) -> str:
        """Return a text on the steps back."""
        first = self._restarts[:MOST_SHOWN]
        shown = [f"{one.place} from {one.before_us / 1e6:.6f} s to {one.after_us / 1e6:.6f} s" for one in first]
        count = len(self._restarts)
        if count <= MOST_SHOWN:
            return ", ".join(shown)
        return f"{count:,}{' or more' if self.unsorted else ''} times, first {', '.join(shown)}"

    def _hint(self) -> str:
        """Return a hint on the effect of each option."""
        if self.unsorted:
            return "--sort sorts all events by time, which is right if all times are on one clock"
        events = f"{self._late:,} event{'s' if self._late > 1 else ''} ({100 * self._late / self.total:.2g}%)"
        drop = f"--drop-late leaves out the {events} that are 1 ms or more older than an event before them"
        cut = f"--from-restart N keeps one part ({self._parts()})"
        keep = "--sort keeps all events and sorts them by time, which is right if all times are on one clock"
        few = self._late <= FEW_LATE * self.total
        hints = [drop, cut] if few else [cut, drop]
        if min(one.after_us for one in self._restarts) > self._first_us:  # otherwise the clock began anew
            hints.insert(0, keep)
        return "; ".join(hints)

    def _parts(self) -> str:
        """Return the parts between restarts with their sizes, for example `part 0: 3 events, part 1: 1 event`."""
        first = enumerate(self._sizes[: MOST_SHOWN + 1])
        shown = [f"part {number}: {size:,} event{'s' * (size != 1)}" for number, size in first]
        more = len(self._sizes) - len(shown)
        return ", ".join([*shown, f"{more} more"] if more > 0 else shown)

    @property
    def notes(self) -> list[str]:
        """Notes on events that were sorted, kept or dropped."""
        notes = []
        if self.small:
            back = f"{self.back_us:,} us" if self.back_us < SLICE_US else f"{self.back_us / 1e6:.6g} s"
            came = "1 event came" if self.small == 1 else f"{self.small:,} events came"
            notes.append(f"{came} up to {back} late: sorted")
        if self._options.from_restart is not None and self._restarts:
            kept = f"kept part {self._options.from_restart} ({self._parts()})"
            notes.append(f"time goes back {self._steps()}; {kept}")
        if self._options.drop_late and self._late:
            events = "1 event" if self._late == 1 else f"{self._late:,} events"
            notes.append(f"dropped {events} that came 1 ms or more late")
        return notes

    @property
    def dropped(self) -> dict[str, int]:
        """Numbers of events that the options leave out, by reason; only reasons that occur."""
        dropped = {"late": self._late} if self._options.drop_late else {}
        if self._options.from_restart is not None:
            dropped["other_parts"] = self.total - self._sizes[min(self._options.from_restart, len(self._sizes) - 1)]
        return {reason: count for reason, count in dropped.items() if count}


def _sorted(events: Events) -> Events:
    return events.at(np.argsort(events.t, kind="stable"))
