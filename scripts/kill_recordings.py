"""Kill recordings with SIGKILL at random times, repair what they left, and print how much was lost.

    python scripts/kill_recordings.py RECORDING [--count 40] [--gripper none|virtual] [--camera NAME]

A recording is replayed in real time as if it were a camera (or --camera names another). The loss is counted from the
moment of the kill back to the last slice that was saved; what passed between the start of the recorder and the first
slice counts as lost, so the figure is an upper bound.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LONGEST_START_S = 60.0


def killed_after(seconds: float, camera: str, gripper: str, output: Path) -> float:
    """Start a recording, kill it so long after its first file appeared; returns how long it really ran, in s."""
    arguments = ["record", "--camera", camera, "--gripper", gripper, "--seconds", "60"]
    arguments += ["--expected-event-rate", "1e5", "-q"]
    run = subprocess.Popen([sys.executable, "-m", "evetac_cli", *arguments, "-o", str(output)])
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


def main() -> None:
    """Kill, repair, validate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--camera", default=None)
    parser.add_argument("--gripper", default="none")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rng = random.Random(chosen.seed)
    camera = chosen.camera or f"replay:{chosen.recording}"
    lost_s: list[float] = []
    repaired = 0
    for trial in range(chosen.count):
        with tempfile.TemporaryDirectory() as name:
            output = Path(name) / "killed.recording.h5"
            ran_s = killed_after(rng.uniform(0.3, 3.0), camera, chosen.gripper, output)
            command = [sys.executable, "-m", "evetac_cli", "repair", "--json", str(output.with_suffix(".part"))]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            (row,) = json.loads(done.stdout)["rows"]
            good = done.returncode == 0 and row["status"] == "repaired" and output.exists()
            repaired += good
            lost_s.append(ran_s - (row["slices_kept"] or 0) / 1000)
            saved = f"{row['slices_kept']} slices, {row['gripper_rows_kept']} gripper rows"
            print(
                f"{trial + 1:3d}: ran {ran_s:.3f} s, {row['status']}, kept {saved}, lost {lost_s[-1]:.3f} s", flush=True
            )
    print(f"repaired {repaired} of {chosen.count}, lost at most {max(lost_s):.3f} s")


if __name__ == "__main__":
    main()
