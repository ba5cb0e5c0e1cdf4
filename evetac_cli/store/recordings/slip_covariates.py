"""The covariates of the slip of a recording (kernels/slip/covariates.py), from its truth, or from labels and events."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.slip.architectures import GEL_PX
from evetac_cli.kernels.slip.covariates import SlipCovariates, SlipTruth, first_looked_at, of_labels, of_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import BLOCK_SLICES, Recording, ramp_start, true_onset


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

    The recording must be simulated. None for a grasp as well, because its controller acts on the slip.
    """
    onset = None if recording.has("control") else true_onset(recording)
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
