"""The windows of a recording for the classifier that tells two recordings apart (kernels/realism)."""

import numpy as np
from numpy.typing import NDArray

from evetac_cli.kernels.calibration import rest_image
from evetac_cli.kernels.realism import classifier, windows
from evetac_cli.store.read import Recording

Floats = NDArray[np.float64]

MOST_WINDOWS = 240  # of a recording: two minutes


def window_features(recording: Recording) -> Floats:
    """Features (windows, features) of half seconds from the start on, their slices at rest or in motion."""
    counts = np.diff(recording.starts)
    at_rest = np.zeros(len(counts), np.bool_)
    for first, stop in rest_image.quiet_spells(counts):
        at_rest[first:stop] = True
    length = windows.WINDOW_SLICES
    rows = []
    for begin in range(0, min(len(counts) - length + 1, MOST_WINDOWS * length), length):
        starts = recording.starts[begin : begin + length + 1]
        events = recording.between(begin, begin + length)
        rows.append(windows.features(events, starts - starts[0], at_rest[begin : begin + length], recording.frame_px))
    return np.array(rows, np.float64).reshape(-1, len(windows.FEATURES))


def area(first: Floats, second: Floats) -> float | None:
    """AUC of held-out windows of two recordings; None where they are too short."""
    try:
        return classifier.told_apart(first, second)
    except ValueError:
        return None


def area_of_halves(of: Floats) -> float | None:
    """AUC between every other pair of windows and the pairs between them; None where the recording is too short."""
    other = np.arange(len(of)) // classifier.BLOCK % 2 == 1
    return area(of[~other], of[other])
