"""Training: which samples are drawn, how they are varied, and that something is learned, the same for the same seed."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from evetac_cli.kernels import features, training
from evetac_cli.kernels.networks import from_weights
from evetac_cli.kernels.slip import ARCHITECTURES, Trajectory
from evetac_cli.kernels.training import RECIPES, Batch, Samples, Training

HIST10 = ARCHITECTURES["hist10"]
PAPER = RECIPES["paper"]
ADAM = RECIPES["adam"]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Train on one thread, as the stage does, and leave torch as it was."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def trajectory(slices: int, onset: int, busy: NDArray[np.bool_] | None = None, mark: float = 0) -> Trajectory:
    """Give labels that slip from `onset` on, busy slices as wished, and `mark` as displacement everywhere."""
    label = np.zeros(slices, np.int8)
    if onset >= 0:
        label[onset:] = 1
    outside = np.where(np.ones(slices, bool) if busy is None else busy, 26, 25).astype(np.int32)
    return Trajectory(np.full((slices, 56), mark, np.float32), np.zeros((slices, 56), np.int32), outside, label, onset)


def pools(slip: int, busy: int, quiet: int) -> Samples:
    """Give samples of which only the pools matter, with a different slice for each."""
    ends = np.arange(slip + busy + quiet)
    displacement, events = np.zeros((0, 56), np.float32), np.zeros((0, 56), np.int32)
    return Samples(HIST10, 7, 8, displacement, events, ends[:slip], ends[slip : slip + busy], ends[slip + busy :])


def separable(rng: np.random.Generator) -> Samples:
    """Give three trajectories, half busy and half quiet, in which slip moves all dots and makes them blink."""
    trajectories = []
    for _ in range(3):
        label = (np.arange(200) >= 150).astype(np.int8)
        displacement = rng.uniform(0, 0.5, (200, 56)) + 10 * label[:, None]
        events = rng.poisson(np.where(label, 200, 0.45)[:, None], (200, 56)).astype(np.int32)
        trajectories.append(Trajectory(displacement.astype(np.float32), events, events.sum(axis=1), label, 150))
    return training.gather(trajectories, HIST10)


def loss_falls(result: Training) -> float:
    """First loss of the curve over the last."""
    return float(result.curve_loss[0] / result.curve_loss[-1])


def test_pools_of_a_small_trajectory() -> None:
    """Assert that slip, busy and quiet slices are those counted by hand, cut 15 slices from the onset on."""
    busy = np.arange(100) % 2 == 0
    samples = training.gather([trajectory(100, 30, busy)], HIST10)
    np.testing.assert_array_equal(samples.slip, np.arange(30, 45))
    np.testing.assert_array_equal(samples.busy, np.arange(10, 30, 2))
    np.testing.assert_array_equal(samples.quiet, np.arange(9, 30, 2))
    assert len(samples.displacement_px) == 45


@pytest.mark.parametrize(("history", "first", "slipping"), [(1, 0, 15), (10, 9, 15), (20, 19, 20), (50, 49, 50)])
def test_history_sets_the_first_sample_and_the_cut(history: int, first: int, slipping: int) -> None:
    """Assert that no sample lies before a full history, and that longer histories keep more slices of slip."""
    samples = training.gather([trajectory(200, 60)], replace(HIST10, history=history, recent=history))
    assert samples.busy[0] == first
    np.testing.assert_array_equal(samples.slip, np.arange(60, 60 + slipping))


def test_busy_means_more_than_25_events_outside_the_window() -> None:
    """Assert that 25 events are quiet and 26 busy, and that events beside dots do not decide."""
    one = trajectory(40, 30, np.arange(40) == 20)
    samples = training.gather([one._replace(events_per_dot=np.full((40, 56), 100, np.int32))], HIST10)
    np.testing.assert_array_equal(samples.busy, [20])
    assert 20 not in samples.quiet


def test_unexamined_slices_are_no_samples() -> None:
    """Assert that a label of -1 is in no pool."""
    one = trajectory(60, 40, np.arange(60) % 2 == 0)
    one.label[20:45] = -1
    samples = training.gather([one], HIST10)
    drawn = np.concatenate([samples.slip, samples.busy, samples.quiet])
    assert not set(drawn) & set(range(20, 45))
    assert len(drawn) == 11 + 10


def test_samples_keep_to_their_trajectory() -> None:
    """Assert that no window reaches over the border to the trajectory before it."""
    samples = training.gather([trajectory(50, 30, mark=index) for index in range(4)], HIST10)
    ends = np.concatenate([samples.slip, samples.busy])
    displacement = samples.inputs(ends)[..., :10]
    assert np.ptp(displacement, axis=(1, 2)).max() == 0
    assert Counter(displacement[:, 0, 0].tolist()) == {index: 15 + 21 for index in range(4)}


def test_inputs_are_the_features() -> None:
    """Assert that a sample holds what the features kernel gives for its slice."""
    rng = np.random.default_rng(0)
    one = trajectory(60, 40)._replace(
        displacement_px=rng.random((60, 56), np.float32), events_per_dot=rng.integers(0, 9, (60, 56), np.int32)
    )
    samples = training.gather([one], HIST10)
    ends = np.array([9, 30, 54])
    expected = features.windows(one.displacement_px, one.events_per_dot, 10, ends)
    np.testing.assert_array_equal(samples.inputs(ends), expected)


def test_empty_pools_are_named() -> None:
    """Assert that a missing slip or busy pool is an error that names it, and a missing quiet pool is none."""
    with pytest.raises(ValueError, match="slip pool is empty"):
        training.gather([trajectory(50, -1)], HIST10)
    with pytest.raises(ValueError, match="busy pool is empty"):
        training.gather([trajectory(50, 30, np.zeros(50, bool))], HIST10)
    with pytest.raises(ValueError, match="slip pool is empty"):
        training.gather([], HIST10)
    with pytest.raises(ValueError, match="slip pool is empty"):
        training.gather([trajectory(9, 5)], HIST10)
    assert len(training.gather([trajectory(50, 30)], HIST10).quiet) == 0


def test_trajectories_that_do_not_fit_are_refused() -> None:
    """Assert that wrong shapes, labels, onsets and numbers are refused with the trajectory's place and the field."""
    good = trajectory(50, 30)
    bad = {
        "events_per_dot: expected shape": good._replace(events_per_dot=np.zeros((50, 63), np.int32)),
        "events_outside: expected shape": good._replace(events_outside=np.zeros(49, np.int32)),
        "labels": good._replace(label=np.full(50, 3, np.int8)),
        "onset": good._replace(onset=50),
        "displacement_px: expected finite": good._replace(displacement_px=np.full((50, 56), np.nan, np.float32)),
        "events_per_dot: expected whole numbers": good._replace(events_per_dot=np.full((50, 56), -1, np.int32)),
    }
    for message, one in bad.items():
        with pytest.raises(ValueError, match=f"trajectory 1: .*{message}"):
            training.gather([good, one], HIST10)


def drawn(samples: Samples, count: int, seed: int = 0) -> list[Batch]:
    """Draw some batches."""
    return list(islice(training.batches(samples, np.random.default_rng(seed)), count))


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
    assert training.steps_per_epoch(samples) == 3
    assert [tuple(len(part) for part in batch) for batch in drawn(samples, 4)] == [
        (32, 32, 8),
        (32, 32, 8),
        (6, 6, 2),
        (32, 32, 8),
    ]


@pytest.mark.parametrize("busy", [5, 32, 33, 100])
def test_an_epoch_sees_every_busy_sample_once(busy: int) -> None:
    """Assert that each epoch is one pass over the busy pool, in another order than the epoch before."""
    samples = pools(7, busy, 3)
    steps = training.steps_per_epoch(samples)
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
    assert training.steps_per_epoch(samples) == 3
    batches = drawn(samples, 3)
    assert [tuple(len(part) for part in batch) for batch in batches] == [(32, 40, 0), (32, 40, 0), (8, 10, 0)]
    np.testing.assert_array_equal(np.sort(np.concatenate([batch.busy for batch in batches])), samples.busy)


def test_half_of_the_samples_are_rotated() -> None:
    """Assert that a sample is left alone or is one of its three rotations, half the time and a sixth each."""
    rng = np.random.default_rng(1)
    inputs = rng.random((3000, 56, 2), np.float32) + 1
    before = inputs.copy()
    out = training.augment(inputs, 7, 8, np.random.default_rng(2))
    np.testing.assert_array_equal(inputs, before)
    grid = inputs.reshape(-1, 7, 8, 2)
    turns = np.full(len(inputs), -1)
    for quarter_turns in (0, 1, 2, 3):
        turned = features.rotate(grid, quarter_turns).reshape(inputs.shape) if quarter_turns else inputs
        turns[np.all(out == turned, axis=(1, 2))] = quarter_turns
    shares = np.bincount(turns, minlength=4) / len(turns)
    # five standard deviations of 3000 draws: 0.046 and 0.034
    assert abs(shares[0] - 0.5) < 0.046
    assert np.all(np.abs(shares[1:] - 1 / 6) < 0.034)


@pytest.fixture(scope="module")
def problem() -> Samples:
    """Give the separable samples once."""
    return separable(np.random.default_rng(3))


def same(first: Training, second: Training) -> bool:
    """Whether two runs ended with the same weights, bit for bit."""
    one, other = first.checkpoints[-1].weights, second.checkpoints[-1].weights
    return all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_same_seed_same_network(problem: Samples, recipe: training.Recipe) -> None:
    """Assert that the generator's seed fixes all weights and losses, whatever torch's own generator did before."""
    first = training.train(problem, recipe, np.random.default_rng(4), max_steps=20)
    torch.rand(3)
    second = training.train(problem, recipe, np.random.default_rng(4), max_steps=20)
    other = training.train(problem, recipe, np.random.default_rng(5), max_steps=20)
    assert same(first, second)
    np.testing.assert_array_equal(first.curve_loss, second.curve_loss)
    assert not same(first, other)


def test_seed_sets_the_first_weights_too(problem: Samples) -> None:
    """Assert that runs that learn nothing still end with other weights for another seed."""
    idle = replace(PAPER, learning_rate=0.0)
    first, second = (training.train(problem, idle, np.random.default_rng(seed), max_steps=1) for seed in (4, 5))
    assert not same(first, second)


def test_global_generators_are_left_alone(problem: Samples) -> None:
    """Assert that training neither uses nor moves torch's global generator."""
    before = torch.random.get_rng_state()
    training.train(problem, PAPER, np.random.default_rng(4), max_steps=2)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize(("recipe", "factor"), [(PAPER, 1.5), (ADAM, 100)], ids=["paper", "adam"])
def test_separable_problem_is_learned(problem: Samples, recipe: training.Recipe, factor: float) -> None:
    """Assert that 500 steps bring the loss down by a factor of 1.5 with the paper's recipe, of 100 with Adam."""
    result = training.train(problem, recipe, np.random.default_rng(6), max_steps=500)
    assert loss_falls(result) > factor
    network = from_weights(HIST10, result.checkpoints[-1].weights)
    with torch.no_grad():
        slipping = network(torch.from_numpy(problem.inputs(problem.slip)))
        holding = network(torch.from_numpy(problem.inputs(problem.busy)))
    assert slipping.min() > holding.max()


def test_checkpoints_follow_the_epochs(problem: Samples) -> None:
    """Assert that a whole run keeps a checkpoint every so many epochs and at its end, and is not called cut."""
    every_two = replace(ADAM, checkpoint_every=2)
    steps = training.steps_per_epoch(problem)
    result = training.train(problem, every_two, np.random.default_rng(7), epochs=5)
    assert [checkpoint.step for checkpoint in result.checkpoints] == [2 * steps, 4 * steps, 5 * steps]
    assert (result.steps, result.steps_planned, result.cut) == (5 * steps, 5 * steps, False)
    assert result.recipe == every_two


def test_cut_run_spreads_its_checkpoints_and_says_so(problem: Samples) -> None:
    """Assert that max_steps leaves the paper's seven checkpoints, evenly, the last at the end, and sets `cut`."""
    result = training.train(problem, PAPER, np.random.default_rng(8), max_steps=35)
    assert [checkpoint.step for checkpoint in result.checkpoints] == [5, 10, 15, 20, 25, 30, 35]
    assert (result.steps, result.steps_planned) == (35, 70 * training.steps_per_epoch(problem))
    assert result.cut
    short = training.train(problem, PAPER, np.random.default_rng(8), max_steps=3)
    assert [checkpoint.step for checkpoint in short.checkpoints] == [1, 2, 3]


def test_max_steps_beyond_the_epochs_changes_nothing(problem: Samples) -> None:
    """Assert that a limit that is not reached gives the uncut run."""
    free = training.train(problem, PAPER, np.random.default_rng(9), epochs=1)
    limited = training.train(problem, PAPER, np.random.default_rng(9), epochs=1, max_steps=10**6)
    assert same(free, limited)
    assert not limited.cut


def test_checkpoints_are_stages_of_one_run(problem: Samples) -> None:
    """Assert that a checkpoint holds the weights of its step, not of the end."""
    long = training.train(problem, ADAM, np.random.default_rng(10), max_steps=14)
    short = training.train(problem, ADAM, np.random.default_rng(10), max_steps=4)
    middle = next(checkpoint for checkpoint in long.checkpoints if checkpoint.step == 4)
    last = short.checkpoints[-1]
    assert last.step == 4
    assert all(np.array_equal(middle.weights[name], last.weights[name]) for name in last.weights)
    assert not np.array_equal(middle.weights["fc5.weight"], long.checkpoints[-1].weights["fc5.weight"])


def test_loss_curve_covers_the_run(problem: Samples) -> None:
    """Assert that at most 100 points rise to the last step, the first near ln 2, and progress reports each of them."""
    heard: list[tuple[int, int, float]] = []
    result = training.train(
        problem, ADAM, np.random.default_rng(11), max_steps=130, on_progress=lambda *point: heard.append(point)
    )
    assert len(result.curve_step) == len(result.curve_loss) == 100
    assert result.curve_step[-1] == 130
    assert np.all(np.diff(result.curve_step) > 0)
    assert heard == [
        (step, 130, loss) for step, loss in zip(result.curve_step.tolist(), result.curve_loss.tolist(), strict=True)
    ]
    assert result.curve_loss[0] == pytest.approx(np.log(2), abs=0.1)


def test_paper_leaves_the_inputs_alone(problem: Samples) -> None:
    """Assert that the paper's recipe is plain SGD at 0.001 for 70 epochs on inputs as they are."""
    assert (PAPER.optimiser, PAPER.learning_rate, PAPER.epochs, PAPER.checkpoint_every) == ("sgd", 0.001, 70, 10)
    arrays = training.train(problem, PAPER, np.random.default_rng(12), max_steps=1).checkpoints[0].weights
    assert np.all(arrays["input_scale"] == 1)
    assert np.all(arrays["input_offset"] == 0)


def test_paper_step_is_plain_gradient_descent(problem: Samples) -> None:
    """Assert that the second step too moves the weights by 0.001 times the gradient of binary cross entropy alone."""
    steps = training.train(problem, PAPER, np.random.default_rng(13), max_steps=2)
    network = from_weights(HIST10, steps.checkpoints[0].weights)
    # the draws and turns of step 2, from the same streams
    _, draws, turns = np.random.default_rng(13).spawn(3)
    for batch in islice(training.batches(problem, draws), 2):
        inputs = training.augment(problem.inputs(np.concatenate(batch)), 7, 8, turns)
    target = torch.from_numpy((np.arange(len(inputs)) < len(batch.slip)).astype(np.float32))
    probability = torch.sigmoid(network(torch.from_numpy(inputs)))
    loss = -(target * torch.log(probability) + (1 - target) * torch.log(1 - probability)).mean()
    loss.backward()  # type: ignore[no-untyped-call]
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None
        expected = (parameter - 0.001 * parameter.grad).detach().numpy()
        np.testing.assert_allclose(steps.checkpoints[1].weights[name], expected, atol=1e-7)


def test_adam_normalises_from_the_training_samples() -> None:
    """Assert that normalised inputs have mean 0 and spread 1 over a batch's mixture, and flat channels stay finite."""
    rng = np.random.default_rng(14)
    busy = np.arange(400) % 2 == 0
    one = trajectory(400, 380, busy)._replace(
        displacement_px=np.full((400, 56), 7.3, np.float32), events_per_dot=rng.poisson(20, (400, 56)).astype(np.int32)
    )
    samples = training.gather([one], HIST10)
    arrays = training.train(samples, ADAM, np.random.default_rng(15), max_steps=1).checkpoints[0].weights
    mixture = [(samples.slip, 32), (samples.busy, 32), (samples.quiet, 8)]
    moved = [((samples.inputs(at) - arrays["input_offset"]) * arrays["input_scale"], share) for at, share in mixture]
    mean = sum(share / 72 * values.mean(axis=(0, 1)) for values, share in moved)
    square = sum(share / 72 * (values**2).mean(axis=(0, 1)) for values, share in moved)
    np.testing.assert_allclose(mean, 0, atol=1e-5)
    np.testing.assert_allclose(square[10:], 1, atol=1e-4)
    # the dots never move: nothing to scale, and no rounding is blown up
    np.testing.assert_array_equal(arrays["input_scale"][:10], 1)


def test_diverging_training_stops(problem: Samples) -> None:
    """Assert that a loss that is not finite ends the run with the recipe's name instead of weights of NaN."""
    wild = replace(PAPER, name="wild", learning_rate=1e30)
    with pytest.raises(ValueError, match="recipe wild: expected a finite loss"):
        training.train(problem, wild, np.random.default_rng(16), max_steps=50)


@pytest.mark.parametrize("limits", [{"epochs": 0}, {"max_steps": 0}, {"epochs": -3}])
def test_no_training_is_refused(problem: Samples, limits: dict[str, Any]) -> None:
    """Assert that a run of no step is refused."""
    with pytest.raises(ValueError, match="at least one epoch"):
        training.train(problem, PAPER, np.random.default_rng(0), **limits)


def test_training_without_quiet_slices(problem: Samples) -> None:
    """Assert that both recipes train where the quiet pool is empty."""
    assert len(problem.quiet) > 0
    noisy = replace(problem, quiet=np.empty(0, np.int64))
    for recipe in RECIPES.values():
        result = training.train(noisy, recipe, np.random.default_rng(17), max_steps=5)
        assert np.all(np.isfinite(result.curve_loss))
