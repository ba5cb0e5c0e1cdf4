"""The covariates of the slips that detectors are judged on, which stand above the tables of `evaluate slip`.

From the truth of the simulated recordings that the features were made from, beside them or in a folder that is named;
where there is none, from labels and events in the features, which tell less: where events lie is not in them, so that
those outside the window's strip are counted.
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
    """Of which features there is the simulated recording; InputError where one is missing in a folder, or another."""
    known = []
    for path in paths:
        with StageFile(path, "features") as features, _truth(features, folder) as recording:
            known.append(recording is not None)
    return known


def rows(paths: Sequence[Path], folder: Path | None) -> Rows:
    """A row for each covariate that can be told of these labelled features, over those that slip."""
    slips = []
    for path in paths:
        with StageFile(path, "features") as features, _truth(features, folder) as recording:
            slip = _of_features(features) if recording is None else covariates_of_truth(recording)
        slips += [slip] if slip is not None else []
    return summary(slips)


def in_words(rows: Rows) -> list[str]:
    """What the rows of a report do not tell of its slips, as a sentence; nothing where they tell all."""
    told = {row["covariate"] for row in rows if "covariate" in row}
    missing = [words for words in WORDS.values() if words not in told]
    if not told or not missing:
        return []
    return [
        "Not told of these slips (the truth of simulated recordings tells most, see --recordings):"
        f" {'; '.join(missing)}."
    ]


@contextmanager
def _truth(features: StageFile, folder: Path | None) -> Iterator[Recording | None]:
    """The simulated recording that features were made from, beside them or in a folder; None where there is none.

    InputError where it is missing in the folder that is named, or is another there.
    """
    path = output_path(features.path, "recording", folder)
    if not path.exists():
        if folder is not None:
            raise InputError(
                "no such recording", where=str(path), hint="name the folder of the recordings with --recordings"
            )
        yield None
        return
    try:
        opened = open_recording(path)
    except EvetacError:
        if folder is not None:
            raise
        yield None  # features do not need it
        return
    with opened as recording:
        if folder is not None:
            check_made_from(features, recording)
        own = recording.header["id"] in features.header["parents"]
        yield recording if own and recording.has("truth") else None


def _of_features(features: StageFile) -> SlipCovariates | None:
    """What labels and events of features tell of their slip; None where the labels tell of none."""
    onset = int(features.read("onset_slice"))
    if onset < 0:
        return None

    def outside(start: int, stop: int) -> NDArray[np.int64]:
        counts: NDArray[np.int64] = features.read("events_outside", start, stop)
        return counts

    return of_labels(onset, features.read("label"), outside)
