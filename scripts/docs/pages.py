"""Write the reference pages of the documentation from the code: commands, files, Python, scenes, sensors, models.

    python scripts/docs/pages.py [--out docs/reference]

The folder is committed, so that links work for readers of a clone. `make docs` writes it again before each build of the
site; a test asserts that it matches the code. CONTRIBUTING and the two lists of changes become pages of the site too;
these copies are not committed.
"""

import argparse
import inspect
import re
import shutil
import sys
from pathlib import Path

import evetac_cli as evetac
from scripts.docs import command_pages, file_pages, method_pages, simulation_pages
from scripts.docs.page_text import MADE

ROOT = Path(__file__).resolve().parents[2]
MODULES = (command_pages, file_pages, simulation_pages, method_pages)
OF_THE_REPOSITORY = {
    "contributing.md": "CONTRIBUTING.md",
    "changes.md": "CHANGELOG.md",
    "file-changes.md": "schemas/CHANGES.md",
}
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:|#)([^)#]+)(#[^)]*)?\)")
# Sections of the page of Python names, in this order.
SIMULATORS = ("SeenSlice", "SimulatedCamera", "Simulation", "Touch", "TouchSensor")
OPENING, EVENTS, SIMULATING, ERRORS = "Open files", "Events, dots, slip", "Simulate", "Errors"


def every_page() -> dict[str, str]:
    """Return the text of all reference pages by their paths below the folder."""
    generated = {path: text for module in MODULES for path, text in module.pages().items()}
    copied = {path: for_the_site((ROOT / name).read_text("utf-8")) for path, name in OF_THE_REPOSITORY.items()}
    return {path: MADE + text for path, text in {**generated, "python.md": _python(), **copied}.items()}


def _python() -> str:
    """Return the page of public Python names; mkdocstrings inserts their docstrings."""
    lines = [
        "# All names in Python\n",
        "    import evetac_cli as evetac\n",
        "Each name is imported on first use. The package is fully typed. A test runs all examples on this page.\n",
    ]
    for part in (OPENING, EVENTS, SIMULATING, ERRORS):
        lines.append(f"## {part}\n")
        lines += [f"::: evetac_cli.{name}\n" for name in evetac.__all__ if _part_of(name) == part]
        if part == OPENING:
            lines.append("::: evetac_cli.store.files.StageFile\n")
    return "\n".join(lines)


def _part_of(name: str) -> str:
    item = getattr(evetac, name)
    if name.startswith("open_") or name == "Recording":
        return OPENING
    if inspect.isclass(item) and issubclass(item, Exception):
        return ERRORS
    simulates = inspect.isfunction(item) or name in SIMULATORS
    return SIMULATING if simulates else EVENTS


def for_the_site(text: str) -> str:
    """Adapt links for the site: links to docs/ are kept; other repository files, not on the site, are only named."""

    def replace(match: re.Match[str]) -> str:
        label, path, place = match[1], match[2], match[3] or ""
        if path.startswith("docs/"):
            return f"[{label}](../{path.removeprefix('docs/')}{place})"
        return f"`{path}`" if label.strip("`") == path else f"{label} (`{path}`)"

    return LINK.sub(replace, text)


def write(folder: Path) -> list[Path]:
    """Write all pages into a folder and return their paths; SystemExit if the folder has any other file."""
    for path in sorted(folder.rglob("*")):
        if path.is_symlink() or (path.is_file() and not path.read_bytes().startswith(MADE.encode())):
            raise SystemExit(f"{path} was not made by this script: nothing was removed or written")
    shutil.rmtree(folder, ignore_errors=True)
    written = []
    for path, text in every_page().items():
        place = folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
        written.append(place)
    return written


def main() -> None:
    """Write the pages and print their number."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "reference")
    chosen = parser.parse_args()
    sys.stdout.write(f"{chosen.out}: {len(write(chosen.out))} pages\n")


if __name__ == "__main__":
    main()
