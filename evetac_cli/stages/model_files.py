"""What a model file says of its slip detector, for those who do not run it (slip_detectors.py does)."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.errors import InputError
from evetac_cli.store.files import StageFile

USELESS_HINT = "train for more steps, on more trajectories, and name at least 4 others with --validate"


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


def read_weights(model: StageFile) -> dict[str, NDArray[np.float32]]:
    """The weights in a model file by their names in the detector; those of several networks begin with a number."""
    names = [name for name in model.contents() if name.startswith("weights/")]
    return {name.removeprefix("weights/"): model.read(name) for name in names}
