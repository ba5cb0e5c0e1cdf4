"""Names of a table's columns: which are times, which brackets are a unit, and which an index."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evetac_cli.errors import InputError
from evetac_cli.formats.read.read_table import read_table
from evetac_cli.formats.read.table_names import name_and_unit

pa = pytest.importorskip("pyarrow")
import pyarrow.parquet as pq  # noqa: E402  (not installed everywhere)

ROWS = 20


def by_csv(folder: Path, columns: dict[str, Any]) -> Any:
    path = folder / "a.csv"
    rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return read_table(path, None)


def by_parquet(folder: Path, columns: dict[str, Any]) -> Any:
    pq.write_table(pa.table(columns), folder / "a.parquet")
    return read_table(folder / "a.parquet", None)


@pytest.mark.parametrize("times", [{"t_s": 0.01}, {"header.stamp.sec": 1, "header.stamp.nanosec": 10_000_000}])
def test_columns_are_found_by_name_in_every_order(tmp_path: Path, times: dict[str, float]) -> None:
    """Assert that CSV and Parquet give each column its own values, wherever the times are in the table."""
    row = np.arange(ROWS)
    steps = {name: step * row for name, step in times.items()}
    columns = {"fx": row / 1000, "fy": 500.0 + row, **steps}
    expected_us = [10_000 * at for at in range(ROWS)] if len(times) == 1 else [1_010_000 * at for at in range(ROWS)]
    for order in itertools.permutations(columns):
        for read in (by_csv, by_parquet):
            stream, _ = read(tmp_path, {name: columns[name] for name in order})
            assert stream.t_us.tolist() == expected_us
            assert sorted(stream.columns) == ["fx", "fy"]
            assert stream.columns["fx"].tolist() == columns["fx"].tolist()
            assert stream.columns["fy"].tolist() == columns["fy"].tolist()


@pytest.mark.parametrize(
    "kind", ["timestamp[ns]", "timestamp[us, tz=UTC]", "duration[ns]", "duration[ms]", "time64[us]"]
)
@pytest.mark.parametrize("name", ["timestamp", "__index_level_0__"])
def test_a_type_of_times_states_its_unit(tmp_path: Path, kind: str, name: str) -> None:
    """Assert that dates, durations and times of day are read in their unit, also as the last column of pandas."""
    ticks = {"ns": 10**9, "us": 10**6, "ms": 10**3}[kind.split("[")[1][:2]] // 100
    type_ = pa.timestamp("us", "UTC") if "tz" in kind else pa.type_for_alias(kind)
    stream, _ = by_parquet(
        tmp_path, {"fx": np.arange(5) / 8, name: pa.array([at * ticks for at in range(5)], pa.int64()).cast(type_)}
    )
    assert stream.t_us.tolist() == [10_000 * at for at in range(5)]
    assert stream.columns["fx"].tolist() == [0.0, 0.125, 0.25, 0.375, 0.5]
    assert stream.clock == f"column {name}, whose type states its unit"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("q[0]", ("q_0", "")),
        ("q(12)", ("q_12", "")),
        ("pose[0][1]", ("pose_0_1", "")),
        ("pose[0, 1]", ("pose_0_1", "")),
        ("joint[2].effort", ("joint_2.effort", "")),
        ("q[0] [rad]", ("q_0", "rad")),
        ("tau_nm[3]", ("tau_nm_3", "N m")),
        ("force[x]", ("force_x", "")),
        ("force [N]", ("force", "N")),
        ("Force, z [N]", ("Force, z", "N")),
        ("power (W)", ("power", "W")),
        ("rate [1/s]", ("rate", "1/s")),
        ("acceleration [m/s2]", ("acceleration", "m/s2")),
        ("x_mm", ("x_mm", "mm")),
    ],
)
def test_a_number_in_brackets_is_an_index(name: str, expected: tuple[str, str]) -> None:
    """Assert that an index stays in the name and is no unit, and that units with a number in them stay units."""
    assert name_and_unit(name) == expected


@pytest.mark.parametrize(
    ("names", "chosen", "others"),
    [
        (("%time", "field.header.stamp"), 1, "%time"),
        (("header.stamp", "%time"), 0, "%time"),
        (("__time", "/joints/header/stamp"), 1, "__time"),
        (("__time", "/a/header/stamp", "/b/header/stamp"), 0, "s /a/header/stamp, /b/header/stamp"),
        (("log_time", "timestamp"), 1, "log_time"),
        (("time", "timestamp"), 0, "timestamp"),
        (("time", "t_s"), 1, "time"),
        (("rosbagTimestamp", "time (s)"), 1, "rosbagTimestamp"),
        (("time", "header.stamp.nanosec", "header.stamp.sec"), 2, "time"),
    ],
)
def test_the_choice_between_two_times_is_said(tmp_path: Path, names: tuple[str, ...], chosen: int, others: str) -> None:
    """Assert that a unit goes before a stamp, a stamp before another time, reception comes last, and a note says so."""
    columns: dict[str, Any] = {
        name: [1_700_000_000 + at + row / 4 for row in range(3)] for at, name in enumerate(names)
    }
    if "header.stamp.sec" in columns:
        columns |= {"header.stamp.sec": [1_700_000_002] * 3, "header.stamp.nanosec": [0, 1, 2]}
    columns["x"] = [1.0, 2.0, 3.0]
    stream, notes = by_parquet(tmp_path, columns)
    assert stream.t_us[0] == (1_700_000_000 + chosen) * 10**6
    column = "column" if others.startswith("s ") else "column "
    assert notes == [f"other times, which were not used: {column}{others}"]


@pytest.mark.parametrize("stamp", [("header.stamp",), ("header.stamp.sec", "header.stamp.nanosec")])
def test_a_stamp_that_was_never_set_is_refused(tmp_path: Path, stamp: tuple[str, ...]) -> None:
    """Assert that times that are 0 in all rows are refused with the name of other times, but not if in one."""
    received = [1_700_000_000_000_000_000 + at * 10_000_000 for at in range(ROWS)]
    zero = dict.fromkeys(stamp, [0] * ROWS)
    columns = {**zero, "log_time": received, "x": list(range(ROWS))}
    with pytest.raises(InputError, match=r"never set(.|\n)*log_time" if len(stamp) > 1 else "unit of time is unclear"):
        by_csv(tmp_path, columns)
    if len(stamp) > 1:
        once = {stamp[0]: [*[0] * (ROWS - 1), 1_700_000_000]}
        assert by_parquet(tmp_path, columns | once)[0].t_us[0] == 0
