"""scripts/studies/touch/wrong_dots.py: errors that are put in are found."""

import pytest

from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor
from scripts.studies.touch import wrong_dots
from scripts.studies.touch.contact_maker import ContactMaker
from scripts.studies.touch.contacts import dots_of


def test_injected_errors_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that six dots that are 5 px off are found in a contact, and that net shear is better without them."""
    monkeypatch.setattr(wrong_dots, "WRONG", (6,))
    monkeypatch.setattr(wrong_dots, "OFF_PX", (5.0,))
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm = dots_of(sensor)
    none, six = wrong_dots.rows_of([ContactMaker(rest_mm).make("ball", 8000)], rest_mm, sensor.mm_per_px)
    assert (none["found"], none["n"]) == (None, 1)
    assert six["found"] > 0.8
    assert six["shear_without_n"] < six["shear_with_n"]
