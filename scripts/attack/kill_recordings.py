"""Kill recordings with SIGKILL at random times, repair what they left, and print how much was lost.

    python scripts/attack/kill_recordings.py [--count 100] [--busy 4] [--camera NAME] [--gripper none|virtual]

The camera plays prepared words unless --camera names another, such as replay:RECORDING. The loss is the time from the
last saved slice to the kill. The time between the start of the recorder and the first slice counts as lost too, so the
figure is an upper bound.

Exit code 1 if a recording could not be repaired, or if more than 0.5 s was lost (1 s with busy loops, --busy).
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from evetac_cli.events import SLICES_PER_S

CAMERA = "virtual:prepared=100000"
LONGEST_START_S = 120.0
BOUND_S, BUSY_BOUND_S = 0.5, 1.0
BUSY = "while True: pass"


def killed_after(seconds: float, camera: str, gripper: str, output: Path) -> float:
    """Start a recording and kill it a given time after its first file appeared; return its actual length in s."""
    arguments = ["record", "--camera", camera, "--gripper", gripper, "--seconds", "60"]
    arguments += ["--expected-event-rate", "1e5", "-q"]
    run = subprocess.Popen([sys.executable, "-P", "-m", "evetac_cli", *arguments, "-o", str(output)])
    first = output.with_suffix(".part") / "static.h5"
    deadline = time.monotonic() + LONGEST_START_S
    while not first.exists():
        if run.poll() is not None or time.monotonic() > deadline:
            run.kill()
            raise SystemExit(f"the recording did not start: {' '.join(arguments)}")
        time.sleep(0.002)
    began = time.monotonic()
    time.sleep(seconds)
    run.send_signal(signal.SIGKILL)
    ran_s = time.monotonic() - began
    run.wait()
    return ran_s


def one(seconds: float, camera: str, gripper: str) -> dict[str, Any]:
    """Kill one recording and repair it; return the kept and the lost time."""
    with tempfile.TemporaryDirectory() as name:
        output = Path(name) / "killed.recording.h5"
        ran_s = killed_after(seconds, camera, gripper, output)
        evetac = [sys.executable, "-P", "-m", "evetac_cli"]
        repair = [*evetac, "validate", "--repair", "--json", str(output.with_suffix(".part"))]
        done = subprocess.run(repair, capture_output=True, text=True, check=False)
        (row,) = json.loads(done.stdout)["rows"]
        repaired = done.returncode == 0 and row["status"] == "repaired" and output.exists()
        checked = subprocess.run([*evetac, "validate", str(output)], capture_output=True, check=False)
        valid = repaired and checked.returncode == 0
    kept_s = (row["slices_kept"] or 0) / SLICES_PER_S
    return {
        "ran_s": round(ran_s, 4),
        "status": row["status"],
        "valid": valid,
        "slices_kept": row["slices_kept"],
        "gripper_rows_kept": row["gripper_rows_kept"],
        "lost_s": round(ran_s - kept_s, 4),
    }


def main() -> None:
    """Kill, repair, validate and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--camera", default=CAMERA)
    parser.add_argument("--gripper", default="none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--busy", type=int, default=0, help="number of busy loops that run at the same time")
    chosen = parser.parse_args()
    rng = random.Random(chosen.seed)
    rows = []
    with ExitStack() as opened:
        for _ in range(chosen.busy):
            opened.callback(subprocess.Popen([sys.executable, "-P", "-c", BUSY]).kill)
        for trial in range(chosen.count):
            rows.append({"trial": trial, **one(rng.uniform(0.3, 3.0), chosen.camera, chosen.gripper)})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    lost_s = np.array([row["lost_s"] for row in rows])
    bound_s = BUSY_BOUND_S if chosen.busy else BOUND_S
    whole = {
        "camera": chosen.camera,
        "gripper": chosen.gripper,
        "busy_loops": chosen.busy,
        "trials": len(rows),
        "repaired_and_valid": sum(row["valid"] for row in rows),
        "lost_s_median": float(np.median(lost_s)),
        "lost_s_most": float(lost_s.max()),
        "bound_s": bound_s,
        "over_bound": int((lost_s > bound_s).sum()),
    }
    print(json.dumps(whole))
    if whole["over_bound"] or whole["repaired_and_valid"] < len(rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
