"""Slip detection from one slice alone: more than k events in a slice, with k chosen on other objects.

The first detection is the first slice with more than k events after the current began to fall. The threshold k is the
one that is correct most often on all other objects, so that no object is evaluated with a threshold chosen on it.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from evetac_cli.evaluate.likeness.counts import SliceCounts
from evetac_cli.evaluate.slip_tables import TIMING_BINS
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import EARLIEST_MS, LATEST_MS

THRESHOLDS = (25, 35, 50, 75, 100, 150, 200, 300, 400, 600, 800, 1000, 1500)  # events per slice
NEVER_MS = 10**6  # after the onset: represents no detection


class Slip(NamedTuple):
    """A slip: its object, and its first detection for each threshold, in ms after the onset."""

    object: str
    after_ms: tuple[int, ...]


def slip(called: str, counts: SliceCounts) -> Slip:
    """Return a slip of an object; raise ValueError if the counts have no onset."""
    if counts.onset is None:
        raise ValueError("expected event counts with an onset of slip")
    since_start = counts.sensing[counts.start :]
    loud = (np.flatnonzero(since_start > k) for k in THRESHOLDS)
    first = (counts.start + int(slices[0]) - counts.onset if len(slices) else NEVER_MS for slices in loud)
    return Slip(called, tuple(first))


def judge(slips: Sequence[Slip]) -> Row:
    """Return shares of slips detected in time, and in each of the paper's intervals; {} with fewer than two objects.

    `one_threshold_low` and `_high`: the smallest and the largest k that was chosen.
    """
    if len({one.object for one in slips}) < 2:
        return {}
    threshold_index = {
        name: _best(one for one in slips if one.object != name) for name in {one.object for one in slips}
    }
    after_ms = np.array([one.after_ms[threshold_index[one.object]] for one in slips])
    intervals = {
        f"one_threshold_{name}": float(np.mean((after_ms >= low) & (after_ms <= high)))
        for name, low, high in TIMING_BINS
    }
    return {
        "one_threshold_correct": float(np.mean((after_ms >= EARLIEST_MS) & (after_ms <= LATEST_MS))),
        **intervals,
        "one_threshold_low": THRESHOLDS[min(threshold_index.values())],
        "one_threshold_high": THRESHOLDS[max(threshold_index.values())],
    }


def _best(slips: Iterable[Slip]) -> int:
    """Return the index of the threshold that is in time most often, the lowest if several are."""
    after_ms = np.array([one.after_ms for one in slips])
    in_time = ((after_ms >= EARLIEST_MS) & (after_ms <= LATEST_MS)).mean(axis=0)
    return int(np.argmax(in_time))
