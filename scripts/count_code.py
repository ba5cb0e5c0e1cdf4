"""Count lines of code and statements of evetac by folder, also against another commit.

    python scripts/count_code.py                    # this checkout
    python scripts/count_code.py --against 7b4e486d   # ... and the change since a commit

A line of code has a token that is not part of a comment or a docstring. Statements are counted beside the lines,
because denser lines are no less code.
"""

import argparse
import ast
import io
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
COUNTED = ("evetac_cli", "tests", "scripts", "examples")
NO_CODE = frozenset(
    {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
)


class Size(NamedTuple):
    """Size of a module or of several modules."""

    modules: int = 0
    lines: int = 0
    statements: int = 0

    def __add__(self, other: "Size") -> "Size":  # type: ignore[override]
        return Size(*(a + b for a, b in zip(self, other, strict=True)))


def size_of(source: str) -> Size:
    """Count the lines of code and the statements of a module's source."""
    tree = ast.parse(source)
    docstrings = {line for node in ast.walk(tree) for line in _docstring_lines(node)}
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    lines = {line for token in tokens if token.type not in NO_CODE for line in range(token.start[0], token.end[0] + 1)}
    return Size(1, len(lines - docstrings), sum(isinstance(node, ast.stmt) for node in ast.walk(tree)))


def _docstring_lines(node: ast.AST) -> range:
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        match node.body:
            case [ast.Expr(value=ast.Constant(value=str())) as text, *_]:
                return range(text.lineno, (text.end_lineno or text.lineno) + 1)
    return range(0)


def sizes(root: Path) -> dict[str, Size]:
    """Return the size of each folder of a checkout: `evetac_cli/sim`, `tests`, ..."""
    found: dict[str, Size] = {}
    for top, module in _modules(root):
        parts = module.relative_to(root).parts
        room = "/".join(parts[:2]) if top == "evetac_cli" and len(parts) > 2 else top
        found[room] = found.get(room, Size()) + size_of(module.read_text("utf-8"))
    return found


def _modules(root: Path) -> Iterator[tuple[str, Path]]:
    for top in COUNTED:
        for module in sorted((root / top).rglob("*.py")):
            yield top, module


def _sizes_at(commit: str) -> dict[str, Size]:
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(("git", "archive", commit, *COUNTED), cwd=ROOT, stdout=subprocess.PIPE, check=True)
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
            files.extractall(folder, filter="data")
        return sizes(Path(folder))


def main() -> int:
    """Print a row for each folder, and the sum of the package."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="COMMIT", help="also print the change since this commit")
    given = parser.parse_args()
    now, before = sizes(ROOT), _sizes_at(given.against) if given.against else None
    for found in (now, before):
        if found is not None:
            package = [size for room, size in found.items() if room.startswith("evetac_cli")]
            found["package"] = sum(package, Size())
    print(f"{'':<24}{'modules':>9}{'lines':>9}{'statements':>12}" + (f"{'change':>9}{'':>9}{'':>12}" if before else ""))
    for room in dict.fromkeys((*now, *(before or ()))):
        size = now.get(room, Size())
        row = f"{room:<24}{size.modules:>9}{size.lines:>9}{size.statements:>12}"
        if before:
            old = before.get(room, Size())
            row += "".join(f"{a - b:>+{width}}" for a, b, width in zip(size, old, (9, 9, 12), strict=True))
        print(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
