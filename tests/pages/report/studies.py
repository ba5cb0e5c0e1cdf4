"""A small study for the tests of report: trials with labels, and reports on them."""

import json
from pathlib import Path
from typing import Any

from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Header, Recipe
from tests.pages.view.trials import ONSET, SLICES, write_labels, write_recording

MODEL = "hist10, adamw"


def write_report(
    path: Path, command: str, rows: list[dict[str, Any]], summary: dict[str, Any], parents: tuple[Header, ...] = ()
) -> None:
    """A report as `evaluate` writes it."""
    arrays = {"command": command, "rows": json.dumps(rows), "summary": json.dumps(summary)}
    recipe = Recipe("report", 1, {"command": command, "of": path.name}, parents=parents, simulated_source=True)
    write_stage(path, recipe, arrays, force=True)


def write_trials(
    folder: Path, label_errors_ms: list[int | None], slices: int = SLICES, names: str = "slip-{:03}"
) -> list[Header]:
    """Recordings that slip at ONSET, labelled with these errors (None: no onset); the headers of features of them."""
    features = []
    for number, error_ms in enumerate(label_errors_ms):
        path = folder / f"{names.format(number)}.recording.h5"
        recording = write_recording(path, slices, number=1 + number % 9, seed=number)
        onset = slices if error_ms is None else ONSET + error_ms
        labels = write_labels(path.with_name(path.name.replace("recording", "labels")), recording, onset, slices=slices)
        features.append(Recipe("features", 1, {}, parents=(recording, labels)).header())
    return features


def slip_rows(features: list[Header], late_by_ms: list[int | None], **setting: Any) -> list[dict[str, Any]]:
    """Rows of `evaluate slip` for one model: its setting, its timing and a row a trajectory."""
    row = {
        "setting": MODEL,
        "seeds": 1,
        "trajectories": len(late_by_ms),
        "counted": len(late_by_ms),
        "preset": "adamw",
        "f1": 0.5,
        "f1_sd": 0.1,
    }
    row |= {"slip_correct": 0.5, "slip_correct_sd": None, "slip_early": 0.25, "slip_late": 0.25, "paper_f1": 0.73}
    row |= {"model": "hist10", "horizon_ms": 0}
    trajectories = [
        {
            "setting": MODEL,
            "model_file": "m.model.h5",
            "file": "same.features.h5",  # of the same name in many folders: trials are told apart by their recipes
            "object": str(1 + at % 9),
            "t_c_ms": ONSET,
            "t_m_ms": None if late_ms is None else ONSET + late_ms,
            "t_m_minus_t_c_ms": late_ms,
        }
        for at, late_ms in enumerate(late_by_ms)
    ]
    return [{**row, **setting}, {"setting": MODEL, "over_50_ms_ahead": 0.25, "10_to_0_ms_ahead": 0.5}, *trajectories]


def write_study(folder: Path) -> Path:
    """Five trials, of which one has no label and two are detected too early and never; a broken file, two reports."""
    folder.mkdir(exist_ok=True)
    features = write_trials(folder, [2, -1, None, 3, 40])
    write_report(
        folder / "s.slip.report.h5", "evaluate slip", slip_rows(features, [0, -120, 5, None, 4]), {}, tuple(features)
    )
    cases = [
        {"part": "gel", "case": name, "ok": ok, "quantity": "energy gained", "value": value, "bound": 1e-5}
        for name, ok, value in (("thin", True, 1e-7), ("thick", False, 2.0))
    ]
    cases = [{**case, "unit": "of all", "outcome": "ran", "reason": "<b>forces</b> are balanced"} for case in cases]
    write_report(folder / "sim.stability.report.h5", "evaluate stability", cases, {"cases": 2})
    (folder / "broken.labels.h5").write_text("no")
    return folder
