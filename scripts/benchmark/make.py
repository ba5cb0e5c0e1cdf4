"""Make evetac-bench, the benchmark of evetac that can be given away, from scripts/benchmark/recipe.toml.

    python scripts/benchmark/make.py make --size small --out bench-small --jobs 2
    python scripts/benchmark/make.py digests bench-full

`make` simulates the trials of a size and writes the folder, which `evetac evaluate benchmark` scores. `digests`
compares the recordings of a folder with the digests in scripts/benchmark/, or writes them with --write. An interrupted
`make` goes on where it ended. All is simulated.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from scripts.benchmark import files
from scripts.benchmark.trials import RECIPE


def digests_path(size: str) -> Path:
    """Return the file of the digests of a size."""
    return RECIPE.with_name(f"digests-{size}.json")


def compare(folder: Path, *, write: bool) -> None:
    """Compare the digests of a folder with those in the repository; SystemExit if they differ."""
    about: dict[str, Any] = json.loads((folder / "benchmark.json").read_text())
    path = digests_path(about["size"])
    if write:
        path.write_text(json.dumps(about, indent=1) + "\n")
        sys.stdout.write(f"{path}\n")
        return
    if not path.exists():
        raise SystemExit(f"{path}: no digests of this size are stored; --write writes them")
    known = json.loads(path.read_text())
    if known["recipe_sha256"] != about["recipe_sha256"]:
        raise SystemExit(f"{folder}: expected the recipe {known['recipe_sha256'][:12]} of {path}, found another one")
    there, ours = known["recordings"], about["recordings"]
    other = sorted(name for name in there.keys() | ours.keys() if there.get(name) != ours.get(name))
    sys.stdout.write(f"{len(there) - len(other)} of {len(there)} recordings equal those of {path}\n")
    if other:
        raise SystemExit(f"{folder}: other contents in {', '.join(other)}; the last digits depend on the processor")


def main(arguments: list[str] | None = None) -> None:
    """Make a benchmark, or compare its digests."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_subparsers(dest="what", required=True)
    make = what.add_parser("make", help="simulate the trials and write the folder")
    make.add_argument("--size", choices=("small", "full"), default="small")
    make.add_argument("--out", type=Path, required=True, help="folder of the benchmark")
    make.add_argument("--jobs", type=int, default=2, help="trials simulated at the same time")
    digests = what.add_parser("digests", help="compare the contents of a folder with the digests in the repository")
    digests.add_argument("folder", type=Path)
    digests.add_argument("--write", action="store_true", help="write them instead")
    chosen = parser.parse_args(arguments)
    if chosen.what == "make":
        files.make(chosen.size, chosen.out, chosen.jobs)
    else:
        compare(chosen.folder, write=chosen.write)


if __name__ == "__main__":
    main()
