"""The labelled onset of slip: its interval, its confidence, and the reason if the labels abstain."""

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.store.files import StageFile

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
