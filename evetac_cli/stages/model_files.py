"""Information on a slip detector from its model file, for code that does not run it (slip_detectors.py does)."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.alarms import WarningCurve
from evetac_cli.kernels.slip.reliability import OddsScale
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.ancestry import TRAINING
from evetac_cli.store.layout.provenance import Header

USELESS_HINT = "train for more steps, on more trajectories, and use at least 4 others with --validate"
# Dataset of features with the slipping share of the visible contact, from a simulation's truth.
TRUE_SLIP_SHARE = "truth/visible_slip_share"


def why_useless(model: StageFile) -> str:
    """Return the reason why a model detects nothing: at its threshold all slices are slip, or none is; "" otherwise.
    A threshold of 0 is useless anyway.
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

    InputError if both are given, if the model has counted no false alarms, or if no threshold has few enough.
    """
    if threshold is not None and false_alarms_per_min is not None:
        raise InputError("cannot be combined with a threshold", where="--false-alarms-per-min")
    if false_alarms_per_min is None:
        return float(model.read("threshold")) if threshold is None else threshold
    curve = read_curve(model)
    if curve is None or not curve.minutes:
        hint = "set a threshold instead, or train the model again, with trials without slip in --validate"
        raise InputError("the model has no rate of false alarms", where=str(model.path), hint=hint)
    rate_threshold = curve.threshold_for(false_alarms_per_min)
    least = curve.at(rate_threshold)[0]
    if least > false_alarms_per_min:
        message, expected = "no threshold of the model has so few false alarms", f"at least {least:.3g}"
        raise InputError(message, where="--false-alarms-per-min", expected=expected, found=f"{false_alarms_per_min:g}")
    return rate_threshold


def read_weights(model: StageFile) -> dict[str, NDArray[np.float32]]:
    """Return the weights by their names in the network."""
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
