"""scripts/touch_drift.py and touch_wrong_dots.py: when is looked at what, how looks become rows, and a short run."""

import sys
from pathlib import Path

import numpy as np
import pytest

from evetac_cli.sim.setup import scene_file
from evetac_cli.sim.setup.plan import named_sensor
from evetac_cli.sim.setup.sensor import Sensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import results
import touch_drift as study
import touch_wrong_dots
from contact_maker import ContactMaker
from script_tables import table_of
from touch_contacts import dots_of


def test_looks_are_taken_while_the_object_is_held() -> None:
    """Assert that minutes end before the gripper opens, in the grip that they belong to."""
    assert study.times(60, 2) == [(0, "10 s", 10), (0, "1 min", 56), (1, "2 min", 56)]
    assert study.times(600, 10) == [
        *((0, "10 s", 10), (0, "1 min", 60), (0, "2 min", 120), (0, "5 min", 300)),
        (0, "10 min", 596),
    ]


@pytest.mark.parametrize("flash", [False, True])
def test_the_scene_can_be_read(flash: bool, tmp_path: Path) -> None:
    """Assert a scene of 82 pushes a minute that end before the gripper opens, with a flash where one is asked for."""
    path = tmp_path / "pushed.toml"
    path.write_text(study.scene_text(60, flash))
    scene = scene_file.load(str(path))
    assert scene.push is not None
    assert len(scene.push.at_s) == 83
    assert scene.gripper.open_s is not None
    assert max(scene.push.at_s) + scene.push.lasts_s < scene.gripper.open_s
    assert (scene.light is not None) == flash


def test_looks_become_a_row() -> None:
    """Assert rms, common part and worst of known errors, of dots that are left out none, and rms of the force."""
    off = np.zeros((4, 2))
    off[0] = [3.0, 4.0]
    looks = study.Looks([off, np.where(np.arange(4)[:, None] == 3, np.nan, 0.0) + np.zeros((4, 2))], [0.3, 0.4])
    row = looks.row()
    assert row["rms_px"] == pytest.approx(np.sqrt(25 / 7))
    assert row["common_px"] == pytest.approx(np.sqrt(0.5 * 1.25**2))
    assert (row["worst_px"], row["rms_n"], row["looks"]) == (5.0, pytest.approx(np.sqrt(0.125)), 2)


def test_wrong_dots_are_counted_by_how_far_they_are_off() -> None:
    """Assert what was found of dots off by 1 and by 2 px from the median, and who was called wrong besides."""
    off = np.zeros((9, 2)) + [0.5, 0.0]
    off[:3, 0] += [1.2, 2.5, 0.6]
    wrong = study.WrongDots()
    wrong.add(off, np.array([0, 1, 1, 0, 0, 0, 0, 0, 0], np.bool_))
    assert wrong.by_px == {1.0: [1, 2], 2.0: [1, 1]}
    assert (wrong.called, wrong.right) == (1, 7)


@pytest.mark.slow
@pytest.mark.parametrize("flash", [False, True])
def test_a_short_run(flash: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a grip of 7 s makes a row for each remedy, that dots are near, and that a flash shows them."""
    monkeypatch.setattr(study, "MINUTE_S", 7)
    judge = study.run(7, 1, 5, flash, [])
    rows = {row["remedy"]: row for row in study.rows_of("", judge) if row["after"] == "1 min"}
    assert rows["a flash every 1 s" if flash else "stable"]["rms_px"] < 0.6
    assert len(rows) == (2 if flash else 7)
    if flash:
        assert rows["as the flash alone shows them"]["rms_px"] < 0.2
    else:
        across = {"heading": "{after}", "cell": "{rms_px:.1f} px"}
        table = table_of("t", "T", {"dots": "{remedy}"}, list(rows.values()), "nothing", {}, across=across)
        assert "put back when nothing touches" in results.text(table)


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
