"""Train on trajectories that do not fit into memory together: in groups that do, one after the other.

The features files are packed in blocks of some thousand slices, so reading one slice costs as much as reading its whole
block. Groups of whole trajectories are therefore drawn at random once. Each group is read in turn, passes all of its
busy samples once, in the same order as if it were alone, and makes room for the next. Trajectories that fit into memory
form one group.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from evetac_cli.kernels.slip.sampling import Batch, PoolSizes, SlipSamples, batches, steps_per_epoch


class Size(NamedTuple):
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


def drawn_groups(sizes: Sequence[Size], most_bytes: int, rng: np.random.Generator) -> list[list[int]]:
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
