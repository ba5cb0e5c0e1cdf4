"""Covariates of the slips on which detectors are evaluated, shown above the tables of `evaluate slip`.

They come from the truth of the simulated recordings behind the features. Without truth they come from labels and events
in the features. These contain less: they have no event positions, so events outside the window's strip are counted too.
"""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import EvetacError
from evetac_cli.jobs import Rows
from evetac_cli.kernels.slip.covariates import WORDS, SlipCovariates, of_labels, summary
from evetac_cli.stages.related_files import OTHER_FOLDER, Origins, check_made_from
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from evetac_cli.store.recordings.slip_covariates import covariates_of_truth


def with_truth(paths: Sequence[Path], folder: Path | None) -> list[Path | None]:
    """Return for each features file its simulated recording; None if it is not found, not readable or has no truth.

    With a folder (--recordings), InputError if a recording is not found there or cannot be read.
    """
    origins = Origins("recording", folder)
    found = []
    for path in paths:
        with StageFile(path, "features") as features:
            recording = origins.find(features) if folder is None else origins.must_find(features, OTHER_FOLDER)
            found.append(recording if recording and _has_truth(features, recording, folder) else None)
    return found


def _has_truth(features: StageFile, path: Path, folder: Path | None) -> bool:
    try:
        with open_recording(path) as recording:
            if folder is not None:
                check_made_from(features, recording)
            return recording.header["id"] in features.header["parents"] and recording.has("truth")
    except EvetacError:
        if folder is not None:
            raise
        return False  # features can do without


def rows(paths: Sequence[Path], recordings: Sequence[Path | None], left_out: Collection[Path] = ()) -> Rows:
    """Return a row for each covariate that these labelled features provide, over the slips that are evaluated.

    recordings: those with truth, from `with_truth`. left_out: features whose labels abstain.
    """
    slips = []
    for path, simulated in zip(paths, recordings, strict=True):
        if path in left_out:
            continue
        if simulated is None:
            with StageFile(path, "features") as features:
                slip = _of_features(features)
        else:
            with open_recording(simulated) as recording:
                slip = covariates_of_truth(recording)
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


def _of_features(features: StageFile) -> SlipCovariates | None:
    """Return the covariates from labels and events of features; None if the labels have no slip."""
    onset = int(features.read("onset_slice"))
    if onset < 0:
        return None

    def outside(start: int, stop: int) -> NDArray[np.int64]:
        counts: NDArray[np.int64] = features.read("events_outside", start, stop)
        return counts

    return of_labels(onset, features.read("label"), outside)
