"""Make a simulated recording of any length, and check that no command needs more memory for a longer one.

    python scripts/attack/long_recording.py OUT.recording.h5 --minutes 60
    python scripts/attack/long_recording.py FOLDER --minutes 60 --check [--limit-mb 1000]

The end of a simulated trial, with some 300,000 events per second, is repeated with continuing times, and the file's
header states this. The recording is a load for memory and disk, not a realistic touch.

With --check, these commands run on it: the stages, the evaluations, a replayed grasp, validate, repair, trim, export
and import. A table lists the time and the memory of each (largest resident set, at least that of this program). Exit
code 1 if a command failed or exceeded the limit.

`train` is left out because its cost depends on the number of trials, not on their length.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evetac_cli.events import SLICE_US, Events
from evetac_cli.resources import MODEL
from evetac_cli.store.files import write_stage
from evetac_cli.store.layout import schema
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import Recording, open_recording
from evetac_cli.store.recordings.segments import RecordingWriter

TRIAL = ("record", "--scene", "slip", "--object", "2", "--count", "1", "--seed", "8000", "-q")
EVENTS_A_SLICE = 300
CLOCKS = ("gripper/t_us", "control/t_us")
TEXT_MINUTES = 6


class Repeated:
    """The end of a trial, with enough events, as arrays that begin at slice 0, and the rules for repeating it."""

    def __init__(self, trial: Recording, events_a_slice: float = EVENTS_A_SLICE) -> None:
        starts = trial.starts
        left = np.arange(len(trial), 0, -1)
        busy = np.flatnonzero((starts[-1] - starts[:-1]) / left >= events_a_slice)
        if not len(busy):
            raise SystemExit(f"{trial.path}: no part has {events_a_slice:g} events per slice")
        first = int(busy[0])
        self.header = trial.header
        self.slices = len(trial) - first
        self.from_ms = first
        self.starts = starts[first:] - starts[first]
        self.whole: dict[str, Any] = {}
        self.rows: dict[str, NDArray[Any]] = {}
        self.dims: dict[str, str] = {}
        table = schema.load("recording")
        for name in trial.contents():
            row = table.find(name)
            dim = str(row.dims[0]) if row is not None and row.dims else ""
            if dim in ("events", "slices"):
                self.rows[name] = trial.read(name, int(starts[first]) if dim == "events" else first)
            elif dim in ("commands", "control_steps"):
                clock = trial.read(f"{name.partition('/')[0]}/t_us")
                within = (clock >= first * SLICE_US) & (clock < len(trial) * SLICE_US)
                self.rows[name] = trial.read(name)[within]
            elif name != "ms_to_idx" and not name.startswith("capture/"):
                self.whole[name] = trial.read(name)
            if name == "events/t" or name in CLOCKS:
                self.rows[name] = self.rows[name] - first * SLICE_US
            self.dims[name] = dim

    def recipe(self, slices: int) -> Recipe:
        """Return the recipe of the long recording: simulated, made from its parent, and repeated."""
        parameters = {"repeated": {"from_ms": self.from_ms, "slices": self.slices, "to_slices": slices}}
        return Recipe("recording", 1, parameters, parents=(self.header,))

    def ms_to_idx(self, slices: int) -> NDArray[np.int64]:
        """Return the first event of every slice, and the number of events."""
        slice_ = np.arange(slices + 1, dtype=np.int64)
        times, rest = np.divmod(slice_, self.slices)
        return times * self.starts[-1] + self.starts[rest]

    def count(self, name: str, slices: int) -> int:
        """Return how many rows of a dataset belong to a number of slices."""
        times, rest = divmod(slices, self.slices)
        return times * len(self.rows[name]) + self._end(name, rest)

    def _end(self, name: str, rest: int) -> int:
        """Return how many rows of the part belong to its first slices."""
        if self.dims[name] == "slices":
            return rest
        clock = "events/t" if self.dims[name] == "events" else f"{name.partition('/')[0]}/t_us"
        return int(np.searchsorted(self.rows[clock], rest * SLICE_US))

    def blocks(self, slices: int) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the rows of all datasets, repetition by repetition, the last one cut."""
        for first in range(0, slices, self.slices):
            block = {
                name: rows[: self._end(name, min(self.slices, slices - first))] for name, rows in self.rows.items()
            }
            for name in ("events/t", *CLOCKS):
                if name in block:
                    block[name] = block[name] + first * SLICE_US
            yield block

    def write(self, path: Path, slices: int) -> None:
        """Write the long recording."""
        arrays = {**self.whole, "ms_to_idx": self.ms_to_idx(slices)}
        lengths = {name: self.count(name, slices) for name in self.rows}
        write_stage(path, self.recipe(slices), arrays, self.blocks(slices), lengths)

    def leave_segments(self, path: Path, slices: int) -> None:
        """Write the folder NAME.part of an aborted recording, without the datasets that only a simulation has."""
        static = {name: value for name, value in self.whole.items() if name.startswith("sensor/") or name == "t_offset"}
        writer = RecordingWriter(path, static, recipe=self.recipe(slices))
        starts = self.starts
        for first in range(0, slices, self.slices):
            t = self.rows["events/t"] + first * SLICE_US
            events = Events(t, *(self.rows[f"events/{column}"] for column in "xyp"))
            for slice_ in range(min(self.slices, slices - first)):
                writer.append(events.part(int(starts[slice_]), int(starts[slice_ + 1])))
        writer.close_segment()
        writer.leave()


def commands(folder: Path, slices: int) -> Iterator[tuple[str, ...]]:
    """Return the commands to check, in an order in which each finds its inputs."""
    long, broken = folder / "long.recording.h5", folder / "broken.recording.part"
    text_ms = min(TEXT_MINUTES * 60_000, slices)
    yield "validate", f"{long}"
    yield "info", f"{long}"
    yield "label", f"{long}"
    yield "label", "--method", "farneback", f"{long}", "-o", f"{folder / 'farneback.labels.h5'}"
    yield "label", "--method", "truth", f"{long}", "-o", f"{folder / 'truth.labels.h5'}"
    yield "track", f"{long}"
    yield "featurize", f"{long}"
    yield "track", "--rgb", f"{long}"
    yield from _force_model(folder / "trials", folder / "short.force-model.h5")
    yield "predict-touch", f"{folder / 'long.tracks.h5'}"
    yield "grasp", "--camera", f"replay:{long}", "-o", f"{folder / 'replayed.recording.h5'}"
    yield "evaluate", "data-rate", f"{long}", "-o", f"{folder / 'rate.report.h5'}"
    yield "evaluate", "tracking", f"{folder / 'long.tracks.h5'}", "-o", f"{folder / 'tracking.report.h5'}"
    features = f"{folder / 'long.features.h5'}"
    yield "evaluate", "slip", features, "--model", f"{MODEL}", "-o", f"{folder / 'slip.report.h5'}"
    yield "trim", f"{long}", "--from-ms", "500", "-o", f"{folder / 'piece.recording.h5'}"
    yield "validate", "--repair", f"{broken}"
    yield "export", "--format", "dsec", f"{long}", "-o", f"{folder / 'long.dsec.h5'}"
    yield "record", "--from", f"{folder / 'long.dsec.h5'}", "-o", f"{folder / 'imported.recording.h5'}"
    yield "trim", f"{long}", "--to-ms", f"{text_ms}", "-o", f"{folder / 'minutes.recording.h5'}"
    yield "export", "--format", "text", f"{folder / 'minutes.recording.h5'}"
    derived = ("long.labels", "long.tracks", "long.features", "long.touch")
    for name in (*derived, "piece.recording", "imported.recording", "replayed.recording"):
        yield "validate", f"{folder / name}.h5"


def _force_model(trials: Path, model: Path) -> Iterator[tuple[str, ...]]:
    """Return the commands that fit a force model to two short trials of the long recording's sensor."""
    yield "record", "--scene", "slip", "--object", "2", "--count", "2", "--seed", "1", "-q", "-o", f"{trials}"
    recordings = [str(path) for path in sorted(trials.glob("*.recording.h5"))]
    if not recordings:  # options that `record` was not given
        return
    yield "track", *recordings
    tracks = [str(path) for path in sorted(trials.glob("*.tracks.h5"))]
    yield "train-force", *tracks, "--samples", "50", "--epochs", "1", "-o", f"{model}"


def run(command: tuple[str, ...]) -> tuple[int, float, float]:
    """Run a command; return its exit code, seconds, and largest resident set in MB."""
    began_s = time.monotonic()
    process = subprocess.Popen([sys.executable, "-P", "-m", "evetac_cli", *command], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return process.returncode, time.monotonic() - began_s, used.ru_maxrss / unit


def simulated_trial(folder: Path) -> Path:
    """Record the trial whose end is repeated."""
    subprocess.run([sys.executable, "-P", "-m", "evetac_cli", *TRIAL, "-o", str(folder)], check=True)
    return next(iter(sorted(folder.glob("*.recording.h5"))))


def check(folder: Path, repeated: Repeated, slices: int, limit_mb: float, only: frozenset[str] = frozenset()) -> bool:
    """Run every command, or some, on a long recording in a folder and print its cost; return whether all succeeded."""
    began_s = time.monotonic()
    if not (folder / "long.recording.h5").exists():
        repeated.write(folder / "long.recording.h5", slices)
    if not only or "validate" in only:
        repeated.leave_segments(folder / "broken.recording.h5", slices)
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    print(f"{slices} slices, {repeated.ms_to_idx(slices)[-1]} events (simulated, repeated)")
    print(f"{'exit':>4} {'time_s':>8} {'memory_mb':>9}  command")
    print(f"{'-':>4} {time.monotonic() - began_s:8.1f} {own_mb:9.0f}  (writing both)", flush=True)
    well = own_mb <= limit_mb
    for command in commands(folder, slices):
        if only and command[0] not in only:
            continue
        code, seconds, memory_mb = run(command)
        shown = " ".join(Path(part).name if part.startswith(str(folder)) else part for part in command)
        over = f"  more than {limit_mb:g} MB" if memory_mb > limit_mb else ""
        print(f"{code:4} {seconds:8.1f} {memory_mb:9.0f}  {shown}{over}", flush=True)
        well &= code == 0 and not over
    return well


def main() -> int:
    """Record, repeat, and check if requested."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("out", type=Path, help="the recording to write; with --check the folder to work in")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--limit-mb", type=float, default=1000.0)
    parser.add_argument("--only", default="", help="with --check: only these commands, separated by commas")
    parser.add_argument("--trial", type=Path, help="a recording to repeat instead of a new one")
    chosen = parser.parse_args()
    slices = round(chosen.minutes * 60_000)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_recording(chosen.trial or simulated_trial(Path(folder))) as trial,
    ):
        repeated = Repeated(trial)
    if not chosen.check:
        repeated.write(chosen.out, slices)
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    only = frozenset(filter(None, chosen.only.split(",")))
    return 0 if check(chosen.out, repeated, slices, chosen.limit_mb, only) else 1


if __name__ == "__main__":
    sys.exit(main())
