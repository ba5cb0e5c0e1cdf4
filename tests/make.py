"""Helpers that many tests use: outputs of stages and commands, recordings of given events, simulated trials."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from evetac_cli.cli.config import with_config
from evetac_cli.cli.main import app
from evetac_cli.commands.columns import columns_of, find
from evetac_cli.events import Events, slice_starts
from evetac_cli.inspect import validate
from evetac_cli.jobs import Outcome
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout.provenance import Recipe, content_digest

FRAME_PX = (640, 480)


def run_stage(
    stage: Any, files: list[Path], chosen: Any, out: Path | None = None, **options: Any
) -> tuple[Path, Outcome]:
    """Run the one job of a stage; return the path of its output and its report."""
    (job,) = stage.jobs(files, chosen, out)
    outcome: Outcome = stage.run(job, chosen, **options)
    commands = {f"evetac_cli.{command.module}": name for name, command in with_config().items()}
    if stage.__name__ in commands:
        assert_explained(commands[stage.__name__], outcome.rows)
    return job.output, outcome


def assert_explained(command: str, rows: list[dict[str, Any]]) -> None:
    """Assert that `--legend` of a command explains every column of its rows."""
    columns = columns_of(command)
    without = sorted({name for row in rows for name in row if find(columns, name) is None})
    assert not without, (command, without)


def run_valid(stage: Any, files: list[Path], chosen: Any, out: Path | None = None) -> tuple[Path, Outcome]:
    """Run the one job of a stage, and assert that its output is valid."""
    output, outcome = run_stage(stage, files, chosen, out)
    assert [row["faults"] for row in validate.run([output]).rows] == [None]
    return output, outcome


def output_of(stage: Any, chosen: Any, *files: Path, out: Path | None = None) -> Path:
    """Return the output path of a stage's one job."""
    return run_stage(stage, list(files), chosen, out)[0]


def evetac(*words: object) -> Any:
    """Run a command in this process, on a wide terminal; return exit_code, stdout and stderr."""
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})


def answer_of(*words: object) -> Any:
    """Return a command's output as JSON, and assert that it succeeds."""
    result = evetac(*words, "--json")
    assert result.exit_code == 0, (words, result.output[-2000:], result.stderr[-2000:])
    assert result.exception is None
    answer = json.loads(result.stdout)
    assert_explained(answer["command"], answer["rows"])
    return answer


def event_arrays(
    events: Events, slices: int, frame_px: tuple[int, int] = FRAME_PX, t_offset: int = 0
) -> dict[str, Any]:
    """Return the datasets of a recording of these events, by an unnamed sensor."""
    return {
        **{f"events/{column}": getattr(events, column) for column in Events._fields},
        "ms_to_idx": slice_starts(events.t, slices),
        "t_offset": np.int64(t_offset),
        "sensor/frame_px": np.array(frame_px, np.int32),
        "sensor/name": "unknown",
    }


def events_at(t_us: Any) -> Events:
    """Return OFF events of the pixel (0, 0) at these times."""
    t = np.asarray(t_us, np.int64)
    return Events(t, np.zeros(t.size, np.uint16), np.zeros(t.size, np.uint16), np.zeros(t.size, np.uint8))


def truth_arrays(dots_px: Any, slip: Any = 0, normal_n: Any = 0.0, shear_n: Any = 0.0) -> dict[str, Any]:
    """Return the truth for dots (slices, dots, 2), with slip and forces of all slices or of each; the rest is 0."""
    slices = len(dots_px)
    names = ("slid_px", "every_node_slid_px", "slip_share", "visible_slip_share")
    return {
        "truth/dot_xy_px": np.asarray(dots_px, np.float32),
        "truth/object_xy_px": np.zeros((slices, 2), np.float32),
        **{f"truth/{name}": np.zeros(slices, np.float32) for name in names},
        "truth/slip": np.full(slices, slip, np.uint8),
        "truth/normal_force_n": np.full(slices, normal_n, np.float32),
        "truth/shear_force_n": np.full((slices, 2), shear_n, np.float32),
        "truth/sampled_parameters": "{}",
    }


def label_arrays(label: Any, onset: int, flow_px: Any = np.nan) -> dict[str, Any]:
    """Return the datasets of labels of each slice, with this onset; flow_px: of all slices or of each."""
    return {
        "label": np.asarray(label, np.int8),
        "relative_flow_px": np.full(len(label), flow_px, np.float32),
        "onset_slice": np.int64(onset),
        "confidence": np.float64(1.0),
        "flow_pairs_computed": np.int64(0),
    }


def write_recording(path: Path, arrays: dict[str, Any], *, simulated: bool = False, **parameters: Any) -> Path:
    """Write a recording of these datasets, like an import does, and return its path."""
    recipe = Recipe("recording", 1, parameters, content=content_digest(arrays), simulated_source=simulated)
    write_stage(path, recipe, arrays, force=True)
    return path


def play_trial(trial: Any, slices: int | None = None) -> tuple[list[dict[str, Any]], list[Events]]:
    """Return truth and events of a number of slices of a simulated trial, or of all until it is finished."""
    rows, events = [], []
    for _ in range(slices) if slices is not None else itertools.count():
        if trial.finished:
            break
        events.append(trial.step())
        rows.append(trial.truth())
    return rows, events


def everything(folder: Path) -> list[str]:
    """Return the names of all files and folders below."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
