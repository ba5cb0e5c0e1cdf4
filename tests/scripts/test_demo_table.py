"""scripts/demo_table.py: the table at the end of `make demo` tells what the reports say."""

import sys
import time
from pathlib import Path
from typing import Any

import pytest

from evetac_cli import params
from evetac_cli.stages.evaluate import grasp, labels, slip, tracking
from tests.conftest import Made

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import demo_table

APART = "apart.recording.h5"  # no model is trained on it


def reports(made: Made, folder: Path) -> None:
    """What `make demo` evaluates, each in its report."""
    trial = made.folder / APART
    evaluations: list[tuple[Any, Any, Path]] = [
        (labels, params.EvaluateLabels(), made.beside(trial, "labels")),
        (tracking, params.EvaluateTracking(), made.beside(trial, "tracks")),
        (slip, params.EvaluateSlip(model=made.model), made.beside(trial, "features")),
        (grasp, params.EvaluateGrasp(), made.grasp),
    ]
    for stage, chosen, file in evaluations:
        name = stage.__name__.rpartition(".")[2]
        (job,) = stage.jobs([file], chosen, folder / f"{name}.report.h5")
        stage.run(job, chosen)


def test_every_report_has_its_lines(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Assert the figures of labels, tracking, slip and the grasp, and how many files there are."""
    reports(made, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["demo_table.py", str(time.time() - 1000.0)])
    demo_table.main()
    printed = capsys.readouterr().out
    (trial,) = (row for row in demo_table.figures(tmp_path, "grasp")[0] if "file" in row)
    timing = demo_table.figures(tmp_path, "slip")[1]["slip_correct"]
    lines = {line.split("│")[1].strip(): line.split("│")[2].strip() for line in printed.splitlines() if "│" in line}
    assert lines["... found"].endswith("of 1")
    assert lines["slip timing correct, unseen trajectories"] == f"{timing:.3g}"
    assert lines["grasp of object 11 with the detector"].startswith("lifted" if trial["lifted"] else "not lifted")
    assert "holds 0 recording, 0 labels, 0 tracks, 0 features, 0 model, 4 report; 4 made in " in printed
