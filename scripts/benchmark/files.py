"""Write the folder of evetac-bench: inputs without truth, truth apart, tables of recordings and instants, digests."""

import csv
import hashlib
import json
import multiprocessing
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from evetac_cli.jobs import Row, silent
from evetac_cli.store.files import write_stage
from evetac_cli.store.hdf5.disk import taking_the_place_of
from evetac_cli.store.layout.provenance import Recipe, content_digest
from evetac_cli.store.made_folders import new_folder, require_free
from evetac_cli.store.recordings.read import Recording, open_recording, true_onset
from evetac_cli.trials import grasp, record
from evetac_cli.trials.grasp.settings import SimulatedGrasp
from scripts.benchmark import pages
from scripts.benchmark import trials as benchmark_trials
from scripts.benchmark.trials import RECIPE, Slot

METHOD = 1  # increase if the same recipe gives other files
# What a user of a real sensor has. Modulus and contrast of the gel are not among them: they are known only of simulated
# sensors, or after `evetac identify`.
SENSOR = ("frame_px", "dot_xy_px", "dot_radius_px", "window_px")
LEFT_OUT = ("control/outcome",)  # how a grasp ended is truth
TRUTH = ("slip", "visible_slip_share", "normal_force_n")  # in each ms
READER = RECIPE.with_name("reader.py")


def make(size: str, out: Path, jobs: int) -> None:
    """Simulate all trials of a size and write the folder, which appears when it is complete.

    Finished recordings are kept in NAME.parts beside it until then, so that an interrupted run goes on where it ended.
    """
    recipe = benchmark_trials.recipe()
    chosen = benchmark_trials.slots(recipe, size)
    recorded = [slot for slot in chosen if slot.kind != "grip"]
    require_free(out)
    parts = out.with_name(f"{out.name}.parts")
    _prepare_parts(parts)
    rows = []
    for row in _each([(recipe, slot, parts) for slot in recorded], jobs):
        rows.append(row)
        sys.stderr.write(f"{len(rows)} of {len(recorded)}: {row['recording']}\n")
    with new_folder(out) as folder:
        prepare(folder)
        for row in rows:
            for name in (f"inputs/{row['recording']}.recording.h5", f"truth/{row['recording']}.h5"):
                shutil.copyfile(parts / name, folder / name)
        lifts = {slot.name: _lift(recipe, slot, folder) for slot in chosen if slot.kind == "grip"}
        finish(folder, recipe, size, rows, lifts)
    shutil.rmtree(parts)


def _prepare_parts(parts: Path) -> None:
    """Make the folder of finished recordings, and empty it if they are of another recipe."""
    if parts.exists() and (parts / RECIPE.name).read_bytes() != RECIPE.read_bytes():
        shutil.rmtree(parts)
    if not parts.exists():
        prepare(parts)
        (parts / "rows").mkdir()
        shutil.copyfile(RECIPE, parts / RECIPE.name)


def prepare(folder: Path) -> None:
    """Make the folders of a benchmark."""
    for name in ("inputs", "truth/lifts", "queries"):
        (folder / name).mkdir(parents=True)


def finish(folder: Path, recipe: Mapping[str, Any], size: str, rows: Sequence[Row], lifts: Mapping[str, Row]) -> None:
    """Write everything but the recordings and their truth: tables, recipe, reader, digests, card and metadata."""
    rows = sorted(rows, key=lambda row: str(row["recording"]))
    _tables(folder, rows, lifts)
    shutil.copy(RECIPE, folder / "recipe.toml")
    shutil.copy(READER, folder / "reader.py")
    about = {
        "name": recipe["name"],
        "version": recipe["version"],
        "size": size,
        "simulated": True,
        "recipe_sha256": hashlib.sha256(RECIPE.read_bytes()).hexdigest(),
        "method": METHOD,
        "recordings": {str(row["recording"]): row["digest"] for row in rows},
    }
    (folder / "benchmark.json").write_text(json.dumps(about, indent=1) + "\n")
    pages.write(folder, about, rows, lifts)


def _each(task: Sequence[tuple[Any, ...]], jobs: int) -> Iterable[Row]:
    if jobs == 1:
        yield from map(_record, task)
        return
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(_record, task)


def _record(task: tuple[Mapping[str, Any], Slot, Path]) -> Row:
    """Simulate a trial and write its input, its truth and at last its row, which is returned; unless it exists."""
    recipe, slot, parts = task
    done = parts / "rows" / f"{slot.name}.json"
    if done.exists():
        return dict(json.loads(done.read_text()))
    whole = parts / f"{slot.name}.recording.h5"
    made = benchmark_trials.trial(recipe, slot, whole)
    if isinstance(made.trial, SimulatedGrasp):
        grasp.simulated.run(made.trial, force=True, progress=silent)
    else:
        record.simulated.run(made.trial, force=True, progress=silent)
    row = divide(recipe, whole, parts, slot.name, sensor_name(recipe, made.sensor), presses=slot.kind == "press")
    row |= {"kind": slot.kind, "split": slot.split, "mm_per_px": made.trial.plan.sensor.mm_per_px}
    row |= {"true_sensor": made.sensor, "true_object": made.object_name, "motion": made.motion, "seed": slot.seed}
    whole.unlink()
    with taking_the_place_of(done) as temporary:
        temporary.write_text(json.dumps(row))
    return row


def divide(recipe: Mapping[str, Any], whole: Path, folder: Path, name: str, sensor: str, *, presses: bool) -> Row:
    """Write a recording as an input without truth, and its truth apart; return what tables and digests need."""
    with open_recording(whole) as recording:
        arrays = input_arrays(recording, sensor)
        true = truth_arrays(recording, recipe, presses=presses)
        slices = len(recording)
    about = {"benchmark": recipe["name"], "benchmark_version": recipe["version"], "recording": name}
    digest = content_digest(arrays)
    recipe = Recipe("recording", METHOD, about, content=digest, simulated_source=True)
    write_stage(folder / "inputs" / f"{name}.recording.h5", recipe, arrays)
    with h5py.File(folder / "truth" / f"{name}.h5", "w") as file:
        for path, values in true.items():
            packed = {"compression": "gzip", "shuffle": True} if np.ndim(values) else {}
            file.create_dataset(path, data=values, **packed)
    return {
        "recording": name,
        "sensor": sensor,
        "slices": slices,
        "digest": hashlib.sha256(f"{digest} {content_digest(true)}".encode()).hexdigest(),
        "dots_ms": true["dots_ms"].tolist(),
        "force_ms": true["force_ms"].tolist(),
    }


def sensor_name(recipe: Mapping[str, Any], sensor: str) -> str:
    """Return the name of a sensor in the inputs, from which its parameters do not follow."""
    if not sensor.startswith("randomized:"):
        return sensor
    most = 1000
    names = np.random.default_rng(recipe["first_sensor"] + 1).permutation(most)
    return f"sensor-{names[int(sensor.partition(':')[2]) - recipe['first_sensor']]:03d}"


def input_arrays(recording: Recording, sensor: str) -> dict[str, Any]:
    """Return the datasets of a recording that are not truth, with another name of the sensor."""
    kept = {}
    for name in recording.contents():
        group, _, rest = name.partition("/")
        if group == "sensor" and rest not in SENSOR:
            continue
        if group not in ("truth", "capture") and name not in LEFT_OUT:
            kept[name] = recording.read(name)
    return {**kept, "sensor/name": sensor}


def truth_arrays(recording: Recording, recipe: Mapping[str, Any], *, presses: bool) -> dict[str, Any]:
    """Return what the scorer compares with: slip and contact in each ms, dots and forces at the instants judged."""
    slices = len(recording)
    dots_ms = np.arange(recipe["dots_every_ms"], slices, recipe["dots_every_ms"])
    true = {name: recording.read(f"truth/{name}") for name in TRUTH}
    onset = true_onset(recording) if recording.has("gripper") else None
    true["onset_ms"] = np.int64(-1 if onset is None else onset)
    true |= {"dots_ms": dots_ms, "dot_xy_px": recording.read("truth/dot_xy_px")[dots_ms]}
    if presses:
        force_ms = np.arange(recipe["force_every_ms"], slices, recipe["force_every_ms"])
        true |= {"force_ms": force_ms, "shear_force_n": recording.read("truth/shear_force_n")[force_ms]}
    else:
        true |= {"force_ms": np.zeros(0, np.int64), "shear_force_n": np.zeros((0, 2), np.float32)}
    return true


def _lift(recipe: Mapping[str, Any], slot: Slot, folder: Path) -> Row:
    """Write scene and object of a closed-loop lift; return its row."""
    texts, flags, object_name = benchmark_trials.lift_files(recipe, slot, folder / "truth" / "lifts")
    for name, text in texts.items():
        (folder / "truth" / "lifts" / f"{slot.name}.{name}.toml").write_text(text)
    return {"split": slot.split, "object": object_name, **flags}


def _tables(folder: Path, rows: Sequence[Row], lifts: Mapping[str, Row]) -> None:
    names = ("recording", "kind", "split", "sensor")
    write_csv(folder / "recordings.csv", names, ([row[name] for name in names] for row in rows))
    scales = sorted({(row["sensor"], row["mm_per_px"]) for row in rows})
    write_csv(folder / "sensors.csv", ("sensor", "mm_per_px"), scales)
    for task in ("dots", "force"):
        instants = ((row["recording"], ms) for row in rows for ms in row[f"{task}_ms"])
        write_csv(folder / "queries" / f"{task}.csv", ("recording", "ms"), instants)
    names = ("recording", "true_sensor", "true_object", "motion", "seed")
    write_csv(folder / "truth" / "recordings.csv", names, ([row[name] for name in names] for row in rows))
    (folder / "truth" / "lifts.json").write_text(json.dumps(lifts, indent=1) + "\n")


def write_csv(path: Path, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table as CSV."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([names, *rows])
