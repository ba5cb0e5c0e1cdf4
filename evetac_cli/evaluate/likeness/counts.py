"""Events per slice, in the columns that the paper counts and in the window; measures around a slip; one threshold.

The single threshold is slip detection from one slice alone: more than k events in a slice. The first detection is the
first such slice after the current began to fall. k is the one that is correct most often on all other objects.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate.data_rate.measure import labels_beside
from evetac_cli.evaluate.data_rate.paper import COLUMNS
from evetac_cli.evaluate.slip.tables import TIMING_BINS
from evetac_cli.jobs import Row
from evetac_cli.kernels.slip.metrics import EARLIEST_MS, LATEST_MS
from evetac_cli.store.recordings.read import Recording, ramp_start, true_onset

ABOUT_MS = 250  # before and after the onset: the paper's half second
QUIETEST_MS = 100  # their mean rate is the floor without motion
BUSY = 25  # events per slice; slices with more are active in the paper's training
HELD_UNTIL_MS = 500  # before the onset
BEFORE_MS, AFTER_MS = (-100, -30), (0, 30)
THRESHOLDS = (25, 35, 50, 75, 100, 150, 200, 300, 400, 600, 800, 1000, 1500)  # events per slice
NEVER_MS = 10**6  # after the onset: represents no detection


@dataclass(frozen=True)
class SliceCounts:
    """Events per slice in the columns that the paper counts, and in the window; the onset and the start of its ramp.

    onset: the first slice of gross slip in the truth, or without truth in the labels next to the recording; None if
    neither has one.
    """

    sensing: NDArray[np.int64]
    window: NDArray[np.int64]
    onset: int | None
    start: int

    @property
    def floor(self) -> float:
        """Events per slice in the quietest 100 ms before the onset, or of all; NaN for shorter recordings."""
        before = self.sensing if self.onset is None else self.sensing[: self.onset]
        if len(before) < QUIETEST_MS:
            return math.nan
        return float(np.convolve(before, np.ones(QUIETEST_MS), "valid").min()) / QUIETEST_MS


def count(recording: Recording) -> SliceCounts:
    """Count the events of a recording; raise InputError if labels next to it belong to another recording."""
    sensing = np.zeros(len(recording), np.int64)
    for block in recording.blocks():
        slices = np.repeat(np.arange(len(block.starts) - 1), np.diff(block.starts))
        own = slices[block.events.x < COLUMNS]
        sensing[block.first : block.stop] = np.bincount(own, minlength=len(block.starts) - 1)
    window = np.diff(recording.starts) - sensing
    if recording.has("truth"):
        return SliceCounts(sensing, window, true_onset(recording), ramp_start(recording))
    labels = labels_beside(recording)
    onset = None if labels is None or labels.onset.abstained else labels.onset.slice_
    return SliceCounts(sensing, window, onset, ramp_start(recording))


def about_slip(counts: SliceCounts) -> Row:
    """Return event measures around the onset, {} without onset; rates are events per ms of the counted columns."""
    if counts.onset is None:
        return {}
    sensing, window = (events.astype(np.float64) for events in (counts.sensing, counts.window))
    onset, floor = counts.onset, counts.floor
    about = slice(max(onset - ABOUT_MS, 0), onset + ABOUT_MS)
    after = slice(onset, onset + ABOUT_MS)
    rate_before, rate_after = rate(counts, *BEFORE_MS), rate(counts, *AFTER_MS)
    held_counts = sensing[: max(onset - HELD_UNTIL_MS, 0)]
    all_after = float(sensing[after].sum() + window[after].sum())
    earlier = sensing[counts.start : max(onset - 50, counts.start)]
    return {
        "events_ms_about_slip": _mean(sensing[about]),
        "window_events_ms_about_slip": _mean(window[about]),
        "events_ms_100_to_30_before": rate_before,
        "events_ms_30_before": rate(counts, -30, 0),
        "events_ms_30_after": rate_after,
        "before_over_after": (rate_before - floor) / (rate_after - floor) if rate_after > floor else math.nan,
        "loudest_slice": float(sensing[about].max()) if len(sensing[about]) else math.nan,
        "loudest_slice_50_before": float(earlier.max()) if len(earlier) else math.nan,
        "held_above_25_share": _mean((held_counts > BUSY).astype(np.float64)),
        "window_share_after_slip": float(window[after].sum()) / all_after if all_after else math.nan,
    }


def rate(counts: SliceCounts, first_ms: int, stop_ms: int) -> float:
    """Return events per ms of the counted columns between two times after the onset, in ms; NaN without onset."""
    if counts.onset is None:
        return math.nan
    first, stop = (max(counts.onset + ms, 0) for ms in (first_ms, stop_ms))
    return _mean(counts.sensing[first:stop].astype(np.float64))


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan


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
