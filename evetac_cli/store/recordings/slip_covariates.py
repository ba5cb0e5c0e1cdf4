"""The covariates of the slip of a recording (kernels/slip/covariates.py), from its truth, or from labels and events."""

from functools import partial

from evetac_cli.kernels.slip.covariates import SlipCovariates, SlipTruth, first_looked_at, of_labels, of_truth
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.gel_columns import gel_counts
from evetac_cli.store.recordings.read import Recording, ramp_start, true_onset


def covariates_of_truth(recording: Recording) -> SlipCovariates | None:
    """Of the first gross slip of a simulated recording since its current began to fall; None where nothing slips.

    None for a grasp as well: its controller acts on the slip.
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
    """Of the slip that the labels of this recording, or its labelled features, tell; None where they tell none."""
    onset = int(labels.read("onset_slice"))
    return None if onset < 0 else of_labels(onset, labels.read("label"), partial(gel_counts, recording))
