"""Figures of slip detectors sensor by sensor: what is made of known predictions, and the tables of it."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import reproduce
import results
import slip_by_sensor
import studies
from experiment_tables import Evaluation
from slip_by_sensor import Sensor

from evetac_cli.errors import InputError
from evetac_cli.kernels.slip.metrics import Prediction
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe

SLICES, ONSET = 400, 300


def prediction(object_: int, first: int, onset: int = ONSET) -> Prediction:
    """A trajectory that slips from its onset on, or never (-1), and is called slip from a slice on."""
    at = np.arange(SLICES)
    label = ((at >= onset) & (onset >= 0)).astype(np.int8)
    return Prediction((at >= first).astype(np.float32), label, onset, str(object_))


def header(seed: int, sensor: str) -> Header:
    """The header of the features of a recording."""
    recording = Recipe("recording", 1, {"object": 1, "sensor": sensor}, seed=seed, simulated_source=True).header()
    return Recipe("features", 1, {}, parents=(recording,)).header()


def rows_of(said: dict[str, list[Prediction]], monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The rows of two models that say the same of these sensors."""
    monkeypatch.setattr(slip_by_sensor, "predictions", lambda model, sensor: said[sensor.name])
    sensors = [
        Sensor(name, [], [header(1000 * place + number, name) for number in range(len(trials))])
        for place, (name, trials) in enumerate(said.items())
    ]
    models: Any = {"shipped": SimpleNamespace(threshold=0.5), "first edition": SimpleNamespace(threshold=0.5)}
    return slip_by_sensor.sensor_rows(models, sensors, 0)


def test_rows_and_their_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Assert shares, intervals over objects, the mean over randomized sensors, and the table that the page gets."""
    right, early = [prediction(one, ONSET) for one in (1, 2)], [prediction(one, 0) for one in (1, 2)]
    said = {"evetac": right, "randomized:1": [*right, *early], "randomized:2": early}
    rows = rows_of(said, monkeypatch)
    assert [row["sensor"] for row in rows] == ["evetac", "randomized:1", "randomized:2", "mean of 2 randomized"]
    assert [row["shipped_slip_correct"] for row in rows] == [1.0, 0.5, 0.0, 0.25]
    assert [row["shipped_slip_early"] for row in rows] == [0.0, 0.5, 1.0, 0.75]
    assert (rows[0]["shipped_slip_correct_low"], rows[0]["shipped_slip_correct_high"]) == (1.0, 1.0)
    assert [(row["trials"], row["slips"], row["seeds"]) for row in rows[1:]] == [
        (4, 4, "1000-1003"),
        (2, 2, "2000-2001"),
        (6, 6, "1000-1003, 2000-2001"),
    ]
    whole = table(rows)
    assert whole["simulated"] and whole["sizes"]["recording_seeds"] == [7]
    assert [row["seeds"] for row in whole["rows"]] == [row["seeds"] for row in rows]
    (tmp_path / "slip-by-sensor.json").write_text(json.dumps(whole))
    page = "<!-- table slip-by-sensor -->\n<!-- end of slip-by-sensor -->\n"
    filled = results.fill_page(page, tmp_path)
    assert "| sensor | trials | early | correct | late | F1 | correct, first edition | F1, first edition |" in filled
    assert "| evetac | 2 | 0.00 | 1.00 (1.00 to 1.00) | 0.00 | 1.00 (1.00 to 1.00) | 1.00 | 1.00 |" in filled
    alone = table([{key: row[key] for key in row if not key.startswith("first_edition")} for row in rows])
    assert "| sensor | trials | early | correct | late | F1 |\n" in results.text(alone)


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The table of these rows, from one recording."""
    evaluation = Evaluation(
        rows, {}, simulated=True, header=Recipe("report", 1, {}, parents=(header(7, "evetac"),)).header()
    )
    return reproduce.result(studies.SLIP_BY_SENSOR, {"slip-by-sensor": evaluation}, ["python"])


def test_sensors_that_never_slip(monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a folder without slip has no timing, that others have theirs, and that the mean is of those."""
    still = [prediction(1, SLICES, -1), prediction(2, 100, -1)]
    said = {"randomized:1": still, "randomized:2": [prediction(1, ONSET), prediction(1, 0)], "evetac": still}
    alone, other, _, mean = rows_of(said, monkeypatch)
    assert (alone["slips"], alone["shipped_slip_correct"], alone["shipped_slip_correct_low"]) == (0, None, None)
    assert other["shipped_slip_correct"] == mean["shipped_slip_correct"] == 0.5
    cells = [results.cell(column, alone, {}) for column in table([alone, other])["columns"]]
    assert cells[:5] == ["randomized:1", "2", "", "", ""]
    (nothing,) = rows_of({"evetac": still}, monkeypatch)
    assert nothing["shipped_slip_early"] is None and nothing["shipped_f1"] is not None


def test_a_sensor_is_called_as_in_its_recordings(tmp_path: Path) -> None:
    """Assert that the name is that of the files, or of the folder where they are of several; no files are refused."""
    for folder, sensors in (("one", ["randomized:5"] * 2), ("many", ["evetac", "second"])):
        for number, sensor in enumerate(sensors):
            path = tmp_path / folder / f"{number}.features.h5"
            path.parent.mkdir(exist_ok=True)
            recording = Recipe("recording", 1, {"object": 1, "sensor": sensor}, seed=number).header()
            arrays = {"displacement_px": np.zeros((3, 4), np.float32), "events_per_dot": np.zeros((3, 4), np.int32)}
            arrays |= {
                "dot_shape": np.array([2, 2], np.int32),
                "events_total": np.zeros(3, np.int32),
                "events_outside": np.zeros(3, np.int32),
            }
            write_stage(path, Recipe("features", 1, {}, parents=(recording,)), arrays)
    assert [slip_by_sensor.sensor_in(tmp_path / folder).name for folder in ("one", "many")] == ["randomized:5", "many"]
    with pytest.raises(InputError, match="no features"):
        slip_by_sensor.sensor_in(tmp_path)
