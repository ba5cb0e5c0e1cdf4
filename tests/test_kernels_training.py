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

from evetac_cli.kernels import features, inputs, slip, training
from evetac_cli.kernels.features import EventImages
from evetac_cli.kernels.inputs import Trajectory
from evetac_cli.kernels.networks import from_weights
from evetac_cli.kernels.slip import ARCHITECTURES, DotArchitecture, View
from evetac_cli.kernels.training import RECIPES, Batch, Samples, Training

HIST10 = ARCHITECTURES["hist10"]
PAPER = RECIPES["paper"]
ADAM = RECIPES["adam"]
STEADY = RECIPES["steady"]


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
    return Trajectory(np.full((slices, 56, 4), mark, np.float32), outside, label, onset)


def pools(slip: int, busy: int, quiet: int) -> Samples:
    """Give samples of which only the pools matter, with a different slice for each."""
    ends = np.arange(slip + busy + quiet)
    series = np.zeros((0, 56, 4), np.float32)
    return Samples(HIST10, 7, 8, series, ends[:slip], ends[slip : slip + busy], ends[slip + busy :])


def separable(rng: np.random.Generator) -> Samples:
    """Give three trajectories, half busy and half quiet, in which slip moves all dots and makes them blink."""
    trajectories = []
    for _ in range(3):
        label = (np.arange(200) >= 150).astype(np.int8)
        displacement = rng.uniform(0, 0.5, (200, 56)) + 10 * label[:, None]
        events = rng.poisson(np.where(label, 200, 0.45)[:, None], (200, 56)).astype(np.int32)
        series = features.series(displacement.astype(np.float32), events)
        trajectories.append(Trajectory(series, events.sum(axis=1), label, 150))
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
    assert inputs.length(samples.series) == 45


@pytest.mark.parametrize(("history", "first", "slipping"), [(1, 0, 15), (10, 9, 15), (20, 19, 20), (50, 49, 50)])
def test_history_sets_the_first_sample_and_the_cut(history: int, first: int, slipping: int) -> None:
    """Assert that no sample lies before a full history, and that longer histories keep more slices of slip."""
    architecture = DotArchitecture("", (View("events", history),), 1, 1)
    samples = training.gather([trajectory(200, 60)], architecture)
    assert samples.busy[0] == first
    np.testing.assert_array_equal(samples.slip, np.arange(60, 60 + slipping))


def test_busy_means_more_than_25_events_outside_the_window() -> None:
    """Assert that 25 events are quiet and 26 busy, and that events beside dots do not decide."""
    one = trajectory(40, 30, np.arange(40) == 20)
    samples = training.gather([one._replace(series=np.full((40, 56, 4), 100, np.float32))], HIST10)
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


def test_inputs_are_those_of_the_trajectory() -> None:
    """Assert that a sample holds what its slice has in the trajectory itself, and that unseen slices are not kept."""
    rng = np.random.default_rng(0)
    one = trajectory(90, 60)._replace(series=rng.random((90, 56, 4), np.float32))
    one.label[:40] = -1
    samples = training.gather([trajectory(50, 30), one], HIST10)
    kept = 60 + 15 - (40 - 9)
    assert inputs.length(samples.series) == 45 + kept
    expected = inputs.at(HIST10, one.series, np.arange(40, 75))
    found = samples.inputs(np.concatenate([samples.busy[samples.busy >= 45], samples.slip[samples.slip >= 45]]))
    np.testing.assert_array_equal(found, expected)


def test_ahead_relabels_the_same_slices() -> None:
    """Assert that predicting 10 ms ahead trains on the same slices, of which 10 more are slip."""
    now = training.gather([trajectory(100, 50)], HIST10)
    ahead = training.gather([trajectory(100, 50)], HIST10, ahead_ms=10)
    np.testing.assert_array_equal(ahead.slip, np.arange(40, 65))
    np.testing.assert_array_equal(np.sort([*now.slip, *now.busy]), np.sort([*ahead.slip, *ahead.busy]))


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
    series = np.zeros((50, 56, 4), np.float32)
    bad = {
        "series: expected 56 dots": good._replace(series=np.zeros((50, 63, 4), np.float32)),
        "series: expected 50 slices": good._replace(series=series[:49]),
        "events_outside: expected shape": good._replace(events_outside=np.zeros(49, np.int32)),
        "labels": good._replace(label=np.full(50, 3, np.int8)),
        "onset": good._replace(onset=50),
        "series: expected finite": good._replace(series=series + np.nan),
        "events_outside: expected whole numbers": good._replace(events_outside=np.full(50, -1, np.int32)),
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
    """Assert that a sample is left alone half the time, and turned once, twice or three times a sixth each."""
    turns = training.quarter_turns(3000, np.random.default_rng(2))
    shares = np.bincount(turns, minlength=4) / len(turns)
    # five standard deviations of 3000 draws: 0.046 and 0.034
    assert abs(shares[0] - 0.5) < 0.046
    assert np.all(np.abs(shares[1:] - 1 / 6) < 0.034)


def test_each_sample_is_turned_as_drawn() -> None:
    """Assert that the inputs of a batch are turned one by one, in their place, and the batch is left as it was."""
    batch = np.random.default_rng(1).random((5, 56, 20), np.float32)
    before = batch.copy()
    out = training.augment(pools(1, 1, 1), batch, np.array([0, 1, 2, 3, 0]))
    np.testing.assert_array_equal(batch, before)
    grid = batch.reshape(5, 7, 8, 20)
    for sample, turns in enumerate((0, 1, 2, 3, 0)):
        expected = features.rotate(grid[sample : sample + 1], turns).reshape(56, 20)
        np.testing.assert_array_equal(out[sample], expected)


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
        ends = np.concatenate(batch)
        turned = training.augment(problem, problem.inputs(ends), training.quarter_turns(len(ends), turns))
    target = torch.from_numpy((np.arange(len(turned)) < len(batch.slip)).astype(np.float32))
    probability = torch.sigmoid(network(torch.from_numpy(turned)))
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
    series = np.full((400, 56, 4), 7.3, np.float32)
    series[..., 1] = rng.poisson(20, (400, 56))
    one = trajectory(400, 380, busy)._replace(series=series)
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


class Interruption(Exception):
    """Ctrl-C, or a machine that is switched off."""


def run_and_stop(samples: Samples, recipe: training.Recipe, after: int, steps: int) -> training.Kept:
    """Train, and stop when a run of `after` steps is kept."""
    states: list[training.Kept] = []

    def keep(state: Any) -> None:
        found = state()
        if int(found["step"]) == after:
            states.append({name: array.copy() for name, array in found.items()})
            raise Interruption

    with pytest.raises(Interruption):
        training.train(samples, recipe, np.random.default_rng(20), max_steps=steps, on_keep=keep)
    return states[0]


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
@pytest.mark.parametrize("after", [50, 100])
def test_an_interrupted_run_goes_on_to_the_same_result(problem: Samples, recipe: training.Recipe, after: int) -> None:
    """Assert that a run broken off and taken up again ends with the same checkpoints and curve, bit for bit."""
    whole = training.train(problem, recipe, np.random.default_rng(20), max_steps=140)
    kept = run_and_stop(problem, recipe, after, 140)
    assert all(array.dtype != object for array in kept.values())
    resumed = training.train(problem, recipe, np.random.default_rng(20), max_steps=140, kept=kept)
    assert [one.step for one in resumed.checkpoints] == [one.step for one in whole.checkpoints]
    for one, other in zip(resumed.checkpoints, whole.checkpoints, strict=True):
        assert one.weights.keys() == other.weights.keys()
        assert all(np.array_equal(one.weights[name], other.weights[name]) for name in one.weights)
    np.testing.assert_array_equal(resumed.curve_step, whole.curve_step)
    np.testing.assert_array_equal(resumed.curve_loss, whole.curve_loss)


def test_a_kept_run_of_another_network_is_refused(problem: Samples) -> None:
    """Assert that what was kept of one architecture or recipe does not slip into another."""
    kept = run_and_stop(problem, PAPER, 50, 60)
    other = replace(problem, architecture=ARCHITECTURES["no-hist"])
    for samples, recipe in ((other, PAPER), (problem, STEADY)):
        with pytest.raises(ValueError, match="expected a kept run of this network"):
            training.train(samples, recipe, np.random.default_rng(20), max_steps=60, kept=kept)


def test_steady_keeps_the_running_mean(problem: Samples) -> None:
    """Assert that its checkpoints are the mean of the weights on the way, in which early weights are soon forgotten."""
    plain = replace(STEADY, average=0.0)
    idle = replace(plain, learning_rate=0.0)
    start, way, found = (
        training.train(problem, recipe, np.random.default_rng(1), max_steps=7) for recipe in (idle, plain, STEADY)
    )
    mean = start.checkpoints[0].weights["fc3.weight"].astype(np.float64)
    for step in range(1, 8):
        share = (1 + step) / (10 + step)
        mean = share * mean + (1 - share) * way.checkpoints[step - 1].weights["fc3.weight"]
        np.testing.assert_allclose(found.checkpoints[step - 1].weights["fc3.weight"], mean, atol=1e-6)


def test_steady_slows_down(problem: Samples) -> None:
    """Assert that the learning rate is 0.002 in the first step, half of it in the middle and nearly 0 in the last."""
    flat = replace(STEADY, average=0.0, cosine=False, weight_decay=0.0)
    falling = replace(flat, cosine=True)
    start, *runs = (
        training.train(problem, recipe, np.random.default_rng(2), max_steps=7)
        for recipe in (replace(flat, learning_rate=0.0), flat, falling)
    )
    first, other = (run.checkpoints[0].weights["fc3.weight"] for run in runs)
    np.testing.assert_array_equal(first, other)
    # the first step of Adam goes as far as the learning rate, whatever the gradient
    assert np.abs(first - start.checkpoints[0].weights["fc3.weight"]).max() == pytest.approx(0.002, rel=1e-3)
    steady, slower = (
        np.abs(run.checkpoints[6].weights["fc3.weight"] - run.checkpoints[5].weights["fc3.weight"]).mean()
        for run in runs
    )
    assert slower < 0.15 * steady  # (1 + cos(6 / 7 pi)) / 2 is 0.05


def test_factors_are_drawn_log_uniformly() -> None:
    """Assert that steady makes samples 0.3 to 2 times as strong, and the other recipes leave them as they are."""
    for recipe in (PAPER, ADAM):
        np.testing.assert_array_equal(training.factors(recipe, 72, np.random.default_rng(0)), 1)
    logarithm = np.log(training.factors(STEADY, 3000, np.random.default_rng(0)))
    shares, _ = np.histogram(logarithm, bins=4, range=(np.log(0.3), np.log(2)))
    assert shares.sum() == 3000
    assert np.all(np.abs(shares / 3000 - 0.25) < 0.04)  # five standard deviations


def test_the_first_step_sees_the_varied_samples(problem: Samples) -> None:
    """Assert that a batch is turned, then multiplied sample by sample: the loss of step 1 is that of such a batch."""
    idle = replace(STEADY, learning_rate=0.0, weight_decay=0.0, average=0.0)
    result = training.train(problem, idle, np.random.default_rng(13), max_steps=1)
    _, draws, turns, gains = np.random.default_rng(13).spawn(4)
    batch = next(training.batches(problem, draws))
    ends = np.concatenate(batch)
    varied = training.augment(problem, problem.inputs(ends), training.quarter_turns(len(ends), turns))
    varied = varied * training.factors(idle, len(ends), gains)[:, None, None]
    target = torch.from_numpy((np.arange(len(ends)) < len(batch.slip)).astype(np.float32))
    with torch.no_grad():
        logits = from_weights(HIST10, result.checkpoints[0].weights)(torch.from_numpy(varied))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, target)
    assert result.curve_loss[0] == pytest.approx(float(loss), rel=1e-5)


def test_images_are_trained_on() -> None:
    """Assert that an image network tells full images from empty ones, and is the same again for the same seed."""
    label = (np.arange(60) >= 40).astype(np.int8)
    rng = np.random.default_rng(0)
    counts = np.where(label, 3000, 30)
    start = np.cumsum([0, *counts])
    images = EventImages(start, rng.integers(0, 540 * 480, start[-1]).astype(np.uint32), np.ones(start[-1], np.int8))
    one = Trajectory(images, counts.astype(np.int32), label, 40)
    samples = training.gather([one, one], ARCHITECTURES["no-hist-img-6x6"])
    assert (len(samples.slip), len(samples.busy), len(samples.quiet)) == (30, 80, 0)
    short, again = (training.train(samples, ADAM, np.random.default_rng(1), max_steps=2) for _ in range(2))
    assert same(short, again)
    result = training.train(samples, ADAM, np.random.default_rng(1), max_steps=25)
    network = from_weights(samples.architecture, result.checkpoints[-1].weights)
    with torch.no_grad():
        slipping, holding = (network(torch.from_numpy(samples.inputs(at))) for at in (samples.slip, samples.busy))
    assert slipping.min() > holding.max()


def test_shifted_trajectories_are_checked() -> None:
    """Assert that a shift into the past is refused with the trajectory's place."""
    with pytest.raises(ValueError, match="trajectory 0: ahead_ms: expected at least 0"):
        training.gather([trajectory(50, 30)], HIST10, ahead_ms=-1)
    assert slip.shift(trajectory(50, 30).label, 5).sum() == 25
