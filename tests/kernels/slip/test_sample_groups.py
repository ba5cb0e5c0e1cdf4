"""Groups of trajectories: all of one as if it were alone, each busy sample once an epoch, one group in memory."""

import gc
import weakref
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evetac_cli.kernels.slip import sampling, training
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.sampling import PoolSizes, SampleGroups, SlipSamples, TrajectorySize, drawn_groups

HIST10 = ARCHITECTURES["hist10"]
BUSY = 46  # samples of a trajectory: every other slice of 9 .. 99


def trajectory(number: int, slices: int = 120, onset: int = 100) -> Trajectory:
    """A trajectory with its number as displacement, of which every other slice is busy."""
    label = (np.arange(slices) >= onset).astype(np.int8)
    outside = np.where(np.arange(slices) % 2, 26, 25).astype(np.int32)
    return Trajectory(np.full((slices, 56, 2), number, np.float32), outside, label, onset)


class Shelf:
    """Six trajectories in three groups, which are made when they are asked for."""

    def __init__(self) -> None:
        self.members = [[0, 5], [1, 3], [2, 4]]
        self.read: list[int] = []
        steps = [-(-2 * BUSY // 32)] * 3
        self.groups = SampleGroups(steps, self._samples)

    def _samples(self, number: int) -> SlipSamples:
        self.read.append(number)
        return sampling.gather([trajectory(index) for index in self.members[number]], HIST10)


def test_sizes_of_pools_are_those_that_are_gathered() -> None:
    """Assert that a trajectory's samples are counted as they are sorted, with and without quiet ones, and ahead."""
    for ahead, one in ((0, trajectory(1)), (10, trajectory(1)), (0, trajectory(1)._replace(onset=-1))):
        if one.onset < 0:
            one.label[50:] = -1
            one.label[40:45] = 1
        samples = sampling.gather([one], HIST10, horizon_ms=ahead)
        sizes = sampling.pool_sizes(one.label, one.onset, one.events_outside, HIST10, ahead)
        assert sizes == (len(samples.slip), len(samples.busy), len(samples.quiet), len(samples.still))
        assert sizes.steps == sampling.steps_per_epoch(samples)


def test_an_epoch_sees_every_busy_sample_once() -> None:
    """Assert that each busy sample of every group is drawn once an epoch, and groups are read in turn, once each."""
    shelf = Shelf()
    epochs = 2
    drawn: list[float] = []
    for batch in islice(shelf.groups.batches(np.random.default_rng(0)), epochs * shelf.groups.steps_per_epoch):
        drawn += shelf.groups.now.inputs(batch.busy)[:, 0, 0].tolist()
        assert set(shelf.groups.now.inputs(batch.slip)[:, 0, 0]) <= set(shelf.members[shelf.read[-1]])
    assert shelf.read == [0, 1, 2] * epochs
    assert sorted(drawn) == sorted([float(number) for number in range(6)] * BUSY * epochs)


@pytest.mark.slow
def test_a_group_leaves_memory_before_the_next_is_read() -> None:
    """Assert that nothing holds a group any more when the next one is read, in the middle of a training."""
    shelf = Shelf()
    held: list[weakref.ref[SlipSamples]] = []
    make = shelf._samples

    def noted(number: int) -> SlipSamples:
        gc.collect()
        assert all(one() is None for one in held)
        samples = make(number)
        held.append(weakref.ref(samples))
        return samples

    groups = SampleGroups([2, 2, 2], noted)
    training.train(groups, training.PRESETS["adam"], np.random.default_rng(0), max_steps=7)
    assert shelf.read == [0, 1, 2, 0]


def test_each_network_of_the_same_groups_is_the_same() -> None:
    """Assert that a training is the same whichever group is in memory when it begins, and where it was broken off."""
    saved: list[training.TrainingState] = []
    shelf = Shelf()
    preset = training.PRESETS["adam"]
    first = training.train(shelf.groups, preset, np.random.default_rng(0), max_steps=9)
    assert shelf.read[-1] != 0
    second = training.train(shelf.groups, preset, np.random.default_rng(0), max_steps=9)

    def stop(state: Callable[[], training.TrainingState]) -> None:
        saved.append(state())
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training, "SAVE_STEPS", 4)
        training.train(Shelf().groups, preset, np.random.default_rng(0), max_steps=9, on_save=stop)
    third = training.train(Shelf().groups, preset, np.random.default_rng(0), max_steps=9, resume_from=saved[-1])
    for other in (second, third):
        for name, array in first.checkpoints[-1].weights.items():
            np.testing.assert_array_equal(array, other.checkpoints[-1].weights[name])


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 1), st.integers(0, 2)), min_size=1, max_size=30),
    st.integers(1, 20),
    st.integers(0, 5),
)
def test_groups_hold_all_within_the_memory(given_sizes: list[tuple[int, int, int]], most: int, seed: int) -> None:
    """Assert that every trajectory is in one group that can be trained on, and that groups are as large as allowed."""
    sizes = [TrajectorySize(memory, PoolSizes(slip, busy, 0)) for memory, slip, busy in given_sizes]
    groups = drawn_groups(sizes, most, np.random.default_rng(seed))
    assert sorted(index for group in groups for index in group) == list(range(len(sizes)))

    def usable(group: list[int]) -> bool:
        slip, busy, *_ = np.sum([sizes[index].samples for index in group], axis=0)
        return bool(slip and busy)

    if len(groups) > 1:
        assert all(usable(group) for group in groups)
    if all(size.samples.slip and size.samples.busy for size in sizes):
        taken = [sum(sizes[index].memory_bytes for index in group) for group in groups]
        assert all(bytes_ <= most or len(group) == 1 for bytes_, group in zip(taken, groups, strict=True))
        assert len(groups) < 2 or sum(taken) > most
