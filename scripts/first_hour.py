"""Follow docs/first-hour.md and README word by word in an empty environment, and check what they say comes out.

    python scripts/first_hour.py [--folder EMPTY] [--minutes 15] [--write]

The last commit is cloned, and the blocks ```sh of each page are run from there, one shell a page. A comment
`<!-- expect NAME LOW..HIGH -->` below a block says within which range a figure has to lie that the block prints, as
`NAME: 0.84` or as cells `NAME | 0.84` of a table. All commands have to succeed, within the minutes.

`--write` puts what a block printed on stdout into the block ```text that follows it, in the pages of this checkout.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("docs/first-hour.md", "README.md")  # whose files the second finds up to date
MOST_LINES = 45  # of what a block printed, in a page
COLUMNS = "100"
BLOCK = re.compile(r"^```sh\n(?P<code>.*?)^```\n(?P<rest>.*?)(?=^```sh\n|\Z)", re.DOTALL | re.MULTILINE)
EXPECT = re.compile(r"<!-- expect (?P<name>.+?) (?P<low>-?[\d.]+)\.\.(?P<high>-?[\d.]+) -->")
OUTPUT = re.compile(r"\A(?P<before>(?:\s|<!--.*?-->)*```text\n).*?(?P<after>^```\n)", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """Commands of a page, and the figures that they have to print: name, lowest, highest."""

    code: str
    expected: tuple[tuple[str, float, float], ...]


def blocks(page: str) -> list[Block]:
    """The blocks of commands of a page in Markdown, in their order."""
    return [
        Block(
            match["code"],
            tuple((each["name"], float(each["low"]), float(each["high"])) for each in EXPECT.finditer(match["rest"])),
        )
        for match in BLOCK.finditer(page)
    ]


def figure(printed: str, name: str) -> float | None:
    """The first number behind a name at the beginning of a line or cell; None where there is none."""
    match = re.search(rf"(?:^|[|│])\s*{re.escape(name)}\s*[:|│]\s*(-?[\d,]*\.?\d+)", printed, re.MULTILINE)
    return float(match[1].replace(",", "")) if match else None


def faults(block: Block, printed: str) -> list[str]:
    """In what a block's figures differ from what its page says."""
    wrong = []
    for name, low, high in block.expected:
        value = figure(printed, name)
        if value is None or not low <= value <= high:
            wrong.append(f"{name}: expected {low:g} to {high:g}, found {'none' if value is None else f'{value:g}'}")
    return wrong


def run(page: list[Block], folder: Path, environment: dict[str, str]) -> tuple[int, list[str]]:
    """Run the blocks in one shell: its exit code, and what each block printed, as far as it came.

    Blocks are told apart by a line that no command prints.
    """
    mark = f"--- next block {os.urandom(8).hex()}"
    script = "".join(f"echo '{mark}'\n{block.code}" for block in page)
    words = ["bash", "-euo", "pipefail", "-c", script]
    printed: list[str] = []
    with subprocess.Popen(words, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as shell:
        assert shell.stdout is not None
        for line in shell.stdout:
            if line.strip() == mark:
                print("+", *page[len(printed)].code.splitlines(), sep="\n  ", flush=True)
                printed.append("")
            else:
                print(line, end="", flush=True)
                printed[-1] += line
    return shell.returncode, printed


def with_outputs(page: str, printed: list[str]) -> str:
    """A page whose blocks ```text hold what the blocks of commands above them printed."""
    outputs = iter(printed)

    def replace(match: re.Match[str]) -> str:
        lines = [line.rstrip() for line in next(outputs, "").strip("\n").splitlines()]
        shown = [*lines[:MOST_LINES], "..."] if len(lines) > MOST_LINES else lines
        text = "".join(f"{line}\n" for line in shown)
        rest = OUTPUT.sub(lambda output: output["before"] + text + output["after"], match["rest"], count=1)
        return f"```sh\n{match['code']}```\n{rest if shown else match['rest']}"

    return BLOCK.sub(replace, page)


def empty_environment(folder: Path) -> dict[str, str]:
    """The variables of this process without those of a Python environment, and with caches that are empty."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "NUMBA_CACHE_DIR", "MAKEFLAGS", "MAKELEVEL")
    }
    path = [each for each in kept["PATH"].split(os.pathsep) if not (Path(each).parent / "pyvenv.cfg").exists()]
    return {**kept, "PATH": os.pathsep.join(path), "XDG_CACHE_HOME": str(folder / "cache"), "COLUMNS": COLUMNS}


def follow(folder: Path, *, write: bool) -> list[str]:
    """Follow the pages in a clone in this folder; what was not as they say, in words."""
    clone = folder / "evetac"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    wrong = []
    for name in PAGES:
        text = (clone / name).read_text()
        page = blocks(text)
        started = time.monotonic()
        code, printed = run(page, clone, empty_environment(folder))
        print(f"{name}: {len(printed)} of {len(page)} blocks, {time.monotonic() - started:.0f} s", flush=True)
        if code:
            wrong.append(f"{name}: a block ended with exit code {code}:\n{page[len(printed) - 1].code}")
            return wrong
        wrong += [f"{name}: {fault}" for block, out in zip(page, printed, strict=True) for fault in faults(block, out)]
        if write:
            (ROOT / name).write_text(with_outputs((ROOT / name).read_text(), printed))
    return wrong


def main() -> None:
    """Follow the pages; exit code 1 where something is not as they say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=None, help="an empty folder; default: a temporary one")
    parser.add_argument("--minutes", type=float, default=15.0, help="longest time that it may take")
    parser.add_argument("--write", action="store_true", help="put what was printed into the pages")
    chosen = parser.parse_args()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        wrong = follow(chosen.folder or Path(temporary), write=chosen.write)
    minutes = (time.monotonic() - started) / 60
    if minutes > chosen.minutes:
        wrong.append(f"it took {minutes:.1f} minutes, expected at most {chosen.minutes:g}")
    print(*wrong, f"{minutes:.1f} minutes, {len(wrong)} faults", sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
