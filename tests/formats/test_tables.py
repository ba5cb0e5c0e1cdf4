"""Tables of trials: pandas and duckdb read of them what the files hold, with units, times and where it comes from."""

import csv
import json
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest

from evetac_cli.formats.exports import export, export_folder, target_path
from evetac_cli.formats.write import slice_columns, write_table
from evetac_cli.inspect.export import trial_files
from evetac_cli.stages.slip_detectors import load_detector, read_series
from evetac_cli.store.files import StageFile, write_stage
from evetac_cli.store.layout.provenance import Recipe
from evetac_cli.store.layout.schema import load
from tests import small_files
from tests.conftest import Made
from tests.formats.trials import write_grasp
from tests.quick import few
from tests.small_files import EVENTS_A_SLICE, SLICES

pytest.importorskip("pyarrow")
duckdb = pytest.importorskip("duckdb")
import pyarrow.parquet as pq  # noqa: E402  (not installed everywhere)

# Column -> kind, dataset and, of each row, which of its values.
COLUMNS: dict[str, tuple[str, str, Any]] = {
    "truth_normal_force_n": ("recording", "truth/normal_force_n", ()),
    "truth_shear_force_y_n": ("recording", "truth/shear_force_n", 1),
    "truth_dot_07_x_px": ("recording", "truth/dot_xy_px", (7, 0)),
    "control_probability": ("recording", "control/probability", ()),
    "dot_11_y_px": ("tracks", "dot_xy_px", (11, 1)),
    "events_per_dot_03": ("tracks", "events_per_dot", 3),
    "lost_00": ("tracks", "lost", 0),
    "label": ("labels", "label", ()),
    "relative_flow_px": ("labels", "relative_flow_px", ()),
    "displacement_05_px": ("features", "displacement_px", 5),
    "displacement_05_x_px": ("features", "displacement_xy_px", (5, 0)),
    "events_outside": ("features", "events_outside", ()),
    "touch_shear_x_n": ("touch", "shear_n", 0),
    "touch_shear_sd_y_n": ("touch", "shear_sd_n", 1),
    "touch_normal_n": ("touch", "normal_n", ()),
    "touch_torsion_n_mm": ("touch", "torsion_n_mm", ()),
    "touch_centre_x_mm": ("touch", "centre_mm", 0),
    "touch_sticking_share": ("touch", "sticking_share", ()),
}


def stored(recording: Path, kind: str, dataset: str, value: Any) -> Any:
    with h5py.File(recording.with_name(recording.name.replace(".recording.", f".{kind}."))) as h5:
        values = h5[dataset][()]
    places = value if isinstance(value, tuple) else (value,)
    return values[(slice(None), *places)]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial with a file of every kind."""
    return write_grasp(tmp_path_factory.mktemp("tables"), "a")


@pytest.fixture(scope="module")
def table(source: Path) -> Path:
    """It as Parquet."""
    target = source.with_name("a.parquet")
    row = export(source, "parquet", target, opened=trial_files)
    assert (row["slices"], row["events"], row["simulated"]) == (SLICES, None, True)
    assert row["left_out"] == "images of streams/wrist"
    return target


@pytest.mark.parametrize("column", COLUMNS)
def test_values_are_those_of_the_files(source: Path, table: Path, column: str) -> None:
    """Assert that pandas and duckdb read every value of a column as it is stored, and NaN as unknown."""
    expected = stored(source, *COLUMNS[column])
    frame = pd.read_parquet(table, columns=["t_ms", column])
    assert frame["t_ms"].tolist() == list(range(SLICES))
    np.testing.assert_array_equal(frame[column].to_numpy(expected.dtype), expected)
    rows = duckdb.sql(f"SELECT {column} FROM '{table}' ORDER BY t_ms").fetchall()
    known = ~np.isnan(expected)
    assert [value is not None for (value,) in rows] == known.tolist()
    np.testing.assert_array_equal([value for (value,) in rows if value is not None], expected[known])


def test_every_dataset_with_slices_is_there(source: Path, table: Path) -> None:
    """Assert that no dataset with a row a slice, or of a clock, is forgotten, and none has two columns of a name."""
    names = pq.read_schema(table).names
    assert len(set(names)) == len(names)
    missing = []
    for kind in slice_columns.KINDS:
        with StageFile(source.with_name(f"a.{kind}.h5")) as file:
            for row in load(kind).datasets:
                along = row.dims[0] if row.dims else ""
                wanted = row.path in file.contents() and along in ("slices", "commands", "control_steps")
                ending = f"_{row.unit.lower()}" if row.unit else ""
                stem = row.path.replace("/", "_").removesuffix(ending).removesuffix("_xy")
                if wanted and not any(stem in name for name in names):
                    missing.append(row.path)
    assert missing == []
    assert "visible_slip_share" not in names and "truth_visible_slip_share" in names


def test_rows_of_a_clock_stand_until_the_next(tmp_path: Path) -> None:
    """Assert that a slice has the last row before its end with its time, none before the first, and losses are said."""
    t_us = np.array([1999, 2000, 5000, 5400, *range(6000, 14000, 1000)], np.int64)
    path = write_grasp(tmp_path, "a", gripper__t_us=t_us)
    target = tmp_path / "a.parquet"
    row = export(path, "parquet", target, opened=trial_files)
    frame = pd.read_parquet(target)
    position = stored(path, "recording", "gripper/position_ticks", ())
    expected = [np.nan, 0, 1, 1, 1, 3, *range(4, 12), *[11] * 10]
    for at, index in enumerate(expected):
        shown = frame["gripper_t_us"][at], frame["gripper_position_ticks"][at]
        if np.isnan(index):
            assert np.isnan(shown).all()
        else:
            assert shown == (t_us[index], position[index])
    assert "1 of 12 rows of gripper: 1 because a later row of the same slice is shown" in row["left_out"]
    assert "after the end" not in row["left_out"]
    every = frame.drop_duplicates("control_t_us")
    assert every["control_goal_ticks"].tolist() == stored(path, "recording", "control/goal_ticks", ()).tolist()


def test_columns_say_their_unit_and_where_they_come_from(source: Path, table: Path) -> None:
    """Assert units and long names of the schema in the columns, and the headers and the word simulated in the file."""
    schema = pq.read_schema(table)
    units = {"truth_normal_force_n": "N", "dot_11_y_px": "px", "gripper_current_ma": "mA", "label": "1", "t_ms": "ms"}
    assert {name: schema.field(name).metadata[b"units"].decode() for name in units} == units
    meaning = schema.field("dot_11_y_px").metadata[b"long_name"].decode()
    assert meaning == "dot centres at the end of the slice, row-major over the grid, dot 11 (row 2, column 3), y"
    said = json.loads(schema.metadata[b"evetac"])
    assert (said["simulated"], said["object"], said["seed"], said["outcome"]) == (True, 8, 1, "slips")
    assert sorted(said["headers"]) == sorted(slice_columns.KINDS)
    with StageFile(source) as file:
        assert said["headers"]["recording"]["id"] == file.header["id"]
    frame = pd.read_parquet(table)
    assert frame["simulated"].all() and set(frame["trial"]) == {"a"}
    assert frame["events_total"].tolist() == [EVENTS_A_SLICE] * SLICES


@pytest.mark.slow
def test_other_streams_stand_beside(tmp_path: Path) -> None:
    """Assert that columns of a stream have its unit and its last sample, and that images are left out."""
    about = json.dumps({"what": "probe", "units": {"force": "N", "height_mm": "mm"}})
    t_us = np.array([-500, 2500, 2600, 90_000], np.int64)
    columns = {"t_us": t_us, "about": about, "force": np.array([1.5, 2.5, np.nan, 4.5]), "height_mm": np.arange(4.0)}
    more: dict[str, Any] = {f"streams__probe__{name}": values for name, values in columns.items()}
    path = write_grasp(tmp_path, "a", **more, streams__probe__frames=np.zeros((4, 2, 3, 1), np.uint8))
    target = tmp_path / "a.parquet"
    row = export(path, "parquet", target, opened=trial_files)
    why = "1 because a later row of the same slice is shown, 1 after the end of the last slice"
    assert f"2 of 4 rows of streams/probe: {why}" in row["left_out"]
    frame = pd.read_parquet(target)
    assert frame["streams_probe_height_mm"].tolist() == [0.0, 0.0, *[2.0] * (SLICES - 2)]
    assert frame["streams_probe_force"][:2].tolist() == [1.5, 1.5] and frame["streams_probe_force"][2:].isna().all()
    schema = pq.read_schema(target)
    assert [name for name in schema.names if "frames" in name or "about" in name] == []
    units = [schema.field(f"streams_probe_{name}").metadata[b"units"] for name in ("force", "height_mm", "t_us")]
    assert units == [b"N", b"mm", b"us"]


def test_csv_has_the_same_numbers(source: Path, table: Path) -> None:
    """Assert that the text holds every column of the Parquet file with equal values, and unknown ones as nothing."""
    target = target_path(source, "csv", None)
    export(source, "csv", target, opened=trial_files)
    ours, text = pd.read_parquet(table), pd.read_csv(target)
    assert list(text) == list(ours)
    for name in ours:
        values = ours[name].to_numpy()
        if values.dtype.kind in "fiub":
            np.testing.assert_array_equal(text[name].to_numpy(values.dtype), values, name)
        else:
            assert text[name].tolist() == values.tolist()
    assert "nan" not in target.read_text()


FORMULAS = ("=cmd|' 'C'!A0", "=1+1", "+SUM(A1)", "-2+3", "@x", "\t=1", "\r=1", " =1", "\uff1d1", "-inf", "+", "=")


@pytest.mark.parametrize("text", few(FORMULAS, "=1+1", "@x", "\t=1", "\uff1d1"))
def test_no_text_of_a_csv_is_a_formula(text: str, tmp_path: Path) -> None:
    """Assert that names of trial, sensor and object that a spreadsheet would run stand behind an apostrophe."""
    name = text.replace("/", "-")
    path = tmp_path / f"{name}.recording.h5"
    small_files.recording(path)
    with StageFile(path) as file:
        arrays = {item: file.read(item) for item in file.contents()}
    parameters = {"sensor": text, "object": text}
    write_stage(path, Recipe("recording", 1, parameters, seed=-3, simulated_source=True), arrays, force=True)
    target = tmp_path / "out.csv"
    export(path, "csv", target)
    with target.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {(row["trial"], row["sensor"], row["object"], row["seed"]) for row in rows} == {
        (f"'{name}", f"'{text}", f"'{text}", "-3")
    }
    export(path, "parquet", tmp_path / "out.parquet")  # which no spreadsheet runs
    assert set(pq.read_table(tmp_path / "out.parquet")["sensor"].to_pylist()) == {text}


@pytest.mark.slow
def test_pieces_make_no_difference(source: Path, table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert the same table when a few slices are written at a time."""
    monkeypatch.setattr(write_table, "BATCH_BYTES", 7 * 8 * len(pq.read_schema(table)))
    target = tmp_path / "b.parquet"
    export(source, "parquet", target, opened=trial_files)
    assert pq.ParquetFile(target).metadata.num_row_groups == 4
    pd.testing.assert_frame_equal(pd.read_parquet(target), pd.read_parquet(table))


def test_a_folder_becomes_one_data_set(tmp_path: Path) -> None:
    """Assert that object, sensor, seed and outcome are columns, and what a trial lacks is null."""
    sources = [write_grasp(tmp_path / "in", "a", 8, 1), write_grasp(tmp_path / "in", "c", 3, 3, kinds="tracks")]
    out = tmp_path / "out"
    row = export_folder(sources, "parquet", out, {}, opened=trial_files)
    assert (row["recordings"], row["files"], row["slices"], row["simulated"]) == (2, 2, 2 * SLICES, True)
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*.parquet")) == [
        "object=3/sensor=evetac/c.parquet",
        "object=8/sensor=evetac/a.parquet",
    ]
    asked = "SELECT object, sensor, seed, outcome, count(*), count(label), count(truth_slip)"
    rows = duckdb.sql(f"{asked} FROM '{out}/*/*/*.parquet' GROUP BY ALL ORDER BY seed").fetchall()
    assert rows == [
        (8, "evetac", 1, "slips", SLICES, SLICES, SLICES),
        (3, "evetac", 3, None, SLICES, 0, SLICES),
    ]
    frame = pd.read_parquet(out)
    assert len(frame) == 2 * SLICES and {"object", "sensor"} <= set(frame)
    assert row["columns"] == frame.shape[1]
    for name, number in (("a", 8), ("c", 3)):
        part = frame[frame["trial"] == name]
        assert set(part["object"].astype(int)) == {number}
        forces = stored(tmp_path / "in" / f"{name}.recording.h5", "recording", "truth/normal_force_n", ())
        np.testing.assert_array_equal(part["truth_normal_force_n"], forces)


@pytest.mark.slow
def test_unknown_objects_and_odd_names_are_read(tmp_path: Path) -> None:
    """Assert that an object that is unknown is null in each reader, and a sensor keeps any name that it has."""
    import polars  # of the extra `dev`

    odd = "a b/ü=1"
    sources = [
        write_grasp(tmp_path / "in", "a", 8, 1, kinds="tracks"),
        write_grasp(tmp_path / "in", "b", None, 2, kinds="tracks", name_of_sensor=odd),
    ]
    export_folder(sources, "parquet", tmp_path / "out", {}, opened=trial_files)
    expected = [("a", 8, "evetac"), ("b", None, odd)]
    rows = duckdb.sql(f"SELECT DISTINCT trial, object, sensor FROM '{tmp_path}/out/**/*.parquet' ORDER BY trial")
    assert rows.fetchall() == expected
    lazy = polars.scan_parquet(tmp_path / "out", hive_partitioning=True).select("trial", "object", "sensor")
    assert lazy.unique().sort("trial").collect().rows() == expected
    frame = pd.read_parquet(tmp_path / "out", columns=["trial", "object", "sensor"])
    frame = frame.drop_duplicates().sort_values("trial")
    assert frame["sensor"].tolist() == ["evetac", odd]
    assert frame["object"].isna().tolist() == [False, True] and frame["object"].iloc[0] == 8


@pytest.mark.slow
def test_features_of_other_tracks_are_left_out(tmp_path: Path) -> None:
    """Assert that a table does not mix what was made from two sets of tracks, and says so."""
    path = write_grasp(tmp_path, "a")
    with StageFile(path) as file:
        header = file.header
    (tmp_path / "a.tracks.h5").unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(small_files, "TRACKER", {"preset": "paper", "constants": {}})
        small_files.tracks(tmp_path / "a.tracks.h5", header)
    row = export(path, "parquet", tmp_path / "a.parquet", opened=trial_files)
    assert "a.features.h5 was made from other tracks" in row["left_out"]
    names = pq.read_schema(tmp_path / "a.parquet").names
    assert "displacement_05_px" not in names and "touch_shear_x_n" not in names and "dot_05_x_px" in names


def test_an_empty_recording_is_an_empty_table(tmp_path: Path) -> None:
    """Assert that no slice is no row, and no error."""
    from tests.formats.test_exports import drawn, write

    path = write(tmp_path / "a.recording.h5", drawn(0), 0)
    for format_, read in (("parquet", pd.read_parquet), ("csv", pd.read_csv)):
        target = target_path(path, format_, None)
        export(path, format_, target, opened=trial_files)
        assert len(read(target)) == 0 and "events_total" in read(target)


@pytest.mark.slow
def test_a_model_adds_its_slip_probability(made: Made, tmp_path: Path) -> None:
    """Assert that the column is what the detector gives, empty before its history is full, with the model's header."""
    target = tmp_path / "a.parquet"
    export(made.recordings[0], "parquet", target, opened=partial(trial_files, model=made.model))
    shown = pd.read_parquet(target, columns=["model_probability"])["model_probability"].to_numpy()
    with StageFile(made.model) as model, StageFile(made.beside(made.recordings[0], "features")) as features:
        detector = load_detector(model)
        expected = detector.over(read_series(features, detector.architecture), 0)
        header = model.header
    np.testing.assert_array_equal(shown, expected)
    assert np.isnan(shown[0]) and np.isfinite(shown[-1])
    assert json.loads(pq.read_schema(target).metadata[b"evetac"])["headers"]["model"]["id"] == header["id"]
