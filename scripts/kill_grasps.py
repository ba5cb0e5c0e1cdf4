"""Kill the detector of grasps in real time at random times, and print how long torque stayed on.

    python scripts/kill_grasps.py [--count 10] [--how kill|stop] [--watchdog-ms 60]

The grasps are virtual. Torque is read from outside: in the memory in which the virtual servo shows its registers
to the world, every half millisecond, by the clock by which the detector was killed (or stopped, as if it hung).
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evetac_cli.devices.virtual.servo_plant import SharedPlant
from evetac_cli.inspect import validate
from evetac_cli.store.read import open_recording

POLL_S = 5e-4
LONGEST_S = 5.0


def spawned(process: int) -> list[int]:
    """World, detector and controller of a grasp, once all three have been started."""
    children: list[str] = []
    for task in Path(f"/proc/{process}/task").iterdir():
        children += (task / "children").read_text().split()
    return sorted(int(pid) for pid in children if "multiprocessing-fork" in Path(f"/proc/{pid}/cmdline").read_text())


def plant_files(process: int) -> Iterator[str]:
    """Files of a virtual plant that a process has open; they have no name of their own."""
    for handle in Path(f"/proc/{process}/fd").iterdir():
        if "evetac-plant" in os.readlink(handle):
            yield str(handle)


def one(out: Path, how: signal.Signals, watchdog_ms: int, after_s: float) -> float:
    """Grasp, kill the detector so long after the first command; ms until torque was off, NaN if it stayed on."""
    command = [sys.executable, "-m", "evetac_cli", "grasp", "--camera", "virtual", "-q", "-o", str(out)]
    with subprocess.Popen([*command, "--watchdog-ms", str(watchdog_ms)], stderr=subprocess.PIPE, text=True) as grasp:
        while not out.with_name(out.name.replace(".h5", ".part")).joinpath("000000.h5").exists():
            if grasp.poll() is not None:
                raise SystemExit(f"the grasp did not start: {grasp.communicate()[1]}")
            time.sleep(0.01)
        world, detector, _ = spawned(grasp.pid)
        plant = SharedPlant(next(plant_files(world)))
        time.sleep(after_s)
        if not plant.goals().torque:
            raise SystemExit(f"it ended by itself: {grasp.communicate()[1]}")
        os.kill(detector, how)
        struck_s = time.monotonic()
        while plant.goals().torque and time.monotonic() < struck_s + LONGEST_S:
            time.sleep(POLL_S)
        passed_s = time.monotonic() - struck_s
        if how is signal.SIGSTOP:
            os.kill(detector, signal.SIGCONT)
        grasp.communicate()
    return passed_s * 1e3 if passed_s < LONGEST_S else float("nan")


def main() -> None:
    """Kill, wait for torque off, validate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--how", choices=("kill", "stop"), default="kill")
    parser.add_argument("--watchdog-ms", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    how = signal.SIGKILL if chosen.how == "kill" else signal.SIGSTOP
    passed_ms = []
    for trial in range(chosen.count):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "killed.recording.h5"
            passed_ms.append(one(out, how, chosen.watchdog_ms, rng.uniform(0.5, 8.0)))
            faults = validate.run([out]).rows[0]["faults"] or "valid"
            with open_recording(out) as file:
                print(f"{trial}: {passed_ms[-1]:.1f} ms, {len(file)} slices, {faults}: {file.read('capture/ended')}")
    print(
        f"{chosen.count} grasps (simulated): torque off after {np.median(passed_ms):.1f} ms, most {max(passed_ms):.1f}"
    )


if __name__ == "__main__":
    main()
