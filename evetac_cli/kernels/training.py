"""Train a slip detector: which slices are drawn, how often, how they are varied, and the steps of the optimiser.

Slip is rare, and most of the rest is silence, so samples are drawn from three pools (paper, Model Training & Data
Selection):

- slip: slices labelled slip;
- busy: slices labelled no slip with more than 25 events;
- quiet: all other slices labelled no slip.

"Events" are those outside the window strip, because a detector must not know what the window sees. A batch of 72 holds
32, 32 and 8 of them, and an epoch is one pass over the busy pool.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from evetac_cli.kernels import features, slip
from evetac_cli.kernels.networks import SlipNet, weights

BUSY_EVENTS = 25  # a slice with more is busy
SLIP_SHARE = 32  # samples of each pool in a batch
BUSY_SHARE = 32
QUIET_SHARE = 8
ROTATED_SHARE = 0.5
CURVE_POINTS = 100
NORMALISE_SAMPLES = 2000  # of each pool, enough for a mean and a spread


@dataclass(frozen=True)
class Recipe:
    """A named, complete set of training constants."""

    name: str
    optimiser: Literal["sgd", "adam"]
    learning_rate: float
    normalise: bool  # shift and scale each input channel to mean 0 and spread 1 over the training samples
    epochs: int
    checkpoint_every: int  # epochs


RECIPES = {
    recipe.name: recipe
    for recipe in [
        Recipe("paper", "sgd", learning_rate=1e-3, normalise=False, epochs=70, checkpoint_every=10),
        # not the paper's: for when few steps are to be enough; its name travels with the result
        Recipe("adam", "adam", learning_rate=1e-3, normalise=True, epochs=70, checkpoint_every=10),
    ]
}


@dataclass(frozen=True)
class Samples:
    """Trajectories end to end, and for each pool the slices (int64) at which a sample's history ends."""

    architecture: slip.Architecture
    rows: int
    columns: int
    displacement_px: NDArray[np.float32]  # (all slices, dots)
    events_per_dot: NDArray[np.int32]  # (all slices, dots)
    slip: NDArray[np.int64]
    busy: NDArray[np.int64]
    quiet: NDArray[np.int64]

    def inputs(self, at: NDArray[np.int64]) -> NDArray[np.float32]:
        """Network inputs (samples, dots, inputs_per_dot) of the samples that end at these slices.

        Why so: gathered anew for each batch, because all windows together hold every slice ten times over (2.4 GB for
        the paper's 360 trajectories of 1.5 s) and gathering takes a small part of a training step.
        """
        windows = features.windows(self.displacement_px, self.events_per_dot, self.architecture.history, at)
        return slip.inputs(self.architecture, windows)


def gather(
    trajectories: Sequence[slip.Trajectory], architecture: slip.Architecture, rows: int = 7, columns: int = 8
) -> Samples:
    """Sort the slices of trajectories into the three pools.

    A trajectory with an onset is cut to the slices [0, onset + cut): 15 ms for a history of 10 or less, 20 ms to 20,
    50 ms beyond. A slice is a sample when its history is full and it is labelled. ValueError where shapes, values or
    the onset do not fit, or where the slip or the busy pool would be empty; the quiet pool may be.
    """
    pools: dict[str, list[NDArray[np.int64]]] = {"slip": [], "busy": [], "quiet": []}
    displacements = []
    events = []
    begin = 0
    for index, trajectory in enumerate(trajectories):
        try:
            _check(trajectory, rows * columns)
        except ValueError as error:
            raise ValueError(f"trajectory {index}: {error}") from error
        slices = len(trajectory.label)
        if trajectory.onset >= 0:
            slices = min(slices, trajectory.onset + architecture.train_cut_ms)
        label = trajectory.label[:slices]
        busy = trajectory.events_outside[:slices] > BUSY_EVENTS
        full = np.arange(slices) >= architecture.history - 1
        pools["slip"].append(begin + np.flatnonzero(full & (label == 1)))
        pools["busy"].append(begin + np.flatnonzero(full & (label == 0) & busy))
        pools["quiet"].append(begin + np.flatnonzero(full & (label == 0) & ~busy))
        displacements.append(np.asarray(trajectory.displacement_px[:slices], np.float32))
        events.append(np.asarray(trajectory.events_per_dot[:slices], np.int32))
        begin += slices
    ends = {name: np.concatenate([np.empty(0, np.int64), *parts]) for name, parts in pools.items()}
    meanings = {"slip": "labelled slip", "busy": f"labelled no slip with more than {BUSY_EVENTS} events"}
    for name, meaning in meanings.items():
        if len(ends[name]) == 0:
            raise ValueError(
                f"the {name} pool is empty: expected at least one slice {meaning} with a full history of "
                f"{architecture.history}, found none in {len(trajectories)} trajectories"
            )
    return Samples(architecture, rows, columns, np.concatenate(displacements), np.concatenate(events), **ends)


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


def augment(inputs: NDArray[np.float32], rows: int, columns: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Rotate each sample with probability 0.5 by 90, 180 or 270 degrees, as if the gel had been gripped that way round.

    `inputs` is (samples, dots, channels), dots row-major; returns a new array of that shape.
    """
    quarter_turns = np.where(rng.random(len(inputs)) < ROTATED_SHARE, rng.integers(1, 4, len(inputs)), 0)
    grid = inputs.reshape(len(inputs), rows, columns, -1).copy()
    for turns in (1, 2, 3):
        chosen = quarter_turns == turns
        if chosen.any():
            grid[chosen] = features.rotate(grid[chosen], turns)
    return grid.reshape(inputs.shape)


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


def train(
    samples: Samples,
    recipe: Recipe,
    rng: np.random.Generator,
    epochs: int | None = None,
    max_steps: int | None = None,
    on_progress: Callable[[int, int, float], None] | None = None,
) -> Training:
    """Train one network with binary cross entropy (paper, Model Training & Data Selection).

    `epochs` None takes the recipe's. Checkpoints are kept every `recipe.checkpoint_every` epochs and at the end; where
    `max_steps` cuts the run, as many are spread evenly over the steps that are left, and the result's `cut` is True.
    `on_progress` gets (step, steps, loss) at each of the up to 100 points of the loss curve. The result depends on the
    generator's state alone (on one kind of machine and number of torch threads, which is the caller's to set).
    ValueError when the loss stops being finite.
    """
    epochs = recipe.epochs if epochs is None else epochs
    if epochs < 1 or (max_steps is not None and max_steps < 1):
        raise ValueError(f"expected at least one epoch and one step, found {epochs} and {max_steps}")
    per_epoch = steps_per_epoch(samples)
    planned = epochs * per_epoch
    steps = planned if max_steps is None else min(planned, max_steps)
    checkpoint_epochs = sorted({*range(recipe.checkpoint_every, epochs + 1, recipe.checkpoint_every), epochs})
    kept = {epoch * per_epoch for epoch in checkpoint_epochs}
    if steps < planned:
        kept = set(_evenly(steps, len(checkpoint_epochs)))
    points = set(_evenly(steps, CURVE_POINTS))

    seeds, draws, turns = rng.spawn(3)
    network = _network(samples, recipe, int(seeds.integers(2**63)))
    make = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam}[recipe.optimiser]
    optimiser = make(network.parameters(), lr=recipe.learning_rate, fused=True)
    checkpoints = []
    curve_step = []
    curve_loss = []
    loss_sum = torch.zeros(())
    since = 0
    for step, batch in enumerate(islice(batches(samples, draws), steps), start=1):
        inputs = augment(samples.inputs(np.concatenate(batch)), samples.rows, samples.columns, turns)
        target = torch.zeros(len(inputs))
        target[: len(batch.slip)] = 1
        optimiser.zero_grad()
        loss = functional.binary_cross_entropy_with_logits(network(torch.from_numpy(inputs)), target)
        torch.autograd.backward(loss)
        optimiser.step()
        loss_sum += loss.detach()
        if step in points:
            mean = float(loss_sum) / (step - since)
            if not np.isfinite(mean):
                raise ValueError(f"recipe {recipe.name}: expected a finite loss, found {mean} by step {step}")
            curve_step.append(step)
            curve_loss.append(mean)
            loss_sum.zero_()
            since = step
            if on_progress:
                on_progress(step, steps, mean)
        if step in kept:
            checkpoints.append(Checkpoint(step, weights(network)))
    return Training(recipe, checkpoints, np.array(curve_step, np.int64), np.array(curve_loss), steps, planned)


def _network(samples: Samples, recipe: Recipe, seed: int) -> SlipNet:
    scale = offset = None
    if recipe.normalise:
        offset, spread = _moments(samples)
        # a channel that varies by rounding alone carries nothing: it is shifted to 0 and not blown up
        scale = 1 / np.where(spread > 1e-6 * np.abs(offset), spread, 1)
    with torch.random.fork_rng(devices=[]):  # torch draws first weights from its global generator only
        torch.manual_seed(seed)
        return SlipNet(samples.architecture, samples.rows, samples.columns, scale, offset)


def _moments(samples: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of each channel over what a batch holds: every pool counts by its share."""
    shares = np.array([SLIP_SHARE, _busy_share(samples), QUIET_SHARE if len(samples.quiet) else 0])
    mean = np.zeros(samples.architecture.inputs_per_dot)
    square = np.zeros(samples.architecture.inputs_per_dot)
    for share, pool in zip(shares / shares.sum(), (samples.slip, samples.busy, samples.quiet), strict=True):
        if len(pool) == 0:
            continue
        spaced = pool[:: -(-len(pool) // NORMALISE_SAMPLES)]
        values = samples.inputs(spaced).astype(np.float64)
        mean += share * values.mean(axis=(0, 1))
        square += share * np.square(values).mean(axis=(0, 1))
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


def _check(trajectory: slip.Trajectory, dots: int) -> None:
    slices = len(trajectory.label)
    expected = {
        "displacement_px": (slices, dots),
        "events_per_dot": (slices, dots),
        "events_outside": (slices,),
        "label": (slices,),
    }
    for name, shape in expected.items():
        found = getattr(trajectory, name).shape
        if found != shape:
            raise ValueError(f"{name}: expected shape {shape}, found {found}")
    slip.check_labels(trajectory.label, trajectory.onset)
    if not np.isfinite(trajectory.displacement_px).all():
        raise ValueError("displacement_px: expected finite numbers")
    for name in ("events_per_dot", "events_outside"):
        counts = getattr(trajectory, name)
        if counts.dtype.kind not in "iu" or np.any(counts < 0):
            raise ValueError(
                f"{name}: expected whole numbers of at least 0, found {counts.dtype} from {counts.min(initial=0)}"
            )
