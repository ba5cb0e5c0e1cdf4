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
from evetac_cli.errors import InputError, MissingLibrary
from evetac_cli.formats.write import hub_tables
from evetac_cli.inspect import share
from evetac_cli.inspect.share.sections import NOT_LIKE
from tests import small_files
from tests.formats.trials import write_grasp
from tests.inspect.test_share import fields, shared
from tests.small_files import DOTS, EVENTS_A_SLICE, SLICES

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
    """It as share lays it out, with events."""
    out = folder.with_name("hub")
    shared(folder, out=out, tables="events", author="Noether, Emmy")
    return out


def files_of(hub: Path, name: str) -> dict[str, list[str]]:
    """The files of each split of a table, as the patterns of the card find them."""
    (config,) = [one for one in fields(hub)["configs"] if one["config_name"] == name]
    return {one["split"]: sorted(map(str, hub.glob(one["path"]))) for one in config["data_files"]}


def stored(folder: Path, name: str, kind: str, dataset: str) -> Any:
    with h5py.File(folder / f"{name}.{kind}.h5") as file:
        return file[dataset][()]


def test_configs_name_all_files_of_all_tables(hub: Path) -> None:
    """Assert that each table is a configuration with both splits, whose patterns find each of its files once."""
    given = fields(hub)
    assert [one["config_name"] for one in given["configs"]] == ["trials", "slices", "dots", "events"]
    assert [one["config_name"] for one in given["configs"] if one.get("default")] == ["trials"]
    found = [files_of(hub, one["config_name"]) for one in given["configs"]]
    assert all(list(one) == ["train", "test"] and all(len(files) == 1 for files in one.values()) for one in found)
    every = sorted(str(path) for path in hub.rglob("*.parquet"))
    assert sorted(file for one in found for files in one.values() for file in files) == every
    assert given["size_categories"] == ["n<1K"] and "viewer" not in given


def test_pandas_duckdb_and_polars_read_a_shared_folder(folder: Path, hub: Path) -> None:
    """Assert that each of the three reads every table, joins them, and finds the numbers of the files."""
    import polars as pl  # of the extra `dev`

    forces = {name: stored(folder, name, "recording", "truth/normal_force_n") for name in TRIALS}
    dots = {name: stored(folder, name, "tracks", "dot_xy_px")[:, 7, 0] for name in TRIALS}
    joined = pd.concat(map(pd.read_parquet, sum(files_of(hub, "slices").values(), []))).merge(
        pd.concat(map(pd.read_parquet, sum(files_of(hub, "dots").values(), []))),
        on=["trial", "t_ms"],
        suffixes=("", "_2"),
    )
    for name in TRIALS:
        one = joined[joined["trial"] == name].sort_values("t_ms")
        np.testing.assert_array_equal(one["truth_normal_force_n"], forces[name])
        np.testing.assert_array_equal(one["dot_07_x_px"], dots[name])

    rows = duckdb.sql(f"""
        SELECT t.trial, t.split, t.object, t.seed, t.slices, t.events, sum(s.truth_normal_force_n), first(s.recording)
        FROM '{hub}/tables/trials/*.parquet' t
        JOIN (SELECT *, 'x' AS recording FROM '{hub}/tables/slices/*/*.parquet') s USING (trial) GROUP BY ALL ORDER BY 1
    """).fetchall()
    events = SLICES * EVENTS_A_SLICE
    expected = [("learn/a", "train", 8, 1, SLICES, events), ("unseen/b", "test", 3, 2, SLICES, events)]
    assert [row[:6] for row in rows] == expected
    assert [row[6] for row in rows] == pytest.approx([forces[name].sum(dtype=float) for name in TRIALS])

    lazy = pl.scan_parquet(f"{hub}/tables/events/*/*.parquet").sort("trial", "t_us", maintain_order=True).collect()
    for name in TRIALS:
        one = lazy.filter(pl.col("trial") == name)
        np.testing.assert_array_equal(one["x"].to_numpy(), stored(folder, name, "recording", "events/x"))
        np.testing.assert_array_equal(one["t_us"].to_numpy(), stored(folder, name, "recording", "events/t"))
    assert pl.read_parquet(f"{hub}/tables/dots/train/*.parquet")["dot_07_x_px"].to_list() == dots["learn/a"].tolist()


def test_tables_are_plain(hub: Path) -> None:
    """Assert that columns are numbers, truth values and text with units, alike in all files, and dots stand apart."""
    for name in ("trials", "slices", "dots", "events"):
        schemas = [pq.read_schema(file) for files in files_of(hub, name).values() for file in files]
        assert all(one.equals(schemas[0]) for one in schemas)
        types = {str(field.type) for field in schemas[0]}
        assert types <= {"bool", "string", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
                         "float", "double"}  # fmt: skip
        assert all(field.metadata[b"units"] and field.metadata[b"long_name"] for field in schemas[0])
        groups = [pq.read_metadata(file).num_row_groups for files in files_of(hub, name).values() for file in files]
        assert groups == [1, 1]
    slices, dots = (set(pq.read_schema(files_of(hub, name)["train"][0]).names) for name in ("slices", "dots"))
    assert slices & dots == {"t_ms", "trial", "object", "sensor", "seed", "outcome", "simulated"}
    assert {"touch_normal_n", "gripper_position_ticks", "label"} <= slices
    assert {f"dot_{DOTS - 1}_x_px", "truth_dot_00_y_px", "lost_00", "displacement_05_px"} <= dots


def test_without_splits_all_is_train_and_events_are_left_out(folder: Path, tmp_path: Path) -> None:
    """Assert that a flat folder has the one split, no table of events, and a card that says so; two of a name too."""
    flat = tmp_path / "flat"
    (flat / "x").mkdir(parents=True)
    for path in (folder / "learn").iterdir():
        shutil.copy(path, flat / path.name.replace("a.", "x-a."))
        shutil.copy(path, flat / "x" / path.name)
    shared(flat, out=tmp_path / "hub")
    assert {name: list(files_of(tmp_path / "hub", name)) for name in ("trials", "slices", "dots")} == dict.fromkeys(
        ("trials", "slices", "dots"), ["train"]
    )
    assert not (tmp_path / "hub" / "tables" / "events").exists()
    assert sorted(path.name for path in (tmp_path / "hub" / "tables" / "slices" / "train").iterdir()) == [
        "x-a-2.parquet", "x-a.parquet",
    ]  # fmt: skip
    named = pd.read_parquet(tmp_path / "hub" / "tables" / "trials" / "train.parquet")
    assert sorted(named["trial"]) == ["x-a", "x/a"]
    assert all((tmp_path / "hub" / recording).is_file() for recording in named["recording"])
    assert "not split into training and test data" in (tmp_path / "hub" / "README.md").read_text()


def test_without_pyarrow_there_are_no_tables(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that the files are shared all the same, which is said with the command that installs it, and no viewer is
    promised; and that events, which were asked for, are refused.
    """  # fmt: skip
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result = share.run([folder], Share(), tmp_path / "hub")
    assert "tables need pyarrow" in result.summary["notes"] and "[convert]" in result.summary["notes"]
    assert not (tmp_path / "hub" / "tables").exists() and (tmp_path / "hub" / "data" / "learn").is_dir()
    assert fields(tmp_path / "hub")["viewer"] is False and "configs" not in fields(tmp_path / "hub")
    assert "Parquet" not in (tmp_path / "hub" / "README.md").read_text()
    with pytest.raises(MissingLibrary, match="tables need pyarrow"):
        shared(folder, out=tmp_path / "events", tables="events")
    assert not (tmp_path / "events").exists()


def test_nothing_is_left_of_tables_that_fail(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that a disk that is full while tables are written leaves no folder."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(hub_tables, "write_rows", full)
    with pytest.raises(InputError, match="No space left"):
        shared(folder, out=tmp_path / "hub")
    assert list(tmp_path.iterdir()) == []


def test_limitations_are_those_of_the_files(folder: Path, hub: Path, tmp_path: Path) -> None:
    """Assert that a card says what is simulated, covered, held out, estimated and lost, and warns of a shared trial."""
    page = (hub / "README.md").read_text()
    assert "All trials are simulated" in page
    assert "2 trials: 1 sensor, 2 objects, 1 scene. The data cannot show" in page
    assert "`test` has objects that are not in `train` (3) and only sensors that are also in `train`." in page
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
    assert "dots" not in [one["config_name"] for one in fields(tmp_path / "real-hub")["configs"]]


def test_what_is_off_is_what_the_page_says() -> None:
    """Assert that the facts that a card names are those that docs/likeness.md lists as off."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "likeness.md").read_text()
    listed = next(match[0] for match in re.finditer(r"(?:^- `[\w-]+`: .*\n)+", page, re.MULTILINE))
    assert [line.split("`")[1] for line in listed.splitlines()] == list(NOT_LIKE)
