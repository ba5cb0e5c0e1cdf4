"""Evaluations that rest on recordings whose slip the gel's nodes did not resolve say so."""

from pathlib import Path
from typing import Any

import pytest

from evetac_cli.evaluate.data_rate import EvaluateDataRate
from evetac_cli.evaluate.data_rate import measure as data_rate
from evetac_cli.evaluate.grasp import EvaluateGrasp
from evetac_cli.evaluate.grasp import measure as grasp
from evetac_cli.evaluate.labels import EvaluateLabels
from evetac_cli.evaluate.labels import measure as labels
from evetac_cli.evaluate.tracking import EvaluateTracking
from evetac_cli.evaluate.tracking import measure as tracking
from evetac_cli.store.recordings.slip_grid import COLUMN, NODES
from tests.conftest import Made
from tests.make import run_stage

SUBJECTS: list[tuple[Any, Any, str]] = [
    (labels, EvaluateLabels(), "labels"),
    (tracking, EvaluateTracking(), "tracks"),
    (data_rate, EvaluateDataRate(), "recording"),
    (grasp, EvaluateGrasp(), "grasp"),
]


def file(made: Made, kind: str) -> Path:
    """A file of this kind that the session's fixtures have made."""
    if kind == "grasp":
        return made.grasp
    return made.recordings[0] if kind == "recording" else made.beside(made.recordings[0], kind)


@pytest.mark.parametrize(("stage", "params", "kind"), SUBJECTS, ids=[kind for _, _, kind in SUBJECTS])
def test_rows_have_the_nodes_and_people_are_told(
    stage: Any, params: Any, kind: str, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Assert that rows have what the recording's truth says, and that a sentence names those with too few nodes."""
    monkeypatch.setattr(stage.slip_grid, "nodes_of", lambda recording: 2.5 if recording.has(NODES) else None)
    _, outcome = run_stage(stage, [file(made, kind)], params, tmp_path / "a.report.h5")
    rows = [row for row in outcome.rows if row.get("file")]
    assert [row[COLUMN] for row in rows] == [2.5]
    said = stage.for_people(outcome.rows, params)[1][-1]
    assert said.startswith("The gel's nodes do not resolve the slip of 1 recording (")
    for row in rows:
        row[COLUMN] = 6.0
    assert not any("nodes" in line for line in stage.for_people(outcome.rows, params)[1])
