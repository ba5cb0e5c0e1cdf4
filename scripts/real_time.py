"""How well a grasp in real time keeps its time, with virtual devices: prepared event words and a virtual gripper.

    python scripts/real_time.py [--seconds 60] [--runs 5] [--against CHECKOUT] [-o runs.json]

A run is `evetac grasp --camera virtual:prepared --gripper virtual`: the real drivers, the shipped detector, the paper's
controller and the recorder, in their processes. For each it prints slices and commands a second; latency from the first
event of the slice with slip to the last byte of the command; how late slices are evaluated (from their end, in us) and
steps begin; commands missed. Before each run it measures how late the machine itself wakes from sleeps of 1 ms, while
this program does nothing else, at the loops' priority.

Latency needs slip, and the events are at random. The detector's probability falls from 0.5 to 0.05 in some 5 s;
--slip-threshold 0.2 calls slip what lies above it, after that some slices in a hundred, as at the edge of slip. Where
every slice slips, a step answers two, and its latency is that of the older.

--against runs another checkout in turns with this one, of which only the commands are used. Its prepared words may end
after 30 s. Simulated.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.console import print_table
from evetac_cli.inspect.doctor.speed import Computer
from evetac_cli.store.files import StageFile

HERE = Path(__file__).resolve().parents[1]
TOUCH_S = 1.5  # of the scene `lift`, before the law reacts to slip
JITTER_S = 2.0
SPREADS = {"latency": "latency_us", "slice_late": "slice_late_us", "step_late": "step_late_us"}
MEDIANS = ("slices_per_s", "commands_per_s", "latency_us_median", "latency_us_p99", "missed")


def grid(folder: Path) -> Path:
    """A dot grid, as `calibrate` writes it."""
    x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
    dots = np.stack([x, y], axis=-1).tolist()
    path = folder / "grid.json"
    path.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots}))
    return path


def jitter() -> dict[str, float]:
    """How late the machine wakes from sleeps of 1 ms, in us, over all cores."""
    computer = Computer()
    cores = computer.cores()
    late_us = np.concatenate([computer.wake_ups_us(core, JITTER_S / len(cores)).late_us for core in cores])
    return {"jitter_us_p99": float(np.percentile(late_us, 99)), "jitter_us_most": float(late_us.max())}


def one(checkout: Path, chosen: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One grasp by the commands of a checkout, from the figures of its recording."""
    phases_s = chosen.seconds - TOUCH_S
    lift_s = phases_s / 2
    out = folder / "run.recording.h5"
    words = [
        *("--camera", f"virtual:prepared={chosen.events_per_s}", "--gripper", "virtual"),
        *("--calibration", str(grid(folder)), "--slip-threshold", f"{chosen.slip_threshold:g}"),
        *("--lift-s", f"{lift_s:g}", "--balance-s", f"{phases_s - lift_s:g}"),
        *("--max-seconds", f"{2 * chosen.seconds:g}"),
        *("-q", "--force", "-o", str(out)),
    ]
    measured: dict[str, Any] = {"checkout": checkout.name, **jitter()}
    command = [sys.executable, "-P", "-m", "evetac_cli", "grasp", *words]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    if not out.exists():
        raise SystemExit(f"no recording was made: {done.stderr}")
    with StageFile(out, "recording") as file:
        late = file.read("control/late_us")
        for name in ("slices_per_s", "commands_per_s"):
            measured[name] = float(file.read(f"capture/{name}"))
        for name, path in SPREADS.items():
            if file.has(f"capture/{path}"):
                median, p99, most = file.read(f"capture/{path}").tolist()
                measured |= {f"{name}_us_median": median, f"{name}_us_p99": p99, f"{name}_us_most": most}
        contact = file.read("control/phase") == 0
        latency_us = file.read("control/latency_us")[~contact]
        measured["latencies"] = int(np.isfinite(latency_us).sum())
        measured["slip_share"] = float(np.mean(file.read("control/probability") >= chosen.slip_threshold))
        measured |= {"commands": len(late), "missed": int(file.read("capture/command_misses"))}
        measured |= {"ended": str(file.read("capture/ended")), "scheduling": str(file.read("capture/scheduling"))}
    out.unlink()
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--against", type=Path, help="another checkout, run in turns with this one")
    parser.add_argument("--events-per-s", type=int, default=1_000_000)
    parser.add_argument("--slip-threshold", type=float, default=0.2)
    parser.add_argument("-o", "--out", type=Path, help="all runs as JSON")
    chosen = parser.parse_args()
    checkouts = [HERE, *([chosen.against.resolve()] if chosen.against else [])]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(chosen.runs):
            for checkout in checkouts:
                rows.append(one(checkout, chosen, Path(folder)))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    medians = []
    for checkout in checkouts:
        ours = [row for row in rows if row["checkout"] == checkout.name]
        known = {name: [row[name] for row in ours if name in row] for name in MEDIANS}
        figures = {name: float(np.median(values)) for name, values in known.items() if values}
        medians.append({"checkout": checkout.name, "runs": len(ours), **figures})
    print_table(f"grasp in real time, {chosen.seconds:g} s, median of the runs", medians, {}, simulated=True)
    if chosen.out:
        chosen.out.write_text(json.dumps({"settings": vars(chosen) | {"against": None, "out": None}, "runs": rows}))


if __name__ == "__main__":
    main()
