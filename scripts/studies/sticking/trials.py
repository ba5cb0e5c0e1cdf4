"""Trials for training and evaluating the sticking-share network: without a camera, with a simulated tracker error.

The tracker's error of the true dots is drawn at random (motions.py has the trials).
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Flags, Floats, Singles
from evetac_cli.kernels.touch import rest, sticking
from evetac_cli.kernels.touch.dot_motion import DotNoise
from evetac_cli.kernels.touch.sticking import StickingNetwork
from evetac_cli.kernels.touch.touch_map import BEGINS, ENDS
from scripts.studies.motions import EVETAC, Trial, planned, played

UNSEEN = ("fast jerks", "data-rate", "weights", "vibration", "slip-speeds", "opening", "light touch")  # not in training
# The tracker's error, as standard deviations in px: two errors that drift and return within DRIFT_S, as in
# kernels/touch/dot_motion.py, and one from slice to slice.
OWN_PX, COMMON_PX, SLICE_PX, DRIFT_S = 0.05, 0.2, 0.03, 1.0
KNOT_MS = 50
LOW, HIGH = 0.05, 0.95  # slipping shares: practically none below LOW, practically all above HIGH
AFTER_MS = 50  # an alarm may last this long after a slip


def tracked_px(trial: Trial, rng: np.random.Generator) -> Floats:
    """Return the dots as tracked: with an error of each dot and a common one, both drifting."""
    slices, dots = trial.dot_px.shape[:2]
    knots = slices // KNOT_MS + 2
    keeps = math.exp(-KNOT_MS * 1e-3 / DRIFT_S)
    drift = rng.normal(size=(knots, dots, 2)) * OWN_PX
    common = rng.normal(size=(knots, 1, 2)) * COMMON_PX
    both = drift + common
    both[0] = 0.0  # a tracker starts on dots at rest
    for knot in range(1, knots):
        both[knot] = keeps * both[knot - 1] + math.sqrt(1 - keeps**2) * both[knot]
    at = np.arange(slices) / KNOT_MS
    before = at.astype(int)
    part = (at - before)[:, None, None]
    error = (1 - part) * both[before] + part * both[before + 1]
    seen: Floats = trial.dot_px + error + rng.normal(size=error.shape) * SLICE_PX
    return seen


def kept(folder: Path, motion: str, number: int, seed: int, sensor: str = EVETAC, reshaped: bool = False) -> Trial:
    """Return a trial from its file in a folder; the trial is made first if the file is missing."""
    name = (motion.replace(" ", "-"), number, seed, sensor.replace(":", "_"), *["reshaped"] * reshaped)
    path = folder / f"{'-'.join(map(str, name))}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = played(planned(motion, number, seed, sensor, reshaped), seed)
        part = path.with_suffix(".part.npz")
        np.savez(part, **made._asdict())
        part.rename(path)
        return made
    with np.load(path, allow_pickle=False) as held:
        values = {name: held[name] for name in Trial._fields}
    frame = values.pop("frame_px").tolist()
    return Trial(**{**values, "mm_per_px": float(values["mm_per_px"])}, frame_px=(frame[0], frame[1]))


def recent_largest(values: Singles, slices: int) -> Singles:
    """Return the largest value over each slice and a number of slices before it."""
    padded = np.concatenate([np.zeros(slices, values.dtype), values])
    largest: Singles = np.lib.stride_tricks.sliding_window_view(padded, slices + 1).max(axis=1)
    return largest


def touched(dot_mm: Floats, rest_mm: Floats) -> Flags:
    """Return in which slices the gel is touched, by the rule of touch maps."""
    moved = dot_mm - rest_mm
    apart = moved - moved.mean(axis=1, keepdims=True)
    over_own = np.sqrt(np.mean(apart**2, axis=(1, 2))) / DotNoise().own_mm
    touches = np.zeros(len(dot_mm), np.bool_)
    now = False
    for number, value in enumerate(over_own.tolist()):
        now = value > (ENDS if now else BEGINS)
        touches[number] = now
    return touches


class Looks(NamedTuple):
    """Inputs and outputs of a network at each look of a trial during touch.

    slices: of the looks; inputs: (looks, INPUTS); `estimated`: the slipping share and its standard deviation; begun:
    probability that slip has begun; fields_mm: displacements of dots at the reference and now (looks, 2, dots, 2).
    """

    slices: NDArray[np.int64]
    inputs: Singles
    estimated: Singles
    begun: Singles
    sd: Singles
    direction_rad: Singles
    alarm: Flags
    fields_mm: Singles


def looks_of(trial: Trial, rng: np.random.Generator, network: StickingNetwork, missing: float = 0.0) -> Looks:
    """Return a network's estimates for a trial seen by a tracker, with a share of the dots missing throughout."""
    return looks_at(trial, tracked_px(trial, rng), rng.random(len(trial.rest_px)) < missing, network)


def looks_at(trial: Trial, dot_px: Floats, lost: Flags, network: StickingNetwork) -> Looks:
    """Return a network's estimates for tracked dots (slices, dots, 2), of which some (dots,) are lost throughout."""
    dot_mm, rest_mm = trial.in_mm(dot_px), trial.in_mm(trial.rest_px)
    state = sticking.start(rest_mm, network)
    touches = touched(dot_mm[:, ~lost], rest_mm[~lost])
    kept: list[tuple[Any, ...]] = []
    for number, at_mm in enumerate(dot_mm):
        reading = sticking.step(state, at_mm, lost, bool(touches[number]))
        if touches[number] and state.rest.slices % rest.BLOCK_MS == 0:
            fields = np.stack([state.reference_mm - rest_mm, state.rest.block_mm - rest_mm])
            estimated = 1.0 - reading.sticking_share
            kept.append((number, state.inputs.copy(), estimated, state.has_begun, *reading[1:3], reading.alarm, fields))
    columns = list(zip(*kept, strict=True)) or [()] * len(Looks._fields)
    shapes = ((-1,), (-1, sticking.INPUTS), (-1,), (-1,), (-1,), (-1,), (-1,), (-1, 2, *rest_mm.shape))
    kinds = (np.int64, *[np.float32] * 5, np.bool_, np.float32)
    made = (np.array(c, k).reshape(s) for c, k, s in zip(columns, kinds, shapes, strict=True))
    return Looks(*made)
