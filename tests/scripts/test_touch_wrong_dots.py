"""scripts/touch_wrong_dots.py: errors that are put in are found."""

import sys
from pathlib import Path

import pytest

from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import touch_wrong_dots
from contact_maker import ContactMaker
from touch_contacts import dots_of


def test_injected_errors_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that six dots that are 5 px off are found in a contact, and that net shear is better without them."""
    monkeypatch.setattr(touch_wrong_dots, "WRONG", (6,))
    monkeypatch.setattr(touch_wrong_dots, "OFF_PX", (5.0,))
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm = dots_of(sensor)
    none, six = touch_wrong_dots.rows_of([ContactMaker(rest_mm).make("ball", 8000)], rest_mm, sensor.mm_per_px)
    assert (none["found"], none["n"]) == (None, 1)
    assert six["found"] > 0.8
    assert six["shear_without_n"] < six["shear_with_n"]
