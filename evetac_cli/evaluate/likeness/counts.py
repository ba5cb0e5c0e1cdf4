"""Events per slice, separately for the columns that the paper counts and for the window, and measures around a slip."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate import paper
from evetac_cli.evaluate.data_rate import labels_beside
from evetac_cli.jobs import Row
from evetac_cli.store.recordings.read import Recording, ramp_start, true_onset

ABOUT_MS = 250  # before and after the onset: the paper's half second
QUIETEST_MS = 100  # their mean rate is the floor without motion
BUSY = 25  # events per slice; slices with more are active in the paper's training
HELD_UNTIL_MS = 500  # before the onset
BEFORE_MS, AFTER_MS = (-100, -30), (0, 30)


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
        own = slices[block.events.x < paper.COLUMNS]
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
