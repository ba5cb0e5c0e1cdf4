"""Follow docs/first-hour.md and README word by word in an empty environment, and check the results they promise.

    python scripts/first_hour.py [--folder EMPTY] [--minutes 15] [--page docs/slip-detector.md] [--write]

The last commit is cloned. The ```sh blocks of each page run in the clone, one shell per page. A comment `<!-- expect
NAME LOW..HIGH -->` below a block gives the range of a figure that the block prints, as `NAME: 0.84` or as table cells
`NAME | 0.84`. All commands must succeed within the time limit.

`--page` follows one page instead, with the evetac of this Python, in a folder that is empty.

`--write` puts the stdout of each block into the ```text block that follows it, in the pages of this checkout.
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
PAGES = ("docs/first-hour.md", "README.md")  # its files are up to date for the second page
MOST_LINES = 55  # lines of a block's output that a page shows
COLUMNS = "100"
BLOCK = re.compile(r"^```sh\n(?P<code>.*?)^```\n(?P<rest>.*?)(?=^```sh\n|\Z)", re.DOTALL | re.MULTILINE)
EXPECT = re.compile(r"<!-- expect (?P<name>.+?) (?P<low>-?[\d.]+)\.\.(?P<high>-?[\d.]+) -->")
OUTPUT = re.compile(r"\A(?P<before>(?:\s|<!--.*?-->)*```text\n).*?(?P<after>^```\n)", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """Commands of a page, and the figures that they must print: name, lowest and highest value."""

    code: str
    expected: tuple[tuple[str, float, float], ...]


def blocks(page: str) -> list[Block]:
    """Return the blocks of commands of a Markdown page, in order."""
    return [
        Block(
            match["code"],
            tuple((each["name"], float(each["low"]), float(each["high"])) for each in EXPECT.finditer(match["rest"])),
        )
        for match in BLOCK.finditer(page)
    ]


def figure(printed: str, name: str) -> float | None:
    """Return the first number after a name at the beginning of a line or cell; None if there is none."""
    match = re.search(rf"(?:^|[|│])\s*{re.escape(name)}\s*[:|│]\s*(-?[\d,]*\.?\d+)", printed, re.MULTILINE)
    return float(match[1].replace(",", "")) if match else None


def faults(block: Block, printed: str) -> list[str]:
    """Return the differences between a block's figures and those that its page promises."""
    wrong = []
    for name, low, high in block.expected:
        value = figure(printed, name)
        if value is None or not low <= value <= high:
            wrong.append(f"{name}: expected {low:g} to {high:g}, found {'none' if value is None else f'{value:g}'}")
    return wrong


def run(page: list[Block], folder: Path, environment: dict[str, str]) -> tuple[int, list[str]]:
    """Run the blocks in one shell; return its exit code and the output of each block that ran.

    A line that no command prints separates the blocks.
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
    """Return the page with the ```text blocks replaced by the output of the commands above them."""
    outputs = iter(printed)

    def replace(match: re.Match[str]) -> str:
        lines = [line.rstrip() for line in next(outputs, "").strip("\n").splitlines()]
        shown = [*lines[:MOST_LINES], "..."] if len(lines) > MOST_LINES else lines
        text = "".join(f"{line}\n" for line in shown)
        rest = OUTPUT.sub(lambda output: output["before"] + text + output["after"], match["rest"], count=1)
        return f"```sh\n{match['code']}```\n{rest if shown else match['rest']}"

    return BLOCK.sub(replace, page)


def empty_environment(folder: Path) -> dict[str, str]:
    """Return this process's variables without those of a Python environment, and with empty caches."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "NUMBA_CACHE_DIR", "MAKEFLAGS", "MAKELEVEL")
    }
    path = [each for each in kept["PATH"].split(os.pathsep) if not (Path(each).parent / "pyvenv.cfg").exists()]
    return {**kept, "PATH": os.pathsep.join(path), "XDG_CACHE_HOME": str(folder / "cache"), "COLUMNS": COLUMNS}


def this_environment() -> dict[str, str]:
    """Return this process's variables, with the evetac of this Python first."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    return {**os.environ, "PATH": path, "COLUMNS": COLUMNS}


def follow(folder: Path, *, write: bool) -> list[str]:
    """Follow the pages in a clone in this folder; return the differences, in words."""
    clone = folder / "evetac"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    texts = {name: (clone / name).read_text() for name in PAGES}
    environment = empty_environment(folder)
    return [fault for name in PAGES for fault in follow_page(name, texts[name], clone, environment, write=write)]


def follow_page(name: str, text: str, folder: Path, environment: dict[str, str], *, write: bool = False) -> list[str]:
    """Follow the text of a page in this folder; return the differences, in words."""
    page = blocks(text)
    started = time.monotonic()
    code, printed = run(page, folder, environment)
    print(f"{name}: {len(printed)} of {len(page)} blocks, {time.monotonic() - started:.0f} s", flush=True)
    if code:
        return [f"{name}: a block ended with exit code {code}:\n{page[len(printed) - 1].code}"]
    if write:
        (ROOT / name).write_text(with_outputs((ROOT / name).read_text(), printed))
    return [f"{name}: {fault}" for block, out in zip(page, printed, strict=True) for fault in faults(block, out)]


def main() -> None:
    """Follow the pages; exit code 1 if a result differs from its page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=None, help="an empty folder; default: a temporary one")
    parser.add_argument("--minutes", type=float, default=15.0, help="time limit, in minutes")
    parser.add_argument("--page", help="a page to follow alone")
    parser.add_argument("--write", action="store_true", help="put the printed output into the pages")
    chosen = parser.parse_args()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.folder or Path(temporary)
        if chosen.page:
            wrong = follow_page(
                chosen.page, (ROOT / chosen.page).read_text(), folder, this_environment(), write=chosen.write
            )
        else:
            wrong = follow(folder, write=chosen.write)
    minutes = (time.monotonic() - started) / 60
    if minutes > chosen.minutes:
        wrong.append(f"it took {minutes:.1f} minutes, expected at most {chosen.minutes:g}")
    print(*wrong, f"{minutes:.1f} minutes, {len(wrong)} faults", sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
