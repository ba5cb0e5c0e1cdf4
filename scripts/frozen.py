"""Name the commit at which methods and constants were frozen, and list the frozen files that have changed since.

    python scripts/frozen.py                    # what has changed
    python scripts/frozen.py --write f9c755f9   # freeze that commit: writes frozen.json

All files that can change a figure are frozen. These are code, scenes, sensors, objects and models in five folders of
the package, and the thresholds and weights that scripts judge with. frozen.json has the SHA-256 of each. Styles of
pages are left out. A change is reported and counted, but it is no error: methods may improve, and tables made
with them name their own commit.
"""

import argparse
import hashlib
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
FILE = Path(__file__).with_name("frozen.json")
FOLDERS = ("kernels", "sim", "data", "trials", "stages")  # of evetac_cli
OF_SCRIPTS = ("scripts/slip-thresholds.json", "scripts/slip-oracles.json", "scripts/no-noise.sensor.toml")
FACTS = "evetac_cli/data/likeness.toml"  # public facts that figures are compared with; no method reads them
SUFFIXES = (".py", ".toml", ".json", ".h5", ".npz")
SEEDS = range(90_000, 100_000)  # of the trials that frozen methods are judged on
NAMED = 3  # most changed files that are named in words
RULE = (
    f"every file with the suffix {', '.join(SUFFIXES)} in evetac_cli/{{{','.join(FOLDERS)}}},"
    f" and {', '.join(OF_SCRIPTS)}; not {FACTS}"
)


@dataclass(frozen=True)
class Freeze:
    """The frozen commit, its date (YYYY-MM-DD), and the SHA-256 of each frozen file."""

    commit: str
    date: str
    files: dict[str, str]


def is_frozen(path: str) -> bool:
    """Whether the file with this path in the repository is frozen."""
    parts = PurePosixPath(path)
    inside = parts.parts[0] == "evetac_cli" and len(parts.parts) > 2 and parts.parts[1] in FOLDERS
    return path in OF_SCRIPTS or (inside and parts.suffix in SUFFIXES and path != FACTS)


def read(path: Path = FILE) -> Freeze:
    """Return the stored freeze."""
    stored = json.loads(path.read_text())
    return Freeze(stored["commit"], stored["date"], stored["files"])


def changed(freeze: Freeze, root: Path = ROOT) -> list[str]:
    """Return the files that were changed, removed or added since the freeze, sorted."""
    folders = [root / "evetac_cli" / folder for folder in FOLDERS]
    there = {str(path.relative_to(root)) for folder in folders for path in folder.rglob("*") if path.is_file()}
    found = {path for path in there | set(OF_SCRIPTS) if is_frozen(path) and (root / path).exists()}
    kept = {path for path in found if hashlib.sha256((root / path).read_bytes()).hexdigest() == freeze.files.get(path)}
    return sorted((found | freeze.files.keys()) - kept)


def in_words(freeze: Freeze, differing: list[str]) -> str:
    """Return the sentences on the freeze that pages and checks show."""
    named = ", ".join(f"`{path.removeprefix('evetac_cli/')}`" for path in differing[:NAMED])
    more = f" and {len(differing) - NAMED} more" if len(differing) > NAMED else ""
    since = f"{len(differing)} changed since: {named}{more}." if differing else "None of them has changed since."
    return (
        f"Methods, constants, presets, thresholds, scenes and detectors were frozen at commit {freeze.commit[:8]}"
        f" ({freeze.date}): {len(freeze.files)} files, listed in `scripts/frozen.json`. {since}"
    )


def write(commit: str) -> None:
    """Write frozen.json from a commit of this repository; SystemExit if git does not have it."""

    def git(*words: str) -> bytes:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, check=False)
        if done.returncode:
            raise SystemExit(f"error: git {' '.join(words)}: {done.stderr.decode().strip()}")
        return done.stdout

    full, date = git("show", "-s", "--format=%H %cs", commit).decode().split()
    paths = [path for path in git("ls-tree", "-r", "--name-only", full).decode().splitlines() if is_frozen(path)]
    files = {path: hashlib.sha256(git("show", f"{full}:{path}")).hexdigest() for path in sorted(paths)}
    stored = {"commit": full, "date": date, "rule": RULE, "files": files}
    FILE.write_text(json.dumps(stored, indent=1) + "\n")


def main() -> None:
    """Write the file, or print what has changed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", metavar="COMMIT", help="freeze this commit")
    chosen = parser.parse_args()
    if chosen.write:
        write(chosen.write)
    freeze = read()
    differing = changed(freeze)
    print(in_words(freeze, differing))
    print(*(f"  {path}" for path in differing), sep="\n" if differing else "")


if __name__ == "__main__":
    main()
