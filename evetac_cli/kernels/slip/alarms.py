"""When a detector alarms, from its probabilities: the one rule of detector, controller, tables and pictures.

A slice alarms when it and the two before it reach the threshold: a node of the gel that lets go alone lifts the
probability for a slice or two, and is no slip. Alarms are counted 200 ms apart. One that goes on counts again after
200 ms, so that a detector that always alarms has five per second and not one in all.

Time is the slice index, one slice a millisecond. The first slice that reaches the threshold, by which the paper times
its models, is in metrics.py.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.labels import is_slip

ALARM_SLICES = 3  # in a row that reach the threshold
APART_MS = 200  # from one alarm that counts to the next
NEAR_SLIP_MS = 200  # so near to slip, before or after it, an alarm is not false
LEADS_MS = (0, 5, 10, 20, 40)  # by which slips are to be warned of


@dataclass
class AlarmState:
    """The rule, slice by slice; alarms: slices that alarmed so far."""

    threshold: float
    alarms: int = 0
    alarming: bool = False  # the last slice
    _on_end: int = 0  # slices that reach the threshold, up to the last


def start(threshold: float) -> AlarmState:
    """Begin before the first slice."""
    return AlarmState(threshold)


def step(state: AlarmState, probability: float) -> bool:
    """Whether one more slice alarms; NaN does not."""
    state._on_end = state._on_end + 1 if is_slip(probability, state.threshold) else 0
    state.alarming = state._on_end >= ALARM_SLICES
    state.alarms += state.alarming
    return state.alarming


def levels(probability: NDArray[np.floating]) -> NDArray[np.float32]:
    """The highest threshold at which each slice alarms, (slices,): the least of its probability and the two before.

    NaN where one of them is NaN or missing.
    """
    single = probability.astype(np.float32)
    level = np.full(len(single), np.nan, np.float32)
    if len(single) >= ALARM_SLICES:
        level[ALARM_SLICES - 1 :] = np.lib.stride_tricks.sliding_window_view(single, ALARM_SLICES).min(axis=1)
    return level


def alarming(probability: NDArray[np.floating], threshold: float) -> NDArray[np.bool_]:
    """Which slices alarm, (slices,): what `step` tells of them in turn."""
    return is_slip(levels(probability), threshold)


def onsets(alarms: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The slices at which alarms count, of (slices,) that alarm: the first, and each that is 200 ms after the last."""
    slices = np.flatnonzero(alarms)
    counted = []
    place = 0
    while place < len(slices):
        counted.append(slices[place])
        place = int(np.searchsorted(slices, slices[place] + APART_MS))
    return np.array(counted, np.int64)


def nothing_slips(label: NDArray[np.int8], onset: int = -1) -> NDArray[np.bool_]:
    """In which slices an alarm is false: labelled no slip (0), and more than 200 ms from any slice that slips.

    onset: first slice of slip where labels were shifted, -1 if there is none.
    """
    slips = label == 1
    if onset >= 0:
        slips[onset] = True
    so_far = np.concatenate([[0], np.cumsum(slips)])
    places = np.arange(len(label))
    first, last = np.maximum(places - NEAR_SLIP_MS, 0), np.minimum(places + NEAR_SLIP_MS + 1, len(label))
    quiet: NDArray[np.bool_] = (label == 0) & (so_far[last] == so_far[first])
    return quiet


def lead_ms(alarms: NDArray[np.bool_], onset: int) -> int | None:
    """How long before the onset of slip the last warning began that lasts until then, of (slices,) that alarm.

    Below 0 where the first alarm comes after the onset; None where none does. ValueError for an onset beyond.
    """
    if not 0 <= onset < len(alarms):
        raise ValueError(f"expected an onset within 0..{len(alarms) - 1}, found {onset}")
    if not alarms[onset]:
        later = np.flatnonzero(alarms[onset:])
        return -int(later[0]) if len(later) else None
    silent = np.flatnonzero(~alarms[:onset])
    return onset - (int(silent[-1]) + 1 if len(silent) else 0)


def lead_level(level: NDArray[np.float32], onset: int, ahead_ms: int) -> float:
    """The highest threshold at which slip is warned of for so long, from `levels` (slices,); NaN if at none."""
    if onset < ahead_ms:
        return float("nan")
    return float(level[onset - ahead_ms : onset + 1].min())
