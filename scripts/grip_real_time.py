"""Run grasps in real time on virtual devices and the same grasps simulated; compare outcomes and lateness.

    python scripts/grip_real_time.py --seeds 0-19 -o rows.jsonl

A seed draws object and sensor as in grip_trials.py. The scene is `lift`, with the phases of these trials and without a
disturbance. `evetac grasp` runs each grasp twice with the same law, detector and threshold. The first run uses --camera
virtual --gripper virtual, in processes that keep real time; if the computer is too slow, the virtual world waits. The
second uses --camera sim. The noise of camera and gripper differs, so the results agree only as well as those of two
seeds. A row is written when its grasps end; existing rows are not made again. All results are simulated.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from grip_trials import BALANCE_S, LIFT_S, Drawn, drawn
from script_rows import add_rows, rows_in, seeds_of

from evetac_cli.jobs import Row
from evetac_cli.kernels.grip.control import LAWS
from evetac_cli.store.files import StageFile

DEVICES = {"real_time": ("--camera", "virtual", "--gripper", "virtual"), "simulated": ("--camera", "sim")}
SHOWN = ("balanced", "failure", "force_end_n", "over_holding_end", "moved_mm", "slip_events", "false_slip_events")
OBJECT_KEYS = ("static_friction", "mass_g", "width_mm", "height_mm", "lever_mm")


def object_text(one: Drawn) -> str:
    """Return the text of the --object file for a grasp's object."""
    touched = one.plan.touched
    assert touched is not None
    numbers = [f"{key} = {getattr(touched, key)!r}" for key in OBJECT_KEYS]
    return "\n".join((f'name = "drawn-{one.seed}"', f'shape = "{touched.shape}"', *numbers, ""))


def lateness(file: StageFile) -> Row:
    """Return how late slices were evaluated and steps begun, in us: median, 99th percentile and maximum."""
    paths = {name: f"capture/{name}_late_us" for name in ("slice", "step")}
    return {f"{name}_late_us": file.read(path).tolist() for name, path in paths.items() if file.has(path)}


def grasped(one: Drawn, law: str, how: str, folder: Path) -> Row:
    """Return the outcome of one grasp with these devices, or the error message if the command failed."""
    (folder / "object.toml").write_text(object_text(one))
    out = folder / f"{how}.recording.h5"
    words = [
        *("grasp", *DEVICES[how], "--controller", law, "--object", "object.toml", "--node-pitch-mm", "1.45"),
        *(("--model", "shipped") if law in LAWS else ()),
        *("--sensor", one.plan.sensor_name),
        *("--lift-s", f"{LIFT_S:g}", "--balance-s", f"{BALANCE_S:g}", "--seed", str(one.seed), "-q", "-o", str(out)),
    ]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "evetac_cli", *words], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode or not out.exists():
        return {"failed": done.stderr.strip()[-300:] or f"exit code {done.returncode}"}
    with StageFile(out, "recording") as file:
        row = json.loads(str(file.read("control/outcome")))
        return {**{name: row[name] for name in SHOWN}, **lateness(file)}


def main() -> None:
    """Run the missing grasps and print how many pairs ended alike."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--law", default="load-proportional")
    parser.add_argument("--seeds", type=seeds_of, default="0-19", help="FIRST-LAST")
    parser.add_argument("-o", "--out", type=Path, required=True, help="JSON lines, one per seed")
    chosen = parser.parse_args()
    seeds = chosen.seeds
    known = {row["seed"] for row in rows_in(chosen.out) if row["law"] == chosen.law}
    for seed in seeds:
        if seed in known:
            continue
        with tempfile.TemporaryDirectory() as folder:
            both = {how: grasped(drawn(seed), chosen.law, how, Path(folder)) for how in DEVICES}
        add_rows(chosen.out, [{"law": chosen.law, "seed": seed, **both}])
    rows = [row for row in rows_in(chosen.out) if row["law"] == chosen.law and row["seed"] in seeds]
    made = [row for row in rows if not any("failed" in row[how] for how in DEVICES)]
    alike = sum(row["real_time"]["balanced"] == row["simulated"]["balanced"] for row in made)
    sys.stdout.write(f"{alike} of {len(rows)} grasps ended alike in real time and simulated\n")


if __name__ == "__main__":
    main()
