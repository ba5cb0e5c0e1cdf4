"""Train a slip detector: which slices are drawn, how often, how they are varied, and the steps of the optimiser.

Slip is rare, and most of the rest is silence, so samples are drawn from three pools (paper, Model Training & Data
Selection):

- slip: slices labelled slip;
- busy: slices labelled no slip with more than 25 events;
- quiet: all other slices labelled no slip.

"Events" are those outside the window strip, because a detector must not know what the window sees. A batch of 72 holds
32, 32 and 8 of them, and an epoch is one pass over the busy pool.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from evetac_cli.kernels import inputs, slip
from evetac_cli.kernels.features import EventImages
from evetac_cli.kernels.inputs import Trajectory
from evetac_cli.kernels.networks import Network, build, weights

BUSY_EVENTS = 25  # a slice with more is busy
SLIP_SHARE = 32  # samples of each pool in a batch
BUSY_SHARE = 32
QUIET_SHARE = 8
ROTATED_SHARE = 0.5
CURVE_POINTS = 100
NORMALISE_SAMPLES = 2000  # of each pool, enough for a mean and a spread
NORMALISE_IMAGES = 200  # as many of images, which have some thousand values each
NORMALISE_VALUES = 1 << 22  # at a time
KEEP_STEPS = 50  # how often a run may be kept, see `train`


@dataclass(frozen=True)
class Recipe:
    """A named, complete set of training constants."""

    name: str
    optimiser: Literal["sgd", "adam", "adamw"]
    learning_rate: float
    normalise: bool  # shift and scale each input channel to mean 0 and spread 1 over the training samples
    epochs: int
    checkpoint_every: int  # epochs
    weight_decay: float = 0.0
    cosine: bool = False  # let the learning rate fall to 0 over the run, as half a cosine
    average: float = 0.0  # keep the running mean of the weights, with this share of the old a step; 0: keep the last
    gain: tuple[float, float] = (
        1.0,
        1.0,
    )  # every sample is multiplied by a factor from this range, drawn log-uniformly


RECIPES = {
    recipe.name: recipe
    for recipe in [
        Recipe("paper", "sgd", learning_rate=1e-3, normalise=False, epochs=70, checkpoint_every=10),
        # not the paper's: for when few steps are to be enough; their names travel with the result
        Recipe("adam", "adam", learning_rate=1e-3, normalise=True, epochs=70, checkpoint_every=10),
        # A single wrong slice spoils a trajectory's timing, and the mean of many late weights makes fewer of them. The
        # gel is elastic and friction has no scale: an object half as heavy moves the dots half as far, with half the
        # events, when it slips under half the force. So the factor makes lighter and heavier objects of those at hand.
        Recipe(
            "steady",
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


@dataclass(frozen=True)
class Samples:
    """Trajectories end to end, and for each pool the slices (int64) at which a sample's history ends.

    Why so: inputs are gathered anew for each batch, because all of them together hold every slice as often as the
    history is long (2.4 GB for 360 trajectories of 1.5 s and hist10), and gathering takes a small part of a step.
    """

    architecture: slip.Architecture
    rows: int
    columns: int
    series: inputs.Series
    slip: NDArray[np.int64]
    busy: NDArray[np.int64]
    quiet: NDArray[np.int64]

    def inputs(self, at: NDArray[np.int64]) -> NDArray[np.float32]:
        """Network inputs (samples, ...) of the samples that end at these slices."""
        return inputs.at(self.architecture, self.series, at)


def gather(
    trajectories: Iterable[Trajectory],
    architecture: slip.Architecture,
    rows: int = 7,
    columns: int = 8,
    ahead_ms: int = 0,
) -> Samples:
    """Sort the slices of trajectories into the three pools; what no sample sees is left out.

    A trajectory with an onset is cut to the slices [0, onset + cut): 15 ms for a history of 10 or less, 20 ms to 20,
    50 ms beyond. A slice is a sample when its history is full and it is labelled. With `ahead_ms` the same slices are
    labelled as in `slip.shift`. ValueError where shapes, values or the onset do not fit, or where the slip or the busy
    pool would be empty; the quiet pool may be.
    """
    history = architecture.history
    pools: dict[str, list[NDArray[np.int64]]] = {"slip": [], "busy": [], "quiet": []}
    parts = []
    begin = count = 0
    for index, trajectory in enumerate(trajectories):
        count += 1
        try:
            _check(trajectory, rows * columns)
            shifted = slip.shift(trajectory.label, ahead_ms)
        except ValueError as error:
            raise ValueError(f"trajectory {index}: {error}") from error
        slices = len(shifted)
        if trajectory.onset >= 0:
            slices = min(slices, trajectory.onset + architecture.train_cut_ms)
        label = shifted[:slices]
        drawn = (np.arange(slices) >= history - 1) & (label >= 0)
        if not drawn.any():
            continue
        busy = trajectory.events_outside[:slices] > BUSY_EVENTS
        first = int(np.argmax(drawn)) - (history - 1)
        for name, members in (("slip", label == 1), ("busy", (label == 0) & busy), ("quiet", (label == 0) & ~busy)):
            pools[name].append(begin - first + np.flatnonzero(drawn & members))
        parts.append(inputs.part(trajectory.series, first, slices))
        begin += slices - first
    ends = {name: np.concatenate([np.empty(0, np.int64), *pool]) for name, pool in pools.items()}
    meanings = {"slip": "labelled slip", "busy": f"labelled no slip with more than {BUSY_EVENTS} events"}
    for name, meaning in meanings.items():
        if len(ends[name]) == 0:
            raise ValueError(
                f"the {name} pool is empty: expected at least one slice {meaning} with a full history of "
                f"{history}, found none in {count} trajectories"
            )
    return Samples(architecture, rows, columns, inputs.join(parts), **ends)


class Batch(NamedTuple):
    """The slices that the samples of one batch end at, by pool."""

    slip: NDArray[np.int64]
    busy: NDArray[np.int64]
    quiet: NDArray[np.int64]


def steps_per_epoch(samples: Samples) -> int:
    """Batches in one pass over the busy pool."""
    return -(-len(samples.busy) // _busy_share(samples))


def batches(samples: Samples, rng: np.random.Generator) -> Iterator[Batch]:
    """Draw batches without end; `steps_per_epoch` of them see every busy sample once.

    Each pool is shuffled, dealt out, and shuffled again when it is used up; slip and quiet samples run on over the
    borders of epochs. The last batch of an epoch holds what is left of the busy pool, and the other shares shrink with
    it (rounded up), so that the proportions hold. An empty quiet pool leaves its share to the busy pool.
    """
    share = _busy_share(samples)
    slip_deck = _deal(samples.slip, rng)
    quiet_deck = _deal(samples.quiet, rng)
    quiet_share = QUIET_SHARE if len(samples.quiet) else 0
    while True:
        order = rng.permutation(samples.busy)
        for start in range(0, len(order), share):
            busy = order[start : start + share]
            yield Batch(
                _take(slip_deck, -(-SLIP_SHARE * len(busy) // share)),
                busy,
                _take(quiet_deck, -(-quiet_share * len(busy) // share)),
            )


def quarter_turns(samples: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """How often each sample is turned by 90 degrees: 1 to 3 times with probability 0.5, else not at all."""
    return np.where(rng.random(samples) < ROTATED_SHARE, rng.integers(1, 4, samples), 0)


def augment(samples: Samples, batch: NDArray[np.float32], turns: NDArray[np.int64]) -> NDArray[np.float32]:
    """Turn each input of a batch, as if the object had been gripped that way round; a new array (paper, as above)."""
    result = batch.copy()
    for times in (1, 2, 3):
        chosen = turns == times
        if chosen.any():
            result[chosen] = inputs.rotate(samples.architecture, batch[chosen], samples.rows, samples.columns, times)
    return result


def factors(recipe: Recipe, samples: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """What each sample is multiplied by, drawn log-uniformly from the range of the recipe."""
    least, most = recipe.gain
    return np.exp(rng.uniform(math.log(least), math.log(most), samples)).astype(np.float32)


class Checkpoint(NamedTuple):
    """The network after some steps, as `networks.weights` gives it."""

    step: int
    weights: dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Training:
    """What a run of training gave."""

    recipe: Recipe
    checkpoints: list[Checkpoint]  # the last is the end of the run
    curve_step: NDArray[np.int64]  # (points,)
    curve_loss: NDArray[np.float64]  # (points,) mean loss since the point before
    steps: int
    steps_planned: int  # what all epochs would have taken

    @property
    def cut(self) -> bool:
        """Whether max_steps ended the run before its last epoch."""
        return self.steps < self.steps_planned


Kept = dict[str, NDArray[Any]]  # a run that is not over, as named arrays


def train(
    samples: Samples,
    recipe: Recipe,
    rng: np.random.Generator,
    epochs: int | None = None,
    max_steps: int | None = None,
    on_progress: Callable[[int, int, float], None] | None = None,
    device: str = "cpu",
    kept: Kept | None = None,
    on_keep: Callable[[Callable[[], Kept]], None] | None = None,
) -> Training:
    """Train one network with binary cross entropy (paper, Model Training & Data Selection).

    `epochs` None takes the recipe's. Checkpoints are kept every `recipe.checkpoint_every` epochs and at the end; where
    `max_steps` cuts the run, as many are spread evenly over the steps that are left, and the result's `cut` is True.
    `on_progress` gets (step, steps, loss) at each of the up to 100 points of the loss curve. The result depends on the
    generator's state alone (on one kind of machine and number of torch threads, which is the caller's to set).

    `on_keep` is called every 50 steps with a function that gives the run as it then is. Given back as `kept`, with all
    else as it was, the run goes on from there to the same result: the generators are led to the same place by drawing
    again what had been drawn. ValueError when the loss stops being finite, or where `kept` is of another run.
    """
    epochs = recipe.epochs if epochs is None else epochs
    if epochs < 1 or (max_steps is not None and max_steps < 1):
        raise ValueError(f"expected at least one epoch and one step, found {epochs} and {max_steps}")
    per_epoch = steps_per_epoch(samples)
    planned = epochs * per_epoch
    steps = planned if max_steps is None else min(planned, max_steps)
    checkpoint_epochs = sorted({*range(recipe.checkpoint_every, epochs + 1, recipe.checkpoint_every), epochs})
    wanted = {epoch * per_epoch for epoch in checkpoint_epochs}
    if steps < planned:
        wanted = set(_evenly(steps, len(checkpoint_epochs)))
    points = set(_evenly(steps, CURVE_POINTS))

    seeds, draws, turns, gains = rng.spawn(4)
    run = _Run(_network(samples, recipe, int(seeds.integers(2**63))).to(device), recipe, device)
    if kept is not None:
        run.restore(kept)
    for step, batch in enumerate(islice(batches(samples, draws), steps), start=1):
        ends = np.concatenate(batch)
        turned = quarter_turns(len(ends), turns)
        factor = factors(recipe, len(ends), gains)
        if step <= run.step:
            continue  # done before the interruption
        target = torch.zeros(len(ends))
        target[: len(batch.slip)] = 1
        varied = augment(samples, samples.inputs(ends), turned)
        varied *= factor.reshape(-1, *(1,) * (varied.ndim - 1))
        run.advance(varied, target, (step - 1) / steps)
        if step in points:
            mean = run.mean_loss()
            if not np.isfinite(mean):
                raise ValueError(f"recipe {recipe.name}: expected a finite loss, found {mean} by step {step}")
            if on_progress:
                on_progress(step, steps, mean)
        if step in wanted:
            run.checkpoints.append(Checkpoint(step, run.weights()))
        if on_keep and step % KEEP_STEPS == 0 and step < steps:
            on_keep(run.keep)
    curve = np.array(run.curve_step, np.int64), np.array(run.curve_loss)
    return Training(recipe, run.checkpoints, *curve, steps, planned)


class _Run:
    """A run of training between two steps."""

    def __init__(self, network: Network, recipe: Recipe, device: str) -> None:
        self.network = network
        self.recipe = recipe
        self.device = device
        self.trained = dict(network.named_parameters())
        make: Any = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[recipe.optimiser]
        self.optimiser = make(
            self.trained.values(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay, fused=True
        )
        self.average = {name: value.detach().clone() for name, value in self.trained.items() if recipe.average}
        self.loss_sum = torch.zeros((), device=device)
        self.step = self.since = 0
        self.checkpoints: list[Checkpoint] = []
        self.curve_step: list[int] = []
        self.curve_loss: list[float] = []

    def advance(self, batch: NDArray[np.float32], target: Tensor, done: float) -> None:
        """Take one step of the optimiser; `done` is the share of the run that lies behind."""
        if self.recipe.cosine:
            for group in self.optimiser.param_groups:
                group["lr"] = self.recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * done))
        self.optimiser.zero_grad()
        logits = self.network(torch.from_numpy(batch).to(self.device))
        loss = functional.binary_cross_entropy_with_logits(logits, target.to(self.device))
        torch.autograd.backward(loss)
        self.optimiser.step()
        self.loss_sum += loss.detach()
        self.step += 1
        if self.average:
            # early weights are soon forgotten: the mean of a short run reaches back for a tenth of it
            share = min(self.recipe.average, (1 + self.step) / (10 + self.step))
            new = [value.detach() for value in self.trained.values()]
            torch._foreach_lerp_(list(self.average.values()), new, 1 - share)

    def mean_loss(self) -> float:
        """Mean loss since this was last asked, which becomes a point of the curve."""
        mean = float(self.loss_sum) / (self.step - self.since)
        self.curve_step.append(self.step)
        self.curve_loss.append(mean)
        self.loss_sum.zero_()
        self.since = self.step
        return mean

    def weights(self) -> dict[str, NDArray[np.float32]]:
        """The weights to be judged: the last, or their running mean."""
        return weights(self.network) | {name: value.cpu().numpy().copy() for name, value in self.average.items()}

    def keep(self) -> Kept:
        """The run as named arrays."""
        arrays: Kept = {
            "step": np.array(self.step),
            "since": np.array(self.since),
            "loss_sum": self.loss_sum.cpu().numpy().copy(),
            "curve_step": np.array(self.curve_step, np.int64),
            "curve_loss": np.array(self.curve_loss, np.float64),
        }
        arrays |= {f"weights/{name}": value for name, value in weights(self.network).items()}
        arrays |= {f"average/{name}": value.cpu().numpy().copy() for name, value in self.average.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            for name, value in state.items():
                if value is not None:
                    arrays[f"optimiser/{index}/{name}"] = value.cpu().numpy().copy()
        for checkpoint in self.checkpoints:
            for name, array in checkpoint.weights.items():
                arrays[f"checkpoint/{checkpoint.step}/{name}"] = array
        return arrays

    def restore(self, kept: Kept) -> None:
        """Become the run that `keep` gave; ValueError if it does not fit."""
        found = _groups(kept)
        try:
            state = {name: torch.from_numpy(np.asarray(array)) for name, array in found["weights"].items()}
            self.network.load_state_dict(state)
            for name, average in self.average.items():
                average.copy_(torch.from_numpy(np.asarray(found["average"][name])))
            optimiser = self.optimiser.state_dict()
            optimiser["state"] = {}
            for name, array in found["optimiser"].items():
                index, key = name.split("/")
                optimiser["state"].setdefault(int(index), {})[key] = torch.from_numpy(np.array(array))
            self.optimiser.load_state_dict(optimiser)
            checkpoints: dict[int, dict[str, NDArray[np.float32]]] = {}
            for name, array in found["checkpoint"].items():
                step, key = name.split("/")
                checkpoints.setdefault(int(step), {})[key] = array
            self.checkpoints = [Checkpoint(*item) for item in checkpoints.items()]
            self.loss_sum.copy_(torch.from_numpy(np.array(kept["loss_sum"])))
            self.step, self.since = int(kept["step"]), int(kept["since"])
            self.curve_step, self.curve_loss = kept["curve_step"].tolist(), kept["curve_loss"].tolist()
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"expected a kept run of this network and recipe, found another: {error}") from error


def _groups(kept: Kept) -> dict[str, Kept]:
    """Arrays by the first part of their names."""
    groups: dict[str, Kept] = {name: {} for name in ("weights", "average", "optimiser", "checkpoint")}
    for name, array in kept.items():
        group, _, rest = name.partition("/")
        if rest:
            groups[group][rest] = array
    return groups


def _network(samples: Samples, recipe: Recipe, seed: int) -> Network:
    scale = offset = None
    if recipe.normalise:
        offset, spread = _moments(samples)
        # a channel that varies by rounding alone carries nothing: it is shifted to 0 and not blown up
        scale = 1 / np.where(spread > 1e-6 * np.abs(offset), spread, 1)
    with torch.random.fork_rng(devices=[]):  # torch draws first weights from its global generator only
        torch.manual_seed(seed)
        return build(samples.architecture, samples.rows, samples.columns, scale, offset)


def _moments(samples: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of each channel over what a batch holds: every pool counts by its share."""
    images = isinstance(samples.architecture, slip.ImageArchitecture)
    over = (0, 2, 3) if images else (0, 1)
    most = NORMALISE_IMAGES if images else NORMALISE_SAMPLES
    at_once = max(1, NORMALISE_VALUES // samples.inputs(samples.slip[:1]).size)
    shares = np.array([SLIP_SHARE, _busy_share(samples), QUIET_SHARE if len(samples.quiet) else 0])
    mean = square = np.zeros(1)
    for share, pool in zip(shares / shares.sum(), (samples.slip, samples.busy, samples.quiet), strict=True):
        spaced = pool[:: -(-len(pool) // most)] if len(pool) else pool
        for begin in range(0, len(spaced), at_once):
            chunk = spaced[begin : begin + at_once]
            values = samples.inputs(chunk).astype(np.float64)
            part = share * len(chunk) / len(spaced)
            mean = mean + part * values.mean(axis=over)
            square = square + part * np.square(values).mean(axis=over)
    return mean, np.sqrt(np.maximum(square - np.square(mean), 0))


def _busy_share(samples: Samples) -> int:
    return BUSY_SHARE if len(samples.quiet) else BUSY_SHARE + QUIET_SHARE


def _deal(pool: NDArray[np.int64], rng: np.random.Generator) -> Iterator[np.int64]:
    while True:
        yield from rng.permutation(pool)


def _take(deck: Iterator[np.int64], count: int) -> NDArray[np.int64]:
    return np.fromiter(islice(deck, count), np.int64, count)


def _evenly(steps: int, points: int) -> list[int]:
    """Up to `points` different steps, evenly spaced, of which the last is `steps`."""
    return sorted({max(1, round(steps * (index + 1) / points)) for index in range(points)})


def _check(trajectory: Trajectory, dots: int) -> None:
    slices = len(trajectory.label)
    if inputs.length(trajectory.series) != slices:
        raise ValueError(f"series: expected {slices} slices as labelled, found {inputs.length(trajectory.series)}")
    if trajectory.events_outside.shape != (slices,):
        raise ValueError(f"events_outside: expected shape {(slices,)}, found {trajectory.events_outside.shape}")
    slip.check_labels(trajectory.label, trajectory.onset)
    outside = trajectory.events_outside
    if outside.dtype.kind not in "iu" or np.any(outside < 0):
        raise ValueError(
            f"events_outside: expected whole numbers of at least 0, found {outside.dtype} from {outside.min(initial=0)}"
        )
    if isinstance(trajectory.series, EventImages):
        return
    if trajectory.series.shape[1:] != (dots, len(slip.CHANNELS)):
        raise ValueError(f"series: expected {dots} dots, found shape {trajectory.series.shape}")
    if not np.isfinite(trajectory.series).all():
        raise ValueError("series: expected finite numbers")
