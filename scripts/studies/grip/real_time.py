"""Run grasps in real time on virtual devices and the same grasps simulated; make the table `grip-real-time`.

    python scripts/studies/grip/real_time.py --seeds 0-19 --rows FILE

A seed draws object and sensor as in trials.py. The scene is `lift`, with the phases of these trials and without a
disturbance, on the coarsest grid of nodes, so that two cores keep real time. `evetac grasp` runs each grasp twice with
the same law, detector and threshold: with --camera virtual --gripper virtual, in processes that keep real time (if the
computer is too slow, the virtual world waits), and with --camera sim. The noise of camera and gripper differs, so the
results agree only as well as those of two seeds. A row is written when its grasps end; existing rows are not made
again. All results are simulated.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from evetac_cli.jobs import Row, Rows
from evetac_cli.store.files import StageFile
from scripts.reproduce.facts import RESULTS
from scripts.reproduce.made_tables import table_of, write
from scripts.studies.grip.trials import BALANCE_S, LIFT_S, Drawn, drawn
from scripts.studies.rows import add_rows, rows_in, seeds_of

DEVICES = {"virtual devices, in real time": ("--camera", "virtual", "--gripper", "virtual"), "simulated": ()}
OBJECT_KEYS = ("static_friction", "mass_g", "width_mm", "height_mm", "lever_mm")
SHOWN = ("balanced", "failure", "force_end_n", "over_holding_end", "moved_mm", "slip_events", "false_slip_events")
COLUMNS = {
    "grasps": "{grasps}",
    "made": "{made}",
    "kept": "{kept}",
    "ended as the other": "{alike}",
    "force at the end over what just holds, median": "{over_holding_end:.2f}",
    "moved, median [mm]": "{moved_mm:.2f}",
    "reactions per grasp": "{slip_events:.1f}",
    "slices late, median [ms]": "{late_ms:.2f}",
    "most": "{late_ms_most:.1f}",
}


def object_text(one: Drawn) -> str:
    """Return the text of the --object file for a grasp's object."""
    touched = one.plan.object
    assert touched is not None
    numbers = [f"{key} = {getattr(touched, key)!r}" for key in OBJECT_KEYS]
    return "\n".join((f'name = "drawn-{one.seed}"', f'shape = "{touched.shape}"', *numbers, ""))


def grasped(one: Drawn, how: str, folder: Path) -> Row:
    """Return the outcome of one grasp with these devices; raise CalledProcessError if the command fails."""
    (folder / "object.toml").write_text(object_text(one))
    out = folder / f"{how.partition(' ')[0]}.recording.h5"
    words = [
        *("grasp", *DEVICES[how], "--object", "object.toml", "--sensor", one.plan.sensor_name),
        *(
            "--node-pitch-mm",
            "1.45",
            "--lift-s",
            f"{LIFT_S:g}",
            "--balance-s",
            f"{BALANCE_S:g}",
            "--seed",
            str(one.seed),
            "-q",
            "-o",
            str(out),
        ),
    ]
    subprocess.run([sys.executable, "-P", "-m", "evetac_cli", *words], cwd=folder, check=True)
    with StageFile(out, "recording") as file:
        row = json.loads(str(file.read("control/outcome")))
        late = file.read("capture/slice_late_us").tolist() if file.has("capture/slice_late_us") else []
        return {**{name: row[name] for name in SHOWN}, "slice_late_us": late}


def shown(rows: Rows, how: str) -> Row:
    """Return the row of the table for these devices."""
    some = [row[how] for row in rows]

    def median(name: str) -> float:
        return float(np.median([one[name] for one in some if one[name] is not None]))

    row = {
        "grasps": how,
        "made": len(some),
        "kept": sum(one["balanced"] for one in some),
        "alike": sum(len({row[name]["balanced"] for name in DEVICES}) == 1 for row in rows),
        "slip_events": float(np.mean([one["slip_events"] for one in some])),
        **{name: median(name) for name in ("over_holding_end", "moved_mm")},
    }
    late_ms = np.array([one["slice_late_us"] for one in some if one["slice_late_us"]]) / 1000
    if len(late_ms):
        row |= {"late_ms": float(np.median(late_ms[:, 0])), "late_ms_most": float(late_ms[:, -1].max())}
    return row


def main() -> None:
    """Run the missing grasps and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, required=True, help="FIRST-LAST")
    parser.add_argument("--rows", type=Path, required=True, help="JSON lines, one per seed")
    chosen = parser.parse_args()
    for seed in sorted(set(chosen.seeds) - {row["seed"] for row in rows_in(chosen.rows)}):
        one = drawn(seed)
        with tempfile.TemporaryDirectory() as folder:
            add_rows(chosen.rows, [{"seed": seed, **{how: grasped(one, how, Path(folder)) for how in DEVICES}}])
    rows = [row for row in rows_in(chosen.rows) if row["seed"] in chosen.seeds]
    seeds = f"{chosen.seeds[0]}-{chosen.seeds[-1]}"
    title = "The same law, detector and threshold in real time and simulated"
    command = f"python scripts/studies/grip/real_time.py --seeds {seeds} --rows FILE"
    cells = [shown(rows, how) for how in DEVICES]
    write(RESULTS, table_of("grip-real-time", title, COLUMNS, cells, command, {"seeds": seeds}))


if __name__ == "__main__":
    main()
