"""Sampling: which slices are drawn, how often, and how they are varied."""

from collections import Counter
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray

from evetac_cli.kernels.slip import features, inputs, sampling
from evetac_cli.kernels.slip.architectures import ARCHITECTURES, ChannelView, DotArchitecture
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.sampling import Batch, SlipSamples

HIST10 = ARCHITECTURES["hist10"]


def trajectory(slices: int, onset: int, busy: NDArray[np.bool_] | None = None, mark: float = 0) -> Trajectory:
    """Give labels that slip from `onset` on, busy slices as wished, and `mark` as displacement everywhere."""
    label = np.zeros(slices, np.int8)
    if onset >= 0:
        label[onset:] = 1
    outside = np.where(np.ones(slices, bool) if busy is None else busy, 26, 25).astype(np.int32)
    return Trajectory(np.full((slices, 56, 2), mark, np.float32), outside, label, onset)


def pools(slip: int, busy: int, quiet: int, still: int = 0) -> SlipSamples:
    """Give samples of which only the pools matter, with a different slice for each."""
    parts = np.split(np.arange(slip + busy + quiet + still), np.cumsum([slip, busy, quiet]))
    series = np.zeros((0, 56, 2), np.float32)
    return SlipSamples(HIST10, 7, 8, series, *parts[:3], np.zeros(0, np.float32), parts[3])


def test_pools_of_a_small_trajectory() -> None:
    """Assert that slip, busy and quiet slices are those counted by hand, cut 15 slices from the onset on."""
    busy = np.arange(100) % 2 == 0
    samples = sampling.gather([trajectory(100, 30, busy)], HIST10)
    np.testing.assert_array_equal(samples.slip, np.arange(30, 45))
    np.testing.assert_array_equal(samples.busy, np.arange(10, 30, 2))
    np.testing.assert_array_equal(samples.quiet, np.arange(9, 30, 2))
    assert inputs.length(samples.series) == 45


@pytest.mark.parametrize(("history", "first", "slipping"), [(1, 0, 15), (10, 9, 15), (20, 19, 20), (50, 49, 50)])
def test_history_sets_the_first_sample_and_the_cut(history: int, first: int, slipping: int) -> None:
    """Assert that no sample lies before a full history, and that longer histories keep more slices of slip."""
    architecture = DotArchitecture("", (ChannelView("events", history),), 1, 1)
    samples = sampling.gather([trajectory(200, 60)], architecture)
    assert samples.busy[0] == first
    np.testing.assert_array_equal(samples.slip, np.arange(60, 60 + slipping))


def test_busy_means_more_than_25_events_outside_the_window() -> None:
    """Assert that 25 events are quiet and 26 busy, and that events beside dots do not decide."""
    one = trajectory(40, 30, np.arange(40) == 20)
    samples = sampling.gather([one._replace(series=np.full((40, 56, 2), 100, np.float32))], HIST10)
    np.testing.assert_array_equal(samples.busy, [20])
    assert 20 not in samples.quiet


def test_share_of_slip_as_far_ahead_as_the_labels() -> None:
    """Assert that a sample has the share of 10 ms later, 1 from the onset on, and NaN where it is not known."""
    share = np.linspace(0, 1, 100, dtype=np.float32)
    known = trajectory(100, 30)._replace(slip_share=share)
    samples = sampling.gather([known, trajectory(100, 30)], HIST10, horizon_ms=10)
    np.testing.assert_array_equal(samples.slip_share[:20], share[10:30])
    assert (samples.slip_share[20:45] == 1).all()
    assert np.isnan(samples.slip_share[45:]).all()


def test_inputs_are_those_of_the_trajectory() -> None:
    """Assert that a sample holds what its slice has in the trajectory itself, and that unseen slices are not kept."""
    rng = np.random.default_rng(0)
    one = trajectory(90, 60)._replace(series=rng.random((90, 56, 2), np.float32))
    one.label[:40] = -1
    samples = sampling.gather([trajectory(50, 30), one], HIST10)
    selected = 60 + 15 - (40 - 9)
    assert inputs.length(samples.series) == 45 + selected
    expected = inputs.at(HIST10, one.series, np.arange(40, 75))
    result = samples.inputs(np.concatenate([samples.busy[samples.busy >= 45], samples.slip[samples.slip >= 45]]))
    np.testing.assert_array_equal(result, expected)


def test_ahead_relabels_the_same_slices() -> None:
    """Assert that predicting 10 ms ahead trains on the same slices, of which 10 more are slip."""
    now = sampling.gather([trajectory(100, 50)], HIST10)
    horizon_ms = sampling.gather([trajectory(100, 50)], HIST10, horizon_ms=10)
    np.testing.assert_array_equal(horizon_ms.slip, np.arange(40, 65))
    np.testing.assert_array_equal(np.sort([*now.slip, *now.busy]), np.sort([*horizon_ms.slip, *horizon_ms.busy]))


def test_empty_pools_are_named() -> None:
    """Assert that a missing slip or busy pool is an error that names it, and a missing quiet pool is none."""
    with pytest.raises(ValueError, match="slip pool is empty"):
        sampling.gather([trajectory(50, -1)], HIST10)
    with pytest.raises(ValueError, match="busy pool is empty"):
        sampling.gather([trajectory(50, 30, np.zeros(50, bool))], HIST10)
    with pytest.raises(ValueError, match="slip pool is empty"):
        sampling.gather([], HIST10)
    with pytest.raises(ValueError, match="slip pool is empty"):
        sampling.gather([trajectory(9, 5)], HIST10)
    assert len(sampling.gather([trajectory(50, 30)], HIST10).quiet) == 0


def drawn(samples: SlipSamples, count: int, seed: int = 0) -> list[Batch]:
    """Draw some batches."""
    return list(islice(sampling.batches(samples, np.random.default_rng(seed)), count))


def test_full_batches_hold_32_32_and_8() -> None:
    """Assert that batches have the paper's proportions exactly, each sample from its own pool."""
    samples = pools(50, 320, 21)
    for batch in drawn(samples, 30):
        assert (len(batch.slip), len(batch.busy), len(batch.quiet)) == (32, 32, 8)
        assert set(batch.slip) <= set(samples.slip)
        assert set(batch.busy) <= set(samples.busy)
        assert set(batch.quiet) <= set(samples.quiet)


def test_last_batch_of_an_epoch_keeps_the_proportions() -> None:
    """Assert that the rest of the busy pool is joined by as much slip and a quarter as much quiet, rounded up."""
    samples = pools(50, 2 * 32 + 6, 21)
    assert sampling.steps_per_epoch(samples) == 3
    assert [tuple(len(part) for part in batch) for batch in drawn(samples, 4)] == [
        (32, 32, 8, 0),
        (32, 32, 8, 0),
        (6, 6, 2, 0),
        (32, 32, 8, 0),
    ]


@pytest.mark.parametrize("busy", [5, 32, 33, 100])
def test_an_epoch_sees_every_busy_sample_once(busy: int) -> None:
    """Assert that each epoch is one pass over the busy pool, in another order than the epoch before."""
    samples = pools(7, busy, 3)
    steps = sampling.steps_per_epoch(samples)
    passes = []
    batches = drawn(samples, 3 * steps)
    for epoch in range(3):
        seen = np.concatenate([batch.busy for batch in batches[epoch * steps : (epoch + 1) * steps]])
        np.testing.assert_array_equal(np.sort(seen), samples.busy)
        passes.append(seen.tolist())
    assert passes[0] != passes[1] != passes[2]


def test_other_pools_are_dealt_evenly() -> None:
    """Assert that slip and quiet samples are all drawn before any is drawn again, over the borders of epochs too."""
    samples = pools(50, 40, 21)
    batches = drawn(samples, 11)
    for part, pool in (("slip", samples.slip), ("quiet", samples.quiet)):
        dealt = np.concatenate([getattr(batch, part) for batch in batches])
        for start in range(0, len(dealt) - len(pool) + 1, len(pool)):
            np.testing.assert_array_equal(np.sort(dealt[start : start + len(pool)]), pool)
        often = Counter(dealt.tolist()).values()
        assert max(often) - min(often) <= 1


def test_empty_quiet_pool_leaves_its_share_to_busy() -> None:
    """Assert that without quiet slices a batch of 72 is 32 slip and 40 busy, and an epoch still one pass."""
    samples = pools(50, 90, 0)
    assert sampling.steps_per_epoch(samples) == 3
    batches = drawn(samples, 3)
    assert [tuple(len(part) for part in batch) for batch in batches] == [(32, 40, 0, 0), (32, 40, 0, 0), (8, 10, 0, 0)]
    np.testing.assert_array_equal(np.sort(np.concatenate([batch.busy for batch in batches])), samples.busy)


def test_what_never_slips_is_a_pool_of_its_own() -> None:
    """Assert that a trajectory without slip adds to no other pool, and makes an epoch no longer."""
    with_slip, without = trajectory(100, 60), trajectory(400, -1)
    without.label[:20] = -1
    alone = sampling.gather([with_slip], HIST10)
    both = sampling.gather([without, with_slip], HIST10)
    for name in ("slip", "busy", "quiet"):
        assert len(getattr(both, name)) == len(getattr(alone, name))
    assert len(both.still) == 380 and len(alone.still) == 0
    assert sampling.steps_per_epoch(both) == sampling.steps_per_epoch(alone)
    unmoved = sampling.inputs.at(HIST10, without.series, np.arange(20, 400))
    np.testing.assert_array_equal(both.inputs(both.still), unmoved)


def test_a_batch_draws_48_that_never_slip() -> None:
    """Assert that all others are drawn as without them, and that the last batch draws as many fewer."""
    with_still, without = drawn(pools(50, 40, 21, 500), 40), drawn(pools(50, 40, 21), 40)
    assert [len(batch.still) for batch in with_still[:4]] == [48, 12, 48, 12]
    assert [len(batch.busy) for batch in with_still] == [len(batch.busy) for batch in without]
    dealt = np.concatenate([batch.still for batch in with_still])[:500]
    np.testing.assert_array_equal(np.sort(dealt), np.arange(111, 611))


def test_half_of_the_samples_are_rotated() -> None:
    """Assert that a sample is left alone half the time, and turned once, twice or three times a sixth each."""
    turns = sampling.quarter_turns(3000, np.random.default_rng(2))
    shares = np.bincount(turns, minlength=4) / len(turns)
    # five standard deviations of 3000 draws: 0.046 and 0.034
    assert abs(shares[0] - 0.5) < 0.046
    assert np.all(np.abs(shares[1:] - 1 / 6) < 0.034)


def test_each_sample_is_turned_as_drawn() -> None:
    """Assert that the inputs of a batch are turned and multiplied one by one, and the batch is left as it was."""
    batch = np.random.default_rng(1).random((5, 56, 20), np.float32)
    before = batch.copy()
    factors = np.array([1, 0.5, 2, 1, 1.7], np.float32)
    out = sampling.augment(pools(1, 1, 1), batch, np.array([0, 1, 2, 3, 0]), factors)
    np.testing.assert_array_equal(batch, before)
    grid = batch.reshape(5, 7, 8, 20)
    for sample, turns in enumerate((0, 1, 2, 3, 0)):
        expected = features.rotate(grid[sample : sample + 1], turns).reshape(56, 20)
        np.testing.assert_array_equal(out[sample], expected * factors[sample])
