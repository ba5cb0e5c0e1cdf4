"""What a recording process and its live view share: messages, and the latest slices and commands in shared memory.

The recording process loads this module, but not the modules that track dots, which take a second to load.

The recording loop writes here and never waits: it overwrites the oldest data, read or not. A slow reader misses
slices. One byte goes the other way: whether the user pressed the release button.

A view may be late and may skip data; a recording may not. So a reader takes no lock. A slice of 1000 events costs its
writer 5 us. Data that are overwritten while being read are only displayed, and every pixel and polarity in the memory
is valid. So the worst result is a picture with a few wrong events.
"""

import multiprocessing
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import Events
from evetac_cli.realtime.shared_row import SharedRow

SLICES = 1 << 13  # 8 s
EVENTS = 1 << 21  # 2 s at a million per second
MOST_EVENTS = EVENTS // 8  # limit of one slice; this many may be in the middle of a write while others are read
GRIPPER_NUMBERS = 6
_COLUMNS: dict[str, tuple[Any, int]] = {
    "head": (np.int64, 2),  # number of slices so far, number of events so far
    "end": (np.int64, SLICES),  # number of events so far after each slice
    "late_us": (np.float32, SLICES),
    "probability": (np.float32, SLICES),
    "x": (np.uint16, EVENTS),
    "y": (np.uint16, EVENTS),
    "p": (np.uint8, EVENTS),
    "let_go": (np.uint8, 8),
}
_GRIPPER_BYTES = 128


# Messages from the recording process to the process of the view, other than slices and commands


class Title(NamedTuple):
    """The title of a view, known before a device is opened."""

    name: str  # name of the command and its file
    simulated: bool
    moves: bool  # whether a gripper moves that can be released


class Started(NamedTuple):
    """The camera runs."""

    sensor: Mapping[str, Any]  # datasets sensor/...


class Lost(NamedTuple):
    """Events lost so far, and the reasons as text."""

    events: str
    why: str


class Message(NamedTuple):
    """A message to the user."""

    text: str


class Ended(NamedTuple):
    """The reason, as text, why there will be no more slices."""

    why: str


# Shared memory


class SeenSlices(NamedTuple):
    """Consecutive slices, starting at number `first`: slice k has the events [starts[k], starts[k + 1])."""

    first: int
    starts: NDArray[np.int64]  # (n + 1,)
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]
    late_us: NDArray[np.float32]  # (n,) delay of each, from its end; NaN if unknown
    probability: NDArray[np.float32]  # (n,) slip probability from the loop; NaN without one

    @property
    def slices(self) -> int:
        """The number of slices."""
        return len(self.late_us)


class GripperNumbers(NamedTuple):
    """The latest command of a gripper and the reading before it; NaN for values that are not commanded or unknown."""

    position_ticks: float
    goal_ticks: float
    current_ma: float
    goal_ma: float
    missed: float  # missed commands so far
    phase: float  # phase of a grasp


class SharedView:
    """The shared memory; may be passed to a process that is being spawned."""

    def __init__(self) -> None:
        size = sum(np.dtype(kind).itemsize * length for kind, length in _COLUMNS.values())
        self._block = multiprocessing.get_context("spawn").RawArray("B", size + _GRIPPER_BYTES)
        self._attach()

    def _attach(self) -> None:
        memory = memoryview(self._block).cast("B")
        columns: dict[str, NDArray[Any]] = {}
        at = 0
        for name, (kind, length) in _COLUMNS.items():
            columns[name] = np.frombuffer(memory, kind, length, at)
            at += columns[name].nbytes
        self._head, self._end, self._late_us, self._probability, x, y, p, self._let_go = columns.values()
        self._events = (x, y, p)
        self._gripper = SharedRow(memory, at, f"{GRIPPER_NUMBERS}d")

    def __getstate__(self) -> dict[str, object]:
        return {"_block": self._block}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._attach()

    def add_slice(self, events: Events, late_us: float = float("nan"), probability: float = float("nan")) -> None:
        """For the loop: add one more slice. If it has more than MOST_EVENTS events, they are left out."""
        slices, written = self._head.tolist()
        size = events.size
        if size <= MOST_EVENTS:
            at = written % EVENTS
            whole = min(size, EVENTS - at)
            columns: tuple[NDArray[Any], ...] = (events.x, events.y, events.p)
            for column, values in zip(self._events, columns, strict=True):
                column[at : at + whole] = values[:whole]
                if whole < size:
                    column[: size - whole] = values[whole:]
            written += size
        place = slices % SLICES
        self._end[place] = written
        self._late_us[place] = late_us
        self._probability[place] = probability
        self._head[1] = written
        self._head[0] = slices + 1

    def set_gripper(self, numbers: GripperNumbers) -> None:
        """For the loop: set the latest command."""
        self._gripper.write(*numbers)

    @property
    def is_asked_to_let_go(self) -> bool:
        """For the loop: whether `let_go` was called."""
        return bool(self._let_go[0])

    def let_go(self) -> None:
        """For the view: request the release of the gripper."""
        self._let_go[0] = 1

    @property
    def slices(self) -> int:
        """The number of slices so far."""
        return int(self._head[0])

    @property
    def gripper(self) -> GripperNumbers | None:
        """The latest command; None before the first."""
        row = self._gripper.read()
        return None if row is None else GripperNumbers(*row[1])

    def since(self, first: int) -> SeenSlices:
        """Return copies of the slices starting at number `first`, without those already overwritten."""
        slices = self.slices
        first = min(max(first, slices - SLICES // 2), slices)
        bounds = self._end[np.arange(first - 1, slices) % SLICES]
        if first == 0:
            bounds[0] = 0
        bounds = np.maximum.accumulate(bounds)  # some processors see the writes of another in a different order
        places = np.arange(first, slices) % SLICES
        late_us, probability = self._late_us[places], self._probability[places]
        kept = self._kept(bounds)
        positions = np.arange(bounds[kept], bounds[-1]) % EVENTS
        x, y, p = (column[positions] for column in self._events)
        over = self._kept(bounds)  # overwritten since then
        if over > kept:
            x, y, p = (column[bounds[over] - bounds[kept] :] for column in (x, y, p))
        starts = bounds[over:] - bounds[over]
        return SeenSlices(first + over, starts, x, y, p, late_us[over:], probability[over:])

    def _kept(self, bounds: NDArray[np.int64]) -> int:
        """Return the first slice without events that were, or are being, overwritten."""
        oldest = int(self._head[1]) + MOST_EVENTS - EVENTS
        return min(int(np.searchsorted(bounds, oldest)), len(bounds) - 1)
