"""Record simulated sensors that all differ, to adapt and to evaluate touch maps on.

    python scripts/studies/sensors/recordings.py FOLDER --first 20000 --sensors 20

For each sensor randomized-narrow:N, 5 s each (10 s with --waypoints 4):

- N-adapt-0 to 11: a flat face, pressed with 6 to 20 N and sheared: one minute in total, to adapt on;
- N-shear-0, 1: the scene `shear` with fewer waypoints and 20 N of normal force, to evaluate on;
- N-disc: a disc of 16 mm, pressed with 10 N; N-slip: an object of the paper's table slips out of the grip (cut gel).

The script also writes scenes/evetac.toml: `shear-0` with eight waypoints, for the sensor on which the paper's method is
trained. Existing recordings are not made again.
"""

import argparse
from pathlib import Path
from typing import Any

from evetac_cli.commands.record import Record
from evetac_cli.sim.setup.scene_file import changed
from evetac_cli.trials import record

FLAT: dict[str, Any] = {}  # the face of the scene, 30 mm x 30 mm
DISC = {"size_mm": None, "radius_mm": 8.0}
# name of the trial: face, normal force and largest shear force in N
PRESSES = {
    "adapt-0": (FLAT, 20.0, 9.0),
    "adapt-1": (FLAT, 12.0, 7.0),
    "adapt-2": (FLAT, 6.0, 4.0),
    "adapt-3": (FLAT, 16.0, 8.0),
    "shear-0": (FLAT, 20.0, 9.0),
    "shear-1": (FLAT, 20.0, 9.0),
    "disc": (DISC, 10.0, 5.0),
}
FIRST_TRIALS = (*PRESSES, "slip")
PRESSES |= {f"adapt-{number}": PRESSES[f"adapt-{number % 4}"] for number in range(4, 12)}
TRIALS = (*FIRST_TRIALS, *(name for name in PRESSES if name not in FIRST_TRIALS))  # their seeds follow from their order
OBJECTS = 20
EVETAC_WAYPOINTS = 8


def scene_text(face: dict[str, Any], normal_n: float, shear_n: float, waypoints: int) -> str:
    """Return the scene `shear` with another face, other forces and fewer waypoints."""
    motion = {"normal_n": normal_n, "shear_n": shear_n, "count": waypoints, "offset_mm": 5.0 if face else 10.0}
    return changed("shear", {"name": "shear-short", "face": face, "motion": motion})


def make(scene_name: str, sensor: int, seed: int, objects: str, output: Path) -> None:
    """Record one trial, unless it exists."""
    chosen = Record(scene=scene_name, objects=objects, sensor=f"randomized-narrow:{sensor}", seed=seed)
    (trial,) = record.jobs([], chosen, output)
    record.run(trial, chosen)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0, help="number of the first sensor, and the first seed")
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument(
        "--trials", nargs="+", choices=TRIALS, default=TRIALS, help="record only these trials of each sensor"
    )
    parser.add_argument("--waypoints", type=int, default=2, help="positions that a face is moved to")
    chosen = parser.parse_args()
    scenes = chosen.folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    for name, press in PRESSES.items():
        (scenes / f"{name}.toml").write_text(scene_text(*press, chosen.waypoints))
    (scenes / "evetac.toml").write_text(scene_text(*PRESSES["shear-0"], EVETAC_WAYPOINTS))
    for number, name in enumerate(TRIALS):
        if name not in chosen.trials:
            continue
        for place in range(chosen.sensors):
            sensor, seed = chosen.first + place, chosen.first + chosen.sensors * number + place
            scene_name = "slip" if name == "slip" else str(scenes / f"{name}.toml")
            objects = str(1 + place % OBJECTS) if name == "slip" else "8"
            make(scene_name, sensor, seed, objects, chosen.folder / f"{sensor}-{name}.recording.h5")
            print(f"randomized-narrow:{sensor} {name}", flush=True)


if __name__ == "__main__":
    main()
