"""A person's label, written as a labels file with its provenance."""

import getpass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile, header_of, write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from evetac_cli.store.recordings.onset import PERSON, labelled_onset
from evetac_cli.store.recordings.read import Recording, ramp_start

METHOD = 1  # raised when the labels written for the same verdict change
CANNOT_TELL = "the person who reviewed it could not decide"


class Verdict(NamedTuple):
    """A person's verdict on a recording: the onset, a slice or -1 for no slip, and an interval for it.

    earliest, latest: -1 if not given. can_tell: whether the onset is certain enough for training.
    """

    onset: int
    earliest: int = -1
    latest: int = -1
    can_tell: bool = True


def name_of(by: str) -> str:
    """Return the name of the person: the given one, or the login name; InputError if there is none."""
    try:
        return by.strip() or getpass.getuser()
    except (KeyError, OSError, ImportError):  # no such user on this system
        raise InputError("there is no login name", where="--by", expected="a name") from None


def keep(recording: Recording, labels: Path, verdict: Verdict, by: str, after_ms: int) -> dict[str, Any]:
    """Write the labels of a verdict, replacing existing ones, and return its row.

    Slices before the onset are labelled no slip, those of the next after_ms slip. InputError for an onset before the
    ramp, outside the recording, or outside its own interval.
    """
    slices, start = len(recording), ramp_start(recording)
    _check(verdict, start, slices)
    replaced = _replaced(labels)
    label = np.zeros(slices, np.int8)
    label[:start] = -1
    if verdict.onset >= 0:
        stop = verdict.onset + max(after_ms, 1)
        label[verdict.onset : stop] = 1
        label[stop:] = -1
        if not verdict.can_tell:
            first, last = (verdict.earliest, verdict.latest) if verdict.earliest >= 0 else (verdict.onset,) * 2
            label[first : last + 1] = -1
    abstained = verdict.onset >= 0 and not verdict.can_tell
    onset_slices = {"onset_slice": verdict.onset, "earliest_slice": verdict.earliest, "latest_slice": verdict.latest}
    arrays = {
        "label": label,
        "relative_flow_px": np.full(slices, np.nan, np.float32),
        **{name: np.int64(value) for name, value in onset_slices.items()},
        "abstained": np.uint8(abstained),
        "doubt": CANNOT_TELL if abstained else "",
        "confidence": np.float64(1.0 if verdict.onset >= 0 else np.nan),
        "flow_pairs_computed": np.int64(0),
    }
    details = {**onset_slices, "can_tell": verdict.can_tell, "after_ms": after_ms}
    parameters = {"method": PERSON, "by": by, **details, "replaced": replaced}
    recipe = Recipe("labels", METHOD, parameters, parents=(recording.header,))
    write_stage(labels, recipe, arrays, force=True)
    before = replaced[-1]["onset_slice"] if replaced else -1
    return {
        "output": str(labels),
        "status": "kept",
        "by": by,
        "onset_ms": verdict.onset if verdict.onset >= 0 else None,
        "abstained": abstained,
        "replaced_method": replaced[-1]["method"] if replaced else None,
        "replaced_onset_ms": before if before >= 0 else None,
        "kept_at": header_of(labels)["made"].get("at"),
    }


def _check(verdict: Verdict, start: int, slices: int) -> None:
    onset, earliest, latest = verdict.onset, verdict.earliest, verdict.latest
    if onset != -1 and not start <= onset < slices:
        raise InputError("no such onset", where="onset", expected=f"{start} to {slices - 1} ms", found=str(onset))
    if (earliest, latest) != (-1, -1) and not (onset >= 0 and start <= earliest <= onset <= latest < slices):
        expected = f"an interval that contains the onset, {onset} ms, and starts at {start} ms or later"
        raise InputError("no such interval", where="interval", expected=expected, found=f"{earliest} to {latest} ms")


def _replaced(labels: Path) -> list[Header]:
    """Return the labels that are replaced, the oldest first, for the header; none if there are no earlier labels."""
    if not labels.exists():
        return []
    with StageFile(labels, "labels") as file:
        onset, header = labelled_onset(file), file.header
    earlier: list[Header] = header["parameters"].get("replaced", [])
    slices = {"onset_slice": onset.slice_, "earliest_slice": onset.earliest, "latest_slice": onset.latest}
    about = {
        "id": header["id"],
        "method": header["parameters"].get("method"),
        "by": header["parameters"].get("by"),
        "at": header["made"].get("at"),
        **{name: -1 if value is None else value for name, value in slices.items()},
        "doubt": onset.doubt,
    }
    return [*earlier, about]
