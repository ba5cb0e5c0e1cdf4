"""The pages for people with another camera or gel: what the code knows is there as the code has it."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evetac_cli.commands.calibrate import Calibrate
from evetac_cli.devices import cameras
from evetac_cli.formats import imports
from evetac_cli.kernels.slip.architectures import (
    ARCHITECTURES,
    GEL_PX,
    LEAST_COLUMNS,
    LEAST_ROWS,
    DotArchitecture,
    ImageArchitecture,
)
from evetac_cli.stages import calibrate
from evetac_cli.store.calibration import read_calibration
from tests.make import run_stage

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "what-works.md").read_text()
RECORDINGS = (DOCS / "recordings.md").read_text()
GELS = [line for line in PAGE.partition("<!-- gels -->")[2].partition("<!-- end of gels -->")[0].splitlines() if line]
ROWS = {row.split("|")[1].strip(): [cell.strip() for cell in row.split("|")[2:-1]] for row in GELS[2:]}


def names(text: str) -> set[str]:
    """What stands in code on a page."""
    return set(re.findall(r"`([^`]+)`", text))


def row(*words: str) -> tuple[str, list[str]]:
    """The one row of the table of gels whose first cell has all these words, and its other cells."""
    ((first, cells),) = [(first, cells) for first, cells in ROWS.items() if all(word in first for word in words)]
    return first, cells


def block(page: str, mark: str, language: str) -> str:
    """The code of a language that follows a mark on a page."""
    return page.partition(f"<!-- {mark} -->")[2].partition(f"```{language}\n")[2].partition("```")[0]


def test_every_camera_and_every_format_stands_in_the_table() -> None:
    """Assert that each name of --camera is there, no other is, and every format that an import takes."""
    table = PAGE.partition("| --- | --- | --- |\n")[2].partition("\n\n")[0]
    live = {name.partition(":")[0] for line in table.splitlines() for name in names(line.split("|")[2])}
    assert live - {"camera"} == set(cameras.KINDS)
    said = re.findall(r"AEDAT|HDF5|npz|npy|RAW|DAT|ROS bag|text", imports.EXPECTED)
    assert len(said) == 9  # AEDAT twice
    assert [word for word in [*said, "AEDAT 2", "AEDAT4"] if word not in table] == []


def test_the_networks_of_each_kind() -> None:
    """Assert that the page names every network of dots and of images, and from which grid on the first can be used."""
    for kind, words in ((DotArchitecture, "networks of dots"), (ImageArchitecture, "networks of images")):
        first, cells = row("train", words)
        wanted = {name for name, one in ARCHITECTURES.items() if isinstance(one, kind)}
        assert names(first) - {"train", "evaluate slip"} == wanted
        assert (cells[-1] == "no") == (kind is DotArchitecture)
    said = row("train", "networks of dots")[1][2]
    assert re.findall(r"(\d+) (?:rows|columns)", said) == [str(LEAST_ROWS), str(LEAST_COLUMNS)]
    assert "{} x {} px".format(*GEL_PX) in PAGE


def test_the_grid_by_hand(tmp_path: Path) -> None:
    """Assert that the grid which the page shows is taken, with its missing dot and its window."""
    text = block(RECORDINGS, "by hand", "json")
    (tmp_path / "gel.json").write_text(text)
    chosen = Calibrate(source=tmp_path / "gel.json")
    (made,) = run_stage(calibrate, [], chosen, tmp_path / "checked.json")[1].rows
    assert (made["rows"], made["columns"], made["missing_dots"], made["window_px"]) == (2, 3, 1, "540 0 640 480")
    assert [key for key in json.loads(text) if f"| `{key}` |" not in RECORDINGS] == []


@pytest.mark.parametrize("columns", [8, 9])
def test_the_grid_from_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    """Assert that the program on the page finds dots in a picture, which `calibrate` puts into rows and columns."""
    monkeypatch.chdir(tmp_path)
    x, y = np.meshgrid(60.25 + 62.5 * np.arange(columns), 41.5 + 62.5 * np.arange(7))
    pixels = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1)
    distance = np.full((480, 640), np.inf)
    for centre in np.stack([x, y], axis=-1).reshape(-1, 2):
        distance = np.minimum(distance, np.linalg.norm(pixels - centre, axis=2))
    picture = 200 - 160 * np.clip(15.5 - distance, 0, 1)  # dark to a radius of 15, of which the rim is a pixel wide
    noisy = picture + np.random.default_rng(0).normal(0, 8, picture.shape)
    cv2.imwrite("gel.png", noisy.clip(0, 255).astype(np.uint8))
    program = compile(ast.parse(block(RECORDINGS, "from a picture", "python")), "recordings.md", "exec")
    exec(program, {})
    chosen = Calibrate(source=Path("dots.json"), rows=7, columns=columns, gel="cut" if columns == 8 else "closed")
    (made,) = run_stage(calibrate, [], chosen, Path("gel.json"))[1].rows
    assert (made["dots"], made["missing_dots"]) == (7 * columns, 0)
    assert made["window_px"] == ("540 0 640 480" if columns == 8 else None)
    dots: Any = read_calibration(Path("gel.json")).dot_xy_px
    assert np.abs(dots - np.stack([x, y], axis=-1)).max() < 0.3
    assert made["radius_px"] == pytest.approx(15.0, abs=0.5)
