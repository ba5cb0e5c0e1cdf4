"""Train a slip detector: named sets of training constants (presets), and the steps of the optimiser."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from evetac_cli.errors import check_range
from evetac_cli.kernels.slip.networks import SlipNetwork, build, from_weights, weights
from evetac_cli.kernels.slip.sampling import (
    STILL_DRAWN,
    STILL_SHARE,
    SampleGroups,
    SlipSamples,
    augment,
    channel_stats,
    quarter_turns,
)

CURVE_POINTS = 100  # of the loss curve
PROGRESS_STEPS = 10  # steps between two calls of the progress hook
SAVE_STEPS = 50  # steps between two saved states from which a run can be resumed, see `train`


@dataclass(frozen=True)
class Preset:
    """A named, complete set of training constants."""

    name: str
    optimiser: Literal["sgd", "adam", "adamw"]
    learning_rate: float
    normalise: bool  # shift and scale each input channel to mean 0 and standard deviation 1 over the training samples
    epochs: int
    checkpoint_every: int  # epochs
    weight_decay: float = 0.0
    cosine: bool = False  # reduce the learning rate to 0 over the run, as half a cosine
    # decay per step of a running mean of the weights, which is the result; 0: use the last weights
    average: float = 0.0
    gain: tuple[float, float] = (1.0, 1.0)  # each sample is multiplied by a factor from this range (log-uniform)
    # weight of a second loss: error of a second output that estimates the true share that slips
    share_weight: float = 0.0
    # Whether probabilities are calibrated on validation data, and the threshold chosen by false alarms per minute.
    calibrated: bool = True


PRESETS = {
    preset.name: preset
    for preset in [
        Preset("paper", "sgd", learning_rate=1e-3, normalise=False, epochs=70, checkpoint_every=10, calibrated=False),
        # Not the paper's: for trainings of few steps.
        Preset("adam", "adam", learning_rate=1e-3, normalise=True, epochs=70, checkpoint_every=10),
        # A single wrong slice spoils a trajectory's timing, and the mean of many late weights makes fewer such errors.
        # The gel is elastic and friction has no scale: an object half as heavy moves the dots half as far, with half
        # the events, when it slips under half the force. So the gain adds lighter and heavier objects to the data.
        Preset(
            "adamw",
            "adamw",
            learning_rate=2e-3,
            normalise=True,
            epochs=70,
            checkpoint_every=10,
            weight_decay=0.01,
            cosine=True,
            average=0.999,
            gain=(0.3, 2.0),
        ),
    ]
}

# Starts from a trained network's weights and adapts them to one sensor with few recordings: small steps.
ADAPT = replace(PRESETS["adamw"], name="adapt", learning_rate=2e-4, average=0.99, gain=(0.6, 1.6))
# For networks with memory (memory_training.py).
MEMORY = Preset("memory", "adamw", learning_rate=3e-3, normalise=True, epochs=70, checkpoint_every=7, weight_decay=0.02)
ADAPT_MEMORY = replace(MEMORY, name="adapt", learning_rate=2e-4)


def with_true_slip_share(preset: Preset) -> Preset:
    """Return the preset with a second loss, in addition to that on the labels: the error of the true slipping share.

    Whether an object is lost within 10 ms depends on how much of the contact already slips, which a simulation knows
    for every slice. Labels contain less information. A network trained on labels alone reports an object as lost if
    half of its contact slips for long, under a slanted finger. The second output is discarded after training.
    """
    return replace(preset, share_weight=1.0)


def factors(preset: Preset, samples: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return factors (samples,) on the samples, drawn log-uniformly from the preset's `gain`."""
    least, most = preset.gain
    return np.exp(rng.uniform(math.log(least), math.log(most), samples)).astype(np.float32)


class Checkpoint(NamedTuple):
    """The network after a number of steps, as returned by `networks.weights`."""

    step: int
    weights: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class SlipTraining:
    """The result of a training run."""

    preset: Preset
    checkpoints: list[Checkpoint]  # the last is the end of the run
    curve_step: NDArray[np.int64]  # (points,)
    curve_loss: NDArray[np.float64]  # (points,) mean loss since the point before
    steps: int
    steps_planned: int  # number of steps of all epochs
    state: "TrainingState"  # of the run at its end

    @property
    def cut(self) -> bool:
        """Whether max_steps ended the run before its last epoch."""
        return self.steps < self.steps_planned


TrainingState = dict[str, NDArray[Any]]  # an unfinished run, as named arrays


def train(
    samples: SlipSamples | SampleGroups,
    preset: Preset,
    rng: np.random.Generator,
    epochs: int | None = None,
    max_steps: int | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
    on_save: Callable[[Callable[[], TrainingState]], None] | None = None,
    device: str = "cpu",
    resume_from: TrainingState | None = None,
    start: Mapping[str, NDArray[np.float32]] | None = None,
) -> SlipTraining:
    """Train one network with binary cross entropy (paper, Model Training & Data Selection).

    epochs: None uses the preset's. Checkpoints are taken every `preset.checkpoint_every` epochs and at the end. If
    `max_steps` cuts the run, the same number is spread evenly over its steps, and the result's `cut` is True. Every 10
    steps, `on_progress` is called with (step, steps); every 50 steps, `on_save` with a function that returns the run's
    state. The result depends on the generator's state alone, on one kind of machine and number of torch
    threads, which the caller sets.

    With samples in groups, the first group determines the normalisation, and an epoch goes through all groups. `start`:
    weights and normalisation of a trained network to start from, as returned by `networks.weights`. `resume_from`: a
    saved state; with all other arguments as before, the run continues from that step to the same result. To do so, the
    random generators draw all earlier values again and discard them. ValueError if the loss becomes infinite or NaN, or
    if `resume_from` is the state of another run.
    """
    epochs = preset.epochs if epochs is None else epochs
    check_range("epochs", epochs, 1)
    check_range("max_steps", 1 if max_steps is None else max_steps, 1)
    groups = samples if isinstance(samples, SampleGroups) else SampleGroups.alone(samples)
    per_epoch = groups.steps_per_epoch
    planned = epochs * per_epoch
    steps = planned if max_steps is None else min(planned, max_steps)
    checkpoint_epochs = sorted({*range(preset.checkpoint_every, epochs + 1, preset.checkpoint_every), epochs})
    checkpoint_steps = {epoch * per_epoch for epoch in checkpoint_epochs}
    if steps < planned:
        checkpoint_steps = set(evenly(steps, len(checkpoint_epochs)))
    points = set(evenly(steps, CURVE_POINTS))

    seeds, draws, turns, gains = rng.spawn(4)
    network = _network(groups.first, preset, int(seeds.integers(2**63)), start)
    run = _TrainingRun(*network, preset, device, steps, planned)
    if resume_from is not None:
        run.restore(resume_from)
    for step, batch in enumerate(islice(groups.batches(draws), steps), start=1):
        ends = np.concatenate(batch)
        turned = quarter_turns(len(ends), turns)
        factor = factors(preset, len(ends), gains)
        if step <= run.step:
            continue  # done before the interruption
        target = torch.zeros(len(ends))
        target[: len(batch.slip)] = 1
        varied = augment(groups.now, groups.now.inputs(ends), turned, factor)
        run.advance(varied, target, groups.now.slip_share[ends], (step - 1) / steps, len(batch.still))
        if on_progress and (step % PROGRESS_STEPS == 0 or step == steps):
            on_progress(step, steps)
        if step in points:
            mean = run.mean_loss()
            if not np.isfinite(mean):
                raise ValueError(f"preset {preset.name}: expected a finite loss, found {mean} by step {step}")
        if step in checkpoint_steps:
            run.checkpoints.append(Checkpoint(step, run.weights()))
        if on_save and step % SAVE_STEPS == 0 and step < steps:
            on_save(run.state)
    return result_of(preset, run.state())


def ended(preset: Preset, saved: TrainingState) -> SlipTraining | None:
    """Return the result of a run from its saved state; None if it is of another run, or has not ended."""
    try:
        return result_of(preset, saved) if int(saved["step"]) == int(saved["steps"]) else None
    except (KeyError, ValueError, TypeError):
        return None


def result_of(preset: Preset, state: TrainingState) -> SlipTraining:
    """Return the result of a run from its state at the end."""
    curve = np.asarray(state["curve_step"]), np.asarray(state["curve_loss"])
    checkpoints = _checkpoints(_groups(state)["checkpoint"])
    return SlipTraining(preset, checkpoints, *curve, int(state["steps"]), int(state["planned"]), state)


class _TrainingRun:
    """State of a training run between two steps."""

    def __init__(
        self,
        network: SlipNetwork,
        share_output: nn.Linear | None,
        preset: Preset,
        device: str,
        steps: int,
        planned: int,
    ) -> None:
        self.steps, self.planned = steps, planned
        self.network = network.to(device)
        self.share_output = None if share_output is None else share_output.to(device)
        self.preset = preset
        self.device = device
        self.trained = dict(network.named_parameters())
        extra = [] if self.share_output is None else list(self.share_output.parameters())
        make: Any = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[preset.optimiser]
        self.optimiser = make(
            [*self.trained.values(), *extra], lr=preset.learning_rate, weight_decay=preset.weight_decay, fused=True
        )
        self.average = {name: value.detach().clone() for name, value in self.trained.items() if preset.average}
        self.loss_sum = torch.zeros((), device=device)
        self.step = self.since = 0
        self.checkpoints: list[Checkpoint] = []
        self.curve_step: list[int] = []
        self.curve_loss: list[float] = []

    def advance(
        self, batch: NDArray[np.float32], target: Tensor, share: NDArray[np.float32], done: float, still: int = 0
    ) -> None:
        """Take one step of the optimiser.

        `share`: of the contact that slips, NaN if unknown. `done`: part of the run before this step, 0 to 1. `still`:
        number of samples at the end of the batch from trajectories in which nothing slips; some of them are selected.
        """
        if still:
            kept = self._samples_to_train_on(batch, still)
            batch, target, share = batch[kept], target[torch.from_numpy(kept)], share[kept]
        if self.preset.cosine:
            for group in self.optimiser.param_groups:
                group["lr"] = self.preset.learning_rate * 0.5 * (1 + math.cos(math.pi * done))
        self.optimiser.zero_grad()
        hidden = self.network.last_hidden(torch.from_numpy(batch).to(self.device))
        logits = self.network.outputs(hidden)[:, 0]
        loss = functional.binary_cross_entropy_with_logits(logits, target.to(self.device))
        if self.share_output is not None:
            is_known = torch.from_numpy(np.isfinite(share)).to(self.device)
            wanted = torch.from_numpy(np.nan_to_num(share)).to(self.device)
            losses = functional.binary_cross_entropy_with_logits(
                self.share_output(hidden)[:, 0], wanted, reduction="none"
            )
            loss = loss + self.preset.share_weight * (losses * is_known).sum() / is_known.sum().clamp(min=1)
        torch.autograd.backward(loss)
        self.optimiser.step()
        self.loss_sum += loss.detach()
        self.step += 1
        if self.average:
            # forgets early weights: in a short run, the mean covers its last tenth
            old = min(self.preset.average, (1 + self.step) / (10 + self.step))
            new = [value.detach() for value in self.trained.values()]
            torch._foreach_lerp_(list(self.average.values()), new, 1 - old)

    def _samples_to_train_on(self, batch: NDArray[np.float32], still: int) -> NDArray[np.int64]:
        """Return the samples of a batch to train on: of the last `still`, the first few, and the hardest others."""
        first, each = len(batch) - still, -(-still * STILL_SHARE // STILL_DRAWN // 2)
        others = torch.from_numpy(batch[first + each :]).to(self.device)
        with torch.no_grad():
            logits = self.network(others).cpu().numpy()
        hardest = np.sort(np.argsort(-logits, kind="stable")[:each])
        return np.concatenate([np.arange(first + each), first + each + hardest])

    def mean_loss(self) -> float:
        """Return the mean loss since the last call, and add it to the loss curve."""
        mean = float(self.loss_sum) / (self.step - self.since)
        self.curve_step.append(self.step)
        self.curve_loss.append(mean)
        self.loss_sum.zero_()
        self.since = self.step
        return mean

    def weights(self) -> dict[str, NDArray[np.float32]]:
        """Return the weights of a checkpoint: the last ones, or their running mean."""
        return weights(self.network) | {name: value.cpu().numpy().copy() for name, value in self.average.items()}

    def state(self) -> TrainingState:
        """Return the run as named arrays, from which `restore` continues."""
        arrays: TrainingState = {
            "step": np.array(self.step),
            "since": np.array(self.since),
            "steps": np.array(self.steps),
            "planned": np.array(self.planned),
            "loss_sum": self.loss_sum.cpu().numpy().copy(),
            "curve_step": np.array(self.curve_step, np.int64),
            "curve_loss": np.array(self.curve_loss, np.float64),
        }
        arrays |= {f"weights/{name}": value for name, value in weights(self.network).items()}
        if self.share_output is not None:
            arrays |= {
                f"share/{name}": value.cpu().numpy().copy() for name, value in self.share_output.state_dict().items()
            }
        arrays |= {f"average/{name}": value.cpu().numpy().copy() for name, value in self.average.items()}
        for index, tensors in self.optimiser.state_dict()["state"].items():
            for name, value in tensors.items():
                if value is not None:
                    arrays[f"optimiser/{index}/{name}"] = value.cpu().numpy().copy()
        for checkpoint in self.checkpoints:
            arrays |= {f"checkpoint/{checkpoint.step}/{name}": array for name, array in checkpoint.weights.items()}
        return arrays

    def restore(self, saved: TrainingState) -> None:
        """Continue from a saved state; ValueError if it is of another network or preset."""
        groups = _groups(saved)
        try:
            state = {name: torch.from_numpy(np.asarray(array)) for name, array in groups["weights"].items()}
            self.network.load_state_dict(state)
            if self.share_output is not None:
                share = {name: torch.from_numpy(np.asarray(array)) for name, array in groups["share"].items()}
                self.share_output.load_state_dict(share)
            for name, average in self.average.items():
                average.copy_(torch.from_numpy(np.asarray(groups["average"][name])))
            optimiser = self.optimiser.state_dict()
            optimiser["state"] = {}
            for name, array in groups["optimiser"].items():
                index, key = name.split("/")
                optimiser["state"].setdefault(int(index), {})[key] = torch.from_numpy(np.array(array))
            self.optimiser.load_state_dict(optimiser)
            self.checkpoints = _checkpoints(groups["checkpoint"])
            self.loss_sum.copy_(torch.from_numpy(np.array(saved["loss_sum"])))
            self.step, self.since = int(saved["step"]), int(saved["since"])
            self.curve_step, self.curve_loss = saved["curve_step"].tolist(), saved["curve_loss"].tolist()
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"expected a saved run of this network and preset, found another: {error}") from error


def _groups(saved: TrainingState) -> dict[str, TrainingState]:
    """Return the arrays by the first part of their names."""
    names = ("weights", "share", "average", "optimiser", "checkpoint")
    groups: dict[str, TrainingState] = {name: {} for name in names}
    for name, array in saved.items():
        group, _, rest = name.partition("/")
        if rest:
            groups[group][rest] = array
    return groups


def _checkpoints(saved: TrainingState) -> list[Checkpoint]:
    """Return the checkpoints, in order, from arrays that are named STEP/NAME."""
    checkpoints: dict[int, dict[str, NDArray[np.float32]]] = {}
    for name, array in saved.items():
        step, key = name.split("/")
        checkpoints.setdefault(int(step), {})[key] = array
    return [Checkpoint(*item) for item in checkpoints.items()]


def _network(
    samples: SlipSamples, preset: Preset, seed: int, start: Mapping[str, NDArray[np.float32]] | None
) -> tuple[SlipNetwork, nn.Linear | None]:
    """Return the network to train, and its second output if the preset and the samples have one."""
    shape = samples.rows, samples.columns
    scale = offset = None
    if preset.normalise and start is None:
        offset, spread = channel_stats(samples)
        # a channel that varies only by rounding carries no information: it is shifted to 0, not amplified
        scale = 1 / np.where(spread > 1e-6 * np.abs(offset), spread, 1)
    with torch.random.fork_rng(devices=[]):  # torch draws initial weights from its global generator only
        torch.manual_seed(seed)
        network = build(samples.architecture, *shape, scale, offset)
        if start is not None:
            network = from_weights(samples.architecture, start, *shape)
        if not preset.share_weight or not np.isfinite(samples.slip_share).any():
            return network, None
        return network, nn.Linear(network.outputs.in_features, 1)


def evenly(steps: int, points: int) -> list[int]:
    """Return up to `points` different steps, evenly spaced; the last is `steps`."""
    return sorted({max(1, round(steps * (index + 1) / points)) for index in range(points)})
