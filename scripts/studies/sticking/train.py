"""Train the sticking-share network on simulated mechanics alone, and write it with a record of its training data.

`python scripts/studies/sticking/train.py --seed 0 --trials FOLDER` makes the missing trials in the folder (some 8
minutes of one core), and trains for some 3 minutes. Weights are fitted to TRAINED objects and to all motions except
UNSEEN (trials.py), standard deviations to CHOSEN_BY objects. JUDGED objects are used for neither. A third of the
trials are of other sensors.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.kernels.touch.sticking import FIELDS, INPUTS, X_MM, Y_MM, StickingNetwork
from evetac_cli.resources import STICKING_MODEL
from scripts.studies import motions
from scripts.studies.motions import Trial
from scripts.studies.sticking import trials

FIRST_SEED, RESHAPED_SEED, CHOOSING_SEED = 1000, 1100, 2000
# Trials per object, for objects of the paper's table and reshaped ones.
COUNTS = {"slip": 4, "slip-varied": 8, "pushes": 10, "jerks": 5, "lifting": 4, "grip": 5, "handling": 6}
RESHAPED = {"slip": 12, "slip-varied": 14, "pushes": 16, "jerks": 6, "lifting": 6, "grip": 12, "handling": 14}
CHOOSING_COUNT = 4
OTHER_SENSOR = 3  # every third trial of an object and motion
WIDTHS = (64, 32)
NETWORKS = 2  # of these widths, trained independently; the estimate is the mean of their log odds
EPOCHS, BATCH, RATE, DECAY = 30, 256, 2e-3, 0.05
SLIPS, KEPT = 0.03, 0.5  # of the looks with less slip, only this share is kept
MISSING = (0.0, 0.0, 0.0, 0.1)  # shares of dots that may be missing in a trial
SD_POINTS = 11
BEGUN = 0.12  # slip has begun at this share; looks between it and trials.LOW count as neither
BEGUN_WEIGHT = 0.5  # weight of its cross entropy relative to the error of the share
DROPPED = 0.02  # share of the inputs that are left out at random


def sensor_of(count: int, number: int, seed: int) -> str:
    """Return the sensor of the count-th trial of an object and a motion."""
    return motions.EVETAC if count % OTHER_SENSOR != OTHER_SENSOR - 1 else f"randomized:{20 * seed + number}"


def training_trials(folder: Path) -> list[Trial]:
    """Return the trials that weights are fitted to."""
    return [
        trials.kept(folder, motion, number, seed + count, sensor_of(count, number, seed + count), reshaped)
        for seed, counts, reshaped in ((FIRST_SEED, COUNTS, False), (RESHAPED_SEED, RESHAPED, True))
        for count in range(max(counts.values()))
        for number in motions.TRAINED
        for motion, most in counts.items()
        if count < most
    ]


def choosing_trials(folder: Path) -> dict[str, list[Trial]]:
    """Return the trials for deviations and alarm, over all trained motions."""
    return {
        motion: [
            trials.kept(folder, motion, number, CHOOSING_SEED + count)
            for number in motions.CHOSEN_BY
            for count in range(CHOOSING_COUNT)
        ]
        for motion in motions.MOTIONS
        if motion not in trials.UNSEEN
    }


class Samples(NamedTuple):
    """Inputs (n, INPUTS) at looks, the true slipping share, and whether slip has begun: 1, 0, or NaN in between."""

    inputs: Singles
    share: Singles
    begun: Singles

    def of(self, chosen: Flags) -> "Samples":
        """Return a subset."""
        return Samples(*(column[chosen] for column in self))


def joined(parts: list[Samples]) -> Samples:
    """Return all samples as one."""
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def samples(made: list[Trial], rng: np.random.Generator) -> Samples:
    """Return the training samples of trials, each seen once by a tracker."""
    network = blank()
    parts = []
    for trial in made:
        looks = trials.looks_of(trial, rng, network, float(rng.choice(MISSING)))
        share = trial.slip_share[looks.slices]
        none = trials.recent_largest(trial.slip_share, trials.AFTER_MS)[looks.slices] < trials.LOW
        begun = np.where(none, 0.0, np.where(share >= BEGUN, 1.0, np.nan)).astype(np.float32)
        parts.append(Samples(looks.inputs, share, begun))
    return joined(parts)


def blank() -> StickingNetwork:
    """Return an untrained network."""
    wide, narrow = WIDTHS
    shapes = ((INPUTS, wide), (wide,), (wide, narrow), (narrow,), (narrow, 2), (2,))
    return StickingNetwork(*(np.zeros(shape, np.float32) for shape in shapes), np.ones(SD_POINTS, np.float32))


def mirrored(inputs: Singles, axis: int) -> Singles:
    """Return the inputs of the same contacts mirrored at the y axis (0) or the x axis (1) of the image."""
    fields = inputs[:, :-1].reshape(-1, len(Y_MM), len(X_MM), FIELDS, 2)
    other = fields[:, :, ::-1] if axis == 0 else fields[:, ::-1]
    sign = np.ones(2, np.float32)
    sign[axis] = -1.0
    flat = (other * sign).reshape(len(inputs), -1)
    return np.concatenate([flat, inputs[:, -1:]], axis=1)


def trained(learnt: Samples, seed: int) -> tuple[Singles, ...]:
    """Return weights and biases, layer by layer, fitted to samples and their mirror images."""
    inputs = learnt.inputs
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng([seed, 1])
    some = [inputs[::4], mirrored(inputs[::4], 0)]
    both = np.concatenate([*some, *(mirrored(each, 1) for each in some)])
    middle, spread = both.mean(axis=0), both.std(axis=0) + 1e-3
    layers: list[torch.nn.Module] = []
    widths = (INPUTS, *WIDTHS, 2)
    for wide, narrow in zip(widths, widths[1:], strict=False):
        layers += [torch.nn.Linear(wide, narrow), torch.nn.ReLU()]
    network = torch.nn.Sequential(*layers[:-1])
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    steps = EPOCHS * -(-len(inputs) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    share, known = torch.tensor(learnt.share), torch.tensor(np.isfinite(learnt.begun).astype(np.float32))
    begun = torch.tensor(np.nan_to_num(learnt.begun))
    for _ in range(EPOCHS):
        order = rng.permutation(len(inputs))
        for first in range(0, len(order), BATCH):
            batch = order[first : first + BATCH]
            given = inputs[batch]
            for axis in range(2):
                if rng.random() < 0.5:
                    given = mirrored(given, axis)
            scaled = (given - middle) / spread * (rng.random(given.shape) > DROPPED)
            odds = network(torch.tensor(scaled.astype(np.float32)))
            off = torch.sigmoid(odds[:, 0]) - share[batch]
            wrong = torch.nn.functional.binary_cross_entropy_with_logits(odds[:, 1], begun[batch], known[batch])
            loss = off.abs().mean() + (off**2).mean() + BEGUN_WEIGHT * wrong
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
    arrays = [parameter.detach().numpy().astype(np.float64) for parameter in network.parameters()]
    first, bias = arrays[0].T / spread[:, None], arrays[1] - arrays[0] @ (middle / spread)
    whole = (first, bias, arrays[2].T, arrays[3], arrays[4].T, arrays[5])
    return tuple(np.ascontiguousarray(array, np.float32) for array in whole)


def as_one(networks: list[tuple[Singles, ...]]) -> tuple[Singles, ...]:
    """Return one network whose output is the mean of the log odds of several."""
    first, first_bias, second, second_bias, third, third_bias = zip(*networks, strict=True)
    beside = np.asarray(block_diag(*second), np.float32)
    mean = np.concatenate(third) / len(networks), sum(third_bias) / len(networks)
    joint = (np.concatenate(first, axis=1), np.concatenate(first_bias), beside, np.concatenate(second_bias), *mean)
    return tuple(np.ascontiguousarray(array, np.float32) for array in joint)


def estimate(weights: tuple[Singles, ...], inputs: Singles) -> Singles:
    """Return the slipping share and the probability that slip has begun (n, 2), for many samples at once."""
    first, first_bias, second, second_bias, third, third_bias = weights
    wide = np.maximum(inputs @ first + first_bias, 0)
    odds = np.maximum(wide @ second + second_bias, 0) @ third + third_bias
    both: Singles = 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
    return both


def deviations(estimated_share: Singles, share: Singles) -> Floats:
    """Return the rms error at each of SD_POINTS estimates of the sticking share, 0 to 1."""
    sticks = 1 - estimated_share
    points = np.linspace(0, 1, SD_POINTS)
    weight = np.maximum(1 - np.abs(sticks[:, None] - points) * (SD_POINTS - 1), 0.0)
    squares = weight.T @ (estimated_share - share) ** 2
    rms: Floats = np.sqrt((squares + 0.05**2) / (weight.sum(axis=0) + 1))  # 0.05 for a point without samples
    return rms


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="seed of the training")
    parser.add_argument("--trials", type=Path, required=True, help="folder of the trials")
    parser.add_argument("--out", type=Path, default=STICKING_MODEL)
    chosen = parser.parse_args()
    rng = np.random.default_rng([chosen.seed, 0])
    made = training_trials(chosen.trials)
    learnt = samples(made, rng)
    kept = learnt.of((learnt.share > SLIPS) | (rng.random(len(learnt.share)) < KEPT))
    weights = as_one([trained(kept, NETWORKS * chosen.seed + number) for number in range(NETWORKS)])
    held_back = joined([samples(some, rng) for some in choosing_trials(chosen.trials).values()])
    estimated, true = estimate(weights, held_back.inputs)[:, 0], held_back.share
    between = (true > trials.LOW) & (true < trials.HIGH)
    network = StickingNetwork(*weights, deviations(estimated, true).astype(np.float32))
    np.savez(chosen.out, **network._asdict())
    card: dict[str, Any] = {
        "what": "share of a contact that sticks, by evetac_cli/kernels/touch/sticking.py",
        "parameters": int(sum(array.size for array in weights)),
        "networks": NETWORKS,
        "training": {
            "seed": chosen.seed,
            "objects": list(motions.TRAINED),
            "motions": COUNTS,
            "motions_of_reshaped_objects": RESHAPED,
            "trial_seeds": [FIRST_SEED, RESHAPED_SEED + max(RESHAPED.values()) - 1],
            "looks": len(kept.share),
            "camera": "none: true dots with a drawn error of a tracker",
        },
        "deviations": {
            "objects": list(motions.CHOSEN_BY),
            "trial_seeds": [CHOOSING_SEED, CHOOSING_SEED + CHOOSING_COUNT - 1],
            "mean_error_between_0.05_and_0.95": float(np.abs(estimated - true)[between].mean()),
        },
        "never_trained_on": {"objects": list(motions.JUDGED), "motions": list(trials.UNSEEN)},
        "simulated": True,
    }
    chosen.out.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")
    sys.stdout.write(json.dumps(card, indent=1) + "\n")


if __name__ == "__main__":
    main()
