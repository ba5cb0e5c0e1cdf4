"""docs/read-without-evetac.md: its readers run where evetac cannot be imported, and read what evetac reads."""

import json
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import evetac_cli as evetac
from evetac_cli.kernels.force.models import apply_network, apply_regression
from evetac_cli.kernels.slip.features import gel_image
from evetac_cli.resources import MODEL
from evetac_cli.stages.force.train_force import read_model
from evetac_cli.store.calibration import read_calibration
from evetac_cli.store.files import StageFile
from evetac_cli.store.layout import schema
from tests import small_files
from tests.formats.trials import write_grasp

PAGE = Path(__file__).resolve().parents[1] / "docs" / "read-without-evetac.md"
READERS = dict(
    re.findall(r"^## (.+?)\n(?:(?!^## ).*\n)*?^```python\n((?:.*\n)*?)^```$", PAGE.read_text(), re.MULTILINE)
)
MOST_LINES = 20
GRIPPER, ANY, IMAGE_OF = "recording: gripper, controller, truth", "Any file: what it is and where it comes from", 3
# Runs each reader in a namespace of its own, and keeps what numbers and texts it leaves.
RUN = f"""
import sys
for name in ("evetac_cli", "hdf5plugin"):
    sys.modules[name] = None
import json
import h5py
import numpy
before = set(sys.modules)

def kept(name, value):
    if isinstance(value, dict):
        return [pair for key, one in value.items() for pair in kept(f"{{name}}.{{key}}", one)]
    if isinstance(value, (numpy.ndarray, numpy.generic, str, float, int)):
        return [(name, numpy.array(value))]
    return []

for number, text in enumerate(json.load(sys.stdin)):
    names = {{}}
    exec(text, names)
    if callable(names.get("image")):
        names["image_of"] = names["image"]({IMAGE_OF})
    arrays = {{key: one for name, value in names.items() if name[0] != "_" for key, one in kept(name, value)}}
    numpy.savez(f"{{number}}.npz", **arrays)
roots = {{name.partition(".")[0] for name in set(sys.modules) - before}}
print("LOADED", sorted(roots - sys.stdlib_module_names))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of each kind with random values, and a dot grid."""
    folder = tmp_path_factory.mktemp("stranger")
    small_files.every_kind(folder)
    write_grasp(folder, "a")
    rng = np.random.default_rng(0)
    with h5py.File(folder / "a.force-model.h5", "r+") as file:
        for name in ("regression/slope_n_px", "regression/offset_n", *(f"network/{n}/weight" for n in range(3))):
            file[name][...] = rng.normal(size=file[name].shape)
    with h5py.File(folder / "a.tracks.h5", "r+") as file:
        file["lost"][3, 4] = 1
    grid = {"frame_px": [640, 480], "radius_px": 9.0, "dot_xy_px": small_files.GRID_PX.tolist()}
    (folder / "gel.json").write_text(json.dumps(grid))
    return folder


@pytest.fixture(scope="module")
def read(folder: Path) -> Mapping[str, Mapping[str, Any]]:
    """What each reader of the page left, by its heading: names and arrays."""
    command = [sys.executable, "-I", "-c", RUN]
    done = subprocess.run(
        command, input=json.dumps([*READERS.values()]), cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "LOADED []" in done.stdout
    return {heading: np.load(folder / f"{number}.npz") for number, heading in enumerate(READERS)}


def test_every_kind_has_a_short_reader() -> None:
    """Assert that each kind of file has a reader, none of which has twenty lines, and that h5py and numpy are all."""
    headings = [heading.partition(":")[0] for heading in READERS]
    assert set(schema.KINDS) <= set(headings)
    assert PAGE.read_text().count("```python") == len(READERS) == len(schema.KINDS) + 4
    for reader in READERS.values():
        assert len(reader.splitlines()) < MOST_LINES
        assert set(re.findall(r"^(?:import|from) (\w+)", reader, re.MULTILINE)) <= {"h5py", "numpy", "json"}


def same(found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def reader(read: Mapping[str, Any], kind: str) -> Mapping[str, Any]:
    return next(found for heading, found in read.items() if heading.startswith(f"{kind}:"))


def test_recordings_are_read(read: Mapping[str, Any], folder: Path) -> None:
    """Assert that events, dots at rest, gripper, controller and truth are those that evetac reads."""
    with evetac.open_recording(folder / "a.recording.h5") as recording:
        every = recording.between(0, len(recording))
        found = reader(read, "recording")
        same(found, {f"events.{name}": getattr(every, name) for name in "txyp"})
        same(found, {"starts": recording.starts, "dots_px": recording.dot_xy_px})
        same(found, {"t_us": recording[len(recording) - 1].t})
        assert (found["width"], found["height"]) == recording.frame_px
        found = read[GRIPPER]
        same(found, {f"gripper.{name}": recording.read(f"gripper/{name}") for name in ("t_us", "current_ma")})
        same(found, {f"control.{name}": recording.read(f"control/{name}") for name in ("goal_ticks", "phase")})
        same(found, {"slip": recording.read("truth/slip"), "force_n": recording.read("truth/normal_force_n")})
        stands = np.repeat(recording.read("gripper/position_ticks"), 2)  # a row every 2 ms
        same(found, {"position_ticks": stands})
        same(read["recording: marks"], {f"marked.{mark.text}": mark.t_us for mark in recording.marks})
        assert [mark.text for mark in recording.marks] == ["lifted"]


def test_what_was_computed_is_read(read: Mapping[str, Any], folder: Path) -> None:
    """Assert that tracks, labels, features and touch are those that evetac reads."""
    with evetac.open_tracks(folder / "a.tracks.h5") as file:
        moved = file.read("dot_xy_px") - file.read("sensor/dot_xy_px").reshape(-1, 2)
        moved[file.read("lost") == 1] = np.nan
        same(reader(read, "tracks"), {"dot_xy_px": file.read("dot_xy_px"), "displacement_px": moved})
        assert np.isnan(moved).sum() == 2
    with evetac.open_labels(folder / "a.labels.h5") as file:
        same(reader(read, "labels"), {"label": file.read("label"), "onset_ms": file.read("onset_slice")})
    with evetac.open_features(folder / "a.features.h5") as file:
        found = reader(read, "features")
        same(found, {"label": file.read("label"), "moved_px": file.read("displacement_xy_px").reshape(-1, 3, 4, 2)})
        x, y, p = np.array([0, 539], np.uint16), np.zeros(2, np.uint16), np.array([1, 0], np.uint8)
        blank = np.zeros((480, 540), np.int8)
        pixel, sign = gel_image(x, y, p, None, blank.copy())  # the very two pixels of small_files
        blank.reshape(-1)[pixel] = sign
        same(found, {"image_of": blank})
    with evetac.open_touch(folder / "a.touch.h5") as file:
        found = reader(read, "touch")
        same(found, {name: file.read(name) for name in ("shear_n", "normal_n", "normal_sd_n", "sticking_share")})
        same(found, {name: file.read(f"map/{name}") for name in ("pressure_pa", "shear_pa", "x_mm")})
        force_n = file.read("map/pressure_pa").sum(axis=(1, 2), dtype=float) * 1e-6  # cells of 1 mm
        np.testing.assert_allclose(found["force_n"], force_n, rtol=1e-6)


def test_models_and_reports_are_read(read: Mapping[str, Any], folder: Path) -> None:
    """Assert that weights, thresholds and rows are those that evetac reads, and forces those that it predicts."""
    with evetac.open_model(MODEL) as file:
        found = reader(read, "model")
        weights = [name for name in file.contents() if name.startswith("weights/")]
        same(found, {name.replace("/", ".", 1): file.read(name) for name in weights})
        same(found, {"threshold": file.read("threshold"), "architecture": file.read("architecture")})
        assert weights and len(found["rows"].shape) == 0
    with evetac.open_report(folder / "a.report.h5") as file:
        same(reader(read, "report"), {"command": file.read("command"), "summary.f1": 0.5})
    _, model = read_model(folder / "a.force-model.h5")
    with evetac.open_tracks(folder / "a.tracks.h5") as file:
        moved = file.read("dot_xy_px") - file.read("sensor/dot_xy_px").reshape(-1, 2)
    found = reader(read, "force-model")
    np.testing.assert_allclose(found["by_regression_n"], apply_regression(model.regression, moved), rtol=1e-9)
    np.testing.assert_allclose(found["by_network_n"], apply_network(model.network, moved), atol=1e-4)


def test_headers_and_grids_are_read(read: Mapping[str, Any], folder: Path) -> None:
    """Assert that a header says what evetac says of it, datasets have units, and a grid has the same dots."""
    with StageFile(folder / "a.features.h5") as file:
        found = read[ANY]
        assert (found["header.kind"], found["header.id"]) == (file.kind, file.header["id"])
        assert "events_per_dot [1]" not in found and set(file.contents()) >= {"displacement_px"}
    grid = read_calibration(folder / "gel.json")
    same(read["The dot grid: JSON"], {"dots_px": grid.dot_xy_px, "radius_px": grid.dot_radius_px})


def test_no_filter_needs_a_plugin(folder: Path) -> None:
    """Assert that datasets of all kinds are packed with gzip and shuffle alone, which every HDF5 has."""
    used = set()
    for path in (*folder.glob("*.h5"), MODEL):
        with h5py.File(path) as file:

            def look(_: str, item: Any) -> None:
                if isinstance(item, h5py.Dataset):
                    filters = item.id.get_create_plist()
                    used.update(filters.get_filter(number)[0] for number in range(filters.get_nfilters()))

            file.visititems(look)
    assert used == {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}
