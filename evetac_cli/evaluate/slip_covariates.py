"""Covariates of the slips on which detectors are evaluated, shown above the tables of `evaluate slip`.

They come from the truth of the simulated recordings behind the features, which are next to them or in a given folder.
Without truth they come from labels and events in the features. These contain less: they have no event positions, so
events outside the window's strip are counted too.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import EvetacError, InputError
from evetac_cli.jobs import Rows
from evetac_cli.kernels.slip.covariates import WORDS, SlipCovariates, of_labels, summary
from evetac_cli.stages.related_files import check_made_from
from evetac_cli.store.files import StageFile, output_path
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.store.recordings.slip_covariates import covariates_of_truth


def with_truth(paths: Sequence[Path], folder: Path | None) -> list[bool]:
    """Return for each features file whether its simulated recording exists; raise InputError if missing in `folder`."""
    has_truth = []
    for path in paths:
        with StageFile(path, "features") as features, _truth(features, folder) as recording:
            has_truth.append(recording is not None)
    return has_truth


def rows(paths: Sequence[Path], folder: Path | None) -> Rows:
    """Return a row for each covariate that these labelled features provide, over those that slip."""
    slips = []
    for path in paths:
        with StageFile(path, "features") as features, _truth(features, folder) as recording:
            slip = _of_features(features) if recording is None else covariates_of_truth(recording)
        slips += [slip] if slip is not None else []
    return summary(slips)


def in_words(rows: Rows) -> list[str]:
    """Return a sentence on the covariates that the rows of a report lack; nothing if they have all."""
    present = {row["covariate"] for row in rows if "covariate" in row}
    missing = [words for words in WORDS.values() if words not in present]
    if not present or not missing:
        return []
    return [
        "Unknown for these slips (the truth of simulated recordings has most of them, see --recordings):"
        f" {'; '.join(missing)}."
    ]


@contextmanager
def _truth(features: StageFile, folder: Path | None) -> Iterator[Recording | None]:
    """Yield the simulated recording behind features, next to them or in a folder; None if there is none.

    Raises InputError if a folder is given and the recording is missing there or is a different one.
    """
    path = output_path(features.path, "recording", folder)
    if not path.exists():
        if folder is not None:
            raise InputError(
                "no such recording", where=str(path), hint="give the folder of the recordings with --recordings"
            )
        yield None
        return
    try:
        opened = open_recording(path)
    except EvetacError:
        if folder is not None:
            raise
        yield None  # features can do without
        return
    with opened as recording:
        if folder is not None:
            check_made_from(features, recording)
        own = recording.header["id"] in features.header["parents"]
        yield recording if own and recording.has("truth") else None


def _of_features(features: StageFile) -> SlipCovariates | None:
    """Return the covariates from labels and events of features; None if the labels have no slip."""
    onset = int(features.read("onset_slice"))
    if onset < 0:
        return None

    def outside(start: int, stop: int) -> NDArray[np.int64]:
        counts: NDArray[np.int64] = features.read("events_outside", start, stop)
        return counts

    return of_labels(onset, features.read("label"), outside)
