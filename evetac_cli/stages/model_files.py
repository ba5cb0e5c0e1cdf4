"""Information on a slip detector from its model file, for code that does not run it (slip_detectors.py does)."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.reliability import OddsScale
from evetac_cli.kernels.slip.warning_curve import WarningCurve
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import TRAINING
from evetac_cli.store.layout.provenance import Header

USELESS_HINT = "train for more steps, on more trajectories, and use at least 4 others with --validate"
# Threshold at which slip is reported to a controller by a model without counted false alarms. With such a model's own
# threshold, 0.95 in evetac's first model, a lift with the paper's controller fails (docs/slip-detector.md, seeds 10,017
# and 10,018).
OLDER_CONTROLLER_THRESHOLD = 0.3
# Datasets of features with the slipping share of the visible contact, from a simulation's truth: the current name, and
# that of features up to version 1.5, where all simulated files had it.
TRUE_SLIP_SHARES = ("truth/visible_slip_share", "visible_slip_share")


def why_useless(model: StageFile) -> str:
    """Return the reason why a model detects nothing: at its threshold all slices are slip, or none is; "" otherwise.

    Models of older versions do not store how many validation slices they detect; a threshold of 0 is useless anyway.
    """
    share = float(model.read("validation/detected_share")) if model.has("validation/detected_share") else None
    if share not in (0.0, 1.0) and float(model.read("threshold")) > 0.0:
        return ""
    if model.has("validation/slip_share") and float(model.read("validation/slip_share")) == 1.0:
        return "its validation trajectories have no slice without slip, so that no threshold could be chosen"
    which = "no slice" if share == 0.0 else "every slice"
    return f"at its threshold, {float(model.read('threshold')):g}, it calls {which} of its validation trajectories slip"


def require_useful(model: StageFile) -> None:
    """Raise InputError for a model that detects nothing, before it controls a gripper."""
    why = why_useless(model)
    if why:
        raise InputError("this model is not a slip detector", where=str(model.path), found=why, hint=USELESS_HINT)


def read_horizon_ms(model: StageFile) -> int:
    """Return how far ahead a model predicts slip, in ms; 0 for detection."""
    return int(model.read("horizon_ms")) if model.has("horizon_ms") else 0


def read_calibration(model: StageFile) -> OddsScale | None:
    """Return the scaling of a model's logits after training; None if its probabilities are not calibrated."""
    if not model.has("calibration"):
        return None
    return OddsScale(float(model.read("calibration/scale")), float(model.read("calibration/offset")))


def read_curve(model: StageFile) -> WarningCurve | None:
    """Return a model's rates of false alarms and warnings by threshold; None if the model does not store them."""
    if not model.has("warnings"):
        return None
    return WarningCurve(
        model.read("warnings/threshold"),
        model.read("warnings/false_alarms_per_min"),
        model.read("warnings/warned_10_ms_ahead"),
        float(model.read("warnings/minutes")),
        int(model.read("warnings/slips")),
    )


def chosen_threshold(
    model: StageFile, threshold: float | None = None, false_alarms_per_min: float | None = None
) -> float:
    """Return the threshold for a detector: the given one, the one for this rate of false alarms, or the model's own.

    InputError if both are given, if the model stores no rates of false alarms, or if none of them is low enough.
    """
    if threshold is not None and false_alarms_per_min is not None:
        raise InputError(
            "cannot be combined with a threshold",
            where="--false-alarms-per-min",
            expected="only one of the two",
            found=f"{threshold:g} and {false_alarms_per_min:g} per minute",
        )
    if false_alarms_per_min is None:
        return float(model.read("threshold")) if threshold is None else threshold
    curve = read_curve(model)
    if curve is None or not curve.minutes:
        raise InputError(
            "the model has no rate of false alarms",
            where=str(model.path),
            expected="false alarms per minute by threshold, as `evetac train` stores them",
            found="none: made by an older evetac" if curve is None else "no slice 200 ms from slip to count them in",
            hint="set a threshold instead, or train the model again, with trials without slip in --validate",
        )
    rate_threshold = curve.threshold_for(false_alarms_per_min)
    least = curve.at(rate_threshold)[0]
    if least > false_alarms_per_min:
        raise InputError(
            "every threshold of the model has more false alarms",
            where="--false-alarms-per-min",
            expected=f"at least {least:.3g}",
            found=f"{false_alarms_per_min:g}",
        )
    return rate_threshold


def controller_threshold(
    model: StageFile, threshold: float | None = None, false_alarms_per_min: float | None = None
) -> float:
    """Return the threshold at which slip is reported to a controller, as `chosen_threshold`.

    For a model of an older evetac it is OLDER_CONTROLLER_THRESHOLD: the model's own threshold was chosen for timing
    alone, and at light touch a detector with it reports nothing.
    """
    if threshold is None and false_alarms_per_min is None and not model.has("warnings"):
        return OLDER_CONTROLLER_THRESHOLD
    return chosen_threshold(model, threshold, false_alarms_per_min)


def read_weights(model: StageFile) -> dict[str, NDArray[np.float32]]:
    """Return the weights by their names in the detector; for several networks, names begin with a number."""
    names = [name for name in model.contents() if name.startswith("weights/")]
    return {name.removeprefix("weights/"): model.read(name) for name in names}


def labelled_by(header: Header) -> str:
    """Return the methods of the labels on which a model, given by its header, was trained, also `truth`; "" if none."""
    return ", ".join(sorted({row["labels"] for row in header["trajectories"] if row["role"] == TRAINING} - {None}))


def learned_true_slip_share(header: Header) -> bool:
    """Whether a model, given by its header, or a model from which it was adapted, learned the true slipping share.

    This is the share of the contact that slips, from the ground truth of simulated recordings:
    `train --learn-true-slip-share`.
    """
    return any(row["true_slip_share"] for row in header["trajectories"])
