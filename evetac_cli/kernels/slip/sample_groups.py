"""Trajectories that do not fit into memory together: a detector is trained on groups of them that do, in turn.

Why so: the features files are packed in blocks of some thousand slices, so that a slice anywhere costs as much as the
thousands around it. Groups are drawn at random once, of whole trajectories; each is read as its turn comes, gives all
its busy samples once, in the same order as if there were nothing else, and makes room for the next. Trajectories that
fit into memory are one group.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from evetac_cli.kernels.slip.sampling import Batch, PoolSizes, SlipSamples, batches, steps_per_epoch


class Size(NamedTuple):
    """What a trajectory takes in memory, and how many samples of each pool it has."""

    memory_bytes: int
    samples: PoolSizes


class SampleGroups:
    """Groups of trajectories, of which one is in memory: `now`."""

    def __init__(self, steps: Sequence[int], read: Callable[[int], SlipSamples]) -> None:
        """steps: of one pass over the busy pool of each group; read: the samples of the group of this number."""
        self._steps, self._read = steps, read
        self._number: int | None = None
        self._now: SlipSamples | None = None

    @classmethod
    def alone(cls, samples: SlipSamples) -> "SampleGroups":
        """The one group of all samples."""
        return cls([steps_per_epoch(samples)], lambda _: samples)

    @property
    def steps_per_epoch(self) -> int:
        """Batches in one pass over the busy pools of all groups."""
        return sum(self._steps)

    @property
    def now(self) -> SlipSamples:
        """The group that is in memory: the first, until another is drawn from."""
        return self._opened(self._number or 0)

    @property
    def first(self) -> SlipSamples:
        """The first group, from which a training takes what it needs to know of all samples."""
        return self._opened(0)

    def batches(self, rng: np.random.Generator) -> Iterator[Batch]:
        """Draw batches without end, each from the group `now`; those of one group as `sampling.batches` draws them."""
        if len(self._steps) == 1:
            yield from batches(self.first, rng)
        while True:
            for number, steps in enumerate(self._steps):
                yield from islice(batches(self._opened(number), rng), steps)

    def _opened(self, number: int) -> SlipSamples:
        if self._now is None or number != self._number:
            self._now = None  # before there is another
            self._now, self._number = self._read(number), number
        return self._now


def drawn_groups(sizes: Sequence[Size], most_bytes: int, rng: np.random.Generator) -> list[list[int]]:
    """The trajectories of each group, sorted: at random, as many as fit, or as it takes to have slip and busy samples.

    most_bytes: that a group takes. One group, if no two have samples of both.
    """
    groups: list[list[int]] = []
    taken = slip = busy = 0  # by the last group
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
