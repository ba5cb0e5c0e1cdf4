"""Figures of the paper on its own sensor, `evetac`: force, sliding and grasps; tables of docs/evidence/likeness.md.

    python scripts/studies/likeness/paper_sensor.py force FOLDER        # forces by each tracker and model, and by RGB
    python scripts/studies/likeness/paper_sensor.py slip FOLDER         # timing, and how long a detector stays on
    python scripts/studies/likeness/paper_sensor.py grasps FOLDER --jobs 2

FOLDER has what the experiments made: `run.py --only force` and `--only paper-recipe` with `--out FOLDER` and the seeds
of docs/results/likeness/paper-sensor.json, where the rows are stored. A row that is there is not measured again. All
results are simulated; the detector is one `fast-slow` by the paper's recipe, 10 ms ahead in grasps as in the paper.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evetac_cli.evaluate.slip.models import Model
from evetac_cli.jobs import Row, Rows
from evetac_cli.kernels.estimates import cluster_weights, ratio_of_clusters
from evetac_cli.stages.slip_detectors import predict, read_trajectory
from evetac_cli.store.files import StageFile
from evetac_cli.store.recordings.read import open_recording
from scripts.reproduce.facts import commit_facts
from scripts.reproduce.perform import Running, evaluate, run_command
from scripts.reproduce.steps import evetac
from scripts.studies.likeness.paper_sensor_tables import DOTS, GRASPS, PATH, SEED, SPEEDS_MM_S, read

DETECTOR = "models/nothing/fast-slow-10ms.model.h5"
PAPERS = ("--controller", "paper", "--tracker", "paper", "--model")
TRIALS = 10


def keep(group: str, rows: Rows, about: Row) -> None:
    """Store the rows of a group, with the commit at which they were measured."""
    made = {key: value for key, value in commit_facts().items() if key in ("commit", "default_sensor")}
    stored = read() | {"default_sensor": made["default_sensor"], group: {**made, **about, "rows": rows}}
    PATH.write_text(json.dumps(stored, indent=1) + "\n")


def force_rows(folder: Path) -> Iterator[Row]:
    """Yield the errors of each tracker's dots and model on `evetac`: means over trajectories, with their intervals."""
    for dots in DOTS:
        files = sorted(map(str, folder.glob(f"unseen/{dots}/*.tracks.h5")))
        words = evetac("evaluate", "force", *files, "--model", f"models/{dots}", "--seed", SEED)
        rows = evaluate(dots, words, folder, Running()).rows
        for model in ("regression", "network"):
            mine = [row for row in rows if row.get("model") == model and row.get("file")]
            found: Row = {"dots": dots, "model": model, "trajectories": len({row["file"] for row in mine})}
            for axis in "xy":
                errors = np.array([row[f"mae_n_{axis}"] for row in mine])
                weights = cluster_weights([row["file"] for row in mine])
                estimate = ratio_of_clusters(errors, np.ones(len(errors)), weights)
                assert estimate is not None
                found |= {f"mae_n_{axis}": estimate.value, f"mae_n_{axis}_interval": [estimate.low, estimate.high]}
            yield found


def sliding(features: Path, recording: Path, model: Model) -> Iterator[tuple[int, bool]]:
    """Yield, for each ms from gross slip to the loss of contact, its place in SPEEDS_MM_S and the detection."""
    with StageFile(features, "features") as file:
        header = file.header
    (found,) = predict([model.detector()], read_trajectory(features, model.architecture), header, model.horizon_ms)
    with open_recording(recording) as file:
        slips, object_px = file.read("truth/slip"), file.read("truth/object_xy_px")
        mm_per_px = file.header["parameters"]["sensor_row"]["mm_per_px"]
        force_n = file.read("truth/normal_force_n")
    speeds_mm_s = np.abs(np.gradient(np.linalg.norm(object_px, axis=1))) * mm_per_px * 1e3
    places = np.searchsorted(SPEEDS_MM_S, speeds_mm_s, side="right") - 1
    gross = np.flatnonzero(slips)
    for at in range(gross[0], len(slips)) if len(gross) else ():
        if not np.isnan(found.probability[at]) and force_n[at] > 0.0:
            yield int(places[at]), bool(found.probability[at] >= model.threshold)


def slip_rows(folder: Path) -> Iterator[Row]:
    """Yield timing and F1 of both networks on known and unseen objects, and how long each stays on by sliding speed."""
    for path in sorted(folder.glob("models/nothing/fast-slow*.model.h5")):
        model = Model.read(path)
        for role in ("known", "unseen"):
            files = sorted(folder.glob(f"nothing/{role}/*.features.h5"))
            words = evetac("evaluate", "slip", *files, "--model", path, "--recordings", f"recordings/{role}")
            rows = evaluate(f"{path.name}-{role}", words, folder, Running()).rows
            (whole,) = (row for row in rows if "slip_correct_sd" in row)
            (first,) = (row for row in rows if "10_to_0_ms_ahead" in row and "pairs_counted" in row)
            counts = np.zeros((len(SPEEDS_MM_S), 2), int)
            for file in files:
                name = file.name.replace(".features.", ".recording.")
                for place, detected in sliding(file, folder / "recordings" / role / name, model):
                    counts[place] += (detected, 1)
            kept = {key: whole[key] for key in ("trajectories", "slip_correct", "slip_early", "slip_late", "f1")}
            kept |= {key: whole[key] for key in whole if key.endswith(("_low", "_high")) and key[:2] in ("sl", "f1")}
            kept["first_10_to_0_ms"] = first["10_to_0_ms_ahead"]
            yield {"horizon_ms": model.horizon_ms, "objects": role, **kept, "detected_ms": counts.tolist()}


def grasp_rows(folder: Path, jobs: int) -> Iterator[Row]:
    """Yield how many of ten objects the paper's controller and detector keep, and how far they move."""
    for number, (name, (flags, _)) in enumerate(GRASPS.items()):
        out = f"grasps/{number}"
        named = ("--count", TRIALS, "--seed", SEED, "--jobs", jobs, "--out", out, "--quiet")
        code, _ = run_command(evetac("grasp", *flags, *PAPERS, DETECTOR, *named), folder)
        if code:
            raise SystemExit(f"{name}: exit code {code}")
        files = sorted(map(str, (folder / out).glob("*.recording.h5")))
        rows = evaluate(out, evetac("evaluate", "grasp", *files), folder, Running()).rows
        each = [row for row in rows if row.get("file")]
        nodes = [row["slip_half_wavelength_nodes"] for row in each]
        moved = [row["moved_lift_mm"] for row in each if row["balanced"]]
        yield {
            "name": name,
            "trials": len(each),
            "lifted": sum(bool(row["lifted"]) for row in each),
            "kept": sum(bool(row["balanced"]) for row in each),
            "moved_lift_mm_median": float(np.median(moved)) if moved else None,
            "moved_mm": [row["moved_mm"] for row in each],
            "slip_half_wavelength_nodes": min(filter(None, nodes), default=None),
        }


def main() -> None:
    """Measure the rows of one group, unless they are there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("group", choices=("force", "slip", "grasps"))
    parser.add_argument("folder", type=Path, help="folder of the experiment's files")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.group in read():
        sys.exit(f"{PATH} has the rows of {chosen.group}; delete them to measure them again")
    folder = chosen.folder.resolve()
    measures = {"force": force_rows, "slip": slip_rows}
    rows = grasp_rows(folder, chosen.jobs) if chosen.group == "grasps" else measures[chosen.group](folder)
    keep(chosen.group, list(rows), {"seed": SEED})


if __name__ == "__main__":
    main()
