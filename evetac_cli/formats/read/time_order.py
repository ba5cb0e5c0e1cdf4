"""Events whose times go back: the one rule for all formats.

An event that comes less than 1 ms after a later one is put in order: sensors send such, and so do the drivers above
them. A step back of 1 ms or more that is no wrap of the clock (clock.py) is a restart: the camera began anew, files
were joined, or a packet was damaged. What the user wants then cannot be known from the numbers. So the file is refused,
with the place and with what each option would keep: `from_restart` one part, `drop_late` all but the events that come
after a later one, `sort` all of them, by time.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.events import SLICE_US, Events, concatenate

MOST_RESTARTS = 1000  # after which a file is taken as unsorted, and its parts are no longer counted
FEW_LATE = 0.02  # share of all events, up to which dropping them is proposed first
MOST_SHOWN = 4  # restarts in a message
MOST_WAITING = 1 << 23  # events of less than 1 ms, in memory; the fastest camera makes 1 million

Placed = tuple[Events, Callable[[int], str]]  # some events, and where the user finds row i of them


@dataclass(frozen=True)
class OrderOptions:
    """What becomes of events that come 1 ms or more after a later one; without an option their file is refused.

    sort: put all events in the order of their time. drop_late: leave such events out. from_restart: keep only the part
    that begins at this restart, counted from 1, up to the next; 0 is the part before the first.
    """

    sort: bool = False
    drop_late: bool = False
    from_restart: int | None = None

    def __post_init__(self) -> None:
        """InputError for two options, of which one would have no effect."""
        chosen = {"--sort": self.sort, "--drop-late": self.drop_late, "--from-restart": self.from_restart is not None}
        flags = [flag for flag, given in chosen.items() if given]
        if len(flags) > 1:
            raise InputError("these options exclude each other", found=" and ".join(flags), hint="give one of them")


IN_ORDER = OrderOptions()


class Restart(NamedTuple):
    """A step back in time: where it is in the file, from which time to which."""

    place: str
    before_us: int
    after_us: int


class TimeOrder:
    """Gives events out in the order of their time, as far as the options allow, and counts what was not in order."""

    def __init__(self, options: OrderOptions) -> None:
        self._options = options
        self._latest_us: int | None = None  # since the last restart
        self._top_us: int | None = None  # of all events
        self._restarts: list[Restart] = []
        self._sizes = [0]  # events of each part
        self._total = 0
        self._late = 0  # events at least 1 ms after a later one, of any part
        self.small = 0  # events that came less than 1 ms after a later one, or with `sort` any time
        self.back_us = 0  # the largest such step
        self._crowded = False  # more events of one time than can wait

    @property
    def unsorted(self) -> bool:
        """Whether the file has more steps back than a camera that was restarted makes."""
        return len(self._restarts) >= MOST_RESTARTS

    @property
    def refused(self) -> bool:
        """Whether the events so far cannot be used as the options say."""
        options = self._options
        return self._crowded or (bool(self._restarts) and (options.from_restart is None or self.unsorted))

    def ordered(self, parts: Iterable[Placed]) -> Iterator[Events]:
        """The events that the options keep; in the order of their time, unless it is to be sorted or is refused."""
        judged = (piece for part, place in parts if part.size for piece in self._judged(part, place))
        return judged if self._options.sort else self._in_order(judged)

    def _judged(self, part: Events, place: Callable[[int], str]) -> Iterator[Events]:
        """The pieces of a part that are kept, cut where the clock was restarted."""
        t = part.t
        self._total += part.size
        if self._latest_us is None:
            self._latest_us = self._top_us = int(t[0])
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
        """Count the events of a piece, and give them out if they are kept."""
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
        """Put events in order that are less than 1 ms late; of one time as they came."""
        waiting: list[Events] = []  # in order, each of them and one after the other; all that is yet to come is later
        count = 0
        for judged in pieces:
            piece = judged if (judged.t[1:] >= judged.t[:-1]).all() else _sorted(judged)
            first_us = int(piece.t[0])
            overtaken = []
            while waiting and waiting[-1].t[-1] > first_us:
                overtaken.append(waiting.pop())
            waiting.append(_sorted(concatenate([*reversed(overtaken), piece])) if overtaken else piece)
            count += piece.size
            assert self._latest_us is not None
            while waiting[0].t[-1] <= self._latest_us - SLICE_US:
                count -= waiting[0].size
                yield waiting.pop(0)
            if count > MOST_WAITING:
                self._crowded = True
                return
        yield from waiting

    def refuse(self, where: str) -> None:
        """InputError where the events cannot be used as the options say."""
        wanted = self._options.from_restart
        if self._crowded:
            raise InputError(
                "more events within 1 ms than a camera makes",
                where=where,
                expected=f"at most {MOST_WAITING:,}",
                found=f"more than that near {(self._top_us or 0) / 1e6:.6f} s",
                hint="are these their times? --sort takes them as they are",
            )
        if self.refused:
            raise InputError(
                "time goes backwards",
                where=where,
                expected="events in the order of their time, less than 1 ms late",
                found=self._steps(),
                hint=self._hint(),
            )
        if wanted is not None and not self._restarts:
            raise InputError(
                "--from-restart has nothing to choose: time never goes back by 1 ms or more",
                where=where,
                found=str(wanted),
                hint="leave it out",
            )
        if wanted is not None and wanted >= len(self._sizes):
            raise InputError("no such restart", where=where, expected=self._parts(), found=str(wanted))

    def _steps(self) -> str:
        """The steps back in words."""
        shown = [
            f"{one.place} from {one.before_us / 1e6:.6f} s to {one.after_us / 1e6:.6f} s"
            for one in self._restarts[:MOST_SHOWN]
        ]
        count = len(self._restarts)
        if count <= MOST_SHOWN:
            return ", ".join(shown)
        return f"{count:,}{' or more' if self.unsorted else ''} times, first {', '.join(shown)}"

    def _hint(self) -> str:
        """What each option would do."""
        if self.unsorted:
            return "--sort sorts all events by time, which is right if all times are of one clock"
        events = f"{self._late:,} event{'s' if self._late > 1 else ''} ({100 * self._late / self._total:.2g}%)"
        drop = f"--drop-late leaves out the {events} that came 1 ms or more after a later one"
        cut = f"--from-restart N keeps one part ({self._parts()})"
        few = self._late <= FEW_LATE * self._total
        return f"{drop}; {cut}" if few else f"{cut}; {drop}"

    def _parts(self) -> str:
        """The parts between restarts, with their sizes, as in `part 0: 3 events, part 1: 1 event`."""
        shown = [
            f"part {number}: {size:,} event{'s' * (size != 1)}"
            for number, size in enumerate(self._sizes[: MOST_SHOWN + 1])
        ]
        more = len(self._sizes) - len(shown)
        return ", ".join([*shown, f"{more} more"] if more > 0 else shown)

    @property
    def notes(self) -> list[str]:
        """What was put in order and what was kept, in words."""
        notes = []
        if self.small:
            back = f"{self.back_us:,} us" if self.back_us < SLICE_US else f"{self.back_us / 1e6:.6g} s"
            came = "1 event came" if self.small == 1 else f"{self.small:,} events came"
            notes.append(f"{came} up to {back} after a later one: put in order")
        if self._options.from_restart is not None and self._restarts:
            kept = f"kept part {self._options.from_restart} ({self._parts()})"
            notes.append(f"time goes back {self._steps()}; {kept}")
        if self._options.drop_late and self._late:
            events = "1 event" if self._late == 1 else f"{self._late:,} events"
            notes.append(f"dropped {events} that came 1 ms or more after a later one")
        return notes

    @property
    def dropped(self) -> dict[str, int]:
        """Events that the options leave out, by reason; none where there are none."""
        dropped = {"late": self._late} if self._options.drop_late else {}
        if self._options.from_restart is not None:
            dropped["other_parts"] = self._total - self._sizes[min(self._options.from_restart, len(self._sizes) - 1)]
        return {reason: count for reason, count in dropped.items() if count}


def _sorted(events: Events) -> Events:
    return events.at(np.argsort(events.t, kind="stable"))
