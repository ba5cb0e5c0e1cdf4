"""scripts/studies/touch/contacts.py: errors over deviations become coverage and factors; contacts are judged."""

import numpy as np
import pytest

from evetac_cli.jobs import Row
from evetac_cli.kernels.touch import touch_map
from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor
from scripts.reproduce.table_text import fill
from scripts.studies.touch import contacts as study
from scripts.studies.touch.contact_maker import ContactMaker

Z = (0.1, 0.4, 0.8, 1.5)


def rows_of(z: tuple[float, ...]) -> list[Row]:
    """A row per contact in which everything is off by so many deviations."""
    return [{"z": {what: [one] for what in study.ERRORS}} for one in z]


def test_factors_make_normal_errors_covered() -> None:
    """Assert that errors which are normal but for a factor get that factor, within what 2000 of them tell."""
    rng = np.random.default_rng(5)
    z = tuple(float(one) for one in np.abs(2.0 * rng.normal(size=2000)))
    assert study.factors(rows_of(z))["torsion"] == pytest.approx(2.0, rel=0.06)


def test_a_contact_is_read_and_judged() -> None:
    """Assert that a ball is read well with all dots, and that its row makes a summary and every cell of the tables."""
    sensor = named_sensor("evetac")[1]
    assert isinstance(sensor, Sensor)
    rest_mm = study.dots_of(sensor)
    assert len(rest_mm) == 63 and len(study.dots_of(sensor, 4)) == 252
    contact = ContactMaker(rest_mm).make("ball", 6000)
    state = touch_map.start(rest_mm, renews=False)
    row = study.judged(contact, study.read(state, contact, study.KNOWN, sensor.mm_per_px), state)
    assert row["net"] < 0.1 and row["place_mm"] < 0.4 and row["iou"] > 0.7 and row["field"] < 0.6
    again = study.judged(contact, study.read(state, contact, study.KNOWN, sensor.mm_per_px), state)
    assert again == row  # what was read before leaves nothing behind
    (fewer,) = study.rows_of(study.Setting("", study.KNOWN.layer, 0.5), [contact], rest_mm, sensor.mm_per_px)
    assert fewer["net"] != row["net"]
    shown = study.summary("known", [row])
    assert shown["iou_wide"] == shown["iou"] == row["iou"] and shown["n"] == 1
    for columns in (study.ERROR_COLUMNS, study.COVERAGE_COLUMNS):
        assert all(fill(cell, shown) for cell in columns.values())
