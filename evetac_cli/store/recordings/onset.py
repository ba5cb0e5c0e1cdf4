"""The onset of slip that labels tell: its interval, how sure they are, and why they abstain where they do."""

from typing import Any, NamedTuple

import numpy as np

from evetac_cli.store.files import StageFile

ABSTAINED = "abstained"  # dataset of labels, and of features made from them
PERSON = "person"  # method of labels that a person gave (`label --review`)


class LabelledOnset(NamedTuple):
    """Slices of 1 ms; None where there is no onset, or where labels of an older version know no interval."""

    slice_: int | None
    earliest: int | None
    latest: int | None
    confidence: float | None
    doubt: str  # why the onset cannot be told, in words; empty where it can

    @property
    def abstained(self) -> bool:
        """Whether the labels say that they cannot tell the onset."""
        return bool(self.doubt)

    def row(self) -> dict[str, Any]:
        """The onset as columns of a table."""
        return {
            "onset_ms": self.slice_,
            "earliest_ms": self.earliest,
            "latest_ms": self.latest,
            "confidence": self.confidence,
            "abstained": self.abstained,
            "doubt": self.doubt or None,
        }

    def in_words(self) -> str:
        """That labels abstain, and why; empty where they do not."""
        return f"The labels abstain: {self.doubt}." if self.doubt else ""


def told_onset(onset: int, earliest: int, latest: int, confidence: float, doubt: str) -> LabelledOnset:
    """The onset as labels have it, in which -1 and NaN stand for none."""
    first, last = (None if value < 0 else value for value in (earliest, latest))
    sure = confidence if np.isfinite(confidence) else None
    return LabelledOnset(None if onset < 0 else onset, first, last, sure, doubt)


def labelled_onset(labels: StageFile) -> LabelledOnset:
    """The onset in a labels file."""
    earliest, latest = (
        int(labels.read(name)) if labels.has(name) else -1 for name in ("earliest_slice", "latest_slice")
    )
    doubt = str(labels.read("doubt")) if labels.has("doubt") else ""
    return told_onset(int(labels.read("onset_slice")), earliest, latest, float(labels.read("confidence")), doubt)


def abstains(file: StageFile) -> bool:
    """Whether labels, or the labels that features were made from, abstained."""
    return file.has(ABSTAINED) and bool(file.read(ABSTAINED))
