"""Check whether a refactoring changed any number: digests of all arrays that a set of commands makes.

    python scripts/digests.py NOW.json                              # 208 files, some 8 minutes on two cores
    python scripts/digests.py NOW.json --against scripts/digests.json
    python scripts/digests.py NOW.json --against scripts/digests.json --other-recipes   # arrays alone

The commands cover two trials of every scene, every sensor, tracker preset, label method and training preset, the demo,
force, RGB, and all grip laws.

A file's digest covers dtype, shape and bytes of its numeric arrays, sorted by name. Texts and ONNX graphs contain names
and are left out. The file's recipe id is stored next to the digest. With --against, the script prints each file that is
missing, new or different, and exits with 1 if there is one. Digests are valid for one type of machine.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
Commands = list[str]  # commands of one case, run one after the other in a folder of its name

RECORDED = ("slip", "shear", "press", "edge", "data-rate")
GRASPED = ("lift", "sideways", "drop-20g", "drop-100g")
GRID = "--node-pitch-mm 1.45"
PAPER = f"{GRID} --controller paper --model shipped"
LAWS = ("load-proportional", "paper-reset --model shipped", "none", "fixed:8")
SENSORS = ("small-dots", "second", "bare-dvxplorer", "soft-gel", "stiff-gel", "randomized:7")
TRAINED = (
    ("paper", "hist10"),
    ("paper", "fast-slow"),
    ("adamw", "no-hist-img-6x6"),
    ("adamw", "hist10"),
    ("adam", "hist10"),
)


def cases() -> Iterator[tuple[str, Commands]]:
    """Return the name of each case and its commands."""
    for scene in RECORDED:
        yield scene, [f"record --scene {scene} --count 2 --out ."]
    for scene in ("vibration", "vibration-randomized"):
        yield scene, [f"record --scene {scene} --tone 200 --count 2 --out ."]
    for scene in GRASPED:
        yield scene, [f"grasp --scene {scene} --object 16 {PAPER} --count 2 --out ."]
    for law in LAWS:
        name = law.partition(" ")[0].replace(":", "-")
        yield name, [f"grasp --object 11 {GRID} --controller {law} --balance-s 5 --out ."]
    for sensor in SENSORS:
        yield f"sensor-{sensor.replace(':', '-')}", [f"record --sensor {sensor} --out ."]
    yield "sensor-randomized", ["record --sensor randomized --seed 3 --count 2 --out ."]
    yield (
        "closed",
        [
            "record --gel closed --out .",
            f"grasp --gel closed --object 17 --sensor second {PAPER} --balance-s 3 --out .",
        ],
    )
    yield "stages", list(_stages())
    yield (
        "force",
        [
            "record --scene shear --seed 2 --out a.recording.h5",
            "record --scene shear --seed 3 --out b.recording.h5",
            "track a.recording.h5 b.recording.h5 --preset stable",
            "track a.recording.h5 b.recording.h5 --rgb --out rgb",
            "train-force a.tracks.h5 b.tracks.h5 --epochs 20 --out m.force-model.h5",
        ],
    )


def _stages() -> Iterator[str]:
    yield "record --object 3 --seed 5 --out a.recording.h5"
    for preset in ("stable", "paper", "official", "unregularised"):
        yield f"track a.recording.h5 --preset {preset} --out {preset}.tracks.h5"
    for method in ("event-flow", "farneback", "dis", "event-count", "truth"):
        yield f"label a.recording.h5 --method {method} --out {method}.labels.h5"
    yield "record --object 3 --seed 6 --out b.recording.h5"
    yield "track a.recording.h5 b.recording.h5"
    yield "label a.recording.h5 b.recording.h5"
    yield "featurize a.recording.h5 b.recording.h5 --images"
    yield "trim a.recording.h5 --from-ms 100 --to-ms 400 --out piece.recording.h5"
    for preset, model in TRAINED:
        how = f"--model {model} --preset {preset} --max-steps 60 --validate b.features.h5"
        yield f"train a.features.h5 {how} --out {preset}-{model}.model.h5"
    yield "evaluate vibration a.recording.h5 --windows 1 --out vib.report.h5"
    yield "evaluate labels a.labels.h5 --out lab.report.h5"
    yield "evaluate tracking a.tracks.h5 --out trk.report.h5"


def digest(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a file's numeric datasets, by name, and its recipe id."""
    arrays: dict[str, bytes] = {}

    def add(name: str, item: object) -> None:
        numbers = isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and not item.is_scale
        if numbers and not name.endswith("onnx"):
            values = np.ascontiguousarray(item[()])
            arrays[name] = f"{values.dtype} {values.shape} ".encode() + values.tobytes()

    with h5py.File(path) as file:
        file.visititems(add)
        recipe = json.loads(file.attrs["header"])["id"]
    whole = hashlib.sha256()
    for name in sorted(arrays):
        whole.update(f"{name} {hashlib.sha256(arrays[name]).hexdigest()}\n".encode())
    return {"arrays": whole.hexdigest()[:20], "recipe": recipe[:20]}


def make(folder: Path, only: list[str]) -> None:
    """Run the cases, two at a time; SystemExit with the messages of a command that fails."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }

    def call(arguments: list[str], into: Path) -> None:
        into.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(arguments, cwd=into, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{into.name}: {' '.join(arguments)}\n{done.stdout}{done.stderr}")

    def run(name: str, commands: Commands) -> None:
        for command in commands:
            call([sys.executable, "-P", "-m", "evetac_cli", *command.split(), "--quiet"], folder / name)
        print(name, file=sys.stderr)

    def demo() -> None:
        reproduce = [sys.executable, str(ROOT / "scripts" / "reproduce" / "run.py"), "--only", "demo"]
        results = ["--out", str(folder), "--results", str(folder / "results")]
        call([*reproduce, *results, "--jobs", "1"], folder)
        print("demo", file=sys.stderr)

    chosen = [case for case in cases() if not only or case[0] in only]
    if chosen:
        run(*chosen.pop(0))  # compiles most of it once
    with ThreadPoolExecutor(2) as pool:
        waiting = [pool.submit(demo)] if not only or "demo" in only else []
        waiting += [pool.submit(run, *case) for case in chosen]
        for each in waiting:
            each.result()


def main() -> int:
    """Make the files, write their digests, and compare them if requested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="JSON file: path of a file -> its digest and recipe id")
    parser.add_argument("--against", type=Path, help="stored digests to compare with")
    parser.add_argument("--other-recipes", action="store_true", help="allow other recipe ids")
    parser.add_argument("--only", nargs="+", default=[], help="cases to run, default: all")
    parser.add_argument("--folder", type=Path, help="where the files go; default: a new temporary folder")
    chosen = parser.parse_args()
    folder = (chosen.folder or Path(tempfile.mkdtemp(prefix="evetac-digests-"))).absolute()
    make(folder, chosen.only)
    now = {str(path.relative_to(folder)): digest(path) for path in sorted(folder.rglob("*.h5"))}
    chosen.out.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    if chosen.against is None:
        print(f"{len(now)} files")
        return 0
    kept = json.loads(chosen.against.read_text(encoding="utf-8"))
    if chosen.only:
        kept = {path: value for path, value in kept.items() if path.split("/")[0] in chosen.only}
    both = sorted(kept.keys() & now.keys())
    wrong = [f"{path}: missing" for path in sorted(kept.keys() - now.keys())]
    wrong += [f"{path}: new" for path in sorted(now.keys() - kept.keys())]
    for what in ("arrays", "recipe"):
        other = [path for path in both if kept[path][what] != now[path][what]]
        print(f"{what}: {len(both) - len(other)} of {len(both)} equal")
        if what == "arrays" or not chosen.other_recipes:
            wrong += [f"{path}: {what} different" for path in other]
    print(*wrong, sep="\n")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
