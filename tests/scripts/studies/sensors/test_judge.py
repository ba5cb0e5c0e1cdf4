"""Slip detectors from sensor to sensor: whose trials are whose, and the table made of judged trials."""

from pathlib import Path

import numpy as np
import pytest

from evetac_cli.evaluate.slip.models import Model
from evetac_cli.resources import MODEL
from scripts.studies import motions
from scripts.studies.motions import Planned, Trial
from scripts.studies.sensors import judge as judge_sensors
from scripts.studies.slip.trials import Scores


def test_each_sensor_has_seeds_of_its_own() -> None:
    """Assert that all sensors of the default have other seeds, whichever of them are named, on objects of the judge."""
    every = judge_sensors.sensors_of("evetac,second,realistic,bare-dvxplorer,54000-54019")
    assert len({sensor.place for sensor in every}) == len(every) == 24
    assert max(sensor.first(54_000) for sensor in every) + judge_sensors.SEEDS_APART <= 55_000
    (one,) = judge_sensors.sensors_of("54003")
    assert one == every[7] and one.randomised and not every[3].randomised
    (number, first), (_, other) = list(one.trials("slip-speeds", motions.JUDGED, 54_000))[:2]
    assert number == motions.JUDGED[0] and first.plan.scene.gel.cut
    assert first.plan.sensor_name == other.plan.sensor_name == "randomized:54003"


def test_rows_are_kept_and_have_every_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that what is played is not played again, and that rows without a model are refused."""
    slices = 1200
    played = []

    def seen(planned: Planned, seed: int, models: dict[str, Model]) -> tuple[Trial, Scores]:
        played.append(seed)
        still, slips = np.zeros(slices, np.float32), np.arange(slices) >= 1100
        told = {name: (still + 0.5, 10) for name in models}
        dots, shear = np.zeros((slices, 4, 2), np.float32), np.ones((slices, 2), np.float32)
        return Trial(dots, np.zeros((4, 2)), 0.03, still, slips, still + 1, shear, still, (640, 480)), told

    monkeypatch.setattr(judge_sensors, "seen", seen)
    (sensor,) = judge_sensors.sensors_of("second")
    for _ in range(2):
        rows = judge_sensors.judge(sensor, {"ours": MODEL}, 9000, 2, tmp_path)
    assert played == [9040, 9041] and (tmp_path / "second.jsonl").exists()
    assert all(set(one["scores"]) == {judge_sensors.ORACLE, "ours"} for one in rows)
    with pytest.raises(SystemExit, match="second.jsonl: .*adapted"):
        judge_sensors.judge(sensor, {"ours": MODEL, "adapted": MODEL}, 9000, 2, tmp_path)
