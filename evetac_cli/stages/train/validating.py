"""What the trajectories that validate decide of a trained model: checkpoint, calibration, threshold.

Every checkpoint that may be chosen is calibrated, unless the preset is the paper's; the checkpoint is chosen by the
paper's rule. Its threshold is the lowest with few enough false alarms per minute, where there is time enough to count
them in, or the paper's.

Why so: thresholds that the paper's rule finds equally good, 0.7 and 0.95 of the first detector of evetac, warn 18 and 8
ms ahead, and say nothing of how often they do so where nothing slips.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip import metrics, reliability, warning_curve
from evetac_cli.kernels.slip.metrics import Choice, Prediction
from evetac_cli.kernels.slip.reliability import OddsScale
from evetac_cli.kernels.slip.warning_curve import WarningCurve

if TYPE_CHECKING:  # torch takes more than a second to import
    from evetac_cli.kernels.slip.training import Preset

LEAST_MINUTES = 5.0  # without slip, to choose a threshold by: with fewer, one alarm per minute is less than five alarms
# Where none are named. A false alarm costs a controller little, as it asks the load before it believes it; a slide that
# is told late costs the object. With 1 per minute the detector that it was chosen by warned of 0.22 of the slips
# that it was validated on 10 ms ahead, with 2 of 0.62, with 4 of 0.74, with 6 of 0.78 (simulated, seeds 5600 to 5623).
FALSE_ALARMS_PER_MIN = 4.0


@dataclass(frozen=True)
class Validated:
    """The choice, what warnings cost, and the calibration of each checkpoint, None where there is none.

    predictions: of the chosen checkpoint, calibrated.
    """

    choice: Choice
    curve: WarningCurve
    calibrations: list[OddsScale | None]
    predictions: Sequence[Prediction]

    @classmethod
    def of(cls, checkpoints: Sequence[Sequence[Prediction]], preset: "Preset", per_min: float | None) -> "Validated":
        """From what the checkpoints predict for the trajectories that validate; per_min: of false alarms, as named.

        Where none are named and there are few minutes to count them in, the paper's rule is taken. InputError where a
        number is named and there is no slice to count in.
        """
        calibrations = [_calibration(predictions) if preset.calibrated else None for predictions in checkpoints]
        calibrated = [
            predictions if each is None else [replace(one, probability=each.of(one.probability)) for one in predictions]
            for predictions, each in zip(checkpoints, calibrations, strict=True)
        ]
        choice = _of_calibrated(metrics.choose_threshold(checkpoints), calibrations)
        chosen = calibrated[choice.checkpoint]
        curve = warning_curve.of_predictions(chosen)
        if per_min is not None and not curve.minutes:
            raise InputError(
                "false alarms cannot be counted in the files that validate",
                where="--false-alarms-per-min",
                expected="slices labelled no slip, 200 ms from any that is, as in trials without slip",
                found="none",
                hint="name such trials with --validate, or leave the option out",
            )
        if per_min is not None or (preset.calibrated and curve.minutes >= LEAST_MINUTES):
            threshold = curve.threshold_for(FALSE_ALARMS_PER_MIN if per_min is None else per_min)
            detected_share, slip_share = metrics.shares(chosen, threshold)
            choice = choice._replace(threshold=threshold, detected_share=detected_share, slip_share=slip_share)
        return cls(choice, curve, calibrations, chosen)

    def arrays(self, which: str) -> dict[str, Any]:
        """Datasets of the model file; which: the trajectories that validate, in words."""
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
        """What is printed of it."""
        false, warned = self.curve.at(self.choice.threshold)
        return {
            "calibrated": self.calibrations[self.choice.checkpoint] is not None,
            "false_alarms_per_min": false if self.curve.minutes else None,
            "minutes_without_slip": self.curve.minutes,
            "warned_10_ms_ahead": warned,
        }


def _of_calibrated(choice: Choice, calibrations: Sequence[OddsScale | None]) -> Choice:
    """A choice among checkpoints with the thresholds that mean the same once these are calibrated.

    Why so: the paper's grid is of thresholds for detectors that learned from as much slip as not.
    """
    thresholds = np.array(
        [
            at if each is None else float(each.of(np.array([at]))[0])
            for at, each in zip(choice.thresholds, calibrations, strict=True)
        ]
    )
    return choice._replace(threshold=float(thresholds[choice.checkpoint]), thresholds=thresholds)


def _calibration(predictions: Sequence[Prediction]) -> OddsScale | None:
    """The calibration of a checkpoint; None for one that tells nothing, which has no more to say either way."""
    try:
        return reliability.fit(predictions)
    except ValueError:
        return None
