"""Simulate trials under a changed setting, measure them as for the public facts, and store the rows.

Used by sensitivity.py and convergence.py. A trial equals that of `evetac record` with the same scene,
object and seed, but without the texture in the window. The texture changes no event in the columns that are counted. A
row is written as soon as its trial is measured. An existing row is not measured again if it has the current method
version of `evetac record`.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.commands.record import Record
from evetac_cli.evaluate.likeness.measures import (
    HELD_UNTIL_MS,
    SliceCounts,
    about_slip,
    count,
    rate,
    shares,
    slip,
    slipping_ms,
)
from evetac_cli.jobs import Row, silent
from evetac_cli.sim.setup.plan import Plan
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.store.recordings.slip_grid import COLUMN, nodes_of
from evetac_cli.trials import record
from evetac_cli.trials.record import simulated
from evetac_cli.trials.trial import SimulatedTrial
from scripts.reproduce.facts import RESULTS, commit_in_words, default_sensor

FOLDER = RESULTS / "likeness"
SLIP, RATE = "slip", "data-rate"  # scenes
OF_EVENTS = (
    "events_ms_about_slip",
    "events_ms_100_to_30_before",
    "events_ms_30_before",
    "events_ms_30_after",
    "loudest_slice_50_before",
)  # figures returned by about_slip
EARLY_MS = (-500, -100)  # relative to the onset
LOUD = 170  # events per slice; slices with more can be mistaken for slip: 100 with dots of 9 px, times 15 / 9
DIGITS = 5  # significant digits of a stored figure


@dataclass(frozen=True)
class Task:
    """A trial to measure: the name of its setting, its scene, object and seed."""

    setting: str
    scene: str
    object: int
    seed: int

    @property
    def key(self) -> Row:
        """The columns that identify its row."""
        return {"setting": self.setting, "scene": self.scene, "object": self.object, "seed": self.seed}


def planned(task: Task, folder: Path, change: Callable[[Plan], Plan] | None = None, **solver: Any) -> SimulatedTrial:
    """Return the trial of a task, with the given solver settings and its plan changed by `change`."""
    chosen: dict[str, Any] = {"scene": task.scene, "objects": str(task.object), "seed": task.seed, "texture": "off"}
    (trial,) = record.jobs([], Record(**chosen, **solver), folder)
    assert isinstance(trial, SimulatedTrial)
    return trial if change is None else replace(trial, plan=change(trial.plan))


def measured(trial: SimulatedTrial) -> Row:
    """Simulate a trial and return its measurements.

    us_a_slice is processor time, in us per slice; that of the first trial includes some time to load code.
    """
    started = time.process_time()
    simulated.run(trial, force=True, progress=silent)
    seconds = time.process_time() - started
    with open_recording(trial.output) as recording:
        counts = count(recording)
        row: Row = {"slices": len(recording), "us_a_slice": 1e6 * seconds / len(recording), COLUMN: nodes_of(recording)}
        row |= _of_rate(recording, counts) if trial.plan.scene.name == RATE else _of_slip(recording, counts)
    return {name: _rounded(value) for name, value in row.items()}


def _of_slip(recording: Recording, counts: SliceCounts) -> Row:
    """Return the onset since the current began to fall, the events around the onset and each threshold's detections.

    Without an onset, only onset_ms is returned, as None.
    """
    if counts.onset is None:
        return {"onset_ms": None}
    about = about_slip(counts)
    return {
        "onset_ms": counts.onset - counts.start,
        "events_ms_500_to_100_before": rate(counts, *EARLY_MS),
        **{name: about[name] for name in OF_EVENTS},
        **slipping_ms(recording.read("truth/visible_slip_share"), counts.onset),
        "loud_ms": loud_ms(counts),
        "after_ms": list(slip("", counts).after_ms),
    }


def loud_ms(counts: SliceCounts) -> list[int]:
    """Return the times before the onset, in ms, of slices with more than 100 events in the last 500 ms before it."""
    first = max((counts.onset or 0) - HELD_UNTIL_MS, 0)
    loud = np.flatnonzero(counts.sensing[first : counts.onset or 0] > LOUD)
    return [int(slice_) for slice_ in (counts.onset or 0) - first - loud]


def _of_rate(recording: Recording, counts: SliceCounts) -> Row:
    """Return bytes per second as a share of the paper's RGB sensor, over the columns that are counted."""
    found = shares(recording, counts)
    return {name: found.get(name) for name in ("share_whole", "share_contact", "share_slip")}


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) and np.isfinite(value) else value


def kept(path: Path) -> list[Row]:
    """Return the rows of a file, or none if the file does not exist."""
    rows: list[Row] = json.loads(path.read_text())["rows"] if path.is_file() else []
    return rows


def of_tasks(tasks: Iterable[Task], rows: list[Row]) -> list[Row]:
    """Return the existing rows of some tasks, in the order of the tasks."""
    found = {_key(row): row for row in rows}
    return [found[key] for key in (_key(task.key) for task in tasks) if key in found]


def _key(row: Row) -> tuple[Any, ...]:
    return tuple(row[name] for name in ("setting", "scene", "object", "seed"))


def measure_missing(path: Path, tasks: list[Task], plan: Callable[[Task, Path], SimulatedTrial], command: str) -> None:
    """Measure one by one the tasks that have no row in a file, and write each row as soon as it is measured.

    Rows by another method version of `evetac record` are measured again, because its arrays have changed.
    """
    rows = [row for row in kept(path) if row["record_method"] == simulated.METHOD]
    done = {_key(row) for row in rows}
    made = commit_in_words()
    for task in tasks:
        if _key(task.key) in done:
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows.append(
                {**task.key, "record_method": simulated.METHOD, "commit": made, **measured(plan(task, Path(folder)))}
            )
        known = of_tasks(tasks, rows)
        write(path, known + [row for row in rows if row not in known], command)
        print(json.dumps({name: rows[-1][name] for name in (*task.key, "us_a_slice")}), file=sys.stderr, flush=True)


def write(path: Path, rows: list[Row], command: str) -> None:
    """Write rows, one per line, and replace the file atomically, so that an interrupted run leaves it unchanged."""
    head = {"name": f"likeness-{path.stem}", "simulated": True, "commands": [command]}
    head |= {"default_sensor": default_sensor()}
    lines = ",\n".join(json.dumps(row) for row in rows)
    text = json.dumps(head, indent=1).removesuffix("\n}") + f',\n "rows": [\n{lines}\n]}}\n'
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    part.write_text(text)
    part.replace(path)


def arguments(about: str | None, name: str) -> argparse.Namespace:
    """Parse the command line. about: the text of --help; name: the default name of the file of rows."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER / f"{name}.json", help="file of rows")
    return parser.parse_args()


def made_by(rows: list[Row], command: str) -> str:
    """Return a sentence with the command, commits and seeds, and older method versions of `evetac record` if any."""
    commits, seeds, methods = (sorted({row[name] for row in rows}) for name in ("commit", "seed", "record_method"))
    older = "".join(f"; by an older method: record {method}" for method in methods if method != simulated.METHOD)
    return f"Made by `{command}` at {', '.join(map(str, commits))}{older}; seeds {', '.join(map(str, seeds))}."
