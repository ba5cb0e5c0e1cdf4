"""The onset of slip in a recording's labels, with interval, confidence and doubt, and the covariates of its slip.

The covariates (kernels/slip/covariates.py) are those of the truth, or of labels and events.
"""

import re
from collections import Counter
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.architectures import GEL_PX
from evetac_cli.kernels.slip.covariates import SlipCovariates, SlipTruth, first_looked_at, of_labels, of_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import BLOCK_SLICES, Recording, ramp_start, true_onset

ABSTAINED = "abstained"  # dataset of labels, and of features made from them
PERSON = "person"  # method of manual labels (`label --review`)


class LabelledOnset(NamedTuple):
    """The onset and its interval, in slices of 1 ms; None without an onset, or without interval in older labels."""

    slice_: int | None
    earliest: int | None
    latest: int | None
    confidence: float | None
    doubt: str  # why the onset cannot be determined; empty if it can

    @property
    def abstained(self) -> bool:
        """Whether the labels abstain because the onset cannot be determined."""
        return bool(self.doubt)

    def row(self) -> dict[str, Any]:
        """Return the onset as columns of a table."""
        return {
            "onset_ms": self.slice_,
            "earliest_ms": self.earliest,
            "latest_ms": self.latest,
            "confidence": self.confidence,
            "abstained": self.abstained,
            "doubt": self.doubt or None,
        }

    def in_words(self) -> str:
        """Return a sentence that the labels abstain, and why; empty if they do not."""
        return f"The labels abstain: {self.doubt}." if self.doubt else ""


def onset_of_values(onset: int, earliest: int, latest: int, confidence: float, doubt: str) -> LabelledOnset:
    """Return the onset from the values in labels, where -1 and NaN mean none."""
    first, last = (None if value < 0 else value for value in (earliest, latest))
    sure = confidence if np.isfinite(confidence) else None
    return LabelledOnset(None if onset < 0 else onset, first, last, sure, doubt)


def labelled_onset(labels: StageFile) -> LabelledOnset:
    """Return the onset in a labels file."""
    earliest, latest = (
        int(labels.read(name)) if labels.has(name) else -1 for name in ("earliest_slice", "latest_slice")
    )
    doubt = str(labels.read("doubt")) if labels.has("doubt") else ""
    return onset_of_values(int(labels.read("onset_slice")), earliest, latest, float(labels.read("confidence")), doubt)


def in_short(doubts: Iterable[str]) -> str:
    """Return the reasons why labels abstain with their numbers, without the figures of a single trial."""
    reasons = Counter(re.split("[:,;]| within [0-9]", doubt)[0] for doubt in doubts)
    return "; ".join(f"{reason} ({count})" for reason, count in reasons.most_common())


def abstains(file: StageFile) -> bool:
    """Whether labels, or the labels from which features were made, abstain."""
    return file.has(ABSTAINED) and bool(file.read(ABSTAINED))


def gel_counts(
    recording: Recording, start: int = 0, stop: int | None = None, columns: int = GEL_PX[0]
) -> NDArray[np.int64]:
    """Return the number of events with x < columns in each of the slices [start, stop), (slices,).

    x is read in blocks of a second, and not at all if the frame has no more columns.
    """
    stop = len(recording) if stop is None else stop
    counts = np.diff(recording.starts[start : stop + 1])
    if recording.frame_px[0] <= columns:
        return counts
    for first in range(start, stop, BLOCK_SLICES):
        starts = recording.starts[first : min(first + BLOCK_SLICES, stop) + 1]
        x = recording.read("events/x", int(starts[0]), int(starts[-1]))
        beyond = np.searchsorted(
            np.flatnonzero(x >= columns), starts - starts[0]
        )  # events of the block before each slice
        counts[first - start : first - start + len(starts) - 1] -= np.diff(beyond)
    return counts


def covariates_of_truth(recording: Recording) -> SlipCovariates | None:
    """Return the covariates of the first gross slip since the current began to fall; None if nothing slips.

    The recording must be simulated. None for a grasp as well, because its controller acts on the slip, and for dots of
    another simulator that does not know the object.
    """
    known = all(recording.has(f"truth/{name}") for name in ("slip", "visible_slip_share", "object_xy_px"))
    onset = true_onset(recording) if known and not recording.has("control") else None
    if onset is None:
        return None
    first, ramp = first_looked_at(onset), ramp_start(recording)
    truth = SlipTruth(
        gross=recording.read("truth/slip", first, onset) > 0,
        visible_share=recording.read("truth/visible_slip_share", first, onset),
        normal_n=recording.read("truth/normal_force_n", first, onset + 1),
        object_xy_px=recording.read("truth/object_xy_px", first, onset),
        ramp=ramp,
        held_xy_px=recording.read("truth/object_xy_px", ramp, ramp + 1)[0] if ramp else None,
    )
    return of_truth(onset, len(recording), truth, partial(gel_counts, recording))


def covariates_of_labels(recording: Recording, labels: StageFile) -> SlipCovariates | None:
    """Return the covariates of the slip in this recording's labels, or labelled features; None without slip."""
    onset = int(labels.read("onset_slice"))
    return None if onset < 0 else of_labels(onset, labels.read("label"), partial(gel_counts, recording))
