"""Training: that something is learned, as the preset says, the same for the same seed."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch

from evetac_cli.kernels.slip import features, sampling, training
from evetac_cli.kernels.slip.architectures import ARCHITECTURES
from evetac_cli.kernels.slip.features import EventImages
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.networks import from_weights
from evetac_cli.kernels.slip.sampling import SlipSamples
from evetac_cli.kernels.slip.training import ADAPT, PRESETS, SlipTraining

HIST10 = ARCHITECTURES["hist10"]
PAPER = PRESETS["paper"]
ADAM = PRESETS["adam"]
ADAMW = PRESETS["adamw"]
ALL = [*PRESETS.values(), ADAPT]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Train on one thread, as the stage does, and leave torch as it was."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def separable(rng: np.random.Generator) -> SlipSamples:
    """Give three trajectories, half busy and half quiet, in which slip moves all dots and makes them blink."""
    trajectories = []
    for _ in range(3):
        label = (np.arange(200) >= 150).astype(np.int8)
        displacement = rng.uniform(0, 0.5, (200, 56)) + 10 * label[:, None]
        events = rng.poisson(np.where(label, 200, 0.45)[:, None], (200, 56)).astype(np.int32)
        series = features.series(displacement.astype(np.float32), events)
        share = (np.arange(200) / 150).clip(0, 1).astype(np.float32)
        trajectories.append(Trajectory(series, events.sum(axis=1), label, 150, share))
    return sampling.gather(trajectories, HIST10)


def loss_falls(result: SlipTraining) -> float:
    """First loss of the curve over the last."""
    return float(result.curve_loss[0] / result.curve_loss[-1])


@pytest.fixture(scope="module")
def problem() -> SlipSamples:
    """Give the separable samples once."""
    return separable(np.random.default_rng(3))


def same(first: SlipTraining, second: SlipTraining) -> bool:
    """Whether two runs ended with the same weights, bit for bit."""
    one, other = first.checkpoints[-1].weights, second.checkpoints[-1].weights
    return all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("preset", ALL, ids=lambda preset: preset.name)
@pytest.mark.slow
def test_same_seed_same_network(problem: SlipSamples, preset: training.Preset) -> None:
    """Assert that the generator's seed fixes all weights and losses, whatever torch's own generator did before."""
    first = training.train(problem, preset, np.random.default_rng(4), max_steps=20)
    torch.rand(3)
    second = training.train(problem, preset, np.random.default_rng(4), max_steps=20)
    other = training.train(problem, preset, np.random.default_rng(5), max_steps=20)
    assert same(first, second)
    np.testing.assert_array_equal(first.curve_loss, second.curve_loss)
    assert not same(first, other)


def test_checkpoints_follow_the_epochs(problem: SlipSamples) -> None:
    """Assert that a whole run keeps a checkpoint every so many epochs and at its end, and is not called cut."""
    every_two = replace(ADAM, checkpoint_every=2)
    steps = sampling.steps_per_epoch(problem)
    result = training.train(problem, every_two, np.random.default_rng(7), epochs=5)
    assert [checkpoint.step for checkpoint in result.checkpoints] == [2 * steps, 4 * steps, 5 * steps]
    assert (result.steps, result.steps_planned, result.cut) == (5 * steps, 5 * steps, False)
    assert result.preset == every_two


def test_cut_run_spreads_its_checkpoints_and_says_so(problem: SlipSamples) -> None:
    """Assert that max_steps leaves the paper's seven checkpoints, evenly, the last at the end, and sets `cut`."""
    result = training.train(problem, PAPER, np.random.default_rng(8), max_steps=35)
    assert [checkpoint.step for checkpoint in result.checkpoints] == [5, 10, 15, 20, 25, 30, 35]
    assert (result.steps, result.steps_planned) == (35, 70 * sampling.steps_per_epoch(problem))
    assert result.cut
    short = training.train(problem, PAPER, np.random.default_rng(8), max_steps=3)
    assert [checkpoint.step for checkpoint in short.checkpoints] == [1, 2, 3]


def test_loss_curve_covers_the_run(problem: SlipSamples) -> None:
    """Assert that at most 100 points rise to the last step, the first near ln 2, and progress to the last step too."""
    heard: list[tuple[int, int]] = []
    result = training.train(
        problem,
        ADAM,
        np.random.default_rng(11),
        max_steps=125,
        on_progress=lambda *point: heard.append(point),
    )
    assert len(result.curve_step) == len(result.curve_loss) == 100
    assert result.curve_step[-1] == 125
    assert np.all(np.diff(result.curve_step) > 0)
    assert heard == [(step, 125) for step in (*range(10, 121, 10), 125)]
    assert result.curve_loss[0] == pytest.approx(np.log(2), abs=0.1)


def test_paper_step_is_plain_gradient_descent(problem: SlipSamples) -> None:
    """Assert that the second step too moves the weights by 0.001 times the gradient of binary cross entropy alone."""
    steps = training.train(problem, PAPER, np.random.default_rng(13), max_steps=2)
    network = from_weights(HIST10, steps.checkpoints[0].weights)
    # the draws and turns of step 2, from the same streams
    _, draws, turns = np.random.default_rng(13).spawn(3)
    for batch in islice(sampling.batches(problem, draws), 2):
        ends = np.concatenate(batch)
        turned = sampling.augment(
            problem, problem.inputs(ends), sampling.quarter_turns(len(ends), turns), np.ones(len(ends), np.float32)
        )
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
    series = np.full((400, 56, 2), 7.3, np.float32)
    series[..., 1] = rng.poisson(20, (400, 56))
    label = (np.arange(400) >= 380).astype(np.int8)
    one = Trajectory(series, np.where(busy, 26, 25).astype(np.int32), label, 380)
    samples = sampling.gather([one], HIST10)
    arrays = training.train(samples, ADAM, np.random.default_rng(15), max_steps=1).checkpoints[0].weights
    mixture = [(samples.slip, 32), (samples.busy, 32), (samples.quiet, 8)]
    moved = [((samples.inputs(at) - arrays["input_offset"]) * arrays["input_scale"], share) for at, share in mixture]
    mean = sum(share / 72 * values.mean(axis=(0, 1)) for values, share in moved)
    square = sum(share / 72 * (values**2).mean(axis=(0, 1)) for values, share in moved)
    np.testing.assert_allclose(mean, 0, atol=1e-5)
    np.testing.assert_allclose(square[10:], 1, atol=1e-4)
    # the dots never move: nothing to scale, and no rounding is blown up
    np.testing.assert_array_equal(arrays["input_scale"][:10], 1)


def test_diverging_training_stops(problem: SlipSamples) -> None:
    """Assert that a loss that is not finite ends the run with the preset's name instead of weights of NaN."""
    wild = replace(PAPER, name="wild", learning_rate=1e30)
    with pytest.raises(ValueError, match="preset wild: expected a finite loss"):
        training.train(problem, wild, np.random.default_rng(16), max_steps=50)


class Interruption(Exception):
    """Ctrl-C, or a machine that is switched off."""


def run_and_stop(samples: SlipSamples, preset: training.Preset, after: int, steps: int) -> training.TrainingState:
    """Train, and stop when a run of `after` steps is saved."""
    states: list[training.TrainingState] = []

    def save(state: Any) -> None:
        arrays = state()
        if int(arrays["step"]) == after:
            states.append({name: array.copy() for name, array in arrays.items()})
            raise Interruption

    with pytest.raises(Interruption):
        training.train(samples, preset, np.random.default_rng(20), max_steps=steps, on_save=save)
    return states[0]


@pytest.mark.parametrize("preset", ALL, ids=lambda preset: preset.name)
@pytest.mark.parametrize("after", [50, pytest.param(100, marks=pytest.mark.slow)])
def test_an_interrupted_run_goes_on_to_the_same_result(
    problem: SlipSamples, preset: training.Preset, after: int
) -> None:
    """Assert that a run broken off and taken up again ends with the same checkpoints and curve, bit for bit."""
    whole = training.train(problem, preset, np.random.default_rng(20), max_steps=after + 40)
    saved = run_and_stop(problem, preset, after, after + 40)
    assert all(array.dtype != object for array in saved.values())
    resumed = training.train(problem, preset, np.random.default_rng(20), max_steps=after + 40, resume_from=saved)
    assert [one.step for one in resumed.checkpoints] == [one.step for one in whole.checkpoints]
    for one, other in zip(resumed.checkpoints, whole.checkpoints, strict=True):
        assert one.weights.keys() == other.weights.keys()
        assert all(np.array_equal(one.weights[name], other.weights[name]) for name in one.weights)
    np.testing.assert_array_equal(resumed.curve_step, whole.curve_step)
    np.testing.assert_array_equal(resumed.curve_loss, whole.curve_loss)


def test_adamw_keeps_the_running_mean(problem: SlipSamples) -> None:
    """Assert that its checkpoints are the mean of the weights on the way, in which early weights are soon forgotten."""
    plain = replace(ADAMW, average=0.0)
    idle = replace(plain, learning_rate=0.0)
    start, direction, results = (
        training.train(problem, preset, np.random.default_rng(1), max_steps=7) for preset in (idle, plain, ADAMW)
    )
    mean = start.checkpoints[0].weights["fc3.weight"].astype(np.float64)
    for step in range(1, 8):
        share = (1 + step) / (10 + step)
        mean = share * mean + (1 - share) * direction.checkpoints[step - 1].weights["fc3.weight"]
        np.testing.assert_allclose(results.checkpoints[step - 1].weights["fc3.weight"], mean, atol=1e-6)


def test_adamw_slows_down(problem: SlipSamples) -> None:
    """Assert that the learning rate is 0.002 in the first step, half of it in the middle and nearly 0 in the last."""
    flat = replace(ADAMW, average=0.0, cosine=False, weight_decay=0.0)
    falling = replace(flat, cosine=True)
    start, *runs = (
        training.train(problem, preset, np.random.default_rng(2), max_steps=7)
        for preset in (replace(flat, learning_rate=0.0), flat, falling)
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
    """Assert that adamw makes samples 0.3 to 2 times as strong, and the other recipes leave them as they are."""
    for preset in (PAPER, ADAM):
        np.testing.assert_array_equal(training.factors(preset, 72, np.random.default_rng(0)), 1)
    logarithm = np.log(training.factors(ADAMW, 3000, np.random.default_rng(0)))
    shares, _ = np.histogram(logarithm, bins=4, range=(np.log(0.3), np.log(2)))
    assert shares.sum() == 3000
    assert np.all(np.abs(shares / 3000 - 0.25) < 0.04)  # five standard deviations


def test_the_first_step_sees_the_varied_samples(problem: SlipSamples) -> None:
    """Assert that a batch is turned, then multiplied sample by sample: the loss of step 1 is that of such a batch."""
    idle = replace(ADAMW, learning_rate=0.0, weight_decay=0.0, average=0.0, share_weight=0.0)
    result = training.train(problem, idle, np.random.default_rng(13), max_steps=1)
    _, draws, turns, gains = np.random.default_rng(13).spawn(4)
    batch = next(sampling.batches(problem, draws))
    ends = np.concatenate(batch)
    turned = sampling.quarter_turns(len(ends), turns)
    factors = training.factors(idle, len(ends), gains)
    varied = sampling.augment(problem, problem.inputs(ends), turned, factors)
    target = torch.from_numpy((np.arange(len(ends)) < len(batch.slip)).astype(np.float32))
    with torch.no_grad():
        logits = from_weights(HIST10, result.checkpoints[0].weights)(torch.from_numpy(varied))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, target)
    assert result.curve_loss[0] == pytest.approx(float(loss), rel=1e-5)


def test_the_share_that_slips_is_learned_beside_the_labels(problem: SlipSamples) -> None:
    """Assert that the true share changes the weights where it is asked for and known, and only then."""
    preset = training.with_true_slip_share(ADAMW)
    unknown = replace(problem, slip_share=np.full_like(problem.slip_share, np.nan))

    def trained(samples: SlipSamples, preset: training.Preset) -> SlipTraining:
        return training.train(samples, preset, np.random.default_rng(20), max_steps=20)

    with_share = trained(problem, preset)
    assert not same(with_share, trained(problem, ADAMW))
    assert same(trained(unknown, preset), trained(problem, ADAMW))
    assert set(with_share.checkpoints[-1].weights) == set(trained(unknown, preset).checkpoints[-1].weights)


@pytest.mark.slow
def test_images_are_trained_on() -> None:
    """Assert that an image network tells full images from empty ones, and is the same again for the same seed."""
    label = (np.arange(60) >= 40).astype(np.int8)
    rng = np.random.default_rng(0)
    counts = np.where(label, 3000, 30)
    start = np.cumsum([0, *counts])
    images = EventImages(start, rng.integers(0, 540 * 480, start[-1]).astype(np.uint32), np.ones(start[-1], np.int8))
    one = Trajectory(images, counts.astype(np.int32), label, 40)
    samples = sampling.gather([one, one], ARCHITECTURES["no-hist-img-6x6"])
    assert (len(samples.slip), len(samples.busy), len(samples.quiet)) == (30, 80, 0)
    short, again = (training.train(samples, ADAM, np.random.default_rng(1), max_steps=2) for _ in range(2))
    assert same(short, again)
    result = training.train(samples, ADAM, np.random.default_rng(1), max_steps=25)
    network = from_weights(samples.architecture, result.checkpoints[-1].weights)
    with torch.no_grad():
        slipping, holding = (network(torch.from_numpy(samples.inputs(at))) for at in (samples.slip, samples.busy))
    assert slipping.min() > holding.max()


def with_stillness(rng: np.random.Generator) -> SlipSamples:
    """Give the separable trajectories, and one that never slips, a tenth of which looks like slip."""
    label = (np.arange(200) >= 150).astype(np.int8)
    made = []
    for slips in (True, True, False):
        moves = label if slips else (np.arange(200) % 10 == 0).astype(np.int8)
        displacement = rng.uniform(0, 0.5, (200, 56)) + 10 * moves[:, None]
        events = rng.poisson(np.where(moves, 200, 0.45)[:, None], (200, 56)).astype(np.int32)
        series = features.series(displacement.astype(np.float32), events)
        made.append(Trajectory(series, events.sum(axis=1), label * slips, 150 if slips else -1))
    return sampling.gather(made, HIST10)


def test_of_what_never_slips_the_hardest_is_trained_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that of 48 drawn a batch keeps the first 8 and the 8 of the others that are the most slip by then."""
    samples = with_stillness(np.random.default_rng(3))
    sizes, kept_logits, other_logits = [], [], []
    chosen = training._TrainingRun._samples_to_train_on

    def watched(run: Any, batch: Any, still: int) -> Any:
        kept = chosen(run, batch, still)
        first = len(batch) - still
        with torch.no_grad():
            logits = run.network(torch.from_numpy(batch)).numpy()
        hard = kept[kept >= first + 8]
        left = np.setdiff1d(np.arange(first + 8, len(batch)), hard)
        sizes.append((still, len(kept) - first, kept[first : first + 8].tolist() == [*range(first, first + 8)]))
        kept_logits.append(logits[hard].min())
        other_logits.append(logits[left].max())
        return kept

    monkeypatch.setattr(training._TrainingRun, "_samples_to_train_on", watched)
    training.train(samples, ADAM, np.random.default_rng(1), epochs=2, max_steps=4)
    assert {size for size in sizes if size[0] == 48} == {(48, 16, True)}
    assert np.all(np.array(kept_logits) >= np.array(other_logits))


def test_a_run_with_stillness_goes_on_to_the_same() -> None:
    """Assert that choosing samples is drawn again by a run that is resumed."""
    samples = with_stillness(np.random.default_rng(2))
    saved: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "SAVE_STEPS", 3)
        first = training.train(
            samples, ADAMW, np.random.default_rng(0), max_steps=7, on_save=lambda state: saved.append(state())
        )
    second = training.train(samples, ADAMW, np.random.default_rng(0), max_steps=7, resume_from=saved[0])
    assert same(first, second)
    assert int(saved[0]["step"]) == 3


def test_paper_leaves_the_inputs_alone(problem: SlipSamples) -> None:
    """Assert that the paper's preset is plain SGD at 0.001 for 70 epochs on inputs as they are."""
    assert (PAPER.optimiser, PAPER.learning_rate, PAPER.epochs, PAPER.checkpoint_every) == ("sgd", 0.001, 70, 10)
    arrays = training.train(problem, PAPER, np.random.default_rng(12), max_steps=1).checkpoints[0].weights
    assert np.all(arrays["input_scale"] == 1)
    assert np.all(arrays["input_offset"] == 0)
