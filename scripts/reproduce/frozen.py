"""Name the commit at which methods and constants were frozen, and list the frozen files that have changed since.

    python scripts/reproduce/frozen.py                    # what has changed
    python scripts/reproduce/frozen.py --moves            # after `git mv`: record in frozen.json where files are now
    python scripts/reproduce/frozen.py --tables           # after an experiment: record the digests of frozen tables
    python scripts/reproduce/frozen.py --write f9c755f9   # freeze that commit: writes frozen.json

All files that can change a figure are frozen. These are code, scenes, sensors, objects and models in five folders of
the package, and the thresholds and weights that scripts judge with. frozen.json has the SHA-256 of each, and in `moved`
the present path of each file that was moved. Of Python files only code counts: comments, docstrings and imports
are left out. Styles of pages are not frozen. A change is reported and counted, but it is no error: methods may improve,
and tables made with them name their own commit. `tables` has the SHA-256 of each table that was made with the frozen
methods, so that a digit changed by hand is noticed.
"""

import argparse
import ast
import hashlib
import io
import json
import subprocess
import tokenize
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("frozen.json")
FOLDERS = ("kernels", "sim", "data", "trials", "stages")  # of evetac_cli
OF_SCRIPTS = ("scripts/studies/slip/thresholds.json", "scripts/studies/slip/oracles.json")
FACTS = "evetac_cli/data/likeness.toml"  # public facts that figures are compared with; no method reads them
SUFFIXES = (".py", ".toml", ".json", ".h5", ".npz")
SEEDS = range(100_000, 110_000)  # of the trials that frozen methods are judged on
NAMED = 3  # most changed files that are named in words
RULE = (
    f"every file with the suffix {', '.join(SUFFIXES)} in evetac_cli/{{{','.join(FOLDERS)}}},"
    f" and {', '.join(OF_SCRIPTS)}; not {FACTS}; of Python files without comments, docstrings and imports"
)


@dataclass(frozen=True)
class Freeze:
    """The frozen commit, its date (YYYY-MM-DD), SHA-256 of the frozen files and tables, and where files are today."""

    commit: str
    date: str
    files: dict[str, str]
    moved: dict[str, str] = field(default_factory=dict)
    tables: dict[str, str] = field(default_factory=dict)


def is_frozen(path: str) -> bool:
    """Whether the file with this path in the repository is frozen."""
    parts = PurePosixPath(path)
    inside = parts.parts[0] == "evetac_cli" and len(parts.parts) > 2 and parts.parts[1] in FOLDERS
    return path in OF_SCRIPTS or (inside and parts.suffix in SUFFIXES and path != FACTS)


def digest(path: str, content: bytes) -> str:
    """Return the SHA-256 of a file; of a Python file, that of its code."""
    return hashlib.sha256(_code(content.decode()).encode() if path.endswith(".py") else content).hexdigest()


def _code(source: str) -> str:
    """Return the lines of a module without comments, docstrings and imports."""
    lines = [*source.splitlines(), ""]
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        left_out = node.body[0] if documented and ast.get_docstring(node) is not None else node
        if left_out is not node or isinstance(node, ast.Import | ast.ImportFrom):
            lines[left_out.lineno - 1 : left_out.end_lineno] = [""] * (left_out.end_lineno - left_out.lineno + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def read(path: Path = FILE) -> Freeze:
    """Return the stored freeze."""
    stored = json.loads(path.read_text())
    return Freeze(stored["commit"], stored["date"], stored["files"], stored["moved"], stored.get("tables", {}))


def tables(freeze: Freeze, results: Path = ROOT / "docs" / "results") -> dict[str, str]:
    """Return the SHA-256 of each table in `results` that was made with these frozen methods, by name."""
    found = {path.stem: path.read_bytes() for path in sorted(results.glob("*.json"))}
    made = {name: text for name, text in found.items() if json.loads(text).get("frozen") == freeze.commit[:8]}
    return {name: hashlib.sha256(text).hexdigest() for name, text in made.items()}


def changed(freeze: Freeze, root: Path = ROOT) -> list[str]:
    """Return the present paths of files that were changed, removed or added since the freeze, sorted."""
    frozen = {freeze.moved.get(path, path): sha256 for path, sha256 in freeze.files.items()}
    folders = [root / "evetac_cli" / folder for folder in FOLDERS]
    there = {str(path.relative_to(root)) for folder in folders for path in folder.rglob("*") if path.is_file()}
    found = {path for path in there if is_frozen(path)} | {path for path in frozen if (root / path).exists()}
    kept = {path for path in found if digest(path, (root / path).read_bytes()) == frozen.get(path)}
    return sorted((found | frozen.keys()) - kept)


def in_words(freeze: Freeze, differing: list[str]) -> str:
    """Return the sentences on the freeze that pages and checks show."""
    named = ", ".join(f"`{path.removeprefix('evetac_cli/')}`" for path in differing[:NAMED])
    more = f" and {len(differing) - NAMED} more" if len(differing) > NAMED else ""
    since = f"{len(differing)} changed since: {named}{more}." if differing else "None of them has changed since."
    return (
        f"Methods, constants, presets, thresholds, scenes and detectors were frozen at commit {freeze.commit[:8]}"
        f" ({freeze.date}): {len(freeze.files)} files, listed in `scripts/reproduce/frozen.json`. {since} Moves,"
        " comments, docstrings and imports do not count."
    )


def git(*words: str) -> bytes:
    """Return what git prints about this repository; SystemExit if it fails."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, check=False)
    if done.returncode:
        raise SystemExit(f"error: git {' '.join(words)}: {done.stderr.decode().strip()}")
    return done.stdout


def followed(files: Iterable[str], renames: Iterable[str]) -> dict[str, str]:
    """Return the present path of each file that was moved; renames: lines of `git log --name-status`, oldest first."""
    origin = {path: path for path in files}  # present path -> path at the freeze
    for line in renames:
        _, old, new = line.split("\t")
        if old in origin:
            origin[new] = origin.pop(old)
    return {first: now for now, first in sorted(origin.items(), key=lambda item: item[1]) if first != now}


def moves(freeze: Freeze) -> dict[str, str]:
    """Return the moves of frozen files that still exist: those of git's history, then those in its index."""
    renamed = ("--diff-filter=R", "--find-renames", "--name-status")
    past = git("log", "--reverse", "--format=", *renamed, f"{freeze.commit}..HEAD").decode()
    moved = followed(freeze.files, (past + git("diff", "--cached", *renamed).decode()).splitlines())
    return {first: now for first, now in moved.items() if (ROOT / now).exists()}


def frozen_at(commit: str) -> Freeze:
    """Return the freeze of a commit of this repository."""
    full, date = git("show", "-s", "--format=%H %cs", commit).decode().split()
    paths = [path for path in git("ls-tree", "-r", "--name-only", full).decode().splitlines() if is_frozen(path)]
    return Freeze(full, date, {path: digest(path, git("show", f"{full}:{path}")) for path in sorted(paths)})


def main() -> None:
    """Write the file, or print what has changed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", metavar="COMMIT", help="freeze this commit")
    parser.add_argument("--tables", action="store_true", help="record the digests of frozen tables")
    parser.add_argument("--moves", action="store_true", help="record the moves of git's history and index")
    chosen = parser.parse_args()
    freeze = frozen_at(chosen.write) if chosen.write else read()
    if chosen.write or chosen.moves or chosen.tables:
        freeze = replace(freeze, moved=moves(freeze), tables=tables(freeze))
        FILE.write_text(json.dumps(asdict(freeze) | {"rule": RULE}, indent=1) + "\n")
    differing = changed(freeze)
    print(in_words(freeze, differing))
    print(*(f"  {path}" for path in differing), sep="\n" if differing else "")


if __name__ == "__main__":
    main()
