"""Predictions over time about the onset of slip, by setting and object (paper, figure of predictions over time).

The paper shows one trajectory of object 3. Here every slip counts: at each time relative to the onset in the labels,
the mean probability and the share of slips whose probability reaches the threshold, over trajectories and seeds.
"""

from collections.abc import Sequence

import numpy as np

from evetac_cli.jobs import Rows
from evetac_cli.kernels.slip.metrics import Prediction

FROM_MS, TO_MS, EVERY_MS = -20, 60, 5  # about the onset, both ends included; the paper's range
TIMES_MS = range(FROM_MS, TO_MS + 1, EVERY_MS)


def rows(setting: str, predictions: Sequence[Sequence[Prediction]], thresholds: Sequence[float]) -> Rows:
    """Return a row per object and time; `predictions`: for each model of the setting, one per trajectory.

    The column `predictions` counts trajectories and seeds with a probability at that time: recordings may end earlier.
    """
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for of_model, threshold in zip(predictions, thresholds, strict=True):
        for prediction in of_model:
            if prediction.onset < 0 or not prediction.timed:
                continue
            slices = prediction.onset + np.array(TIMES_MS)
            inside = (slices >= 0) & (slices < len(prediction.probability))
            probability, reached = np.full(len(slices), np.nan), np.full(len(slices), np.nan)
            probability[inside] = prediction.probability[slices[inside]]
            reached[inside] = prediction.detected(threshold)[slices[inside]]
            found.setdefault(prediction.object, []).append((probability, reached))
    return [
        {
            "setting": setting,
            "object": name,
            "after_onset_ms": after_ms,
            "predictions": int(known.sum()),
            "probability_mean": float(np.mean(probability[known])) if known.any() else None,
            "detected_share": float(np.mean(reached[known])) if known.any() else None,
        }
        for name, pairs in found.items()
        for probabilities, detections in [(np.stack([one for one, _ in pairs]), np.stack([two for _, two in pairs]))]
        for after_ms, probability, reached in zip(TIMES_MS, probabilities.T, detections.T, strict=True)
        for known in [~np.isnan(probability)]
    ]
