"""Slip detectors from sensor to sensor: whose trials are whose, and the table made of judged trials."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import judge_sensors
import motions
import results
import sensor_tables
from motions import Planned, Trial
from slip_trials import THRESHOLDS, Scores

from evetac_cli.evaluate.slip_models import Model
from evetac_cli.resources import MODEL

SCORES = (judge_sensors.ORACLE, "ours", "adapted")
EARLY, RIGHT, LATE = -100, 0, 100  # ms from the onset to the first detection
AT = THRESHOLDS[3]


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


@pytest.mark.parametrize("text", ["", "third", "evetac,evetac", "54000-54020", "5-3"])
def test_wrong_sensors_are_refused(text: str) -> None:
    """Assert that what is no sensor, or would share its seeds with another, is refused."""
    with pytest.raises(argparse.ArgumentTypeError, match="expected"):
        judge_sensors.sensors_of(text)


def row(seed: int, sensor: str, scores: tuple[str, ...], first_ms: dict[str, int]) -> dict[str, Any]:
    """A judged trial, in which at the threshold AT scores come as said, and at every other late."""
    said = {}
    for score in scores:
        first = [first_ms[score] if at == AT else LATE for at in THRESHOLDS]
        counts = [[8, 2, 2] if ms == RIGHT else [0, 5, 10] for ms in first]
        said[score] = {"horizon_ms": 10, "first_ms": first, "counts": counts}
    return {"seed": seed, "sensor": sensor, "object": 2, "unloading_n_s": 2.0, "scores": said}


def judged_rows() -> tuple[dict[str, list[dict[str, Any]]], dict[str, dict[str, float]]]:
    """Two slips on each of three sensors; ours is wrong in one on each randomised sensor, and adapted to these."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for place, name in enumerate(("evetac", "randomized:1", "randomized:2")):
        scores = SCORES[: 2 if name == "evetac" else 3]
        ours = RIGHT if name == "evetac" else EARLY
        rows[name] = [
            row(10 * place + number, name, scores, {**dict.fromkeys(scores, RIGHT), "ours": told})
            for number, told in enumerate((RIGHT, ours))
        ]
        rows[name].append({"seed": 10 * place + 2, "sensor": name, "scores": {}})  # nothing slips
    return rows, {name: {score: AT for score in of[0]["scores"]} for name, of in rows.items()}


def test_a_table_has_sensors_their_means_and_what_adapting_is_worth() -> None:
    """Assert that rows are of sensors, of the randomised together, of the adapted together, and of the difference."""
    rows, at = judged_rows()
    shown = sensor_tables.sensor_rows(rows, at, "ours")
    assert [one["slips"] for one in shown] == [2, 2, 2, 4, 4, 4]
    assert [one.get("ours_correct") for one in shown] == [1.0, 0.5, 0.5, 0.5, 0.5, None]
    assert [one.get("adapted_correct") for one in shown] == [None, 1.0, 1.0, 1.0, 1.0, 0.5]
    assert (shown[-1]["adapted_low"], shown[-1]["adapted_high"]) == (0.5, 0.5)  # by sensor, and each gains as much
    assert shown[1]["ours_low"] == 0.0 and shown[1]["ours_high"] == 1.0  # by object: one is right, one is not
    assert shown[0]["ours_f1"] == pytest.approx(0.8) and shown[1]["ours_f1"] == pytest.approx(16 / 35)
    table = sensor_tables.table(shown, SCORES, len(rows), "command", {})
    text = results.text(table)
    assert "ours on randomized:1 (0.50)" in text and "| 2 randomised together | 4 |" in text
    assert [line for line in text.splitlines() if line.startswith("| adapted less ours, paired | 4 |  |  | 0.50 (")]


def test_a_threshold_of_another_sensor_is_not_taken() -> None:
    """Assert that a model adapted to a sensor is judged at the threshold of its own file."""
    rows, at = judged_rows()
    at["randomized:2"]["adapted"] = THRESHOLDS[5]
    shown = sensor_tables.sensor_rows(rows, at, "ours")
    assert [one.get("adapted_correct") for one in shown] == [None, 1.0, 0.0, 0.5, 0.5, 0.0]


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


def test_a_model_is_adapted_by_commands_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that labels come from events, enough of those that tell an onset validate, and nothing is done twice."""
    said: list[tuple[str, ...]] = []
    learned: list[tuple[int, int]] = []
    tells = {"second": 19, "randomized-9000": 9, "randomized-9001": 7}

    def run(*words: object) -> None:
        said.append(tuple(map(str, words)))
        folder = Path(said[-1][1])
        for kind in {"label": ("labels",), "featurize": ("features",)}.get(str(words[0]), ()):
            for number in range(19):
                (folder / f"{number:02d}.{kind}.h5").touch()
        if words[0] == "train":
            held_back = Path(said[-1][said[-1].index("--validate") + 1])
            learned.append((len(list(folder.glob("*.features.h5"))), len(list(held_back.glob("*.features.h5")))))

    monkeypatch.setattr(judge_sensors, "run", run)
    monkeypatch.setattr(judge_sensors, "record_minute", lambda *_: 1.04)
    monkeypatch.setattr(judge_sensors, "tells_onset", lambda path: int(path.name[:2]) < tells[path.parent.name])
    words = ["judge_sensors.py", "adapt", "--model", str(MODEL), "--seed", "9000", "--sensors", "second,9000-9001"]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path)])
    judge_sensors.main()
    assert [one[0] for one in said] == [*["label", "track", "featurize", "train"] * 2, "label"]
    assert learned == [(12, 7), (14, 5)]
    assert "--method" not in said[0] and "--sticking-share" in said[2]
    assert said[7][said[7].index("--out") + 1] == str(tmp_path / "randomized-9000.model.h5")
    rows = [json.loads(line) for line in (tmp_path / judge_sensors.ADAPTED_ROWS).read_text().splitlines()]
    assert [(one["seed"], one["trials"], one["told"], "took_s" in one) for one in rows] == [
        (9040, 19, 19, True),
        (9160, 19, 9, True),
        (9200, 19, 7, False),
    ]
    judge_sensors.main()
    assert len(said) == 9


def test_the_model_before_adapting_is_known_by_its_id(tmp_path: Path) -> None:
    """Assert that models of which none was adapted are refused: nothing could be compared."""
    with pytest.raises(SystemExit, match="not adapted from any of ours"):
        judge_sensors.adapted_from({"ours": MODEL}, MODEL)
