"""Known properties of a sensor that make it respond differently from another sensor to the same contact."""

from collections.abc import Mapping
from typing import Any, NamedTuple


class Sensitivity(NamedTuple):
    """Properties of one sensor, as estimated by `evetac identify`; None if unknown.

    `contrast_over_threshold`: log contrast of a dot over the camera's threshold, which is the number of events of a
    pixel when the rim of a dot passes. `shear_modulus_pa`: of the gel; under the same force a gel of twice the modulus
    moves half as far. Stage files store them as datasets of these names, calibration files as keys.

    >>> import evetac_cli as evetac
    >>> with evetac.open_recording("a.recording.h5") as recording:
    ...     evetac.Sensitivity(shear_modulus_pa=9e4).known(), sorted(recording.sensitivity.known())
    ({'shear_modulus_pa': 90000.0}, ['contrast_over_threshold', 'shear_modulus_pa'])
    """

    contrast_over_threshold: float | None = None
    shear_modulus_pa: float | None = None

    def known(self) -> dict[str, float]:
        """Return the known properties by name."""
        return {name: value for name, value in self._asdict().items() if value is not None}


UNKNOWN = Sensitivity()
DATASETS = {name: f"sensor/{name}" for name in Sensitivity._fields}


def sensitivity_of(sensor: Mapping[str, Any]) -> Sensitivity:
    """Return the properties among the datasets `sensor/...` of a file or a trial."""
    return Sensitivity(**{name: float(sensor[path]) for name, path in DATASETS.items() if path in sensor})
