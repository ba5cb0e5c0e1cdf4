"""Select the slices that a slip detector is trained on, how often each is drawn, and how samples are rotated.

Slip is rare, and most other slices are silent, so samples are drawn from three pools (paper, Model Training & Data
Selection):

- slip: slices labelled slip;
- busy: slices labelled no slip with more than 25 events;
- quiet: all other slices labelled no slip.

"Events" are those outside the window strip, because a detector must not see the window. A batch of 72 has 32, 32 and 8
of them, and an epoch is one pass over the busy pool.

A fourth pool, `still`, contains trajectories in which nothing ever slips; the paper has none. These are opening
fingers, pushes and shaking, and most of their slices are easy. If there are any, a batch has 16 more samples from this
pool. For these, 48 are drawn. The first 8 are used, and of the other 40 the 8 to which the present network assigns the
highest probability of slip (training.py).

Trajectories that do not fit into memory together are trained on in groups that do. The features files are packed in
blocks of some thousand slices, so reading one slice costs as much as reading its whole block. Groups of whole
trajectories are therefore drawn at random once. Each group is read in turn, passes all of its busy samples once, in the
same order as if it were alone, and makes room for the next. Trajectories that fit into memory form one group.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip import inputs
from evetac_cli.kernels.slip.architectures import Architecture, OverImages
from evetac_cli.kernels.slip.inputs import OfEvents, Trajectory
from evetac_cli.kernels.slip.load_path import LoadPath
from evetac_cli.kernels.slip.metrics import BUSY_EVENTS, check_labels, shift_labels

SLIP_SHARE = 32  # samples of each pool in a batch
BUSY_SHARE = 32
QUIET_SHARE = 8
STILL_SHARE = 16
STILL_DRAWN = 48  # still samples that are drawn, of which STILL_SHARE are used
ROTATED_SHARE = 0.5  # of the samples
NORMALISE_SAMPLES = 2000  # of each pool, enough for a mean and a standard deviation
NORMALISE_IMAGES = 200  # the same for images, each of which has some thousand values
NORMALISE_VALUES = 1 << 22  # processed at a time: 32 MiB


@dataclass(frozen=True)
class SlipSamples:
    """Trajectories end to end, and for each pool the slices (int64) at which a sample's history ends.

    Inputs are gathered again for each batch. All of them together would hold every slice once per step of the history
    (2.4 GB for 360 trajectories of 1.5 s and hist10), and gathering takes a small part of a training step.
    """

    architecture: Architecture
    rows: int
    columns: int
    series: inputs.Series
    slip: NDArray[np.int64]
    busy: NDArray[np.int64]
    quiet: NDArray[np.int64]
    slip_share: NDArray[np.float32]  # (slices,) of the visible contact, as far ahead as the labels; NaN if unknown
    still: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def inputs(self, at: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the network inputs (samples, ...) of the samples that end at these slices."""
        return inputs.at(self.architecture, self.series, at)


def gather(
    trajectories: Iterable[Trajectory],
    architecture: Architecture,
    rows: int = 7,
    columns: int = 8,
    horizon_ms: int = 0,
) -> SlipSamples:
    """Sort the slices of trajectories into the pools; slices that no sample needs are left out.

    A trajectory with an onset is cut to the slices [0, onset + cut): 15 ms for a history up to 10, 20 ms up to 20, 50
    ms beyond. A slice is a sample if its history is full and it is labelled. With `horizon_ms` the same slices get the
    labels of `shift_labels`. Trajectories are taken one by one, and unneeded parts are not kept. ValueError if the
    slip or busy pool would be empty; the others may be.
    """
    pools: dict[str, list[NDArray[np.int64]]] = {name: [] for name in PoolSizes._fields}
    shares: list[NDArray[np.float32]] = []
    series = inputs.join(_sorted(trajectories, architecture, rows * columns, horizon_ms, pools, shares))
    ends = {name: np.concatenate(pool) for name, pool in pools.items()}
    return SlipSamples(architecture, rows, columns, series, **ends, slip_share=np.concatenate(shares))


def _sorted(
    trajectories: Iterable[Trajectory],
    architecture: Architecture,
    dots: int,
    horizon_ms: int,
    pools: dict[str, list[NDArray[np.int64]]],
    shares: list[NDArray[np.float32]],
) -> Iterator[inputs.Series]:
    """Yield the slices of each trajectory that samples need; fills `pools` and `shares` on the way."""
    history = architecture.history
    begin = count = 0
    for trajectory in trajectories:
        count += 1
        assert len(trajectory.label) == len(trajectory.events_outside) == inputs.length(trajectory.series)
        assert isinstance(trajectory.series, OfEvents | LoadPath) or trajectory.series.shape[1] == dots
        members = _members(trajectory.label, trajectory.onset, trajectory.events_outside, architecture, horizon_ms)
        used = np.logical_or.reduce([*members.values()])
        if not used.any():
            continue
        slices, first = len(used), int(np.argmax(used)) - (history - 1)
        for name, mask in members.items():
            pools[name].append(begin - first + np.flatnonzero(mask))
        shares.append(_share_ahead(trajectory, horizon_ms)[first:slices])
        begin += slices - first
        yield inputs.part(trajectory.series, first, slices)
    meanings = {"slip": "labelled slip", "busy": f"labelled no slip with more than {BUSY_EVENTS} events"}
    for name, meaning in meanings.items():
        if not any(len(pool) for pool in pools[name]):
            raise ValueError(
                f"the {name} pool is empty: expected at least one slice {meaning} with a full history of "
                f"{history}, found none in {count} trajectories"
            )


def train_cut_ms(history: int) -> int:
    """Return the length of the training data after an onset (paper, Model Training & Data Selection)."""
    if history <= 10:
        return 15
    return 20 if history <= 20 else 50


def _members(
    label: NDArray[np.int8],
    onset: int,
    events_outside: NDArray[np.int32],
    architecture: Architecture,
    horizon_ms: int,
) -> dict[str, NDArray[np.bool_]]:
    """Return, for each pool, which slices of a trajectory are its samples, up to the cut of the trajectory."""
    shifted = shift_labels(label, horizon_ms)
    slices = len(shifted) if onset < 0 else min(len(shifted), onset + train_cut_ms(architecture.history))
    full, shifted = np.arange(slices) >= architecture.history - 1, shifted[:slices]
    busy = events_outside[:slices] > BUSY_EVENTS
    never_slips = onset < 0 and not np.any(label == 1)
    slips, others, none = full & (shifted == 1), full & (shifted == 0), np.zeros(slices, np.bool_)
    if never_slips:
        return {"slip": none, "busy": none, "quiet": none, "still": others}
    return {"slip": slips, "busy": others & busy, "quiet": others & ~busy, "still": none}


class PoolSizes(NamedTuple):
    """Number of samples in each pool."""

    slip: int
    busy: int
    quiet: int
    still: int = 0

    @property
    def steps(self) -> int:
        """Number of batches in one pass over the busy pool."""
        return -(-self.busy // _busy_share(self.quiet))


def pool_sizes(
    label: NDArray[np.int8],
    onset: int,
    events_outside: NDArray[np.int32],
    architecture: Architecture,
    horizon_ms: int = 0,
) -> PoolSizes:
    """Return the number of samples that `gather` adds to each pool from a trajectory."""
    check_labels(label, onset)
    members = _members(label, onset, events_outside, architecture, horizon_ms)
    return PoolSizes(*(int(np.count_nonzero(mask)) for mask in members.values()))


def _share_ahead(trajectory: Trajectory, horizon_ms: int) -> NDArray[np.float32]:
    """Return the slipping share of the contact this much later, (slices,): 1 starting at the onset, NaN if unknown."""
    slices = len(trajectory.label)
    if trajectory.slip_share is None:
        return np.full(slices, np.nan, np.float32)
    later = np.minimum(np.arange(slices) + horizon_ms, slices - 1)
    share = trajectory.slip_share[later].astype(np.float32)
    return np.where((trajectory.onset >= 0) & (later >= trajectory.onset), np.float32(1), share)


class Batch(NamedTuple):
    """One batch, by pool: the slices at which its samples end. Of `still`, some are selected later."""

    slip: NDArray[np.int64]
    busy: NDArray[np.int64]
    quiet: NDArray[np.int64]
    still: NDArray[np.int64]


def steps_per_epoch(samples: SlipSamples) -> int:
    """Return the number of batches in one pass over the busy pool."""
    return PoolSizes(len(samples.slip), len(samples.busy), len(samples.quiet)).steps  # still samples do not count


def batches(samples: SlipSamples, rng: np.random.Generator) -> Iterator[Batch]:
    """Draw batches without end; `steps_per_epoch` of them use every busy sample once.

    Each pool is shuffled, dealt out, and shuffled again when it is used up; except for busy samples, dealing continues
    across epochs. The last batch of an epoch has the rest of the busy pool, and the other shares shrink with it
    (rounded up), to keep the proportions. If the quiet pool is empty, its share goes to the busy pool.
    """
    share = _busy_share(len(samples.quiet))
    slip_deck = _deal(samples.slip, rng)
    quiet_deck = _deal(samples.quiet, rng)
    quiet_share = QUIET_SHARE if len(samples.quiet) else 0
    still_deck, still_drawn = _deal(samples.still, rng), STILL_DRAWN if len(samples.still) else 0
    while True:
        order = rng.permutation(samples.busy)
        for start in range(0, len(order), share):
            busy = order[start : start + share]
            yield Batch(
                _take(slip_deck, -(-SLIP_SHARE * len(busy) // share)),
                busy,
                _take(quiet_deck, -(-quiet_share * len(busy) // share)),
                _take(still_deck, -(-still_drawn * len(busy) // share)),
            )


def quarter_turns(samples: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the number of rotations by 90 degrees of each sample: 1 to 3 with probability 0.5, else 0."""
    return np.where(rng.random(samples) < ROTATED_SHARE, rng.integers(1, 4, samples), 0)


def augment(
    samples: SlipSamples, batch: NDArray[np.float32], turns: NDArray[np.int64], factors: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return a batch whose inputs are rotated by their quarter turns and multiplied by their factors.

    A rotation simulates another direction of the grasp (paper).
    """
    return inputs.turn(samples.architecture, batch, samples.rows, samples.columns, turns, factors)


def channel_stats(samples: SlipSamples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and standard deviation of each channel over an average batch: every pool counts by its share."""
    images = isinstance(samples.architecture, OverImages)
    axes = (0, 2, 3) if images else (0, 1)
    most = NORMALISE_IMAGES if images else NORMALISE_SAMPLES
    at_once = max(1, NORMALISE_VALUES // samples.inputs(samples.slip[:1]).size)
    pools = pool_shares(samples)
    whole = sum(share for share, _, _ in pools)
    mean = square = np.zeros(1)
    for share, pool in ((share / whole, pool) for share, pool, _ in pools):
        spaced = pool[:: -(-len(pool) // most)]
        for begin in range(0, len(spaced), at_once):
            chunk = spaced[begin : begin + at_once]
            values = samples.inputs(chunk).astype(np.float64)
            part = share * len(chunk) / len(spaced)
            mean = mean + part * values.mean(axis=axes)
            square = square + part * np.square(values).mean(axis=axes)
    return mean, np.sqrt(np.maximum(square - np.square(mean), 0))


def pool_shares(samples: SlipSamples) -> list[tuple[int, NDArray[np.int64], float]]:
    """Return, for each pool that is not empty, its share of a batch, its slices, and their label."""
    pools = (
        (SLIP_SHARE, samples.slip, 1.0),
        (_busy_share(len(samples.quiet)), samples.busy, 0.0),
        (QUIET_SHARE, samples.quiet, 0.0),
        (STILL_SHARE, samples.still, 0.0),
    )
    return [pool for pool in pools if len(pool[1])]


def _busy_share(quiet: int) -> int:
    return BUSY_SHARE if quiet else BUSY_SHARE + QUIET_SHARE


def _deal(pool: NDArray[np.int64], rng: np.random.Generator) -> Iterator[np.int64]:
    while True:
        yield from rng.permutation(pool)


def _take(deck: Iterator[np.int64], count: int) -> NDArray[np.int64]:
    return np.fromiter(islice(deck, count), np.int64, count)


class TrajectorySize(NamedTuple):
    """Memory that a trajectory takes, and its number of samples in each pool."""

    memory_bytes: int
    samples: PoolSizes


class SampleGroups:
    """Groups of trajectories, of which one is in memory: `now`."""

    def __init__(self, steps: Sequence[int], read: Callable[[int], SlipSamples]) -> None:
        """steps: of one pass over the busy pool, for each group; read: returns the samples of a group by its number."""
        self._steps, self._read = steps, read
        self._number: int | None = None
        self._now: SlipSamples | None = None

    @classmethod
    def alone(cls, samples: SlipSamples) -> "SampleGroups":
        """Return a single group of all samples."""
        return cls([steps_per_epoch(samples)], lambda _: samples)

    @property
    def steps_per_epoch(self) -> int:
        """Number of batches in one pass over the busy pools of all groups."""
        return sum(self._steps)

    @property
    def now(self) -> SlipSamples:
        """The group that is in memory: the first, until batches are drawn from another."""
        return self._opened(self._number or 0)

    @property
    def first(self) -> SlipSamples:
        """The first group, from which a training takes its normalisation."""
        return self._opened(0)

    def batches(self, rng: np.random.Generator) -> Iterator[Batch]:
        """Draw batches without end, each from the group `now`; a single group is drawn as by `sampling.batches`."""
        if len(self._steps) == 1:
            yield from batches(self.first, rng)
        while True:
            for number, steps in enumerate(self._steps):
                yield from islice(batches(self._opened(number), rng), steps)

    def _opened(self, number: int) -> SlipSamples:
        if self._now is None or number != self._number:
            self._now = None  # frees the memory before the next group is read
            self._now, self._number = self._read(number), number
        return self._now


def drawn_groups(sizes: Sequence[TrajectorySize], most_bytes: int, rng: np.random.Generator) -> list[list[int]]:
    """Return the trajectories of each group, sorted within it and drawn at random.

    A group has as many trajectories as fit into most_bytes, and at least enough to have slip and busy samples. The
    result is one group if no two would have samples of both.
    """
    groups: list[list[int]] = []
    taken = slip = busy = 0  # totals of the last group
    for number in rng.permutation(len(sizes)).tolist():
        memory_bytes, samples = sizes[number]
        if not groups or (slip and busy and taken + memory_bytes > most_bytes):
            groups.append([])
            taken = slip = busy = 0
        groups[-1].append(number)
        taken, slip, busy = taken + memory_bytes, slip + samples.slip, busy + samples.busy
    if len(groups) > 1 and not (slip and busy):
        last = groups.pop()
        groups[-1] += last
    return [sorted(group) for group in groups]
