"""Events of each slice, those of the columns that the paper counts apart from the window's, and about a slip."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evetac_cli.arrays import Floats
from evetac_cli.evaluate import paper
from evetac_cli.evaluate.data_rate import labels_beside
from evetac_cli.jobs import Row
from evetac_cli.store.recordings.read import Recording, ramp_start, true_onset

ABOUT_MS = 250  # before the onset, and after it: the paper's half second
QUIETEST_MS = 100  # whose mean is the floor that does not come of motion
BUSY = 25  # events in a slice, beyond which the paper's training counts it as one in which something happens
HELD_UNTIL_MS = 500  # before the onset
BEFORE_MS, AFTER_MS = (-100, -30), (0, 30)
LOUD = 100  # events in a slice, beyond which it is taken for slip where none is


@dataclass(frozen=True)
class SliceCounts:
    """Events of each slice in the columns that the paper counts, and beside them; the onset and the start of its ramp.

    onset: the first slice of gross slip by the truth, without truth by the labels beside the recording, None where
    neither has one.
    """

    sensing: NDArray[np.int64]
    window: NDArray[np.int64]
    onset: int | None
    start: int

    @property
    def floor(self) -> float:
        """Events a slice in the quietest 100 ms before the onset, or of all; NaN of a shorter recording."""
        before = self.sensing if self.onset is None else self.sensing[: self.onset]
        if len(before) < QUIETEST_MS:
            return math.nan
        return float(np.convolve(before, np.ones(QUIETEST_MS), "valid").min()) / QUIETEST_MS


def count(recording: Recording) -> SliceCounts:
    """Count the events of a recording; InputError for labels beside it that are another recording's."""
    sensing = np.zeros(len(recording), np.int64)
    for block in recording.blocks():
        slices = np.repeat(np.arange(len(block.starts) - 1), np.diff(block.starts))
        own = slices[block.events.x < paper.COLUMNS]
        sensing[block.first : block.stop] = np.bincount(own, minlength=len(block.starts) - 1)
    window = np.diff(recording.starts) - sensing
    if recording.has("truth"):
        return SliceCounts(sensing, window, true_onset(recording), ramp_start(recording))
    labels = labels_beside(recording)
    onset = labels.onset if labels is not None and labels.onset >= 0 else None
    return SliceCounts(sensing, window, onset, ramp_start(recording))


def about_slip(counts: SliceCounts) -> Row:
    """Figures of the events about the onset; none without one. Rates are events per ms of the columns that count."""
    if counts.onset is None:
        return {}
    sensing, window = (events.astype(np.float64) for events in (counts.sensing, counts.window))
    onset, floor = counts.onset, counts.floor
    about = slice(max(onset - ABOUT_MS, 0), onset + ABOUT_MS)
    after = slice(onset, onset + ABOUT_MS)
    rate_before, rate_after = rate(counts, *BEFORE_MS), rate(counts, *AFTER_MS)
    held = sensing[: max(onset - HELD_UNTIL_MS, 0)]
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
        "held_above_25_share": _mean((held > BUSY).astype(np.float64)),
        "window_share_after_slip": float(window[after].sum()) / all_after if all_after else math.nan,
    }


def rate(counts: SliceCounts, first_ms: int, stop_ms: int) -> float:
    """Events per ms of the columns that count, from and until so many ms after the onset; NaN where none are."""
    if counts.onset is None:
        return math.nan
    first, stop = (max(counts.onset + ms, 0) for ms in (first_ms, stop_ms))
    return _mean(counts.sensing[first:stop].astype(np.float64))


def loud_ms(counts: SliceCounts) -> list[int]:
    """How many ms before the onset slices of more than 100 events lie, in the 500 ms before it; none without one."""
    first = max((counts.onset or 0) - HELD_UNTIL_MS, 0)
    loud = np.flatnonzero(counts.sensing[first : counts.onset or 0] > LOUD)
    return [int(slice_) for slice_ in (counts.onset or 0) - first - loud]


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan
