"""scripts/studies/sensors/blind.py: truths lie in their prior ranges, and the table counts as it says."""

from typing import Any

import pytest

from evetac_cli.sim.setup.plan import one_sensor
from scripts.studies.sensors import blind

NAMES = [parameter.name for parameter in blind.PARAMETERS]


def test_truths_lie_in_their_prior_ranges() -> None:
    """Assert that what is compared can be had of a sensor's row, that names come once, and that ranges hold them."""
    assert len(set(NAMES)) == len(NAMES)
    for number in range(9000, 9050):
        sensor = one_sensor(f"{blind.RANGES}:{number}")
        for parameter in blind.PARAMETERS:
            low, high = parameter.prior
            assert low <= parameter.truth(sensor) <= high, (number, parameter.name)


def result(low: float, high: float, *, truth: float = 0.05, name: str = "noise_hz") -> dict[str, Any]:
    """What is kept of a sensor of which one parameter is told."""
    row = {"parameter": name, "estimate": (low + high) / 2, "low": low, "high": high}
    return {"rows": [row], "truth": {name: truth}, "places_off_px": [0.1] * 10}


def test_widths_and_hits_are_counted() -> None:
    """Assert width over the prior range, hits, and that only a parameter told of all sensors, and narrow, is found."""
    narrow = [result(0.04, 0.06)] * 9 + [result(0.06, 0.07)]
    by_name = {row["parameter"]: row for row in blind.parameter_rows(narrow)}
    row = by_name["noise_hz"]
    assert row["estimated"] == 10 and row["held"] == 9 and row["found"]
    assert row["width_mean"] == pytest.approx((9 * 0.02 + 0.01) / 10 / 0.095)
    assert by_name["mismatch"]["estimated"] == 0 and not by_name["mismatch"]["found"]
    more_missed = blind.parameter_rows([result(0.04, 0.06)] * 8 + [result(0.06, 0.07)] * 2)
    wide = blind.parameter_rows([result(0.02, 0.09)] * 10)
    not_always = blind.parameter_rows([*narrow, {**result(0, 0), "rows": []}])
    for rows in (more_missed, wide, not_always):
        assert not next(row for row in rows if row["parameter"] == "noise_hz")["found"]
