"""What a model file says of its slip detector, for those who do not run it (slip_detectors.py does)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.reliability import OddsScale
from evetac_cli.kernels.slip.warning_curve import WarningCurve
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout.provenance import Header

USELESS_HINT = "train for more steps, on more trajectories, and name at least 4 others with --validate"
# From which a controller is told of slip by a model without counted false alarms: with its own, 0.95 in the
# package's first, a lift of the paper's law fails (docs/slip-detector.md, seeds 10,017 and 10,018).
OLDER_CONTROLLER_THRESHOLD = 0.3
# Where features hold the share of the visible contact that slips, from a simulation's truth: today's name, and the one
# of features up to 1.5, whose simulated files all had it.
TRUE_SLIP_SHARES = ("truth/visible_slip_share", "visible_slip_share")
# Methods of `train` before there was a choice, and the presets by which they learned that share wherever it was known.
LEARNED_TRUTH_METHODS, LEARNED_TRUTH_PRESETS = range(4, 7), ("adamw", "adapt")


def why_useless(model: StageFile) -> str:
    """Why a model detects nothing, in a sentence: at its threshold all slices are slip, or none is; "" if it may do.

    Models of an older evetac do not say how many validation slices they detect; a threshold of 0 is known to be useless
    without that.
    """
    share = float(model.read("validation/detected_share")) if model.has("validation/detected_share") else None
    if share not in (0.0, 1.0) and float(model.read("threshold")) > 0.0:
        return ""
    if model.has("validation/slip_share") and float(model.read("validation/slip_share")) == 1.0:
        return "its validation trajectories have no slice without slip, so that no threshold could be chosen"
    which = "no slice" if share == 0.0 else "every slice"
    return f"at its threshold, {float(model.read('threshold')):g}, it calls {which} of its validation trajectories slip"


def require_useful(model: StageFile) -> None:
    """InputError for a model that detects nothing, before it is let at a gripper."""
    why = why_useless(model)
    if why:
        raise InputError("this model is no slip detector", where=str(model.path), found=why, hint=USELESS_HINT)


def read_horizon_ms(model: StageFile) -> int:
    """How far ahead a model predicts slip, in ms; 0 for detection."""
    return int(model.read("horizon_ms")) if model.has("horizon_ms") else 0


def read_calibration(model: StageFile) -> OddsScale | None:
    """What the logits of a model were scaled by after training; None where its probabilities are not calibrated."""
    if not model.has("calibration"):
        return None
    return OddsScale(float(model.read("calibration/scale")), float(model.read("calibration/offset")))


def read_curve(model: StageFile) -> WarningCurve | None:
    """What warnings of a model cost, by threshold; None for a model that does not say."""
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
    """The threshold that a detector is run at: the one given, one with so few false alarms, or the model's own.

    InputError where both are given, the model does not say how often it alarms falsely, or it always does more often.
    """
    if threshold is not None and false_alarms_per_min is not None:
        raise InputError(
            "a threshold and a number of false alarms are two ways to say one thing",
            where="--false-alarms-per-min",
            expected="one of them",
            found=f"{threshold:g} and {false_alarms_per_min:g} per minute",
        )
    if false_alarms_per_min is None:
        return float(model.read("threshold")) if threshold is None else threshold
    curve = read_curve(model)
    if curve is None or not curve.minutes:
        raise InputError(
            "the model does not say how often it alarms where nothing slips",
            where=str(model.path),
            expected="false alarms per minute by threshold, as `evetac train` stores them",
            found="none: it is of an older evetac" if curve is None else "no slice 200 ms from slip to count them in",
            hint="name a threshold instead, or train it anew, with trials without slip in --validate",
        )
    chosen = curve.threshold_for(false_alarms_per_min)
    least = curve.at(chosen)[0]
    if least > false_alarms_per_min:
        raise InputError(
            "no threshold of the model has so few false alarms",
            where="--false-alarms-per-min",
            expected=f"at least {least:.3g}",
            found=f"{false_alarms_per_min:g}",
        )
    return chosen


def controller_threshold(
    model: StageFile, threshold: float | None = None, false_alarms_per_min: float | None = None
) -> float:
    """The threshold at which a controller is told of slip: as `chosen_threshold`, but for a model of an older evetac.

    Its own was chosen for timing alone, and in light touch a detector that keeps to it is silent.
    """
    if threshold is None and false_alarms_per_min is None and not model.has("warnings"):
        return OLDER_CONTROLLER_THRESHOLD
    return chosen_threshold(model, threshold, false_alarms_per_min)


def read_weights(model: StageFile) -> dict[str, NDArray[np.float32]]:
    """The weights in a model file by their names in the detector; those of several networks begin with a number."""
    names = [name for name in model.contents() if name.startswith("weights/")]
    return {name.removeprefix("weights/"): model.read(name) for name in names}


def training_ancestors(header: Header) -> Iterator[Header]:
    """Headers of the files that the features were made from which a model, given by its header, learned from."""
    history = header["history"]
    for one in header["parents"][: header["parameters"].get("trained_on")]:
        yield from (history[parent] for parent in history[one]["parents"])


def labelled_by(header: Header) -> str:
    """The methods of the labels that a model, given by its header, learned from, `truth` included; "" without any."""
    labels = (one["parameters"] for one in training_ancestors(header) if one["kind"] == "labels")
    return ", ".join(sorted({str(chosen.get("method", "farneback")) for chosen in labels}))


def learned_true_slip_share(header: Header) -> bool:
    """Whether a model, given by its header, or one that it was adapted from, learned which share of the contact slips.

    That is the truth of simulated recordings, beside the labels: `train --learn-true-slip-share`.
    """
    history = header["history"]
    models = [header, *(one for one in history.values() if one["kind"] == "model")]
    return any(_learned_truth(model, history) for model in models)


def _learned_truth(model: Header, history: Header) -> bool:
    chosen = model["parameters"]
    if "learn_true_slip_share" in chosen:
        return bool(chosen["learn_true_slip_share"])
    if model["method"] not in LEARNED_TRUTH_METHODS or chosen.get("preset") not in LEARNED_TRUTH_PRESETS:
        return False
    learned = [history[parent] for parent in model["parents"][: chosen.get("trained_on")] if parent in history]
    return any(one["kind"] == "features" and one["simulated"] for one in learned)
