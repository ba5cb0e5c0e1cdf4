"""Start two different runs onto one output at once, again and again, and count how they end.

    python scripts/attack/two_runs.py [--pairs 20] [--only track,train]

Of two runs with different flags one makes the output, and the other is refused in words, with exit code 2. Exit code 1
if in any pair both say that they made it, since then one result is gone, or if anything else is left in the folder.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

EVETAC = (sys.executable, "-P", "-m", "evetac_cli")
SCENE = ("record", "--object", "11", "--count", "3", "--seed", "1", "-q")
# Command, with "-" and a word if it has several pairs: arguments, and what differs between the two runs.
PAIRS: dict[str, tuple[list[str], list[str], list[str]]] = {
    "track": (["RECORDING", "-o", "out.tracks.h5"], [], ["--preset", "paper"]),
    "label": (["RECORDING", "-o", "out.labels.h5"], ["--method", "truth"], ["--method", "truth", "--after-ms", "7"]),
    "featurize": (["RECORDING", "-o", "out.features.h5"], [], ["--images"]),
    "train": (["FEATURES", "-o", "out.model.h5", "--max-steps", "20"], [], ["--horizon-ms", "5"]),
    "export": (["RECORDING", "-o", "out.txt", "--format", "text"], [], []),
    "export-different": (["RECORDING", "-o", "out.npz"], ["--format", "frames"], ["--format", "voxels"]),
}


def prepare(folder: Path) -> dict[str, str]:
    """Make recordings, tracks, labels and features, and return the path of the first of each kind, or of all."""
    for arguments in (
        [*SCENE, "-o", str(folder)],
        ["track", str(folder), "-q"],
        ["label", str(folder), "--method", "truth", "-q"],
        ["featurize", str(folder), "-q"],
    ):
        subprocess.run([*EVETAC, *arguments], check=True)
    return {"RECORDING": str(min(folder.glob("*.recording.h5"))), "FEATURES": str(folder)}


def pair(command: str, places: dict[str, str], folder: Path) -> tuple[str, str]:
    """Run a pair in an empty folder, and return in words how it ended, and what else is left."""
    arguments, *different = PAIRS[command]
    runs = [
        subprocess.Popen(
            [*EVETAC, command.partition("-")[0], *(places.get(one, one) for one in [*arguments, *flags]), "--json"],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for flags in different
    ]
    ends = []
    for run in runs:
        shown, error = run.communicate()
        if run.returncode == 0:
            ends.append(json.loads(shown)["rows"][0].get("status", "made"))
        else:
            is_refusal = run.returncode == 2 and b"the output exists" in shown + error
            ends.append("refused" if is_refusal else f"exit code {run.returncode}")
    left = [one.name for one in folder.iterdir() if one.suffix not in (".h5", ".txt", ".csv", ".npz")]
    return " + ".join(sorted(ends)), ", ".join(left)


def main() -> int:
    """Run all pairs and print a line for each command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--only", default=",".join(PAIRS))
    options = parser.parse_args()
    is_right = True
    with tempfile.TemporaryDirectory() as name:
        places = prepare(Path(name))
        for command in options.only.split(","):
            ends: Counter[str] = Counter()
            for _ in range(options.pairs):
                with tempfile.TemporaryDirectory() as empty:
                    how, left = pair(command, places, Path(empty))
                    ends[how + (f"; left: {left}" if left else "")] += 1
            print(f"{command}: {options.pairs} pairs: {dict(ends)}", flush=True)
            is_right &= set(ends) == {"made + refused"}
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
