"""share: tables beside the files, which pandas, duckdb and polars read, and the splits and limits that cards tell."""

import re
import shutil
import sys
from pathlib import Path
from typing import Any

import duckdb
import h5py
import numpy as np
import pandas as pd
import pytest

from evetac_cli.commands.share import Share
from evetac_cli.errors import InputError
from evetac_cli.formats.write import write_table
from evetac_cli.inspect import share
from evetac_cli.inspect.share.sections import NOT_LIKE
from tests import small_files
from tests.formats.trials import write_grasp
from tests.inspect.test_share import fields, shared
from tests.small_files import DOTS, SLICES

pytest.importorskip("pyarrow")
import pyarrow.parquet as pq

TRIALS = {"learn/a": (8, 1), "unseen/b": (3, 2)}  # name -> object, seed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two whole trials, one to learn from, and one with an object that only the test has."""
    folder = tmp_path_factory.mktemp("shared") / "data"
    folder.mkdir()
    for name, (object_, seed) in TRIALS.items():
        write_grasp(folder / Path(name).parent, Path(name).name, object_, seed)
    return folder


@pytest.fixture(scope="module")
def hub(folder: Path) -> Path:
    """It as share lays it out."""
    out = folder.with_name("hub")
    shared(folder, out=out, author="Noether, Emmy")
    return out


def files_of(hub: Path) -> dict[str, list[str]]:
    """The files of each split, as the patterns of the card find them."""
    (config,) = fields(hub)["configs"]
    return {one["split"]: sorted(map(str, hub.glob(one["path"]))) for one in config["data_files"]}


def stored(folder: Path, name: str, kind: str, dataset: str) -> Any:
    with h5py.File(folder / f"{name}.{kind}.h5") as file:
        return file[dataset][()]


def test_pandas_duckdb_and_polars_read_a_shared_folder(folder: Path, hub: Path) -> None:
    """Assert that each of the three finds the numbers of the files in tables that are alike, one file per trial."""
    import polars as pl  # of the extra `dev`

    found = files_of(hub)
    assert list(found) == ["train", "test"]
    assert sorted(sum(found.values(), [])) == sorted(str(path) for path in hub.rglob("*.parquet"))
    schemas = [pq.read_schema(file) for files in found.values() for file in files]
    assert len(schemas) == 2 and schemas[0].equals(schemas[1])
    assert {str(field.type) for field in schemas[0]} <= {"bool", "string", "int8", "uint8", "int32", "int64", "float",
                                                         "double"}  # fmt: skip
    assert {"touch_normal_n", "gripper_position_ticks", "label", f"dot_{DOTS - 1}_x_px"} <= set(schemas[0].names)
    assert "viewer" not in fields(hub)
    forces = {name: stored(folder, name, "recording", "truth/normal_force_n") for name in TRIALS}
    dots = {name: stored(folder, name, "tracks", "dot_xy_px")[:, 7, 0] for name in TRIALS}
    joined = pd.concat(pd.read_parquet(hub / "tables" / split) for split in found)
    lazy = pl.scan_parquet(f"{hub}/tables/*/*.parquet").sort("trial", "t_ms").collect()
    for name in TRIALS:
        one = joined[joined["trial"] == name].sort_values("t_ms")
        np.testing.assert_array_equal(one["truth_normal_force_n"], forces[name])
        np.testing.assert_array_equal(one["dot_07_x_px"], dots[name])
        np.testing.assert_array_equal(lazy.filter(pl.col("trial") == name)["dot_07_x_px"].to_numpy(), dots[name])
    rows = duckdb.sql(f"""
        SELECT trial, object, seed, count(*), sum(truth_normal_force_n) FROM '{hub}/tables/*/*.parquet'
        GROUP BY ALL ORDER BY 1
    """).fetchall()
    assert [row[:4] for row in rows] == [(name, *facts, SLICES) for name, facts in TRIALS.items()]
    assert [row[4] for row in rows] == pytest.approx([forces[name].sum(dtype=float) for name in TRIALS])


def test_without_splits_all_is_train(folder: Path, tmp_path: Path) -> None:
    """Assert that a flat folder has the one split, also for two trials of a name, and a card that says so."""
    flat = tmp_path / "flat"
    (flat / "x").mkdir(parents=True)
    for path in (folder / "learn").iterdir():
        shutil.copy(path, flat)
        shutil.copy(path, flat / "x")
    shared(flat, out=tmp_path / "hub")
    files = files_of(tmp_path / "hub")
    assert {split: [Path(name).name for name in names] for split, names in files.items()} == {
        "train": ["a.parquet", "x__a.parquet"]
    }
    assert sorted(pd.read_parquet(tmp_path / "hub" / "tables" / "train")["trial"].unique()) == ["a", "x/a"]
    assert "not split into training and test data" in (tmp_path / "hub" / "README.md").read_text()


def test_without_pyarrow_there_are_no_tables(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the files are shared all the same, with the command that installs it, and no viewer is promised."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result = share.run([folder], Share(), tmp_path / "hub")
    assert "tables need pyarrow" in result.summary["notes"] and "[convert]" in result.summary["notes"]
    assert not (tmp_path / "hub" / "tables").exists() and (tmp_path / "hub" / "data" / "learn").is_dir()
    assert fields(tmp_path / "hub")["viewer"] is False and "configs" not in fields(tmp_path / "hub")
    assert "Parquet" not in (tmp_path / "hub" / "README.md").read_text()


def test_nothing_is_left_of_tables_that_fail(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a disk that is full while tables are written leaves no folder."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(write_table, "write_rows", full)
    with pytest.raises(InputError, match="No space left"):
        shared(folder, out=tmp_path / "hub")
    assert list(tmp_path.iterdir()) == []


def test_limitations_are_those_of_the_files(folder: Path, hub: Path, tmp_path: Path) -> None:
    """Assert that a card says what is simulated, covered, held out, estimated and lost, and warns of a shared trial."""
    page = (hub / "README.md").read_text()
    assert "All trials are simulated" in page
    assert "2 trials: 1 sensor, 2 objects, 1 scene. The data cannot show" in page
    assert "`test` has objects that are not in `train` (3)." in page
    assert "Estimated, not measured: `dot_*_px`" in page and "by method: truth 2)" in page
    assert "2 recordings lost slices" in page
    assert all(f"`{name}`" in page for name in NOT_LIKE)
    copied = tmp_path / "data"
    shutil.copytree(folder, copied)
    for path in (copied / "learn").iterdir():
        shutil.copy(path, copied / "unseen")
    shared(copied, out=tmp_path / "hub")
    assert "**1 recording is in two splits.**" in (tmp_path / "hub" / "README.md").read_text()
    real = tmp_path / "real"
    real.mkdir()
    small_files.recording_of(real / "a.recording.h5", [1, 2, 3])
    shared(real, out=tmp_path / "real-hub")
    page = (tmp_path / "real-hub" / "README.md").read_text()
    assert "no trial is simulated" in page and "known to differ" not in page and "truth_" not in page


def test_what_is_off_is_what_the_page_says() -> None:
    """Assert that the facts that a card names are those that docs/evidence/likeness.md lists as off."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "evidence" / "likeness.md").read_text()
    listed = next(match[0] for match in re.finditer(r"(?:^- `[\w-]+`: .*\n)+", page, re.MULTILINE))
    assert [line.split("`")[1] for line in listed.splitlines()] == list(NOT_LIKE)
