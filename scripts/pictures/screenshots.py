"""Make the screenshots of the documentation from the present code: pages of `view` and the output of commands.

    python scripts/pictures/screenshots.py [--out docs/pictures] [--work FOLDER] [--only view]

The script records two simulated slips into a folder (a temporary one unless --work is given) and runs the commands of
SHOTS on them. A headless Chromium renders the results. The picture of a command has the same name as the page that
shows it, `docs/reference/commands/NAME.md`.
"""

import argparse
import fcntl
import io
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).resolve().parents[2]
COLUMNS, LINES = 100, 50  # of the terminal
MOST_BYTES = 200_000  # of a picture
SPARE_PX = 200  # Chromium's window is larger than the visible part of the page


class Shot(NamedTuple):
    """A picture: its name, the command, the page that the command makes, and the visible size of the page, in px."""

    name: str
    command: str
    page: str = ""  # empty: the command's terminal output
    size_px: tuple[int, int] = (1280, 1400)


PREPARE = (
    "evetac record --scene slip --object 8 --count 2 --out data/ --jobs 2",
    "evetac track data/slip-obj08-s0-000.recording.h5 data/slip-obj08-s0-001.recording.h5",
    "evetac label data/slip-obj08-s0-000.recording.h5 data/slip-obj08-s0-001.recording.h5",
    "evetac featurize data/slip-obj08-s0-000.recording.h5 data/slip-obj08-s0-001.recording.h5",
    "evetac predict-touch data/slip-obj08-s0-000.tracks.h5",
)
SHOTS = (
    Shot("info", "evetac info data/slip-obj08-s0-000.recording.h5"),
    Shot("evaluate-labels", "evetac evaluate labels data/slip-obj08-s0-000.labels.h5 data/slip-obj08-s0-001.labels.h5"),
    Shot("view", "evetac view data/slip-obj08-s0-000.features.h5 --force", "data/slip-obj08-s0-000.html", (1760, 1370)),
)


def printed(command: str, folder: Path) -> str:
    """Return a command's terminal output, with its colours; progress, which is on stderr, is left out."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
    run = subprocess.Popen(_words(command), stdout=theirs, stderr=subprocess.DEVNULL, cwd=folder, env=_environment())
    os.close(theirs)
    pieces = []
    while True:
        try:
            piece = os.read(ours, 1 << 16)
        except OSError:  # the other end of the terminal is closed
            piece = b""
        if not piece:
            break
        pieces.append(piece)
    os.close(ours)
    if run.wait() != 0:
        raise SystemExit(f"{command}: exit code {run.returncode}")
    return b"".join(pieces).decode().replace("\r\n", "\n")


def _words(command: str) -> list[str]:
    return [sys.executable, "-P", "-m", "evetac_cli", *command.split()[1:]]


def _environment() -> dict[str, str]:
    path = os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    return {**os.environ, "PYTHONPATH": path, "TERM": "xterm-256color", "COLUMNS": str(COLUMNS), "LINES": str(LINES)}


def terminal_page(command: str, text: str, folder: Path) -> tuple[Path, tuple[int, int]]:
    """Return a page that shows a terminal, and its size in px; the fonts are those of this computer."""
    console = Console(record=True, width=COLUMNS, file=io.StringIO())
    console.print(Text.from_ansi(f"$ {command}\n{text}".rstrip()))
    drawn = re.sub(r"@font-face\s*\{[^}]*\}", "", console.export_svg(title="evetac"))
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawn)
    assert box is not None
    width, height = (int(float(side)) + 1 for side in box.groups())
    page = folder / "terminal.html"
    page.write_text(f'<body style="margin: 0"><div style="width: {width}px">{drawn}</div>')
    return page, (width, height)


def photograph(page: Path, size_px: tuple[int, int], out: Path, chromium: str) -> None:
    """Render a page with Chromium and save its upper left part as WebP, small enough for a repository."""
    width, height = size_px
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "page.png"
        flags = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=8000")
        where = (f"--user-data-dir={folder}/profile", f"--screenshot={drawn}")
        size = f"--window-size={width},{height + SPARE_PX}"
        run = [chromium, *flags, *where, size, page.resolve().as_uri()]
        subprocess.run(run, check=True, capture_output=True, timeout=120)
        with Image.open(drawn) as image:
            shown = image.convert("RGB").crop((0, 0, width, min(height, image.height)))
    out.parent.mkdir(parents=True, exist_ok=True)
    shown.save(out, "WEBP", quality=80, method=6)
    if out.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{out}: {out.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}; show less of the page")


def make(shot: Shot, work: Path, out: Path, chromium: str) -> Path:
    """Run a command and render its result."""
    text = printed(shot.command, work)
    page, size_px = (work / shot.page, shot.size_px) if shot.page else terminal_page(shot.command, text, work)
    picture = out / f"{shot.name}.webp"
    photograph(page, size_px, picture, chromium)
    return picture


def main() -> None:
    """Prepare the files, then make every picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    parser.add_argument("--work", type=Path, help="folder of recordings, kept and reused")
    parser.add_argument("--only", nargs="*", choices=[shot.name for shot in SHOTS], help="only these pictures")
    chosen = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        parser.exit(1, "expected chromium on the PATH, found none; try: apt install chromium\n")
    with tempfile.TemporaryDirectory() as temporary:
        work = chosen.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        for command in PREPARE:
            printed(command, work)
        for shot in SHOTS:
            if chosen.only is None or shot.name in chosen.only:
                picture = make(shot, work, chosen.out, chromium)
                sys.stdout.write(f"{picture}: {picture.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
