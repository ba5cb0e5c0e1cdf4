"""Dot grids as JSON: good ones in any order, and every kind of fault."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.events import empty
from evetac_cli.kernels.slip.architectures import UNKNOWN_SENSITIVITY, Sensitivity
from evetac_cli.store.calibration import (
    Calibration,
    read_calibration,
    read_quality,
    stored_calibration,
    up_to_date,
    write_calibration,
)
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.recordings.read import open_recording
from tests.make import event_arrays, write_recording

GRID = np.stack(np.meshgrid(50.0 + 60 * np.arange(4), 40.0 + 60 * np.arange(3)), axis=-1)
GOOD: dict[str, Any] = {"frame_px": [640, 480], "radius_px": 20.5, "dot_xy_px": GRID.reshape(-1, 2).tolist()}
FLAT = GOOD["dot_xy_px"]


def read(folder: Path, table: Any) -> Calibration:
    """Read a table as a calibration; a key given as ... is left out."""
    path = folder / "grid.json"
    if isinstance(table, dict):
        table = {key: value for key, value in table.items() if value is not ...}
    path.write_text(table if isinstance(table, str) else json.dumps(table))
    return read_calibration(path)


def test_the_real_evetac(outside_file: Callable[[str], Path]) -> None:
    """Assert that the official base calibration is a grid of 7 rows and 9 columns with the pitch of the real gel."""
    calibration = read_calibration(outside_file("evetac_base_calibration.json"))
    dots = calibration.dot_xy_px
    assert dots.shape == (7, 9, 2)
    assert calibration.frame_px == (640, 480)
    assert calibration.window_px is None
    assert calibration.dot_radius_px == pytest.approx(20.62, abs=0.005)
    stored = {tuple(dot) for dot in json.loads(outside_file("evetac_base_calibration.json").read_text())["dot_xy_px"]}
    assert {tuple(dot) for dot in dots.reshape(-1, 2).tolist()} == stored
    assert np.median(np.diff(dots[..., 0], axis=1)) == pytest.approx(62.7, abs=0.5)
    assert np.median(np.diff(dots[..., 1], axis=0)) == pytest.approx(62.7, abs=0.5)


@pytest.mark.parametrize("order", ["as it is", "shuffled", "nested"])
def test_dots_in_any_order(tmp_path: Path, order: str) -> None:
    """Assert that dots are sorted into rows and columns, however they are listed."""
    flat = GRID.reshape(-1, 2)
    dots = {"as it is": flat, "shuffled": np.random.default_rng(0).permutation(flat), "nested": GRID}[order]
    calibration = read(tmp_path, {**GOOD, "dot_xy_px": dots.tolist()})
    np.testing.assert_array_equal(calibration.dot_xy_px, GRID)


def test_whole_numbers_may_be_written_as_decimals(tmp_path: Path) -> None:
    """Assert that 640.0 is taken as 640, as some writers of JSON have no integers; other keys are let be."""
    calibration = read(tmp_path, {**GOOD, "frame_px": [640.0, 480.0], "window_px": [540.0, 0, 640, 480], "more": 1})
    assert calibration.frame_px == (640, 480)
    assert calibration.window_px == (540, 0, 640, 480)
    assert all(type(size) is int for size in (*calibration.frame_px, *calibration.window_px))


def test_missing_dots(tmp_path: Path) -> None:
    """Assert that a dot may be missing (null) in a list of rows, and not in a list without rows."""
    rows = GRID.tolist()
    rows[1][2] = [None, None]
    dots = read(tmp_path, {**GOOD, "dot_xy_px": rows}).dot_xy_px
    assert np.argwhere(np.isnan(dots[..., 0])).tolist() == [[1, 2]]
    with pytest.raises(InputError, match="missing dots are only possible"):
        read(tmp_path, {**GOOD, "dot_xy_px": [*GOOD["dot_xy_px"], [None, None]]})


def test_dots_in_no_grid(tmp_path: Path) -> None:
    """Assert that one row of up to 256 dots is taken in its order, and that a list of dots in no grid is refused."""
    places = np.random.default_rng(0).uniform(0, 400, (256, 2))
    np.testing.assert_array_equal(
        read(tmp_path, {**GOOD, "radius_px": 0.5, "dot_xy_px": [places.tolist()]}).dot_xy_px, places[None]
    )
    with pytest.raises(InputError, match="more than 256"):
        read(tmp_path, {**GOOD, "radius_px": 0.5, "dot_xy_px": [[*places.tolist(), [1.0, 1.0]]]})
    with pytest.raises(InputError, match="dots without a grid are one row"):
        read(tmp_path, {**GOOD, "radius_px": 0.5, "dot_xy_px": places.tolist()})


def test_mask(tmp_path: Path) -> None:
    """Assert that a dot is missing where the mask is false, also in a list in any order, or its centre null."""
    mask = np.ones((3, 4), bool)
    mask[2, 1] = mask[0, 0] = False
    shuffled = np.random.default_rng(0).permutation(GRID.reshape(-1, 2)).tolist()
    dots = read(tmp_path, {**GOOD, "dot_xy_px": shuffled, "mask": mask.tolist(), "rows": 3, "columns": 4}).dot_xy_px
    np.testing.assert_array_equal(np.isnan(dots[..., 0]), ~mask)
    np.testing.assert_array_equal(dots[mask], GRID[mask])
    rows = GRID.tolist()
    rows[1][2] = [None, 100.0]
    dots = read(tmp_path, {**GOOD, "dot_xy_px": rows, "mask": mask.tolist()}).dot_xy_px
    assert np.argwhere(np.isnan(dots).all(axis=2)).tolist() == [[0, 0], [1, 2], [2, 1]]


def test_written_is_read(tmp_path: Path) -> None:
    """Assert that what is written is read again to 0.001 px, holes and window included, and nothing else is left."""
    dots = GRID + np.random.default_rng(0).uniform(-3, 3, GRID.shape)
    dots[1, 1] = np.nan
    path = tmp_path / "new" / "grid.json"
    for window, sensor in ((None, Sensitivity(7.25, 1.5e5)), ((540, 0, 640, 480), UNKNOWN_SENSITIVITY)):
        calibration = Calibration((640, 480), dots, 14.4321, window, sensor)
        write_calibration(path, calibration, [[1], [0]], {"a_px": 1.0}, {"id": "x"}, "x")
        again = read_calibration(path)
        np.testing.assert_allclose(again.dot_xy_px, dots, atol=5.1e-4)
        assert again.window_px == window
        assert again.sensitivity == sensor
        assert again.dot_radius_px == 14.432
        assert again.hot_xy_px.tolist() == []
        assert read_quality(path) == {"a_px": 1.0}
    assert [file.name for file in path.parent.iterdir()] == ["grid.json"]
    assert json.loads(path.read_text())["mask"][1] == [True, False, True, True]


def test_hot_pixels_are_kept(tmp_path: Path) -> None:
    """Assert that they are written and read, go into recordings but not into tracks, and make another calibration."""
    hot = np.array([[639, 0], [3, 479]], np.uint16)
    plain = Calibration((640, 480), GRID, 15.0, None)
    calibration = replace(plain, hot_xy_px=hot)
    write_calibration(tmp_path / "grid.json", calibration, [], {}, {"id": "x"}, "x")
    again = read_calibration(tmp_path / "grid.json")
    np.testing.assert_array_equal(again.hot_xy_px, hot)
    assert again.digest() == calibration.digest() != plain.digest()
    assert again.recorded().keys() - again.arrays().keys() == {"sensor/hot_xy_px"}
    arrays = event_arrays(empty(), 3) | again.recorded()
    with open_recording(write_recording(tmp_path / "a.recording.h5", arrays)) as recording:
        assert np.argwhere(recording.hot_pixels()).tolist() == [[0, 639], [479, 3]]
        np.testing.assert_array_equal(stored_calibration(recording).hot_xy_px, hot)


def test_up_to_date(tmp_path: Path) -> None:
    """Assert that only the same recipe is up to date, another refused with the first difference unless forced."""
    path = tmp_path / "grid.json"
    recipe, other = (Recipe("calibration", 1, {"gel": gel}) for gel in ("cut", "closed"))
    assert not up_to_date(path, recipe)
    provenance = recipe.identity | {"id": recipe.id}
    write_calibration(path, Calibration((640, 480), GRID, 15.0, None), [], {}, provenance, "x")
    assert up_to_date(path, recipe)
    assert up_to_date(path, recipe, force=True)
    assert not up_to_date(path, other, force=True)
    with pytest.raises(InputError, match="parameters.gel is cut in the file, closed"):
        up_to_date(path, other)
    for content in ("", "{}", "[]", '{"provenance": {}}', '{"provenance": {"id": 3}}', json.dumps(GOOD)):
        path.write_text(content)
        assert not up_to_date(path, recipe, force=True)
        with pytest.raises(InputError, match="not a calibration made by evetac"):
            up_to_date(path, recipe)
    with pytest.raises(InputError, match="is a folder"):
        up_to_date(tmp_path, recipe, force=True)


FAULTS: dict[str, dict[str, Any]] = {
    "frame_px": {"frame_px": [640, 480, 3]},
    "frame_px, with a fraction": {"frame_px": [640.7, 480]},
    "radius_px": {"radius_px": True},
    "radius_px, beyond the frame": {"radius_px": 700},
    "radius_px, left out": {"radius_px": ...},
    "NaN": {"radius_px": float("nan")},
    "window_px": {"window_px": [540, 0, 641, 480]},
    "contrast_over_threshold": {"contrast_over_threshold": 1e-300},
    "rows": {"rows": 4, "columns": 3},
    "hot_pixels": {"hot_pixels": [[640, 0]]},
    "hot_pixels, twice": {"hot_pixels": [[1, 2], [1, 2]]},
    "mask": {"mask": [[True] * 4] * 2},
    "missing": {"mask": [[False] * 4] * 3},
    "not a calibration: expected (dots, 2)": {"dot_xy_px": []},
    "rows from top to bottom": {"dot_xy_px": GRID[::-1].tolist()},
    "unequal": {"dot_xy_px": FLAT[1:]},
    "a dot is outside": {"dot_xy_px": (GRID - 51).reshape(-1, 2).tolist()},
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(tmp_path: Path, name: str) -> None:
    """Assert that a faulty calibration is refused with its file and the key that is wrong."""
    with pytest.raises(InputError) as refused:
        read(tmp_path, {**GOOD, **FAULTS[name]})
    message = str(refused.value)
    assert message.startswith(f"{tmp_path / 'grid.json'}: ")
    assert name.partition(",")[0] in message


@pytest.mark.parametrize("text", ["", json.dumps(GOOD)[:-1], "[" * 100_000, "3", "null"])
def test_text_that_is_no_calibration(tmp_path: Path, text: str) -> None:
    """Assert that it is refused."""
    with pytest.raises(InputError, match="not a calibration"):
        read(tmp_path, text)


def test_digest_is_of_the_grid(tmp_path: Path) -> None:
    """Assert that the digest does not depend on the order of dots, and changes with dot, radius, window and shape."""
    base = read(tmp_path, GOOD).digest()
    assert read(tmp_path, {**GOOD, "dot_xy_px": FLAT[::-1], "more": 1}).digest() == base
    moved = [[50.0, 40.001], *FLAT[1:]]
    others = [
        read(tmp_path, {**GOOD, "dot_xy_px": moved}).digest(),
        read(tmp_path, {**GOOD, "radius_px": 20.6}).digest(),
        read(tmp_path, {**GOOD, "window_px": [540, 0, 640, 480]}).digest(),
        Calibration((640, 480), GRID.reshape(4, 3, 2), 20.5, None).digest(),
    ]
    assert len({base, *others}) == 5
