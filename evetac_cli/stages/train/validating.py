"""Choice of checkpoint, calibration and threshold of a trained model, from the validation trajectories.

Every candidate checkpoint is calibrated, unless the preset is the paper's. The checkpoint is chosen by the paper's
rule. Its threshold is the lowest with few enough false alarms per minute, if there is enough time without slip to count
them; otherwise it is the paper's.

The paper's rule alone is not enough. For evetac's first detector it rates the thresholds 0.7 and 0.95 as equally good,
but they warn 18 and 8 ms ahead. The rule also ignores false alarms when nothing slips.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.commands.train import FALSE_ALARMS_PER_MIN, LEAST_MINUTES
from evetac_cli.errors import InputError
from evetac_cli.kernels.slip import alarms, metrics, reliability
from evetac_cli.kernels.slip.alarms import WarningCurve
from evetac_cli.kernels.slip.metrics import Choice, Prediction
from evetac_cli.kernels.slip.reliability import OddsScale

if TYPE_CHECKING:  # torch takes more than a second to import
    from evetac_cli.kernels.slip.training import Preset


@dataclass(frozen=True)
class Validated:
    """The chosen checkpoint and threshold, its false alarms and warnings, and each checkpoint's calibration or None.

    predictions: those of the chosen checkpoint, calibrated.
    """

    choice: Choice
    curve: WarningCurve
    calibrations: list[OddsScale | None]
    predictions: Sequence[Prediction]

    @classmethod
    def of(cls, checkpoints: Sequence[Sequence[Prediction]], preset: "Preset", per_min: float | None) -> "Validated":
        """Choose from the checkpoints' predictions for the validation trajectories.

        per_min: allowed false alarms per minute, as given by the flag. If None and there are too few minutes to count
        them, the paper's rule is used. InputError if a rate is given but there is no slice to count in.
        """
        calibrations = [_calibration(predictions) if preset.calibrated else None for predictions in checkpoints]
        calibrated = [
            predictions if each is None else [replace(one, probability=each.of(one.probability)) for one in predictions]
            for predictions, each in zip(checkpoints, calibrations, strict=True)
        ]
        choice = _of_calibrated(metrics.choose_threshold(checkpoints), calibrations)
        best_predictions = calibrated[choice.checkpoint]
        curve = alarms.warning_curve(best_predictions)
        if per_min is not None and not curve.minutes:
            hint = "add trials without slip to --validate, or leave the option out"
            message = "false alarms cannot be counted in the validation files"
            raise InputError(message, where="--false-alarms-per-min", hint=hint)
        if per_min is not None or (preset.calibrated and curve.minutes >= LEAST_MINUTES):
            threshold = curve.threshold_for(FALSE_ALARMS_PER_MIN if per_min is None else per_min)
            detected_share, slip_share = metrics.shares(best_predictions, threshold)
            choice = choice._replace(threshold=threshold, detected_share=detected_share, slip_share=slip_share)
        return cls(choice, curve, calibrations, best_predictions)

    def arrays(self, which: str) -> dict[str, Any]:
        """Return datasets for the model file; which: description of the validation trajectories."""
        curve = self.curve
        arrays: dict[str, Any] = {
            "warnings/threshold": curve.threshold,
            "warnings/false_alarms_per_min": curve.false_alarms_per_min,
            "warnings/warned_10_ms_ahead": curve.warned_share,
            "warnings/minutes": np.float64(curve.minutes),
            "warnings/slips": np.int64(curve.slips),
        }
        used = self.calibrations[self.choice.checkpoint]
        if used is not None:
            _, slips = reliability.judged(self.predictions)
            arrays |= {
                "calibration/scale": np.float64(used.scale),
                "calibration/offset": np.float64(used.offset),
                "calibration/slices": np.int64(len(slips)),
                "calibration/slips": np.int64(np.count_nonzero(slips)),
                "calibration/on": f"{len(self.predictions)} trajectories to validate on, {which}",
            }
        return arrays

    def figures(self) -> dict[str, Any]:
        """Return the figures to print."""
        false, warned = self.curve.at(self.choice.threshold)
        return {
            "threshold": self.choice.threshold,
            "calibrated": self.calibrations[self.choice.checkpoint] is not None,
            "false_alarms_per_min": false if self.curve.minutes else None,
            "minutes_without_slip": self.curve.minutes,
            "warned_10_ms_ahead": warned,
            "validation_score": self.choice.score,
            "detected_share": self.choice.detected_share,
        }


def _of_calibrated(choice: Choice, calibrations: Sequence[OddsScale | None]) -> Choice:
    """Return the choice among checkpoints with its thresholds converted to calibrated probabilities.

    The paper's grid of thresholds is for detectors trained on as many slip as non-slip samples.
    """
    thresholds = np.array(
        [
            at if each is None else float(each.of(np.array([at]))[0])
            for at, each in zip(choice.thresholds, calibrations, strict=True)
        ]
    )
    return choice._replace(threshold=float(thresholds[choice.checkpoint]), thresholds=thresholds)


def _calibration(predictions: Sequence[Prediction]) -> OddsScale | None:
    """Return the calibration of a checkpoint; None for a checkpoint without information, where it would not help."""
    try:
        return reliability.fit(predictions)
    except ValueError:
        return None
