"""Train a slip detector with memory on whole contacts, in chunks whose memory continues from the chunk before.

A contact is a run of steps that touch, since the memory is empty without contact. 32 contacts are learned from at a
time, 80 steps of each per step of the optimiser. The learning rate rises to the preset's and falls to 0.

The question is whether a slice within the horizon slips: if known, whether at least 0.3 of the contact does; otherwise
whether its label is slip.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from evetac_cli.errors import check_range
from evetac_cli.kernels.slip.alarms import MUCH_SLIPS
from evetac_cli.kernels.slip.architectures import OF_GRIPPER, MemoryArchitecture
from evetac_cli.kernels.slip.inputs import Trajectory
from evetac_cli.kernels.slip.load_path import EVERY, LoadPath
from evetac_cli.kernels.slip.networks import MemoryNet, build, from_weights, weights
from evetac_cli.kernels.slip.training import (
    CURVE_POINTS,
    PROGRESS_STEPS,
    Checkpoint,
    Preset,
    SlipTraining,
    TrainingState,
    evenly,
    result_of,
)

Singles = NDArray[np.float32]
CHUNK, STREAMS = 80, 32  # steps of a contact per step of the optimiser, and contacts at a time
# Steps later than this after a slip began do not count: the object slides, and nothing is left to foresee. Learning
# from whole trials kept the alarm on for .86 of the time of slides instead of .80, but at one false alarm per minute it
# warned of .35 of slips 10 ms ahead instead of .48 (one training each; 168 slips of seeds from 5,600).
AFTER_MS = 60
WITHOUT_GRIPPER = 0.3  # share of the contacts in which it is unknown, so that one model also works without
CHECKPOINTS = 10
DROPOUT = 0.1
MOST_GRADIENT = 1.0
RISES = 0.15  # share of the run in which the learning rate rises
# Weight of the error of the share: shares between all and nothing are rare, and they matter most.
BETWEEN, BETWEEN_WEIGHT, ABSOLUTE_WEIGHT = (0.05, 0.6), 4.0, 0.3
LEAST_SPREAD = 1e-3  # added to the standard deviation of an input, so that one that hardly varies is not amplified
CONSTANT = 1e-6  # standard deviation up to which an input never varied


class Contact(NamedTuple):
    """A contact of a trajectory by its steps: its numbers (steps, n), the answer 0 or 1, and whether it counts.

    share: of the contact that slips now, NaN if unknown.
    """

    numbers: Singles
    slips: Singles
    counts: Singles
    share: Singles


@dataclass(frozen=True)
class MemorySamples:
    """The contacts that a detector is trained on."""

    architecture: MemoryArchitecture
    contacts: Sequence[Contact]

    @property
    def steps_per_epoch(self) -> int:
        """Number of steps of the optimiser in one pass over all contacts."""
        return -(-sum(len(one.numbers) for one in self.contacts) // (CHUNK * STREAMS))


def gather(trajectories: Iterable[Trajectory], architecture: MemoryArchitecture, horizon_ms: int) -> MemorySamples:
    """Return the contacts of trajectories with a step that counts; ValueError unless some slip and others do not."""
    check_range("horizon_ms", horizon_ms)
    contacts = [one for trajectory in trajectories for one in _contacts(trajectory, horizon_ms)]
    for answer, meaning in ((1, "slips"), (0, "does not slip")):
        if not any(((one.slips == answer) & (one.counts > 0)).any() for one in contacts):
            raise ValueError(f"expected at least one labelled step with contact that {meaning}, found none")
    return MemorySamples(architecture, contacts)


def _contacts(trajectory: Trajectory, horizon_ms: int) -> Iterator[Contact]:
    """Yield each contact up to its last step that counts."""
    path, label = trajectory.series, trajectory.label
    assert isinstance(path, LoadPath) and path.slices == len(label)
    at = EVERY * np.arange(len(path.numbers)) + EVERY - 1
    unknown = np.full(len(label), np.nan, np.float32)
    share = unknown if trajectory.slip_share is None else trajectory.slip_share.astype(np.float32)
    slips = np.where(np.isnan(share), label == 1, share >= MUCH_SLIPS)
    ahead = np.lib.stride_tricks.sliding_window_view(np.pad(slips, (0, horizon_ms)), horizon_ms + 1).max(axis=1)
    counts = (label >= 0) & (np.convolve(label == 1, np.ones(AFTER_MS + 1))[: len(label)] <= AFTER_MS)
    edges = np.flatnonzero(np.diff(path.touches, prepend=False, append=False)).reshape(-1, 2)
    for first, stop in edges.tolist():
        counted = np.flatnonzero(counts[at[first:stop]])
        if len(counted):
            steps = slice(first, first + int(counted[-1]) + 1)
            columns = (values[at[steps]].astype(np.float32) for values in (ahead, counts, share))
            yield Contact(path.numbers[steps], *columns)


def train(
    samples: MemorySamples,
    preset: Preset,
    rng: np.random.Generator,
    epochs: int | None = None,
    max_steps: int | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
    device: str = "cpu",
    start: Mapping[str, Singles] | None = None,
) -> SlipTraining:
    """Train one network; the arguments are those of `training.train`.

    A run is short, so an interrupted one starts anew: the state of the result tells its end alone. The gripper is
    unknown in a share of the contacts, so one model also works without. ValueError if the loss becomes infinite or NaN.
    """
    epochs = preset.epochs if epochs is None else epochs
    check_range("epochs", epochs, 1)
    check_range("max_steps", 1 if max_steps is None else max_steps, 1)
    planned = epochs * samples.steps_per_epoch
    steps = planned if max_steps is None else min(planned, max_steps)
    seeds, draws = rng.spawn(2)
    with torch.random.fork_rng(devices=[]):  # torch draws weights and dropout from its global generator only
        torch.manual_seed(int(seeds.integers(2**63)))
        run = _MemoryRun(samples, preset, steps, device, start)
        chunks = _chunks(samples.contacts, draws)
        points, saved = set(evenly(steps, CURVE_POINTS)), set(evenly(steps, CHECKPOINTS))
        for step in range(1, steps + 1):
            run.advance(next(chunks))
            if on_progress and (step % PROGRESS_STEPS == 0 or step == steps):
                on_progress(step, steps)
            if step in points:
                run.end_point(step)
            if step in saved:
                run.checkpoints.append(Checkpoint(step, weights(run.network)))
    return result_of(preset, run.state(steps, planned))


class _Chunk(NamedTuple):
    """The next steps of each stream, (STREAMS, CHUNK, ...), and which streams begin a contact with them."""

    of: Contact
    begins: NDArray[np.bool_]


def _chunks(contacts: Sequence[Contact], rng: np.random.Generator) -> Iterator[_Chunk]:
    """Deal contacts out to the streams without end, shuffled again when all are used up; a chunk ends with zeros.

    The first contact of a stream begins within its first chunk, so that streams do not begin contacts together.
    """
    order: list[int] = []
    left: list[Contact | None] = [None] * STREAMS
    is_first = True
    while True:
        begins = np.array([one is None for one in left])
        rows = []
        for stream in range(STREAMS):
            rest = left[stream]
            if rest is None:
                order = order or rng.permutation(len(contacts)).tolist()
                rest = _without_gripper(contacts[order.pop()], unknown=rng.random() < WITHOUT_GRIPPER)
                skipped = int(rng.integers(min(CHUNK, len(rest.numbers)))) if is_first else 0
                rest = Contact(*(column[skipped:] for column in rest))
            rows.append([_filled(column[:CHUNK]) for column in rest])
            left[stream] = Contact(*(column[CHUNK:] for column in rest)) if len(rest.numbers) > CHUNK else None
        is_first = False
        yield _Chunk(Contact(*(np.stack(columns) for columns in zip(*rows, strict=True))), begins)


def _without_gripper(contact: Contact, *, unknown: bool) -> Contact:
    if not unknown:
        return contact
    numbers = contact.numbers.copy()
    numbers[:, OF_GRIPPER] = 0
    return contact._replace(numbers=numbers)


def _filled(column: Singles) -> Singles:
    return np.concatenate([column, np.zeros((CHUNK - len(column), *column.shape[1:]), np.float32)])


class _MemoryRun:
    """State of a training run between two steps."""

    def __init__(
        self,
        samples: MemorySamples,
        preset: Preset,
        steps: int,
        device: str,
        start: Mapping[str, Singles] | None,
    ) -> None:
        self.preset, self.device = preset, device
        self.network = _network(samples, start).to(device)
        hidden = samples.architecture.hidden
        self.memory = torch.zeros(1, STREAMS, hidden, device=device)
        self.share_output = nn.Linear(2 * hidden, 1).to(device)  # discarded after training
        trained = [*self.network.parameters(), *self.share_output.parameters()]
        self.optimiser = torch.optim.AdamW(trained, preset.learning_rate, weight_decay=preset.weight_decay)
        self.rate = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser, preset.learning_rate, total_steps=steps + 1, pct_start=RISES
        )
        self.checkpoints: list[Checkpoint] = []
        self.curve_step: list[int] = []
        self.curve_loss: list[float] = []
        self.losses: list[float] = []  # since the last point of the curve

    def advance(self, chunk: _Chunk) -> None:
        """Take one step of the optimiser."""
        numbers, slips, counts, share = (torch.from_numpy(column).to(self.device) for column in chunk.of)
        begins = torch.from_numpy(chunk.begins).to(self.device)
        self.network.train()
        memory = torch.where(begins[None, :, None], 0.0, self.memory)
        hidden, memory = self.network.remembered(numbers, memory, DROPOUT)
        self.memory = memory.detach()
        losses = functional.binary_cross_entropy_with_logits(
            self.network.outputs(hidden)[..., 0], slips, reduction="none"
        )
        loss = (losses * counts).sum() / counts.sum().clamp(min=1)
        if self.preset.share_weight:
            errors = _share_error(torch.sigmoid(self.share_output(hidden)[..., 0]), share)
            known = counts * torch.isfinite(share)
            loss = loss + self.preset.share_weight * (errors * known).sum() / known.sum().clamp(min=1)
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(self.network.parameters(), MOST_GRADIENT)
        self.optimiser.step()
        self.rate.step()
        self.losses.append(float(loss.detach()))

    def end_point(self, step: int) -> None:
        """Add the mean loss since the last point to the loss curve; ValueError unless it is finite."""
        mean = math.fsum(self.losses) / len(self.losses) if all(map(math.isfinite, self.losses)) else math.nan
        if math.isnan(mean):
            raise ValueError(f"preset {self.preset.name}: expected a finite loss, found another by step {step}")
        self.curve_step.append(step)
        self.curve_loss.append(mean)
        self.losses.clear()

    def state(self, steps: int, planned: int) -> TrainingState:
        """Return the run at its end as named arrays, as `training.ended` reads them."""
        return {
            "step": np.array(steps),
            "steps": np.array(steps),
            "planned": np.array(planned),
            "curve_step": np.array(self.curve_step, np.int64),
            "curve_loss": np.array(self.curve_loss, np.float64),
            **{
                f"checkpoint/{one.step}/{name}": array
                for one in self.checkpoints
                for name, array in one.weights.items()
            },
        }


def _network(samples: MemorySamples, start: Mapping[str, Singles] | None) -> MemoryNet:
    if start is not None:
        network = from_weights(samples.architecture, start)
    else:
        offset, scale = _normalisation(samples.contacts)
        network = build(samples.architecture, input_scale=scale, input_offset=offset)
    assert isinstance(network, MemoryNet)
    return network


def _normalisation(contacts: Sequence[Contact]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return offset and scale of each number, over contacts some of which have no gripper.

    The scale is 0 for a number that never varied: the network does not learn its meaning, and must not see it later.
    """
    known = np.concatenate([one.numbers for one in contacts]).astype(np.float64)
    unknown = known.copy()
    unknown[:, OF_GRIPPER] = 0
    parts = (1 - WITHOUT_GRIPPER, known), (WITHOUT_GRIPPER, unknown)
    mean = sum((share * values.mean(axis=0) for share, values in parts), np.zeros(known.shape[1]))
    square = sum((share * np.square(values - mean).mean(axis=0) for share, values in parts), np.zeros(len(mean)))
    spread = np.sqrt(square)
    return mean, np.where(spread > CONSTANT, 1 / (spread + LEAST_SPREAD), 0.0)


def _share_error(estimated: Tensor, share: Tensor) -> Tensor:
    """Return the error of each estimated share; 0 where the share is unknown."""
    low, high = BETWEEN
    wanted = torch.nan_to_num(share)
    weight = torch.where((wanted > low) & (wanted < high), BETWEEN_WEIGHT, 1.0)
    off = torch.where(torch.isfinite(share), estimated - wanted, 0.0)
    return weight * (off.square() + ABSOLUTE_WEIGHT * off.abs())
