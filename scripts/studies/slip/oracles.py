"""Three slip oracles, which use true values that no sensor measures: an upper bound for every detector.

- `share` uses the slipping share of the visible contact;
- `force` also uses the grip force, the load, and the opening speed of the fingers;
- `ahead` also extrapolates these values by AHEAD_MS, with their trend over the last SLOPE_MS.

The share is its own score. The scores of the other two are logistic regressions on gross slip HORIZON ms later, fitted
on trials of TRAINED objects (seeds FIT_SEEDS) and stored in oracles.json. `python scripts/studies/slip/oracles.py` fits
them again.
"""

import itertools
import json
import sys
from functools import cache
from pathlib import Path

import numpy as np

from evetac_cli.arrays import Floats, Singles
from evetac_cli.kernels import estimates
from scripts.studies import motions
from scripts.studies.motions import Trial

HERE = Path(__file__).resolve().parent
FILE = HERE / "oracles.json"
ORACLES = ("share", "force", "ahead")
HORIZONS_MS = (0, 10, 20)
AHEAD_MS, SLOPE_MS = 20, 20
FIT_SEEDS = range(3000, 3004)
FIT_MOTIONS = ("slip", "slip-speeds", "slip-speeds", "pushes", "jerks", "handling", "grip")
PENALTY = 1e-3
SLIP_MS = 60  # slices later than this after the onset of slip are not used for training
LEAST_N = 0.02  # offset of a force in a logarithm


def known(trial: Trial) -> Floats:
    """Return the inputs of `force` (slices, 4): share, log grip over load, their product, opening in ticks/ms."""
    share = trial.slip_share.astype(np.float64)
    load_n = np.hypot(*trial.shear_n.T.astype(np.float64))
    grip = np.log((trial.normal_n + LEAST_N) / (load_n + LEAST_N))
    opening = -_slope(trial.closing_ticks.astype(np.float64))
    return np.stack([share, grip, share * grip, opening], axis=1)


def _slope(values: Floats) -> Floats:
    """Return how much values have risen in each slice, over the last SLOPE_MS."""
    before = np.concatenate([np.repeat(values[:1], SLOPE_MS, axis=0), values[:-SLOPE_MS]])[: len(values)]
    slope: Floats = (values - before) / SLOPE_MS
    return slope


def columns(trial: Trial, oracle: str) -> Floats:
    """Return the weighted inputs, (slices, k); the first column is 1."""
    now = known(trial)
    parts = [np.ones((len(now), 1)), now, now[:, :1] ** 2]
    if oracle == "ahead":
        later = now[:, :2] + AHEAD_MS * _slope(now[:, :2])
        later[:, 0] = np.clip(later[:, 0], 0.0, 1.0)
        parts += [later, later[:, :1] ** 2, later[:, :1] * later[:, 1:2]]
    return np.concatenate(parts, axis=1)


def fit(trials: list[Trial], oracle: str, horizon_ms: int) -> Floats:
    """Fit an oracle's weights on slices in which the object is held, up to SLIP_MS after it slips."""
    rows, wanted = [], []
    for trial in trials:
        slips = trial.slips.copy()
        first = int(np.argmax(slips)) if slips.any() else len(slips)
        stop = min(first + SLIP_MS, len(slips) - horizon_ms)
        held = np.flatnonzero(trial.normal_n[: max(stop, 0)] > 0.0)[::2]
        rows.append(columns(trial, oracle)[held])
        wanted.append(slips[held + horizon_ms])
    inputs, label = np.concatenate(rows), np.concatenate(wanted).astype(np.float64)
    share = float(label.mean())
    importance = np.where(label > 0, 0.5 / share, 0.5 / (1 - share))
    return estimates.logistic_weights(inputs, label, np.full(inputs.shape[1], PENALTY * len(label)), importance)


@cache
def weights() -> dict[str, dict[str, list[float]]]:
    """Return the fitted weights, by oracle and horizon."""
    loaded: dict[str, dict[str, list[float]]] = json.loads(FILE.read_text())["weights"]
    return loaded


def score(trial: Trial, oracle: str, horizon_ms: int = 0) -> Singles:
    """Return the score of an oracle in each slice, 0 to 1."""
    if oracle == "share":
        return trial.slip_share
    logit = columns(trial, oracle) @ np.array(weights()[oracle][str(horizon_ms)])
    return (1 / (1 + np.exp(-logit))).astype(np.float32)


def main() -> None:
    """Fit the weights, and write them with a record of the training data."""
    trials = [
        motions.played(motions.planned(motion, number, seed + 100 * turn, reshaped=True), seed)
        for seed, number in itertools.product(FIT_SEEDS, motions.TRAINED)
        for turn, motion in enumerate(FIT_MOTIONS)
    ]
    fitted = {
        oracle: {str(horizon): fit(trials, oracle, horizon).tolist() for horizon in HORIZONS_MS}
        for oracle in ORACLES[1:]
    }
    sizes = {"seeds": list(FIT_SEEDS), "objects": list(motions.TRAINED), "motions": list(FIT_MOTIONS)}
    FILE.write_text(json.dumps({"fitted_to": {**sizes, "trials": len(trials)}, "weights": fitted}, indent=1) + "\n")
    sys.stdout.write(f"{FILE}\n")


if __name__ == "__main__":
    main()
