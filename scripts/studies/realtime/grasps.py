"""Measure how well a grasp keeps real time on virtual devices: prepared event words and a virtual gripper.

    python scripts/studies/realtime/grasps.py -o runs.jsonl  # five runs of 60 s at each rate
    python scripts/studies/realtime/grasps.py -o runs.jsonl --condition quiet busy half  # and under each condition
    python scripts/studies/realtime/grasps.py -o runs.jsonl --against CHECKOUT --runs 2 --seconds 15

A run is `evetac grasp --camera virtual:prepared --gripper virtual`: the real drivers, the shipped detector, the paper's
controller and the recorder, in their processes. The row of a run is appended to -o when it ends, as a line of JSON;
existing runs are not repeated. A row contains:

- whether the grasp lasted to its end, or the message with which it ended;
- how late slices are evaluated (from their end, in us) and steps begin;
- the latency from the first event of the slice with slip to the last byte of the command;
- missed commands, by evetac and because of late answers of the virtual gripper (its pseudo terminal, its process);
- the share of a core that each process used.

Before each run the script measures how late the machine itself wakes from sleeps of 1 ms, while this program is idle,
at the priority of the control loops. Before the first run under a condition, `evetac doctor speed` runs under the
same condition, and its estimate is stored in every row.

Conditions: quiet is this machine as it is; busy, with two loops that only compute; half, with each process held to half
its speed (conditions.py).

Latency needs slip, but the events are random. The detector's probability falls from 0.5 to 0.05 within some 5 s.
--slip-threshold 0.2 therefore classifies a few slices in a hundred as slip, as at the edge of slip. If every slice
slips, a step answers two slices, and its latency is that of the older.

--against runs another checkout in turns with this one, using only its commands. An older checkout may report less; its
rows lack these figures. Its prepared words may end after 30 s. Simulated.
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

from evetac_cli.commands.grasp import Grasp
from evetac_cli.console import print_table
from evetac_cli.inspect.doctor.speed import Computer
from evetac_cli.sim.setup import scene_file
from evetac_cli.store.files import StageFile
from scripts.studies.realtime.conditions import CONDITIONS, HalfSpeed, Watched, condition

HERE = Path(__file__).resolve().parents[3]
JITTER_S = 2.0
OVER = "the grasp is over"
SPREADS = {"latency": "latency_us", "slice_late": "slice_late_us", "step_late": "step_late_us"}
TIMES = ("slice_late_us_median", "slice_late_us_p99", "latency_us_median", "latency_us_p99")
SHOWN = (*TIMES, "missed_by_us", "missed_by_gripper", "missed")
Row = dict[str, Any]


def grid(folder: Path) -> Path:
    """Write a dot grid, as `calibrate` does."""
    x, y = np.meshgrid(60.0 * np.arange(8) + 60.0, 60.0 * np.arange(7) + 50.0)
    dots = np.stack([x, y], axis=-1).tolist()
    path = folder / "grid.json"
    path.write_text(json.dumps({"frame_px": [640, 480], "radius_px": 11.0, "dot_xy_px": dots}))
    return path


def jitter() -> dict[str, float]:
    """Measure how late the machine wakes from sleeps of 1 ms, in us, over all cores."""
    computer = Computer()
    cores = computer.cores()
    late_us = np.concatenate([computer.wake_ups_us(core, JITTER_S / len(cores)).late_us for core in cores])
    return {"jitter_us_p99": float(np.percentile(late_us, 99)), "jitter_us_most": float(late_us.max())}


def watched(
    checkout: Path, words: list[str], folder: Path, half: HalfSpeed | None
) -> tuple[int, str, str, dict[str, float]]:
    """Run a command of a checkout in a folder; return exit code, stdout, stderr and its processes' shares of a core."""
    command = [sys.executable, "-P", "-m", "evetac_cli", *words]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        watch = Watched(run, folder / "run.recording.part", half)
        out, message = run.communicate()
        return run.returncode, out, message, watch.shares()


def promise(checkout: Path, folder: Path, half: HalfSpeed | None) -> Row:
    """Return the problems found by a checkout's doctor speed, and its estimated events per second, if it has one."""
    code, out, message, _ = watched(checkout, ["doctor", "speed", "--json"], folder, half)
    try:
        result = json.loads(out)
    except ValueError:
        return {"doctor": f"exit code {code}: {message.strip()[-300:]}"}
    wrong = [f"{row['device']} {row['check']}" for row in result["rows"] if row["ok"] is False]
    row: Row = {"doctor": f"wrong: {', '.join(wrong)}" if wrong else "fine in every line"}
    if "judged_events_per_s" in result["summary"]:
        row["doctor_events_per_s"] = result["summary"]["judged_events_per_s"]
    return row


def one(checkout: Path, plan: Row, folder: Path, half: HalfSpeed | None) -> Row:
    """Run one grasp with a checkout's commands; return its figures, if there is a recording."""
    phases_s = plan["seconds"] - scene_file.load(Grasp.scene).time.touch_s
    lift_s = phases_s / 2
    out = folder / "run.recording.h5"
    words = [
        *("grasp", "--camera", f"virtual:prepared={plan['events_per_s']}", "--gripper", "virtual"),
        *("--controller", "paper", "--model", "shipped"),
        *("--calibration", str(grid(folder)), "--slip-threshold", f"{plan['slip_threshold']:g}"),
        *("--lift-s", f"{lift_s:g}", "--balance-s", f"{phases_s - lift_s:g}"),
        *("--max-seconds", f"{2 * plan['seconds']:g}"),
        *("-q", "--force", "-o", str(out)),
    ]
    row: Row = {**jitter(), "load_before": os.getloadavg()[0]}
    code, _, message, shares = watched(checkout, words, folder, half)
    row |= {"load_after": os.getloadavg()[0], "exit_code": code, "message": message.strip()[-600:]}
    row["cpu_shares"] = shares
    if not out.exists():
        return {**row, "lasted": False, "ended": "no recording was made"}
    with StageFile(out, "recording") as file:
        row |= figures(file, plan["slip_threshold"])
    out.unlink()
    return {**row, "lasted": row["ended"] == OVER and code == 0}


def figures(file: StageFile, slip_threshold: float) -> Row:
    """Return the timing figures of a recording."""
    row: Row = {"ended": str(file.read("capture/ended")), "scheduling": str(file.read("capture/scheduling"))}
    for name in ("slices_per_s", "commands_per_s"):
        if file.has(f"capture/{name}"):
            row[name] = float(file.read(f"capture/{name}"))
    for name, path in SPREADS.items():
        if file.has(f"capture/{path}"):
            median, p99, most = file.read(f"capture/{path}").tolist()
            row |= {f"{name}_us_median": median, f"{name}_us_p99": p99, f"{name}_us_most": most}
    latency_us = file.read("control/latency_us")[file.read("control/phase") > 0]
    row |= {"latencies": int(np.isfinite(latency_us).sum()), "commands": len(file.read("control/late_us"))}
    row["slices"] = len(file.read("control/probability"))
    row["slip_share"] = float(np.mean(file.read("control/probability") >= slip_threshold))
    if file.has("capture/command_misses"):
        row["missed"] = int(file.read("capture/command_misses"))
    if file.has("capture/command_misses_by_gripper"):
        row["missed_by_gripper"] = int(file.read("capture/command_misses_by_gripper"))
        row["missed_by_us"] = row["missed"] - row["missed_by_gripper"]
        row["early_commands"] = int((file.read("control/early_goal_ticks") >= 0).sum())
    return row


def plans(chosen: argparse.Namespace, checkouts: list[Path]) -> list[Row]:
    """Return the runs in order: under each condition first doctor, then all rates in turn, run by run."""
    made: list[Row] = []
    for name in chosen.condition:
        where = [{"checkout": checkout.name, "condition": name} for checkout in checkouts]
        made += [{"what": "doctor", **each} for each in where if not chosen.no_doctor]
        how = {"seconds": chosen.seconds, "slip_threshold": chosen.slip_threshold}
        made += [
            {"what": "grasp", **each, "events_per_s": rate, **how, "run": run}
            for run in range(chosen.runs)
            for rate in chosen.events_per_s
            for each in where
        ]
    return made


def known_row(plan: Row, rows: list[Row]) -> Row | None:
    """Return the existing row of a run, if there is one."""
    return next((row for row in rows if plan.items() <= row.items()), None)


def summary(rows: list[Row]) -> list[Row]:
    """Return a row per checkout, condition and rate: how many runs lasted, medians, and doctor's estimate."""
    table = []
    cases = dict.fromkeys((row["condition"], row["events_per_s"], row["checkout"]) for row in rows)
    for case in cases:
        ours = [row for row in rows if (row["condition"], row["events_per_s"], row["checkout"]) == case]
        known = {name: [row[name] for row in ours if name in row] for name in SHOWN}
        shown = dict(zip(("condition", "events_per_s", "checkout"), case, strict=True))
        shown["lasted"] = f"{sum(row['lasted'] for row in ours)} of {len(ours)}"
        shown |= {name: float(np.median(values)) for name, values in known.items() if values}
        shown["doctor"] = ours[-1].get("doctor_events_per_s", ours[-1].get("doctor"))
        table.append(shown)
    return table


def main() -> None:
    """Run, write rows, and print medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--against", type=Path, help="another checkout, run in turns with this one")
    parser.add_argument("--events-per-s", type=int, nargs="+", default=[100_000, 300_000, 1_000_000])
    parser.add_argument("--condition", choices=CONDITIONS, nargs="+", default=["quiet"])
    parser.add_argument("--slip-threshold", type=float, default=0.2)
    parser.add_argument("--no-doctor", action="store_true", help="do not run doctor speed")
    parser.add_argument("-o", "--out", type=Path, help="JSON lines, one per run; existing runs are not repeated")
    chosen = parser.parse_args()
    checkouts = [HERE, *([chosen.against.resolve()] if chosen.against else [])]
    by_name = {checkout.name: checkout for checkout in checkouts}
    if len(by_name) < len(checkouts):
        raise SystemExit("--against: expected a checkout in a folder with another name")
    lines = chosen.out.read_text().splitlines() if chosen.out is not None and chosen.out.exists() else []
    known = [json.loads(line) for line in lines]
    doctor: dict[tuple[str, str], Row] = {}
    rows = []
    for plan in plans(chosen, checkouts):
        row = known_row(plan, known)
        if row is None:
            with tempfile.TemporaryDirectory() as folder, condition(plan["condition"]) as half:
                checkout = by_name[plan["checkout"]]
                if plan["what"] == "doctor":
                    row = {**plan, **promise(checkout, Path(folder), half)}
                else:
                    message = doctor.get((plan["checkout"], plan["condition"]), {})
                    row = {**plan, **one(checkout, plan, Path(folder), half), **message}
            print(json.dumps(row), file=sys.stderr, flush=True)
            if chosen.out is not None:
                with chosen.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
        if plan["what"] == "doctor":
            message = {name: value for name, value in row.items() if name.startswith("doctor")}
            doctor[plan["checkout"], plan["condition"]] = message
        else:
            rows.append(row)
    print_table(f"grasp in real time, {chosen.seconds:g} s, medians of the runs", summary(rows), {}, simulated=True)


if __name__ == "__main__":
    main()
