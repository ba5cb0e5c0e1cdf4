"""The tables of forces: rows as the evaluations say, and the methods of the models."""

from typing import Any

import pytest

from scripts.reproduce.tables import Evaluation
from scripts.studies.sensors import forces

HEADER: dict[str, Any] = {
    "id": "a",
    "kind": "report",
    "method": 2,
    "seed": None,
    "parameters": {"command": "evaluate force"},
    "parents": [],
    "history": {"b": {"kind": "force-model", "method": 7, "seed": 0, "parameters": {"method": "touch"}, "parents": []}},
}


def of_states(*states: str) -> Evaluation:
    """An evaluation of touch maps, with these states of knowledge."""
    summary: dict[str, Any] = {"sensors": 3, "stiffness_error": 0.1}
    for number, state in enumerate(states):
        summary |= {f"{state}_{key}": number + 0.125 for key in forces.FIGURES}
    return Evaluation([], summary | {"identified_sensors": 2}, True, HEADER)


def of_paper(*errors: float) -> Evaluation:
    """An evaluation of the paper's models, a trial for each sensor."""
    rows = [
        {"model": model, "sensor_name": f"randomized:{number}", "mae_n_x": error, "mae_n_y": error + 1.0}
        for number, error in enumerate(errors)
        for model in forces.PAPER_MODELS
    ]
    return Evaluation(rows, {}, True, HEADER)


def test_rows_of_the_table() -> None:
    """Assert a row for every state that was evaluated, of the tracker it was, and means over sensors of the paper's."""
    rows = forces.sensor_rows(
        {
            "stable": of_states("unknown", "identified"),
            "paper": of_states("unknown"),
            "evetac-paper": of_paper(1.0, 3.0),
        }
    )
    assert [(row["known"][:12], row["tracker"], row["sensors"]) for row in rows] == [
        ("nothing", "stable", 3),
        ("what `identi", "stable", 2),
        ("nothing", "paper", 3),
        ("the paper's ", "paper", 2),
        ("the paper's ", "paper", 2),
    ]
    assert rows[1]["mae_n"] == 1.125
    assert rows[3]["mae_n"] == pytest.approx(2.5)
    assert rows[3]["worst_sensor_mae_n"] == pytest.approx(3.5)
