"""Covariates of the slip of a recording, or of the slips of a folder, for `info`.

The slip of a recording is known from truth, or from labels next to it. Of a folder, which may contain a million
recordings, an evenly spread sample is read that takes half a second.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.kernels.slip.covariates import SlipCovariates, not_told, summary
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import Recording
from evetac_cli.store.recordings.slip_covariates import covariates_of_labels, covariates_of_truth

MOST_SLIPS = 40  # recordings of a folder that are read


def slip_of(recording: Recording) -> tuple[str, SlipCovariates | None]:
    """Return the source of a recording's slip, `truth` or `labels`, and its covariates; None if it is unknown."""
    if recording.has("truth"):
        return "truth", covariates_of_truth(recording)
    path = output_path(recording.path, "labels", None)
    if path.exists():
        with suppress(EvetacError), StageFile(path, "labels") as labels:  # `validate` reports faults of the labels
            check_made_from(labels, recording)
            return "labels", covariates_of_labels(recording, labels)
    return "", None


def figures(recording: Recording) -> dict[str, Any]:
    """Return the covariates of a recording's slip, their source, and the unknown ones; {} without slip."""
    source, slip = slip_of(recording)
    if slip is None:
        return {}
    missing = not_told([slip])
    return {
        "slip_onset_ms": slip.onset_ms,
        "slip_told_by": source,
        **slip.figures(),
        **({"slip_not_told": ", ".join(missing)} if missing else {}),
    }


def of_folder(folder: Path, names: Sequence[str], progress: Callable[[int, int], None]) -> tuple[Rows, dict[str, Any]]:
    """Return rows of covariates over recordings of a folder that slip, and their number; empty if none are known."""
    count = min(len(names), MOST_SLIPS)
    sample = [names[number * len(names) // count] for number in range(count)]
    slips = []
    for number, name in enumerate(sample):
        progress(number, len(sample))
        with suppress(EvetacError), Recording(folder / name) as recording:  # the index counts unreadable ones
            _, slip = slip_of(recording)
            slips += [slip] if slip is not None else []
    if not slips:
        return [], {}
    missing = not_told(slips)
    more = {"covariates_not_told": ", ".join(missing)} if missing else {}
    return summary(slips), {"covariates_of": f"{len(slips)} of {len(names)} recordings that slip", **more}
